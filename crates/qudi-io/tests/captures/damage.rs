//! Damaged, encrypted and contradictory files: refused, or said.

use crate::{counts, npy, open, plain, refusal, scene, scratch, write};
use qudi_core::{Frame, Size};
use qudi_io::capture::Capture;
use qudi_io::description::{Axes, MaskChoice, ReadOptions};
use std::io::{Cursor, Write};
use std::path::{Path, PathBuf};
use zip::write::SimpleFileOptions;

/// 20 frames of 32 x 64 counts of 0 and 1.
fn plain_npy() -> Vec<u8> {
    let data: Vec<u8> = scene(20, 32, 64, 3).iter().flatten().map(|&c| c as u8).collect();
    npy("|u1", "False", "(20, 32, 64)", &data)
}

/// Returns the error of reading all frames of a capture that opens.
fn reading_fails(path: &Path, options: &ReadOptions) -> String {
    let mut capture = open(path, options).unwrap();
    let mut one = vec![0; capture.size().pixels()];
    let read = (0..capture.frames()).try_for_each(|frame| capture.read(frame, &mut one));
    read.unwrap_err().to_string()
}

#[test]
fn rejects_gzip_whose_checksum_does_not_match() {
    let folder = scratch();
    let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::none());
    gzip.write_all(&plain_npy()).unwrap();
    let mut bytes = gzip.finish().unwrap();
    let sound = write(folder.path(), "sound.npy.gz", &bytes);
    assert_eq!(counts(&mut open(&sound, &plain()).unwrap()), scene(20, 32, 64, 3));
    bytes[5000] ^= 1;
    let path = write(folder.path(), "a.npy.gz", &bytes);
    let words = reading_fails(&path, &plain());
    assert!(words.contains("damaged"), "{words}");
    let lenient = ReadOptions { lenient: true, ..plain() };
    let noted = open(&path, &lenient).unwrap();
    assert!(noted.info().notes.iter().any(|note| note.contains("damaged")));
}

fn npz(folder: &Path, name: &str, method: zip::CompressionMethod) -> PathBuf {
    let mut archive = zip::ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(method);
    archive.start_file("a.npy", options).unwrap();
    archive.write_all(&plain_npy()).unwrap();
    write(folder, name, &archive.finish().unwrap().into_inner())
}

/// Changes a byte of the entry's data, or of both copies of its CRC-32 where the data are compressed.
fn damage_crc(path: &Path) {
    let mut bytes = std::fs::read(path).unwrap();
    let central = bytes.windows(4).rposition(|w| w == b"PK\x01\x02").unwrap();
    bytes[14] ^= 1;
    bytes[central + 16] ^= 1;
    std::fs::write(path, bytes).unwrap();
}

#[test]
fn rejects_npz_entries_whose_checksum_does_not_match() {
    let folder = scratch();
    for method in [zip::CompressionMethod::Stored, zip::CompressionMethod::Deflated] {
        let path = npz(folder.path(), "a.npz", method);
        assert_eq!(counts(&mut open(&path, &plain()).unwrap()), scene(20, 32, 64, 3));
        damage_crc(&path);
        let words = reading_fails(&path, &plain());
        assert!(words.contains("CRC-32"), "{method:?}: {words}");
    }
}

#[test]
fn rejects_encrypted_npz_entries() {
    let folder = scratch();
    let path = npz(folder.path(), "a.npz", zip::CompressionMethod::Stored);
    let mut bytes = std::fs::read(&path).unwrap();
    let central = bytes.windows(4).rposition(|w| w == b"PK\x01\x02").unwrap();
    bytes[6] |= 1;
    bytes[central + 8] |= 1;
    let path = write(folder.path(), "a.npz", &bytes);
    assert!(refusal(open(&path, &plain())).contains("`a` is encrypted"));
}

/// Encodes a TIFF of one uncompressed page of single bits, 16 x 2, with FillOrder 2.
fn lowest_bit_first() -> Vec<u8> {
    let entries: [(u16, u16, u32); 9] = [
        (256, 3, 16),  // ImageWidth
        (257, 3, 2),   // ImageLength
        (258, 3, 1),   // BitsPerSample
        (259, 3, 1),   // Compression: none
        (262, 3, 1),   // PhotometricInterpretation: black is zero
        (266, 3, 2),   // FillOrder: lowest bit first
        (273, 4, 122), // StripOffsets
        (278, 3, 2),   // RowsPerStrip
        (279, 4, 4),   // StripByteCounts
    ];
    let mut bytes = b"II*\0\x08\0\0\0".to_vec();
    bytes.extend((entries.len() as u16).to_le_bytes());
    for (tag, kind, value) in entries {
        bytes.extend(tag.to_le_bytes());
        bytes.extend(kind.to_le_bytes());
        bytes.extend(1u32.to_le_bytes());
        bytes.extend(value.to_le_bytes());
    }
    bytes.extend([0; 4]);
    assert_eq!(bytes.len(), 122);
    bytes.extend([0b0000_0001, 0b1000_0000, 0b0000_1100, 0]);
    bytes
}

#[test]
fn tiff_bits_are_read_in_their_fill_order() {
    let folder = scratch();
    let path = write(folder.path(), "a.tif", &lowest_bit_first());
    let mut expected = vec![0; 32];
    for pixel in [0, 15, 18, 19] {
        expected[pixel] = 1;
    }
    assert_eq!(counts(&mut open(&path, &plain()).unwrap())[0], expected);
}

#[test]
fn rejects_counts_beyond_the_depth() {
    let folder = scratch();
    let mut data = vec![3u8; 6 * 8 * 8];
    data[300] = 200;
    let path = write(folder.path(), "a.npy", &npy("|u1", "False", "(6, 8, 8)", &data));
    let three = ReadOptions { bits: Some(3), ..plain() };
    let words = reading_fails(&path, &three);
    assert!(words.contains("frame 4 holds a count of 200, beyond the 7 (3 bit)"), "{words}");
    let summed = ReadOptions { sum: Some(3), ..three };
    let mut capture = open(&path, &summed).unwrap();
    assert!(capture.read(1, &mut [0; 64]).is_err(), "sums of such counts as well");
}

/// Creates a record of an array, as `convert` writes it.
fn record(frames: u64, size: (usize, usize), max_count: u16) -> String {
    let (height, width) = size;
    format!(
        r#"{{"version": 1, "program": "qudi", "burst": {{"format": "npy-u8", "frames": {frames},
        "height": {height}, "width": {width}, "max_count": {max_count}, "bits": 3, "fps": null,
        "bitpack": false, "bitpack_dim": null, "bitorder": null}}, "binary": true, "preset": null,
        "capture": "x.bin", "format": "raw-u8", "read": {{"mask": "none"}}}}"#
    )
}

#[test]
fn rejects_records_that_contradict_the_array() {
    let folder = scratch();
    let path = write(folder.path(), "a.npy", &npy("|u1", "False", "(6, 8, 8)", &[3; 6 * 64]));
    let with = |record: &str| {
        write(folder.path(), "a.npy.json", record.as_bytes());
        open(&path, &plain())
    };
    assert_eq!(with(&record(6, (8, 8), 7)).unwrap().max_count(), Some(7));
    assert!(refusal(with(&record(5, (8, 8), 7))).contains("5 frames, and the array holds 6"));
    assert!(refusal(with(&record(6, (8, 9), 7))).contains("frames of 8 x 9"));
    let mut shallow = with(&record(6, (8, 8), 1)).unwrap();
    let words = shallow.read(0, &mut [0; 64]).unwrap_err().to_string();
    assert!(
        words.contains("count of 3, beyond the 1 (1 bit) that the record beside it"),
        "{words}"
    );
}

#[test]
fn notes_broken_links_and_folders_among_frames() {
    let folder = scratch();
    for i in 0..3 {
        let image = image::GrayImage::from_pixel(4, 4, image::Luma([i]));
        image.save(folder.path().join(format!("f{i}.png"))).unwrap();
    }
    std::fs::create_dir(folder.path().join("f3.png")).unwrap();
    #[cfg(unix)]
    std::os::unix::fs::symlink("nowhere", folder.path().join("f4.png")).unwrap();
    let capture = open(folder.path(), &plain()).unwrap();
    assert_eq!(capture.frames(), 3);
    let skipped = if cfg!(unix) { "2 entries" } else { "1 entries" };
    assert!(capture.info().notes.iter().any(|note| note.contains(skipped)));
}

#[test]
fn notes_jpegs_whatever_their_name() {
    let folder = scratch();
    let image = image::GrayImage::from_pixel(16, 16, image::Luma([9]));
    let path = folder.path().join("a.png");
    image.save_with_format(&path, image::ImageFormat::Jpeg).unwrap();
    let capture = open(&path, &plain()).unwrap();
    assert!(capture.info().notes.iter().any(|note| note.contains("lossy")));
}

#[cfg(unix)]
#[test]
fn rejects_special_files_as_captures_masks_and_dark_maps() {
    let folder = scratch();
    let path = write(folder.path(), "a.npy", &npy("|u1", "False", "(6, 8, 8)", &[3; 6 * 64]));
    let null = PathBuf::from("/dev/null");
    assert!(refusal(open(&null, &plain())).contains("not a regular file"));
    let device = folder.path().join("null.npy");
    std::os::unix::fs::symlink(&null, &device).unwrap();
    let masked = ReadOptions { mask: MaskChoice::File(device.clone()), ..plain() };
    assert!(refusal(open(&path, &masked)).contains("not a regular file"));
    let dark = ReadOptions { dcr: Some(device), ..plain() };
    assert!(refusal(open(&path, &dark)).contains("not a regular file"));
}

#[test]
fn notes_pipes_that_end_within_the_first_window() {
    let mut bytes = plain_npy();
    bytes.truncate(bytes.len() - 13 * 32 * 64 - 5);
    let options = ReadOptions {
        lenient: true,
        pack_axis: Some(qudi_io::description::PackAxis::None),
        ..plain()
    };
    let capture = Capture::from_pipe(Cursor::new(bytes), &options, None).unwrap();
    assert_eq!(capture.frames(), 6);
    let notes = &capture.info().notes;
    assert!(
        notes.iter().any(|note| note.contains("promises 20 frames, 6 whole ones")),
        "{notes:?}"
    );
}

#[test]
fn masks_in_fortran_order_are_read() {
    let folder = scratch();
    let path = write(folder.path(), "a.npy", &npy("|u1", "False", "(6, 2, 3)", &[3; 36]));
    // Columns after one another: only row 0, column 2 is set.
    let mask = npy("|u1", "True", "(2, 3)", &[0, 0, 0, 0, 1, 0]);
    let mask = write(folder.path(), "mask.npy", &mask);
    let options = ReadOptions {
        mask: MaskChoice::File(mask),
        bits: Some(3),
        pack_axis: Some(qudi_io::description::PackAxis::None),
        ..ReadOptions::default()
    };
    assert_eq!(open(&path, &options).unwrap().bad_pixels().hot, [2]);
}

#[test]
fn overwrites_folders_of_own_files_only() {
    use qudi_core::atomic_file::Overwrite;
    use qudi_io::writer::{ClipWriter, Planes, TiffSamples};
    let scratch = scratch();
    let path = scratch.path().join("m");
    let size = Size { height: 2, width: 2 };
    let save = || {
        let mut writer =
            ClipWriter::create(&path, size, Planes::Gray, TiffSamples::U16, 25.0, Overwrite::Yes)?;
        writer.push(&Frame::filled(size, 0.5))?;
        writer.finish()
    };
    save().unwrap();
    save().unwrap();
    std::fs::write(path.join("notes.tex"), "mine").unwrap();
    assert!(save().unwrap_err().to_string().contains("`notes.tex`"));
    assert!(path.join("notes.tex").is_file() && path.join("frame_000000.png").is_file());
}

/// Extents of colour captures whose product no number holds, and folders without a file of the sparse stream.
#[test]
fn rejects_impossible_colour_arrays_and_reads_folders_of_raw_files() {
    let folder = scratch();
    let huge = "(4611686018427387904, 4611686018427387904, 3, 2)";
    for (fortran, axes) in [("True", Axes::Thw), ("True", Axes::Hwt), ("False", Axes::Hwt)] {
        let path = write(folder.path(), "huge.npy", &npy("|u1", fortran, huge, &[1; 64]));
        for channel in [0, 1] {
            let options = ReadOptions { axes: Some(axes), channel: Some(channel), ..plain() };
            assert!(open(&path, &options).is_err());
        }
    }
    write(folder.path(), "raw/frames.raw", &[1; 48]);
    let options = ReadOptions { format: None, size: Some("4x4".parse().unwrap()), ..plain() };
    let words = refusal(open(&folder.path().join("raw"), &options));
    assert!(words.contains("no capture in a known format"), "{words}");
}
