//! Cubes of the Single Photon Challenge: `SCENE/FRAME.npy` of packed bit planes in three colours, and the
//! picture of the last one, `SCENE/FRAME.png`, where it is public.

use crate::error::{CliError, Result};
use image::{ImageReader, RgbImage};
use qudi_core::natural_order::natural_order;
use qudi_core::npy::{Header, Sample};
use qudi_core::regular_file::open_regular;
use qudi_core::{Error, Size};
use qudi_io::codec::GivenArray;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Colours of a cube.
pub(super) const COLOURS: usize = 3;

/// A cube of a set.
#[derive(Clone, Debug)]
pub(super) struct Cube {
    /// Its place in the set without extension, as in `attic/000000`.
    pub(super) name: String,
    path: PathBuf,
    header: Header,
}

impl Cube {
    /// Finds the cubes of a set, in the order of their names.
    ///
    /// # Errors
    /// [`CliError`] if there are none, or one is not of the challenge's layout.
    pub(super) fn find(set: &Path) -> Result<Vec<Self>> {
        let mut cubes = Vec::new();
        for scene in names(set)? {
            let folder = set.join(&scene);
            if !folder.is_dir() {
                continue;
            }
            for file in names(&folder)? {
                if let Some(frame) = file.strip_suffix(".npy") {
                    cubes.push(Self::open(format!("{scene}/{frame}"), folder.join(&file))?);
                }
            }
        }
        if cubes.is_empty() {
            return Err(CliError::new(
                "no cubes of the challenge",
                set.display(),
                "name the folder of scenes, as in train/ with train/attic/000000.npy",
            ));
        }
        Ok(cubes)
    }

    fn open(name: String, path: PathBuf) -> Result<Self> {
        let (header, _) = Header::open(&path)?;
        let is_cube = header.sample == Sample::U8 && !header.fortran && header.shape.len() == 4;
        if !is_cube || header.shape[3] != COLOURS || header.shape.contains(&0) {
            return Err(CliError::new(
                format!("an array of {:?}, and no packed cube of three colours", header.shape),
                path.display(),
                "cubes have [bit planes, rows, columns / 8, 3] bytes; leave --challenge out for other captures",
            ));
        }
        Ok(Self { name, path, header })
    }

    /// Returns the size of the picture.
    pub(super) fn size(&self) -> Size {
        Size { height: self.header.shape[1], width: 8 * self.header.shape[2] }
    }

    /// Returns the bit planes of a colour, the last one first: the picture belongs to the last one, and so to
    /// the begin of what is restored.
    ///
    /// # Errors
    /// [`Error`] if the file cannot be opened.
    pub(super) fn reversed_planes(&self, colour: usize) -> qudi_core::Result<GivenArray> {
        let shape = self.header.shape[..3].to_vec();
        let (planes, bytes) = (shape[0] as u64, shape[1] * shape[2] * COLOURS);
        let (start, path) = (self.header.data_start, self.path.clone());
        let mut file = open_regular(&path, "open the cube")?;
        let mut plane = vec![0; bytes];
        let fetch = move |first: u64, count: u64| {
            let mut fetched = Vec::with_capacity(count as usize * bytes / COLOURS);
            for number in first..first + count {
                read_at(&mut file, start + (planes - 1 - number) * bytes as u64, &mut plane)
                    .map_err(|e| Error::io("read the cube", &path, e))?;
                fetched.extend(plane.iter().skip(colour).step_by(COLOURS));
            }
            Ok(fetched)
        };
        let name = self.path.display().to_string();
        Ok(GivenArray { name, sample: Sample::U8, shape, fetch: Box::new(fetch) })
    }

    /// Returns true if no pixel of a colour ever fires.
    ///
    /// # Errors
    /// [`CliError`] if the file cannot be read.
    pub(super) fn is_dark(&self, colour: usize) -> Result<bool> {
        let mut planes = self.reversed_planes(colour)?;
        for number in 0..planes.shape[0] as u64 {
            if (planes.fetch)(number, 1)?.iter().any(|&byte| byte > 0) {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Returns the true picture; none for cubes of the test set.
    ///
    /// # Errors
    /// [`CliError`] if it cannot be read, or has another size.
    pub(super) fn truth(&self) -> Result<Option<RgbImage>> {
        let path = self.path.with_extension("png");
        if !path.exists() {
            return Ok(None);
        }
        let fault = |what: String| CliError::new(what, path.display(), "unpack the set again");
        let open = || {
            let file = BufReader::new(open_regular(&path, "open the true picture")?);
            let reader = ImageReader::new(file).with_guessed_format();
            reader.map_err(|e| fault(format!("cannot read the true picture: {e}")))
        };
        let unreadable = |e: image::ImageError| fault(format!("cannot read the true picture: {e}"));
        let size = self.size();
        let (width, height) = open()?.into_dimensions().map_err(unreadable)?;
        if (height as usize, width as usize) != (size.height, size.width) {
            return Err(fault(format!(
                "a true picture of {height} x {width} for a cube of {size}"
            )));
        }
        Ok(Some(open()?.decode().map_err(unreadable)?.into_rgb8()))
    }
}

fn read_at(file: &mut File, place: u64, bytes: &mut [u8]) -> std::io::Result<()> {
    file.seek(SeekFrom::Start(place))?;
    file.read_exact(bytes)
}

/// Returns the names in a folder in natural order. Names that are no text have no place in an archive.
fn names(folder: &Path) -> Result<Vec<String>> {
    let fault = |e: std::io::Error| {
        CliError::new(format!("cannot list: {e}"), folder.display(), "name a folder")
    };
    let mut names = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(fault)? {
        let name = entry.map_err(fault)?.file_name();
        let name = name.into_string().map_err(|name| {
            CliError::new("a name that is no text", folder.join(name).display(), "rename it")
        })?;
        names.push(name);
    }
    names.sort_by(|a, b| natural_order(a, b));
    Ok(names)
}
