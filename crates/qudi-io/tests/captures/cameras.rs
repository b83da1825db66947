//! The cameras' own raw files, made bit by bit as their layouts say.

use crate::{counts, open, pack, plain, refusal, scene, scratch, write};
use qudi_io::description::{Orientation, ReadOptions};

/// `numpy.rot90` of a 512 x 512 frame.
fn rot90(frame: &[u16]) -> Vec<u16> {
    (0..512 * 512).map(|i| frame[i % 512 * 512 + 511 - i / 512]).collect()
}

#[test]
fn swissspad2_half_arrays_are_lowest_bit_first() {
    let folder = scratch();
    let frames = scene(512, 256, 512, 2);
    let bytes: Vec<u8> = frames.iter().flat_map(|f| pack(f, 512, true)).collect();
    assert_eq!(bytes.len(), 8 << 20);
    // k / 2048 / k / 64: file 64 lies in another folder than file 63.
    write(folder.path(), "0/0/filename63.bin", &bytes);
    write(folder.path(), "0/1/filename64.bin", &bytes[..16_384 * 10]);
    let mut capture = open(folder.path(), &plain()).unwrap();
    assert_eq!(capture.info().format, "swissspad2");
    assert_eq!((capture.frames(), capture.size().height, capture.size().width), (522, 256, 512));
    let mut one = vec![0; 256 * 512];
    for frame in [0usize, 1, 511, 512, 521, 3] {
        capture.read(frame as u64, &mut one).unwrap();
        assert_eq!(one, frames[frame % 512], "{frame}");
    }
    let mut sums = vec![0; 256 * 512];
    capture.total(500..522, &mut sums).unwrap();
    let expected: Vec<u32> =
        (0..256 * 512).map(|i| (500..522).map(|f| u32::from(frames[f % 512][i])).sum()).collect();
    assert_eq!(sums, expected);
}

#[test]
fn swissspad2_full_arrays_are_zones_with_the_bottom_upside_down() {
    let folder = scratch();
    let frames = scene(256, 512, 512, 4);
    let mut bytes = vec![0u8; 8 << 20];
    for (t, frame) in frames.iter().enumerate() {
        for y in 0..512 {
            for x in 0..512 {
                // Stored row, then zones of 16 bytes: top and bottom in turn.
                let (row, bottom) = if y < 256 { (y, 0) } else { (511 - y, 1) };
                let bit = (row * 8 + x / 128 * 2 + bottom) * 128 + x % 128;
                bytes[t * 32_768 + bit / 8] |= (frame[y * 512 + x] as u8) << (bit % 8);
            }
        }
    }
    let path = write(folder.path(), "filename0.bin", &bytes);
    let mut capture = open(&path, &plain()).unwrap();
    assert_eq!(capture.info().format, "swissspad2-full");
    let mut one = vec![0; 512 * 512];
    for frame in [0, 100, 255] {
        capture.read(frame, &mut one).unwrap();
        assert_eq!(one, frames[frame as usize]);
    }
    let mut sums = vec![0; 512 * 512];
    capture.total(3..9, &mut sums).unwrap();
    assert!(
        (0..512 * 512).all(|i| sums[i] == (3..9).map(|f| u32::from(frames[f][i])).sum::<u32>())
    );
    // Copied without unpacking: rows of whole bytes, highest bit first.
    let mut packed = vec![0; 2 * 32_768];
    assert!(capture.copy_packed(254, &mut packed).unwrap());
    assert_eq!(packed, [pack(&frames[254], 512, false), pack(&frames[255], 512, false)].concat());
    let turned = ReadOptions { orient: Some(Orientation::Rot90), ..plain() };
    assert!(!open(&path, &turned).unwrap().copy_packed(0, &mut packed).unwrap());
}

#[test]
fn spad512s_frames_come_with_and_without_trailer_and_turned() {
    let folder = scratch();
    for n in [1000usize, 256, 17] {
        let frames = scene(n.min(40), 512, 512, n as u64);
        let mut bytes: Vec<u8> =
            (0..n).flat_map(|t| pack(&frames[t % frames.len()], 512, false)).collect();
        let plain_file = write(folder.path(), "acq00001/RAW00000.bin", &bytes);
        bytes.extend(b"DONE");
        let dumped = write(folder.path(), "RAW_1700000000.123.bin", &bytes);
        for path in [plain_file, dumped] {
            let mut capture = open(&path, &plain()).unwrap();
            assert_eq!(capture.info().format, "spad512s", "{n}");
            assert_eq!(capture.frames(), n as u64);
            let mut one = vec![0; 512 * 512];
            capture.read(n as u64 - 1, &mut one).unwrap();
            assert_eq!(one, rot90(&frames[(n - 1) % frames.len()]), "vendor orientation");
            let raw = ReadOptions { orient: Some(Orientation::Raw), ..plain() };
            open(&path, &raw).unwrap().read(0, &mut one).unwrap();
            assert_eq!(one, frames[0]);
        }
    }
}

#[test]
fn reports_server_errors_and_rejects_torn_frames() {
    let folder = scratch();
    let frames = scene(20, 512, 512, 6);
    let mut bytes: Vec<u8> = frames.iter().flat_map(|f| pack(f, 512, false)).collect();
    bytes.extend(b"ERROR");
    let path = write(folder.path(), "RAW00000.bin", &bytes);
    let named = ReadOptions { format: Some("spad512s".into()), ..plain() };
    let capture = open(&path, &named).unwrap();
    assert_eq!(capture.frames(), 20);
    assert!(capture.info().notes[0].contains("ERROR"));
    let torn = write(folder.path(), "RAW00001.bin", &bytes[..bytes.len() - 100]);
    let words = refusal(open(&torn, &named));
    assert!(words.contains("19 frames") && words.contains("`lenient`"), "{words}");
    let lenient = ReadOptions { lenient: true, ..named.clone() };
    assert_eq!(open(&torn, &lenient).unwrap().frames(), 19);
    let trailer = ReadOptions { trailer: Some(32_768 - 95), ..named.clone() };
    assert_eq!(open(&torn, &trailer).unwrap().frames(), 19);
    let header = ReadOptions { header: Some(1 << 40), ..named };
    assert!(refusal(open(&torn, &header)).contains("shorter than its header"));
}

#[test]
fn files_of_one_capture_follow_each_other_by_number() {
    let folder = scratch();
    let frames = scene(25, 512, 512, 8);
    let bytes: Vec<u8> = frames.iter().flat_map(|f| pack(f, 512, false)).collect();
    write(folder.path(), "acq00000/RAW00000.bin", &bytes[..10 * 32_768]);
    write(folder.path(), "acq00000/RAW00001.bin", &bytes[10 * 32_768..20 * 32_768]);
    write(folder.path(), "acq00000/RAW00002.bin", &bytes[20 * 32_768..]);
    let raw = ReadOptions { orient: Some(Orientation::Raw), ..plain() };
    let mut capture = open(&folder.path().join("acq00000"), &raw).unwrap();
    assert_eq!(counts(&mut capture), frames);
    let eight = ReadOptions { frames_per_file: Some(8), ..raw.clone() };
    assert_eq!(open(&folder.path().join("acq00000"), &eight).unwrap().frames(), 8 + 8 + 5);
    let twelve = ReadOptions { frames_per_file: Some(12), ..raw };
    assert!(
        refusal(open(&folder.path().join("acq00000"), &twelve)).contains("10 frames instead of 12")
    );
}

#[test]
fn spad512s_deeper_modes_are_bytes_and_words() {
    let folder = scratch();
    let frames: Vec<Vec<u16>> = (0..3u64)
        .map(|t| {
            let sum = scene(15, 512, 512, 20 + t);
            (0..512 * 512).map(|i| sum.iter().map(|f| f[i]).sum()).collect()
        })
        .collect();
    let bytes: Vec<u8> = frames.iter().flatten().map(|&c| c as u8).collect();
    let words: Vec<u8> = frames.iter().flatten().flat_map(|&c| (c * 40).to_le_bytes()).collect();
    let raw = ReadOptions { orient: Some(Orientation::Raw), ..plain() };
    let path = write(folder.path(), "RAW00000.bin", &bytes);
    let mut capture = open(&path, &raw).unwrap();
    assert_eq!(capture.info().format, "spad512s-8");
    assert_eq!(counts(&mut capture), frames);
    let path = write(folder.path(), "RAW00001.bin", &words);
    let mut capture = open(&path, &raw).unwrap();
    assert_eq!(capture.info().format, "spad512s-16");
    assert_eq!(counts(&mut capture)[2][77], frames[2][77] * 40);
}

#[test]
fn sparse_streams_end_frames_with_the_delimiter() {
    let folder = scratch();
    let words = |words: &[u32]| words.iter().flat_map(|w| w.to_le_bytes()).collect::<Vec<u8>>();
    // Photons at pixels 5 and 262143, then an empty frame, then one photon.
    let stream = words(&[5, 262_143, 262_144, 262_144, 512, 262_144]);
    let path = write(folder.path(), "RAW00000.bin", &stream);
    let raw = ReadOptions { orient: Some(Orientation::Raw), ..plain() };
    let mut capture = open(&path, &raw).unwrap();
    assert_eq!((capture.info().format, capture.frames()), ("spad512s-sparse", 3));
    let frames = counts(&mut capture);
    let fired = |t: usize| {
        frames[t].iter().enumerate().filter(|(_, c)| **c == 1).map(|(i, _)| i).collect::<Vec<_>>()
    };
    assert_eq!((fired(0), fired(1), fired(2)), (vec![5, 262_143], vec![], vec![512]));
    // Turned by the vendor: pixel (1, 0) comes to the bottom row.
    let mut turned = open(&path, &plain()).unwrap();
    assert_eq!(counts(&mut turned)[2][511 * 512 + 1], 1);
    let sparse = ReadOptions { format: Some("spad512s-sparse".into()), ..raw };
    let cut = write(folder.path(), "cut.bin", &stream[..stream.len() - 4]);
    assert!(refusal(open(&cut, &sparse)).contains("no delimiter after its 1 photons"));
    let lenient = ReadOptions { lenient: true, ..sparse.clone() };
    assert_eq!(open(&cut, &lenient).unwrap().frames(), 2);
    let beyond = write(folder.path(), "x.bin", &words(&[5, 262_145, 262_144]));
    assert!(refusal(open(&beyond, &sparse)).contains("beyond the last pixel"));
}

#[test]
fn qvga_files_have_a_header_or_none() {
    let folder = scratch();
    let frames = scene(30, 240, 320, 9);
    let bytes: Vec<u8> = frames.iter().flat_map(|f| pack(f, 320, true)).collect();
    let global: Vec<u8> = [&[2u8, 240, 1][..], &bytes].concat();
    // Rolling shutter, exposure 1: the first 240 * 80 bytes are to be skipped.
    let rolling: Vec<u8> = [&[1u8, 240, 0][..], &vec![0xaa; 240 * 80], &bytes].concat();
    for (bytes, note) in [(bytes, None), (global, None), (rolling, Some("rolling"))] {
        let path = write(folder.path(), "spc_data1.bin", &bytes);
        let mut capture = open(&path, &plain()).unwrap();
        assert_eq!((capture.info().format, capture.fps()), ("qvga", Some(9938.4)));
        assert_eq!(counts(&mut capture), frames);
        let noted = capture.info().notes.iter().any(|r| r.contains("rolling"));
        assert_eq!(noted, note.is_some());
    }
}

#[test]
fn file_length_alone_recognises_no_format() {
    let folder = scratch();
    // 8 MiB: a SwissSPAD2 file, or 256 frames of a SPAD512S. The picture tells; noise does not.
    let frames = scene(256, 512, 512, 10);
    let msb: Vec<u8> = frames.iter().flat_map(|f| pack(f, 512, false)).collect();
    let path = write(folder.path(), "capture.bin", &msb);
    assert_eq!(open(&path, &plain()).unwrap().info().format, "spad512s");
    let lsb: Vec<u8> = frames.iter().flat_map(|f| pack(f, 512, true)).collect();
    let path = write(folder.path(), "capture.bin", &lsb);
    assert_eq!(open(&path, &plain()).unwrap().info().format, "swissspad2");
    let mut state = 1u64;
    let noise: Vec<u8> = (0..8 << 20)
        .map(|_| {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 32) as u8
        })
        .collect();
    let path = write(folder.path(), "noise.bin", &noise);
    let words = refusal(open(&path, &plain()));
    assert!(words.contains("ambiguous") && words.contains("`format "), "{words}");
    // A name decides where the picture does not.
    let path = write(folder.path(), "filename7.bin", &noise);
    assert_eq!(open(&path, &plain()).unwrap().info().format, "swissspad2");
}

#[test]
fn reads_raw_files_of_any_camera_with_options() {
    let folder = scratch();
    let frames = scene(6, 10, 12, 11);
    let mut bytes = vec![7u8; 5];
    bytes.extend(frames.iter().flat_map(|f| pack(f, 12, false)));
    bytes.extend([9; 3]);
    let path = write(folder.path(), "x.dat", &bytes);
    let options = ReadOptions {
        format: Some("raw-bits".into()),
        size: Some("10x12".parse().unwrap()),
        header: Some(5),
        trailer: Some(3),
        ..plain()
    };
    assert_eq!(counts(&mut open(&path, &options).unwrap()), frames);
    let sizeless = ReadOptions { size: None, ..options.clone() };
    assert!(refusal(open(&path, &sizeless)).contains("`size 256x512`"));
    let misspelt = ReadOptions { format: Some("raw-bit".into()), ..options };
    assert!(refusal(open(&path, &misspelt)).contains("did you mean `raw-bits`"));
    let bytes: Vec<u8> = frames.iter().flatten().flat_map(|&c| (c * 300).to_le_bytes()).collect();
    let path = write(folder.path(), "y.raw", &bytes);
    let options = ReadOptions {
        format: Some("raw-u16".into()),
        size: Some("10x12".parse().unwrap()),
        ..plain()
    };
    assert_eq!(counts(&mut open(&path, &options).unwrap())[1][5], frames[1][5] * 300);
    assert!(refusal(open(&path, &plain())).contains("no known format"));
    assert!(refusal(open(&write(folder.path(), "empty.bin", b""), &plain())).contains("empty"));
}
