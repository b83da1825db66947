//! Every format with every option: applied, or refused by name.

use crate::{npy, pack, plain, refusal, scene, scratch, write};
use qudi_io::capture::Capture;
use qudi_io::codec::FORMATS;
use qudi_io::description::{
    Axes, BitOrder, FormatOption, MaskChoice, Orientation, PackAxis, ReadOptions,
};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Options that give one of them, and what the file needs to be read at all.
fn with(option: FormatOption, base: &ReadOptions) -> ReadOptions {
    let base = base.clone();
    match option {
        FormatOption::Axes => ReadOptions { axes: Some(Axes::Twh), ..base },
        FormatOption::Channel => ReadOptions { channel: Some(9), ..base },
        FormatOption::Array => ReadOptions { array: Some("other".to_owned()), ..base },
        FormatOption::BitOrder => ReadOptions { bit_order: Some(BitOrder::Lsb), ..base },
        FormatOption::PackAxis => ReadOptions { pack_axis: Some(PackAxis::Width), ..base },
        FormatOption::Size => ReadOptions { size: Some("3x5".parse().unwrap()), ..base },
        FormatOption::Levels => ReadOptions { levels: Some(2), ..base },
        FormatOption::Header => ReadOptions { header: Some(1), ..base },
        FormatOption::Trailer => ReadOptions { trailer: Some(1), ..base },
        FormatOption::FramesPerFile => ReadOptions { frames_per_file: Some(1), ..base },
        FormatOption::Offset => ReadOptions { offset: Some(1.0), ..base },
        FormatOption::Threshold => ReadOptions { threshold: Some(1.0), ..base },
    }
}

/// Returns the path of a capture that another program wrote.
fn golden(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/captures").join(name)
}

/// Writes a file that is opened as `format`; `None` if one takes more than a few bytes.
fn file(format: &str, folder: &Path) -> Option<PathBuf> {
    let frames = scene(4, 16, 24, 9);
    let counts: Vec<u8> = frames.iter().flatten().map(|&c| c as u8).collect();
    let array = npy("|b1", "False", "(4, 16, 24)", &counts);
    Some(match format {
        "npy" => write(folder, "a.npy", &array),
        "npy-gz" => {
            let mut gzip =
                flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
            gzip.write_all(&array).unwrap();
            write(folder, "a.npy.gz", &gzip.finish().unwrap())
        }
        "npz" => {
            let mut archive = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
            archive.start_file("a.npy", zip::write::SimpleFileOptions::default()).unwrap();
            archive.write_all(&array).unwrap();
            write(folder, "a.npz", &archive.finish().unwrap().into_inner())
        }
        "images" => {
            let pixels = frames[0].iter().map(|&c| c as u8).collect();
            let path = folder.join("images");
            std::fs::create_dir_all(&path).unwrap();
            image::GrayImage::from_raw(24, 16, pixels).unwrap().save(path.join("a.png")).unwrap();
            path
        }
        "raw-bits" => {
            let bits: Vec<u8> = frames.iter().flat_map(|f| pack(f, 24, false)).collect();
            write(folder, "bits.bin", &bits)
        }
        "tiff" => {
            let path = folder.join("a.tif");
            let mut encoder =
                tiff::encoder::TiffEncoder::new(std::fs::File::create(&path).unwrap()).unwrap();
            for frame in counts.chunks(16 * 24) {
                encoder.write_image::<tiff::encoder::colortype::Gray8>(24, 16, frame).unwrap();
            }
            path
        }
        "raw-u8" | "raw-u16" => write(folder, "counts.bin", &counts),
        "spad512s-sparse" => {
            let words = [5u32, 512 * 512];
            write(folder, "sparse.bin", &words.map(u32::to_le_bytes).concat())
        }
        "qvga" => {
            let path = folder.join("qvga");
            std::fs::create_dir_all(&path).unwrap();
            write(&path, "zeros.bin", &vec![0; 3 * 9600])
        }
        "mat" => golden("mat/plain.mat"),
        "hdf5" => golden("hdf5/contiguous.h5"),
        "visionsim" => golden("visionsim1"),
        "swissspad2" | "swissspad2-full" | "spad512s" | "spad512s-8" | "spad512s-16" => {
            write(folder, "zeros.bin", &vec![0; 1 << 21])
        }
        _ => return None,
    })
}

#[test]
fn rejects_options_that_a_format_does_not_take_by_name() {
    let folder = scratch();
    for format in FORMATS {
        // Refused before anything is read, so that any file will do.
        let path = file(format.name, folder.path())
            .unwrap_or_else(|| write(folder.path(), "any.bin", &[0; 64]));
        let base = ReadOptions { format: Some(format.name.to_owned()), ..plain() };
        for option in FormatOption::ALL.into_iter().filter(|o| !format.options.contains(o)) {
            let words = refusal(Capture::open(&path, &with(option, &base), None));
            let expected = format!("`{}` does not apply to {}", option.name(), format.name);
            assert!(words.contains(&expected), "{}: {words}", format.name);
        }
    }
}

/// Options that name the format, and what its file needs to be read at all.
fn base(format: &str) -> ReadOptions {
    let size = format.starts_with("raw").then(|| "16x24".parse().unwrap());
    ReadOptions { format: Some(format.to_owned()), size, ..plain() }
}

/// Reads a capture with options: all counts of its first frame and its description, or the refusal.
fn outcome(path: &Path, options: &ReadOptions) -> String {
    let read = || -> qudi_core::Result<String> {
        let mut capture = Capture::open(path, options, None)?;
        let mut counts = vec![0; capture.size().pixels()];
        capture.read(0, &mut counts)?;
        let info = capture.info();
        let known = (info.max_count, info.packing, info.binary);
        Ok(format!("{} frames of {}: {counts:?}, {known:?}", capture.frames(), capture.size()))
    };
    read().unwrap_or_else(|e| e.to_string())
}

#[test]
fn applies_options_that_a_format_takes() {
    let folder = scratch();
    for format in FORMATS {
        let Some(path) = file(format.name, folder.path()) else { continue };
        let base = base(format.name);
        let usual = outcome(&path, &base);
        for &option in format.options {
            // Zeros show neither the order of bits nor a pedestal.
            let of_values = [FormatOption::BitOrder, FormatOption::Offset];
            let zeros = path.ends_with("zeros.bin") && of_values.contains(&option);
            let implied = format.name == "raw-bits" && option == FormatOption::PackAxis;
            let options = if implied {
                ReadOptions { pack_axis: Some(PackAxis::Height), ..base.clone() }
            } else {
                with(option, &base)
            };
            let other = outcome(&path, &options);
            assert!(zeros || other != usual, "{} ignores {}", format.name, option.name());
        }
    }
}

/// Options that every format takes: turning, cropping, depth, mosaics, masks and dark maps.
#[test]
fn applies_options_of_all_captures_to_every_format() {
    let folder = scratch();
    let map = |name: &str, size: qudi_core::Size, values: &dyn Fn(usize) -> f32| {
        let bytes: Vec<u8> = (0..size.pixels()).flat_map(|i| values(i).to_le_bytes()).collect();
        let shape = format!("({}, {})", size.height, size.width);
        write(folder.path(), name, &npy("<f4", "False", &shape, &bytes))
    };
    for format in FORMATS {
        let Some(path) = file(format.name, folder.path()) else { continue };
        let base = base(format.name);
        let usual = outcome(&path, &base);
        let size = Capture::open(&path, &base, None).unwrap().size();
        let mask = map("mask.npy", size, &|i| f32::from(i == size.width + 1));
        let dark = map("dark.npy", size, &|i| if i == 0 { 1e6 } else { 0.0 });
        let all = [
            ("orient", ReadOptions { orient: Some(Orientation::Rot180), ..base.clone() }),
            ("crop", ReadOptions { crop: Some("0:8,8:16".parse().unwrap()), ..base.clone() }),
            (
                "cfa",
                ReadOptions {
                    cfa: Some("rggb".parse().unwrap()),
                    channel: Some(0),
                    ..base.clone()
                },
            ),
            ("sum", ReadOptions { sum: Some(2), ..base.clone() }),
            ("start", ReadOptions { start: Some(1), ..base.clone() }),
            ("bits", ReadOptions { bits: Some(5), ..base.clone() }),
            ("bits", ReadOptions { bits: Some(17), ..base.clone() }),
        ];
        for (name, options) in all {
            // Zeros look alike from every side.
            let zeros = path.ends_with("zeros.bin") && name == "orient";
            assert!(zeros || outcome(&path, &options) != usual, "{} ignores {name}", format.name);
        }
        let masked = ReadOptions { mask: MaskChoice::File(mask), ..base.clone() };
        assert_eq!(Capture::open(&path, &masked, None).unwrap().bad_pixels().hot.len(), 1);
        let dcr = ReadOptions { dcr: Some(dark), mask: MaskChoice::Auto, ..base.clone() };
        assert_eq!(Capture::open(&path, &dcr, None).unwrap().bad_pixels().hot, [0]);
        // A channel of a mosaic is one of its planes, whatever the container.
        let plane = |channel| ReadOptions {
            cfa: Some("rggb@0,0".parse().unwrap()),
            channel: Some(channel),
            ..base.clone()
        };
        let opened = Capture::open(&path, &plane(3), None).unwrap().size();
        assert_eq!((opened.height, opened.width), (size.height / 2, size.width / 2));
        assert!(refusal(Capture::open(&path, &plane(4), None)).contains("channel 4 of the mosaic"));
    }
}
