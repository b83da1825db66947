//! Formats of captures: one file and one line each.
//!
//! Writers are in [`writer`](crate::writer): they share the atomic file and the record, and write few
//! formats.

mod array;
mod companions;
mod given;
#[cfg(feature = "hdf5")]
mod hdf5;
mod images;
mod mat;
mod npy;
mod npz;
mod parts;
mod piped;
mod qvga;
mod raw;
mod spad512s;
mod sparse;
mod swissspad2;
mod tiff;
mod video;
mod visionsim;

pub use companions::files_of;
pub use given::{FetchFrames, GivenArray};
pub(crate) use piped::open_pipe;

use crate::description::{CaptureInfo, Certainty, FormatOption, ReadOptions, refuse_others};
use crate::frames::CountFrames;
use crate::recognition::Probe;
use qudi_core::{Error, Result};
use std::path::Path;

/// One way to store a capture.
#[derive(Debug)]
pub struct Format {
    /// Name for the option `format`.
    pub name: &'static str,
    /// Name in words.
    pub title: &'static str,
    /// Recognises the format, with reasons.
    probe: fn(&Probe) -> Result<Option<Recognition>>,
    /// Options that it takes.
    pub options: &'static [FormatOption],
    /// Opens it.
    open: fn(&Probe, &ReadOptions, &mut CaptureInfo) -> Result<Box<dyn CountFrames>>,
}

/// The certainty that a path is of a format, and the reasons.
pub(crate) struct Recognition {
    certainty: Certainty,
    reasons: Vec<String>,
}

impl Recognition {
    fn new(certainty: Certainty, reasons: &[&str]) -> Self {
        Self { certainty, reasons: reasons.iter().map(|&e| e.to_owned()).collect() }
    }
}

/// All formats. A new one takes a file in `codec/`, a line here, and a row in `docs/formats.md`.
pub const FORMATS: &[Format] = &[
    npy::FORMAT,
    npy::COMPRESSED,
    npz::FORMAT,
    visionsim::FORMAT,
    swissspad2::HALF_ARRAY,
    swissspad2::FULL_ARRAY,
    spad512s::BINARY,
    spad512s::BYTES,
    spad512s::WORDS,
    sparse::FORMAT,
    qvga::FORMAT,
    tiff::FORMAT,
    parts::FORMAT,
    images::FORMAT,
    mat::FORMAT,
    #[cfg(feature = "hdf5")]
    hdf5::FORMAT,
    video::FORMAT,
    raw::BITS,
    raw::BYTES,
    raw::WORDS,
];

/// Opens `path` in the format that `options` name, or else in the best match.
pub(crate) fn open(
    path: &Path,
    options: &ReadOptions,
) -> Result<(Box<dyn CountFrames>, CaptureInfo)> {
    let probe = Probe::new(path, options.size)?;
    if let Some(name) = &options.format {
        let format = by_name(name)?;
        let mut info = CaptureInfo::new(format.name, format.title);
        info.reasons.push("`format`".to_owned());
        return open_as(format, &probe, options, info);
    }
    let mut found = Vec::new();
    for format in FORMATS {
        if let Some(fit) = (format.probe)(&probe)? {
            found.push((format, fit));
        }
    }
    let Some(best) = found.iter().map(|(_, fit)| fit.certainty).max() else {
        return Err(unknown(&probe));
    };
    found.retain(|(_, fit)| fit.certainty == best);
    if found.len() > 1 || best == Certainty::Possible {
        return Err(ambiguous(&probe, &found));
    }
    let (format, fit) = found.remove(0);
    let mut info = CaptureInfo::new(format.name, format.title);
    info.certainty = fit.certainty;
    info.reasons = fit.reasons;
    open_as(format, &probe, options, info)
}

fn open_as(
    format: &Format,
    probe: &Probe,
    options: &ReadOptions,
    mut info: CaptureInfo,
) -> Result<(Box<dyn CountFrames>, CaptureInfo)> {
    let options = &options.of_container(options.cfa.is_some());
    refuse_others(options, format.options, format.name)?;
    let frames = (format.open)(probe, options, &mut info)?;
    info.notes.extend(probe.note_on_skipped());
    Ok((frames, info))
}

/// Options of arrays: axes, packing, colour.
const ARRAY_OPTIONS: &[FormatOption] = &[
    FormatOption::Axes,
    FormatOption::Channel,
    FormatOption::BitOrder,
    FormatOption::PackAxis,
    FormatOption::Size,
    FormatOption::Levels,
    FormatOption::Offset,
    FormatOption::Threshold,
];

/// Options of files that hold several arrays.
const ARRAYS_OPTIONS: &[FormatOption] = &[
    FormatOption::Axes,
    FormatOption::Channel,
    FormatOption::Array,
    FormatOption::BitOrder,
    FormatOption::PackAxis,
    FormatOption::Size,
    FormatOption::Levels,
    FormatOption::Offset,
    FormatOption::Threshold,
];

/// Options of pictures.
const PICTURE_OPTIONS: &[FormatOption] = &[
    FormatOption::Axes,
    FormatOption::Channel,
    FormatOption::Levels,
    FormatOption::Offset,
    FormatOption::Threshold,
];

/// Options of headerless files of packed bits, whose frame size the format knows.
const BIT_FILE_OPTIONS: &[FormatOption] = &[
    FormatOption::BitOrder,
    FormatOption::Header,
    FormatOption::Trailer,
    FormatOption::FramesPerFile,
];

/// Options of headerless files of packed bits of any size.
const SIZED_BIT_FILE_OPTIONS: &[FormatOption] = &[
    FormatOption::BitOrder,
    FormatOption::Size,
    FormatOption::Header,
    FormatOption::Trailer,
    FormatOption::FramesPerFile,
];

fn by_name(name: &str) -> Result<&'static Format> {
    FORMATS.iter().find(|format| format.name == name).ok_or_else(|| {
        let names: Vec<_> = FORMATS.iter().map(|format| format.name).collect();
        let hint = qudi_core::nearest::nearest(name, &names)
            .map_or(String::new(), |n| format!("did you mean `{n}`?  "));
        Error::request(
            format!("no format named `{name}`"),
            "format",
            format!("{hint}there are {}", names.join(", ")),
        )
    })
}

/// Formats of other programs, by magic number or extension: their name, and what converts them.
const FOREIGN_FORMATS: &[(&[u8], &[&str], &str, &str)] = &[
    (
        b"PQTTTR",
        &["ptu", "pt3", "ht3", "phu"],
        "a PicoQuant file of photon arrival times",
        "bin its photons into frames first, as with `ptufile` or `phconvert` in Python, and save them with numpy.save",
    ),
    (
        b"",
        &["spc", "sdt"],
        "a Becker & Hickl file of photon arrival times",
        "bin its photons into frames first, as with `sdtfile` or `phconvert` in Python, and save them with numpy.save",
    ),
    (
        b"SIMPLE  =",
        &["fits", "fit", "fts"],
        "a FITS file",
        "save its cube in Python: numpy.save('capture.npy', astropy.io.fits.getdata(NAME))",
    ),
    (
        b"ZISRAWFILE",
        &["czi", "nd2", "lif", "oib", "oif", "lsm", "ims", "dv", "mrc"],
        "a microscope's own format",
        "export it from ImageJ (Bio-Formats) as a TIFF stack of 8 or 16 bits",
    ),
    (
        b"LUCAM-RECORDER",
        &["ser"],
        "a SER video of an astronomer's camera",
        "export its frames as a multi-page TIFF or FITS, as PIPP, Siril or `serpy` do, and name that",
    ),
    (
        b"Andor Technology",
        &["sif", "dcimg", "cine", "mraw", "cih", "cihx", "b16", "seq", "spe", "xcap"],
        "a camera's own format",
        "export it from the camera's software as a TIFF stack of 16 bits, uncompressed and unscaled",
    ),
    (
        b"% evt",
        &["aedat4", "aedat", "evt", "dat2"],
        "a file of an event camera, which counts no photons",
        "captures are frames of photon counts",
    ),
    (b"SQLite format 3", &["db", "sqlite"], "a database", "export its frames with numpy.save"),
    (
        b"\x1f\x8b",
        &["tgz"],
        "a compressed file",
        "unpack it, or name it NAME.npy.gz if it is a NumPy array",
    ),
    (b"PK\x03\x04", &["zip"], "a zip archive", "unpack it, and name one capture in it"),
    (
        b"7z\xbc\xaf\x27\x1c",
        &["7z", "rar", "tar", "bz2", "xz", "zst"],
        "an archive",
        "unpack it, and name one capture in it",
    ),
];

/// Returns the error of a file of another program's format, with the remedy.
fn foreign(probe: &Probe) -> Option<Error> {
    if probe.is_folder {
        return None;
    }
    let by_magic = FOREIGN_FORMATS
        .iter()
        .find(|(magic, ..)| !magic.is_empty() && probe.head.starts_with(magic));
    let by_name = || {
        FOREIGN_FORMATS.iter().find(|(_, extensions, ..)| extensions.contains(&&*probe.extension))
    };
    let (_, _, what, help) = by_magic.or_else(by_name)?;
    Some(Error::data(*what, &probe.path, *help))
}

fn unknown(probe: &Probe) -> Error {
    let is_zarr = |name: &str| probe.path.join(name).is_file();
    if probe.is_folder && [".zarray", ".zgroup", "zarr.json"].into_iter().any(is_zarr) {
        return Error::data(
            "a Zarr store",
            &probe.path,
            "save one array of it in Python: numpy.save('capture.npy', zarr.open(NAME)[:])",
        );
    }
    if let Some(error) = foreign(probe) {
        return error;
    }
    let hdf5 = probe.head.starts_with(b"\x89HDF\r\n\x1a\n")
        || probe.head.get(512..520).is_some_and(|magic| magic == b"\x89HDF\r\n\x1a\n");
    if hdf5 {
        return Error::data(
            "an HDF5 file (or MATLAB 7.3), and this build reads none",
            &probe.path,
            "build with --features hdf5, or save it in Python: numpy.save('capture.npy', h5py.File(NAME)[DATASET])",
        );
    }
    let what = if probe.is_folder {
        "the folder holds no capture in a known format"
    } else {
        "no known format"
    };
    if let Some(inside) = inside(probe) {
        return Error::data(what, &probe.path, format!("name one capture, as {inside}"));
    }
    Error::data(
        what,
        &probe.path,
        "`qudi info --formats` lists what is read; a file without header is read with `format raw-bits`, raw-u8 or raw-u16 and `size HxW`",
    )
}

/// Returns a file or folder inside that could be a capture.
fn inside(probe: &Probe) -> Option<String> {
    let files = probe.files(&["npy", "npz", "gz", "tif", "tiff", "h5", "png"]).ok()?;
    let file = files.first().filter(|_| probe.is_folder)?;
    let picture = file.extension().is_some_and(|e| e == "png");
    let path = if picture { file.parent()? } else { file };
    Some(path.display().to_string())
}

fn ambiguous(probe: &Probe, found: &[(&Format, Recognition)]) -> Error {
    let candidates: Vec<String> = found
        .iter()
        .map(|(format, fit)| {
            let reasons = fit.reasons.join(", ");
            let why = if reasons.is_empty() { reasons } else { format!(" ({reasons})") };
            format!("{}{why}", format.name)
        })
        .collect();
    Error::data(
        format!("the format is ambiguous: {}", candidates.join("; ")),
        &probe.path,
        format!("say which it is, as in `format {}`", found[0].0.name),
    )
}

/// Reads the map `name` of a MATLAB file, or its only array of two dimensions.
pub(crate) fn read_mat_map(path: &Path, name: &str) -> Result<qudi_core::Frame> {
    let arrays = mat::file::arrays(path)?;
    let mut maps = arrays.iter().filter(|a| a.dims.len() == 2 && a.dims.iter().all(|&d| d > 1));
    let found =
        arrays.iter().find(|a| a.name == name).or_else(|| match (maps.next(), maps.next()) {
            (Some(one), None) => Some(one),
            _ => None,
        });
    match found {
        Some(array) => mat::file::read_map(array, path),
        None => Err(Error::data(
            format!("no variable `{name}` in it"),
            path,
            "save the map as a matrix of height x width",
        )),
    }
}
