//! NumPy arrays: packed, plain, turned, compressed, truncated, hostile.

use crate::{counts, npy, open, pack, plain, refusal, scene, scratch, write};
use proptest::prelude::*;
use qudi_io::description::{Axes, BitOrder, Orientation, PackAxis, ReadOptions};
use std::io::Write;

#[test]
fn first_pixel_is_the_highest_bit_and_padding_needs_the_width() {
    let folder = scratch();
    // One frame of 2 x 10 pixels: 0x01 sets pixel 7, 0x80 in the second byte pixel 8.
    let data = [0x01, 0x80, 0xff, 0x40];
    let path = write(folder.path(), "a.npy", &npy("|u1", "False", "(1, 2, 2)", &data));
    let packed = ReadOptions { pack_axis: Some(PackAxis::Width), ..plain() };
    let mut whole = open(&path, &packed).unwrap();
    assert_eq!((whole.size().height, whole.size().width), (2, 16));
    let mut row = vec![0; 16];
    row[7] = 1;
    row[8] = 1;
    assert_eq!(counts(&mut whole)[0][..16], row);
    let ten = ReadOptions { size: Some("2x10".parse().unwrap()), ..packed.clone() };
    let mut trimmed = open(&path, &ten).unwrap();
    assert_eq!(
        counts(&mut trimmed)[0],
        [0, 0, 0, 0, 0, 0, 0, 1, 1, 0, 1, 1, 1, 1, 1, 1, 1, 1, 0, 1]
    );
    let lsb = ReadOptions { bit_order: Some(BitOrder::Lsb), ..packed.clone() };
    assert_eq!(counts(&mut open(&path, &lsb).unwrap())[0][0], 1);
    let wrong = ReadOptions { size: Some("2x8".parse().unwrap()), ..packed };
    assert!(refusal(open(&path, &wrong)).contains("2 x 16, not of 2 x 8"));
}

#[test]
fn packing_along_the_height_is_read() {
    let folder = scratch();
    // numpy.packbits(frames, axis=1): byte (0, x) holds rows 0 to 7 of column x.
    let data = [0b1000_0001, 0b0100_0000];
    let path = write(folder.path(), "a.npy", &npy("|u1", "False", "(1, 1, 2)", &data));
    let options = ReadOptions { pack_axis: Some(PackAxis::Height), ..plain() };
    let frames = counts(&mut open(&path, &options).unwrap());
    assert_eq!(frames[0], [1, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0]);
}

/// Saturated counts of 8 bits, or packed bits that are all one: both are possible.
#[test]
fn bytes_that_are_all_one_are_asked_about() {
    let folder = scratch();
    let data = [255; 20 * 64 * 6];
    let path = write(folder.path(), "a.npy", &npy("|u1", "False", "(20, 64, 6)", &data));
    let refused = refusal(open(&path, &plain()));
    assert!(refused.contains("255") && refused.contains("pack_axis"), "{refused}");
    for (axis, width) in [(PackAxis::Width, 48), (PackAxis::None, 6)] {
        let options = ReadOptions { pack_axis: Some(axis), ..plain() };
        assert_eq!(open(&path, &options).unwrap().size().width, width);
    }
}

#[test]
fn packed_bits_and_counts_are_told_apart() {
    let folder = scratch();
    let frames = scene(40, 32, 64, 1);
    let packed: Vec<u8> = frames.iter().flat_map(|f| pack(f, 64, false)).collect();
    let plain_bytes: Vec<u8> = frames.iter().flatten().map(|&c| c as u8).collect();
    let white: Vec<u8> = plain_bytes.iter().map(|&c| 255 * c).collect();
    for (name, shape, data) in [
        ("packed.npy", "(40, 32, 8)", packed),
        ("plain.npy", "(40, 32, 64)", plain_bytes),
        ("white.npy", "(40, 32, 64)", white),
    ] {
        let path = write(folder.path(), name, &npy("|u1", "False", shape, &data));
        let mut capture = open(&path, &plain()).unwrap();
        assert_eq!(counts(&mut capture), frames, "{name}");
    }
    let dark = npy("|u1", "False", "(4, 32, 8)", &[0; 4 * 32 * 8]);
    let path = write(folder.path(), "dark.npy", &dark);
    assert!(refusal(open(&path, &plain())).contains("`pack_axis width`"));
}

#[test]
fn every_sample_type_holds_the_same_counts() {
    let folder = scratch();
    let values = [0u16, 1, 7, 3, 2, 5];
    let each = |bytes: &dyn Fn(u16) -> Vec<u8>| -> Vec<u8> {
        values.iter().flat_map(|&v| bytes(v)).collect()
    };
    let cases: Vec<(&str, Vec<u8>)> = vec![
        ("|u1", each(&|v| vec![v as u8])),
        ("|i1", each(&|v| vec![v as u8])),
        ("<u2", each(&|v| v.to_le_bytes().to_vec())),
        (">u2", each(&|v| v.to_be_bytes().to_vec())),
        ("<i4", each(&|v| i32::from(v).to_le_bytes().to_vec())),
        ("<i8", each(&|v| i64::from(v).to_le_bytes().to_vec())),
        (">u8", each(&|v| u64::from(v).to_be_bytes().to_vec())),
        ("<f4", each(&|v| f32::from(v).to_le_bytes().to_vec())),
        ("<f8", each(&|v| f64::from(v).to_le_bytes().to_vec())),
    ];
    for (descr, data) in cases {
        let path = write(folder.path(), "a.npy", &npy(descr, "False", "(1, 2, 3)", &data));
        let options = ReadOptions { pack_axis: Some(PackAxis::None), ..plain() };
        let mut capture = open(&path, &options).unwrap();
        assert_eq!(counts(&mut capture)[0], values, "{descr}");
    }
    let bools = npy("|b1", "False", "(1, 2, 3)", &[0, 1, 1, 0, 0, 1]);
    let mut capture = open(&write(folder.path(), "b.npy", &bools), &plain()).unwrap();
    assert_eq!(capture.max_count(), Some(1));
    assert_eq!(counts(&mut capture)[0], [0, 1, 1, 0, 0, 1]);
}

#[test]
fn rejects_values_that_are_not_counts() {
    let folder = scratch();
    for value in [-1.0f32, 0.5, f32::NAN, 70_000.0] {
        let path =
            write(folder.path(), "a.npy", &npy("<f4", "False", "(1, 1, 1)", &value.to_le_bytes()));
        let mut capture = open(&path, &plain()).unwrap();
        let error = capture.read(0, &mut [0]).unwrap_err().to_string();
        assert!(error.contains("whole numbers"), "{value}: {error}");
    }
    // Means of 7 binary frames become counts again.
    let data: Vec<u8> = [0.0f32, 3.0 / 7.0, 1.0].iter().flat_map(|v| v.to_le_bytes()).collect();
    let path = write(folder.path(), "m.npy", &npy("<f4", "False", "(1, 1, 3)", &data));
    let options = ReadOptions { levels: Some(7), ..plain() };
    let mut capture = open(&path, &options).unwrap();
    assert_eq!((counts(&mut capture)[0].clone(), capture.max_count()), (vec![0, 3, 7], Some(7)));
    let five = ReadOptions { levels: Some(5), ..plain() };
    assert!(open(&path, &five).unwrap().read(0, &mut [0; 3]).is_err());
}

#[test]
fn reads_axes_in_any_order_and_fortran_order() {
    let folder = scratch();
    let (t, h, w) = (5usize, 3usize, 4usize);
    let value = |f: usize, y: usize, x: usize| (100 * f + 10 * y + x) as u16;
    let expected: Vec<Vec<u16>> =
        (0..t).map(|f| (0..h * w).map(|i| value(f, i / w, i % w)).collect()).collect();
    let all = [
        (Axes::Thw, "thw"),
        (Axes::Twh, "twh"),
        (Axes::Hwt, "hwt"),
        (Axes::Wht, "wht"),
        (Axes::Htw, "htw"),
        (Axes::Wth, "wth"),
    ];
    for (axes, names) in all {
        for fortran in [false, true] {
            let extent = |name: char| match name {
                't' => t,
                'h' => h,
                _ => w,
            };
            let names: Vec<char> = names.chars().collect();
            let dims: Vec<usize> = names.iter().map(|&name| extent(name)).collect();
            let mut data = Vec::new();
            for i in 0..t * h * w {
                let index = if fortran {
                    [i % dims[0], i / dims[0] % dims[1], i / dims[0] / dims[1]]
                } else {
                    [i / dims[1] / dims[2], i / dims[2] % dims[1], i % dims[2]]
                };
                let at = |name| index[names.iter().position(|&n| n == name).unwrap()];
                data.extend(value(at('t'), at('h'), at('w')).to_le_bytes());
            }
            let order = if fortran { "True" } else { "False" };
            let shape = format!("({}, {}, {})", dims[0], dims[1], dims[2]);
            let path = write(folder.path(), "a.npy", &npy("<u2", order, &shape, &data));
            let options = ReadOptions { axes: Some(axes), ..plain() };
            let mut capture = open(&path, &options).unwrap();
            assert_eq!(counts(&mut capture), expected, "{axes:?} fortran {fortran}");
        }
    }
}

#[test]
fn rejects_colour_and_reads_one_channel() {
    let folder = scratch();
    let data: Vec<u8> = (0..2 * 2 * 2 * 3).collect();
    let path = write(folder.path(), "a.npy", &npy("|u1", "False", "(2, 2, 2, 3)", &data));
    assert!(refusal(open(&path, &plain())).contains("colour"));
    let green = ReadOptions { channel: Some(1), pack_axis: Some(PackAxis::None), ..plain() };
    let mut capture = open(&path, &green).unwrap();
    assert_eq!(counts(&mut capture), [[1, 4, 7, 10], [13, 16, 19, 22]]);
    let fourth = ReadOptions { channel: Some(3), ..green };
    assert!(refusal(open(&path, &fourth)).contains("channels count from 0 to 2"));
    let mono = npy("|b1", "False", "(2, 2, 2, 1)", &[1, 0, 0, 1, 1, 1, 0, 0]);
    let mut capture = open(&write(folder.path(), "m.npy", &mono), &plain()).unwrap();
    assert_eq!(counts(&mut capture), [[1, 0, 0, 1], [1, 1, 0, 0]]);
}

#[test]
fn reads_compressed_arrays_forwards_and_backwards() {
    let folder = scratch();
    let frames = scene(30, 16, 24, 3);
    let data: Vec<u8> = frames.iter().flat_map(|f| pack(f, 24, false)).collect();
    let bytes = npy("|u1", "False", "(30, 16, 3)", &data);
    let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    gzip.write_all(&bytes).unwrap();
    let path = write(folder.path(), "a.npy.gz", &gzip.finish().unwrap());
    let mut capture = open(&path, &plain()).unwrap();
    assert!(capture.forward_only());
    let mut one = vec![0; 16 * 24];
    for frame in [7, 3, 29, 0, 8, 9] {
        capture.read(frame, &mut one).unwrap();
        assert_eq!(one, frames[frame as usize], "{frame}");
    }
    assert_eq!(counts(&mut capture), frames);
    // Cut off: an error where the data end, and with `lenient` the whole frames.
    let whole = std::fs::read(&path).unwrap();
    let cut = write(folder.path(), "cut.npy.gz", &whole[..whole.len() * 2 / 3]);
    let error = open(&cut, &plain()).and_then(|mut c| c.read(29, &mut one)).unwrap_err();
    assert!(error.to_string().contains("end before frame 29"), "{error}");
    let lenient = ReadOptions { lenient: true, ..plain() };
    let mut rest = open(&cut, &lenient).unwrap();
    assert!((5..29).contains(&rest.frames()), "{}", rest.frames());
    let read = counts(&mut rest);
    assert_eq!(read, frames[..read.len()]);
}

#[test]
fn rejects_or_trims_truncated_arrays() {
    let folder = scratch();
    let bytes = npy("<u2", "False", "(3, 2, 2)", &[5, 0, 6, 0, 7, 0, 8, 0, 1, 0, 2, 0, 3, 0]);
    let path = write(folder.path(), "a.npy", &bytes);
    let words = refusal(open(&path, &plain()));
    assert!(
        words.contains("promises 3 frames, it holds 1") && words.contains("`lenient`"),
        "{words}"
    );
    let lenient = ReadOptions { lenient: true, ..plain() };
    let mut capture = open(&path, &lenient).unwrap();
    assert_eq!(counts(&mut capture), [[5, 6, 7, 8]]);
    assert!(capture.info().notes[0].contains("2 of 3 frames dropped"));
}

#[test]
fn lying_headers_allocate_nothing() {
    let folder = scratch();
    for shape in [
        "(1000000, 100000, 100000)",
        "(18446744073709551615, 2, 2)",
        "(0, 4, 4)",
        "(4, 0, 4)",
        "(3,)",
        "(1, 2, 3, 4, 5)",
    ] {
        for lenient in [false, true] {
            let path = write(folder.path(), "a.npy", &npy("|u1", "False", shape, &[1; 64]));
            let options = ReadOptions { lenient, pack_axis: Some(PackAxis::None), ..plain() };
            // What is there may be read, if asked for; never more.
            match open(&path, &options) {
                Ok(capture) => assert!(lenient && capture.frames() * 4 <= 64, "{shape}"),
                Err(e) => assert!(e.help().is_some()),
            }
        }
    }
    let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    gzip.write_all(&npy("|u1", "False", "(1000000, 4096, 4096)", &[1; 64])).unwrap();
    let path = write(folder.path(), "a.npy.gz", &gzip.finish().unwrap());
    assert!(refusal(open(&path, &plain())).contains("compressed bytes can hold"));
}

#[test]
fn frames_are_chosen_cropped_turned_and_summed() {
    let folder = scratch();
    let frames = scene(20, 8, 16, 5);
    let data: Vec<u8> = frames.iter().flat_map(|f| pack(f, 16, false)).collect();
    let path = write(folder.path(), "a.npy", &npy("|u1", "False", "(20, 8, 2)", &data));
    let options = ReadOptions {
        pack_axis: Some(PackAxis::Width),
        start: Some(3),
        end: Some(18),
        sum: Some(7),
        orient: Some(Orientation::FlipV),
        crop: Some("1:4,2:13".parse().unwrap()),
        ..plain()
    };
    let mut capture = open(&path, &options).unwrap();
    assert_eq!((capture.frames(), capture.max_count()), (2, Some(7)));
    assert!(capture.info().notes.iter().any(|r| r.contains("last 1 frames")));
    let read = counts(&mut capture);
    for (n, frame) in read.iter().enumerate() {
        for (i, &count) in frame.iter().enumerate() {
            let (y, x) = (7 - (1 + i / 11), 2 + i % 11);
            let expected: u16 = (0..7).map(|k| frames[3 + 7 * n + k][y * 16 + x]).sum();
            assert_eq!(count, expected);
        }
    }
    for (start, end, sum) in [(5, 5, 1), (0, 21, 1), (0, 5, 6), (0, 5, 0)] {
        let options =
            ReadOptions { start: Some(start), end: Some(end), sum: Some(sum), ..options.clone() };
        refusal(open(&path, &options));
    }
}

proptest! {
    /// What is packed comes back, on any size, either axis, either order; totals agree with frames.
    #[test]
    fn packed_rows_unpack_to_the_same_bits(
        t in 1usize..40, h in 1usize..20, w in 1usize..40, seed: u64, lsb: bool, along_height: bool,
    ) {
        let folder = scratch();
        let frames = scene(t, h, w, seed);
        let (data, shape): (Vec<u8>, String) = if along_height {
            let data = frames.iter().flat_map(|frame| {
                let columns: Vec<u16> = (0..h * w).map(|i| frame[i % h * w + i / h]).collect();
                let packed = pack(&columns, h, lsb);
                let rows = h.div_ceil(8);
                (0..rows * w).map(|i| packed[i % w * rows + i / w]).collect::<Vec<u8>>()
            });
            (data.collect(), format!("({t}, {}, {w})", h.div_ceil(8)))
        } else {
            let data = frames.iter().flat_map(|frame| pack(frame, w, lsb)).collect();
            (data, format!("({t}, {h}, {})", w.div_ceil(8)))
        };
        let path = write(folder.path(), "a.npy", &npy("|u1", "False", &shape, &data));
        let options = ReadOptions {
            pack_axis: Some(if along_height { PackAxis::Height } else { PackAxis::Width }),
            bit_order: Some(if lsb { BitOrder::Lsb } else { BitOrder::Msb }),
            size: Some(qudi_core::Size { height: h, width: w }),
            ..plain()
        };
        let mut capture = open(&path, &options).unwrap();
        prop_assert_eq!(counts(&mut capture), frames.clone());
        let mut sums = vec![0; h * w];
        capture.total(0..t as u64, &mut sums).unwrap();
        let expected: Vec<u32> =
            (0..h * w).map(|i| frames.iter().map(|f| u32::from(f[i])).sum()).collect();
        prop_assert_eq!(sums, expected);
    }
}
