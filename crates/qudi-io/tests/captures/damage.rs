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
        // The checksum covers frames that are not asked for, too.
        let first = ReadOptions { end: Some(5), ..plain() };
        let mut capture = open(&path, &first).unwrap();
        assert_eq!(counts(&mut capture).len(), 5);
        assert!(capture.verify().unwrap_err().to_string().contains("CRC-32"), "{method:?}");
    }
}

#[test]
fn refuses_images_that_would_fill_the_memory_before_decoding() {
    let folder = scratch();
    let mut header = b"IHDR".to_vec();
    header.extend([8192u32, 8192].into_iter().flat_map(u32::to_be_bytes));
    header.extend([8, 0, 0, 0, 0]);
    let mut png = b"\x89PNG\r\n\x1a\n".to_vec();
    for chunk in [header.as_slice(), b"IDAT"] {
        png.extend((chunk.len() as u32 - 4).to_be_bytes());
        png.extend(chunk);
        png.extend(crc32fast::hash(chunk).to_be_bytes());
    }
    let path = write(folder.path(), "bomb.png", &png);
    let words = refusal(open(&path, &plain()));
    assert!(words.contains("8192 x 8192 pixels is over the limit of 33554432"), "{words}");
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

/// Encodes a TIFF of one uncompressed page of 4 bytes in two rows: samples of `bits` bits, 16 of one bit to
/// the row. Black is zero if `photometric` is 1; bytes are filled from the lowest bit if `fill_order` is 2.
fn small_tiff(bits: u32, photometric: u32, fill_order: u32, data: [u8; 4]) -> Vec<u8> {
    let entries: [(u16, u16, u32); 9] = [
        (256, 3, 16 / bits), // ImageWidth
        (257, 3, 2),         // ImageLength
        (258, 3, bits),      // BitsPerSample
        (259, 3, 1),         // Compression: none
        (262, 3, photometric),
        (266, 3, fill_order),
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
    bytes.extend(data);
    bytes
}

#[test]
fn tiff_bits_are_read_in_their_fill_order() {
    let folder = scratch();
    let bits = [0b0000_0001, 0b1000_0000, 0b0000_1100, 0];
    let path = write(folder.path(), "a.tif", &small_tiff(1, 1, 2, bits));
    let mut expected = vec![0; 32];
    for pixel in [0, 15, 18, 19] {
        expected[pixel] = 1;
    }
    assert_eq!(counts(&mut open(&path, &plain()).unwrap())[0], expected);
}

#[test]
fn tiff_bits_are_counts_also_where_white_is_zero() {
    let folder = scratch();
    let bits = [0b1000_0000, 0b0000_0001, 0b0011_0000, 0];
    let path = write(folder.path(), "a.tif", &small_tiff(1, 0, 1, bits));
    let mut capture = open(&path, &plain()).unwrap();
    let mut expected = vec![0; 32];
    for pixel in [0, 15, 18, 19] {
        expected[pixel] = 1;
    }
    assert_eq!(counts(&mut capture)[0], expected);
    let notes = capture.info().notes.join("; ");
    assert!(notes.contains("white is zero") && notes.contains("as they are stored"), "{notes}");
}

#[test]
fn rejects_tiffs_of_twelve_bits_with_a_remedy() {
    let folder = scratch();
    let path = write(folder.path(), "a.tif", &small_tiff(12, 1, 1, [0; 4]));
    let words = refusal(open(&path, &plain()));
    assert!(words.contains("12") && words.contains("16-bit gray"), "{words}");
}

#[test]
fn rejects_packed_pixels_and_headers_of_frames_with_a_remedy() {
    let folder = scratch();
    let size = Some(qudi_core::Size { height: 16, width: 32 });
    let words = |name: &str, format: &str, bytes: usize| {
        let path = write(folder.path(), name, &vec![1; bytes]);
        let format = Some(format.to_owned());
        refusal(open(&path, &ReadOptions { format, size, ..plain() }))
    };
    let text = words("mono12.raw", "raw-u16", 5 * 768);
    assert!(text.contains("Mono12p") && text.contains("16 bits"), "{text}");
    let text = words("headers.raw", "raw-u16", 10 * (1024 + 128));
    assert!(text.contains("10 frames with headers of 128 bytes"), "{text}");
    assert!(!text.contains("trailer"), "{text}");
    let text = words("cut.raw", "raw-u16", 4 * 1024 + 37);
    assert!(text.contains("trailer 37") && text.contains("lenient"), "{text}");
}

/// Values that are no counts are refused, unless a mask covers their pixels.
#[test]
fn masks_cover_values_that_are_no_counts() {
    let folder = scratch();
    let (bad, frames) = (37, 4);
    let mut mask = vec![0; 64];
    mask[bad] = 1;
    let mask = write(folder.path(), "mask.npy", &npy("|u1", "False", "(8, 8)", &mask));
    let masked = ReadOptions { mask: MaskChoice::File(mask), ..ReadOptions::default() };
    let pixels = |fill: [u8; 4], count: [u8; 4]| -> Vec<u8> {
        (0..64 * frames).flat_map(|i| if i % 64 == bad { fill } else { count }).collect()
    };
    let float = pixels(f32::NAN.to_le_bytes(), 3f32.to_le_bytes());
    let word = pixels(u32::MAX.to_le_bytes(), 3u32.to_le_bytes());
    for (descr, data) in [("<f4", float), ("<u4", word)] {
        let path = write(folder.path(), "a.npy", &npy(descr, "False", "(4, 8, 8)", &data));
        let plain = open(&path, &plain()).and_then(|mut capture| {
            capture.read(0, &mut [0; 64])?;
            Ok(capture)
        });
        assert!(refusal(plain).contains("whole numbers from 0 to 65535"), "{descr}");
        let mut capture = open(&path, &masked).unwrap();
        assert!(counts(&mut capture).iter().flatten().all(|&count| count == 3), "{descr}");
    }
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

/// Compressed captures are judged, too: reading them again starts over.
#[test]
fn compressed_captures_are_judged() {
    let folder = scratch();
    let (frames, side) = (24, 16);
    let mut bytes: Vec<u8> =
        (0..frames * side * side).map(|i| ((i * 7 + i / 256 * 13) % 23) as u8).collect();
    let sound = bytes.clone();
    bytes[12 * side * side..13 * side * side].fill(255);
    let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    gzip.write_all(&npy("|u1", "False", "(24, 16, 16)", &bytes)).unwrap();
    let path = write(folder.path(), "a.npy.gz", &gzip.finish().unwrap());
    let mut capture = open(&path, &plain()).unwrap();
    capture.judge_frames(u64::MAX, &plain(), None).unwrap();
    assert_eq!(capture.findings().saturated, [12]);
    let read = counts(&mut capture);
    let frame = |t: usize| {
        let bytes = &sound[t * side * side..][..side * side];
        bytes.iter().map(|&byte| u16::from(byte)).collect::<Vec<_>>()
    };
    assert!(read[12] == frame(11) || read[12] == frame(13));
    assert!(read[14] == frame(14));
}

/// Slices at every instant are no instants.
#[test]
fn rejects_stacks_of_slices_over_time() {
    let folder = scratch();
    let save = |name: &str, description: &str| {
        let path = folder.path().join(name);
        let file = std::fs::File::create(&path).unwrap();
        let mut encoder = tiff::encoder::TiffEncoder::new(file).unwrap();
        for _ in 0..6 {
            let mut image = encoder.new_image::<tiff::encoder::colortype::Gray8>(4, 4).unwrap();
            let tag = tiff::tags::Tag::ImageDescription;
            image.encoder().write_tag(tag, description).unwrap();
            image.write_data(&[3; 16]).unwrap();
        }
        path
    };
    let imagej = save("a.tif", "ImageJ=1.54f\nimages=6\nslices=2\nframes=3\nhyperstack=true\n");
    let words = refusal(open(&imagej, &plain()));
    assert!(words.contains("2 slices at every instant") && words.contains("[:, 0]"), "{words}");
    let pixels = "<Pixels SizeC=\"1\" SizeZ=\"1\" SizeT=\"3\"/>";
    let series =
        save("b.ome.tif", &format!("<OME><Image>{pixels}</Image><Image>{pixels}</Image></OME>"));
    let words = refusal(open(&series, &plain()));
    assert!(words.contains("2 images") && words.contains("series=0"), "{words}");
    let plain_stack = save("c.tif", "ImageJ=1.54f\nimages=6\nslices=6\n");
    assert_eq!(open(&plain_stack, &plain()).unwrap().frames(), 6);
}

/// Sums that are held are the ones of the file, also after others.
#[test]
fn held_sums_are_those_of_the_file() {
    let folder = scratch();
    let bytes: Vec<u8> = (0..40 * 16 * 16).map(|i| (i * 31 % 7) as u8).collect();
    let path = write(folder.path(), "a.npy", &npy("|u1", "False", "(40, 16, 16)", &bytes));
    let options = ReadOptions { sum: Some(4), bits: Some(3), ..plain() };
    let mut capture = open(&path, &options).unwrap();
    let first = counts(&mut capture);
    assert!(counts(&mut capture) == first);
    let expected = |sum: usize, from: usize| {
        let of = |i: usize| (from..from + sum).map(|t| u16::from(bytes[t * 256 + i])).sum();
        (0..256).map(of).collect::<Vec<u16>>()
    };
    assert_eq!(first[3], expected(4, 12));
    let mut one = vec![0; 256];
    capture.read_from(13, &mut one).unwrap();
    assert_eq!(one, expected(4, 13));
    let mut capture = capture.summed_by(5, &options, None).unwrap();
    assert_eq!(counts(&mut capture)[2], expected(5, 10));
}
