//! Folders: stacks in parts, missing numbers, strangers, and maps that turn with the frames.

use crate::{counts, npy, open, plain, refusal, scratch, write};
use qudi_io::description::{MaskChoice, Orientation, ReadOptions};
use std::path::Path;

const SIDE: usize = 16;

/// Counts of frame `t`, all different.
fn frame(t: usize) -> Vec<u8> {
    (0..SIDE * SIDE).map(|i| ((i * 7 + t * 13) % 23) as u8).collect()
}

fn tiff(path: &Path, frames: std::ops::Range<usize>) {
    let file = std::fs::File::create(path).unwrap();
    let mut encoder = tiff::encoder::TiffEncoder::new(file).unwrap();
    for t in frames {
        let side = SIDE as u32;
        encoder.write_image::<tiff::encoder::colortype::Gray8>(side, side, &frame(t)).unwrap();
    }
}

fn expected(frames: usize) -> Vec<Vec<u16>> {
    (0..frames).map(|t| frame(t).into_iter().map(u16::from).collect()).collect()
}

#[test]
fn stacks_in_parts_are_read_one_after_the_other() {
    let folder = scratch();
    // In natural order, the last one shorter.
    for (number, frames) in [(2, 0..10), (9, 10..20), (10, 20..27)] {
        tiff(&folder.path().join(format!("rec_{number}.tif")), frames);
    }
    let mut capture = open(folder.path(), &plain()).unwrap();
    assert_eq!(capture.frames(), 27);
    assert!(counts(&mut capture) == expected(27));
    let arrays = scratch();
    for (number, frames) in [(0, 0..4), (1, 4..9)] {
        let bytes: Vec<u8> = frames.clone().flat_map(frame).collect();
        let shape = format!("({}, {SIDE}, {SIDE})", frames.len());
        write(arrays.path(), &format!("a{number}.npy"), &npy("|u1", "False", &shape, &bytes));
    }
    let mut capture = open(arrays.path(), &plain()).unwrap();
    assert!(counts(&mut capture) == expected(9));
    assert!(capture.info().notes.iter().any(|note| note.contains("2 parts")));
}

#[test]
fn sets_of_ome_are_read_from_any_of_their_files() {
    let folder = scratch();
    let names = ["a.ome.tif", "b.ome.tif", "c.ome.tif"];
    let data = |(number, name): (usize, &&str)| {
        format!(
            "<TiffData FirstT=\"{}\" IFD=\"0\" PlaneCount=\"3\"><UUID FileName=\"{name}\">urn:uuid:{number}</UUID></TiffData>",
            3 * number
        )
    };
    let data: String = names.iter().enumerate().map(data).collect();
    let text = format!("<OME><Image><Pixels SizeC=\"1\" SizeT=\"9\">{data}</Pixels></Image></OME>");
    for (number, name) in names.iter().enumerate() {
        let file = std::fs::File::create(folder.path().join(name)).unwrap();
        let mut encoder = tiff::encoder::TiffEncoder::new(file).unwrap();
        for t in 3 * number..3 * number + 3 {
            let side = SIDE as u32;
            let mut image =
                encoder.new_image::<tiff::encoder::colortype::Gray8>(side, side).unwrap();
            let tag = tiff::tags::Tag::ImageDescription;
            image.encoder().write_tag(tag, text.as_str()).unwrap();
            image.write_data(&frame(t)).unwrap();
        }
    }
    for path in [folder.path().join("b.ome.tif"), folder.path().to_owned()] {
        let mut capture = open(&path, &plain()).unwrap();
        assert!(counts(&mut capture) == expected(9), "{}", path.display());
        assert!(capture.info().notes.iter().any(|note| note.contains("3 files of one stack")));
    }
    std::fs::remove_file(folder.path().join("c.ome.tif")).unwrap();
    let path = folder.path().join("a.ome.tif");
    let words = refusal(open(&path, &plain()));
    assert!(words.contains("one of 3 files") && words.contains("lenient"), "{words}");
    let lenient = ReadOptions { lenient: true, ..plain() };
    assert_eq!(open(&path, &lenient).unwrap().frames(), 6);
}

#[test]
fn holes_and_strangers_are_named() {
    let folder = scratch();
    let save = |name: &str, t: usize| {
        let side = SIDE as u32;
        image::GrayImage::from_raw(side, side, frame(t))
            .unwrap()
            .save(folder.path().join(name))
            .unwrap();
    };
    for t in (0..9).chain(14..30) {
        save(&format!("f_{t:04}.png"), t);
    }
    save("mean.png", 3);
    let capture = open(folder.path(), &plain()).unwrap();
    assert_eq!(capture.frames(), 25);
    let notes = capture.info().notes.join("; ");
    assert!(
        notes.contains("numbers 9 to 13 are missing") && notes.contains("`mean.png`"),
        "{notes}"
    );
}

#[test]
fn portable_maps_are_counts_and_bits() {
    let folder = scratch();
    for t in 0..7 {
        let header = format!("P5\n{SIDE} {SIDE}\n255\n").into_bytes();
        write(folder.path(), &format!("f{t}.pgm"), &[header, frame(t)].concat());
    }
    let mut capture = open(folder.path(), &plain()).unwrap();
    assert!(counts(&mut capture) == expected(7));
    // Values stay as they are stored, whatever the largest possible one.
    let deep = scratch();
    let samples: Vec<u16> = (0..SIDE * SIDE).map(|i| (i * 13 % 4001) as u16).collect();
    let bytes: Vec<u8> = samples.iter().flat_map(|sample| sample.to_be_bytes()).collect();
    let header = format!("P5 # twelve bits\n{SIDE} {SIDE} 4095\n").into_bytes();
    let image = [header, bytes].concat();
    let path = write(deep.path(), "a.pgm", &image);
    assert!(counts(&mut open(&path, &plain()).unwrap()) == [samples]);
    let path = write(deep.path(), "two.pgm", &[image.clone(), image].concat());
    let words = refusal(open(&path, &plain()));
    assert!(words.contains("more than one image"), "{words}");
    // Images of one folder are alike.
    let mixed = scratch();
    let eight = [format!("P5\n{SIDE} {SIDE}\n255\n").into_bytes(), frame(0)].concat();
    write(mixed.path(), "f0.pgm", &eight);
    let seven = [format!("P5\n{SIDE} {SIDE}\n7\n").into_bytes(), vec![3; SIDE * SIDE]].concat();
    write(mixed.path(), "f1.pgm", &seven);
    let words = refusal(open(mixed.path(), &plain()));
    assert!(words.contains("samples up to 7 among images of samples up to 255"), "{words}");
    // In PBM a set bit is black: no photon.
    let bits = scratch();
    for t in 0..4u8 {
        let header = format!("P4\n{SIDE} {SIDE}\n").into_bytes();
        write(bits.path(), &format!("f{t}.pbm"), &[header, vec![0xf0 >> t; 2 * SIDE]].concat());
    }
    let mut capture = open(bits.path(), &plain()).unwrap();
    let row = |t: usize| (0..SIDE).map(move |x| u16::from(0xf0u8 >> t << (x % 8) & 0x80 == 0));
    for (t, frame) in counts(&mut capture).iter().enumerate() {
        let expected: Vec<u16> = (0..SIDE).flat_map(|_| row(t)).collect();
        assert_eq!(*frame, expected, "{t}");
    }
}

#[test]
fn dark_rates_are_numbers() {
    let folder = scratch();
    let bytes: Vec<u8> = (0..6).flat_map(frame).collect();
    let path = write(folder.path(), "a.npy", &npy("|u1", "False", "(6, 16, 16)", &bytes));
    let mut rates = [1.0f32; SIDE * SIDE];
    rates[SIDE + 2] = f32::NAN;
    let rates: Vec<u8> = rates.iter().flat_map(|rate| rate.to_le_bytes()).collect();
    let dcr = write(folder.path(), "dcr.npy", &npy("<f4", "False", "(16, 16)", &rates));
    let options = ReadOptions { dcr: Some(dcr), ..ReadOptions::default() };
    let words = refusal(open(&path, &options));
    assert!(words.contains("NaN at row 1, column 2"), "{words}");
}

#[test]
fn maps_turn_with_the_frames() {
    let folder = scratch();
    let bytes: Vec<u8> = (0..6).flat_map(frame).collect();
    let path = write(folder.path(), "a.npy", &npy("|u1", "False", "(6, 16, 16)", &bytes));
    let mut map = [0; SIDE * SIDE];
    map[3] = 1;
    let mask = write(folder.path(), "mask.npy", &npy("|u1", "False", "(16, 16)", &map));
    let bad = |orient| {
        let options = ReadOptions {
            mask: MaskChoice::File(mask.clone()),
            orient: Some(orient),
            ..ReadOptions::default()
        };
        open(&path, &options).unwrap().bad_pixels().hot.clone()
    };
    assert_eq!(bad(Orientation::Raw), [3]);
    assert_eq!(bad(Orientation::Rot180), [SIDE * SIDE - 1 - 3]);
    assert_eq!(bad(Orientation::Transpose), [3 * SIDE]);
}
