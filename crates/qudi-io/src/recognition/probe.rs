//! Facts about a path, shared by all formats that try to recognise it.

use super::raw_sample::{RawSample, stem};
use qudi_core::limits::FOLDER_FILES;
use qudi_core::natural_order::natural_order;
use qudi_core::{Error, Result, Size};
use std::cell::OnceCell;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Bytes read from the start of a file.
const HEAD_BYTES: u64 = 4096;

/// Bytes read from the middle of a file.
const SAMPLE_BYTES: u64 = 1 << 20;

/// Levels of folders that are listed: SwissSPAD2 uses two below the capture.
const FOLDER_DEPTH: usize = 3;

/// Facts about a path.
#[derive(Debug)]
pub(crate) struct Probe {
    pub(crate) path: PathBuf,
    pub(crate) is_folder: bool,
    /// Length of a file in bytes.
    pub(crate) length: u64,
    /// Extension in lower case, without the dot.
    pub(crate) extension: String,
    /// First bytes of a file.
    pub(crate) head: Vec<u8>,
    /// Frame size given by the user.
    pub(crate) size: Option<Size>,
    files: OnceCell<Listing>,
    /// Result of [`Probe::raw_sample`], which several formats call.
    raw_sample: OnceCell<Option<RawSample>>,
}

impl Probe {
    /// Probes `path`, whose frames are of `size` if it is given.
    ///
    /// # Errors
    /// [`Error::Io`] if it cannot be read.
    pub(crate) fn new(path: &Path, size: Option<Size>) -> Result<Self> {
        let io = |e| Error::io("open the capture", path, e);
        let found = std::fs::metadata(path).map_err(io)?;
        let mut head = Vec::new();
        if found.is_file() {
            File::open(path).map_err(io)?.take(HEAD_BYTES).read_to_end(&mut head).map_err(io)?;
            if head.is_empty() {
                return Err(Error::data("the file is empty", path, "copy or export it again"));
            }
        } else if !found.is_dir() {
            return Err(Error::data(
                "not a regular file or folder",
                path,
                "store the capture in a file first, or pipe it into `qudi restore -`",
            ));
        }
        Ok(Self {
            path: path.to_owned(),
            is_folder: found.is_dir(),
            length: found.len(),
            extension: path.extension().unwrap_or_default().to_string_lossy().to_lowercase(),
            head,
            size,
            files: OnceCell::new(),
            raw_sample: OnceCell::new(),
        })
    }

    /// Returns the file name without its extension.
    pub(crate) fn stem(&self) -> String {
        stem(&self.path)
    }

    /// Reads facts about the `.bin` file, or the first one of the folder; `None` if there is none.
    pub(crate) fn raw_sample(&self) -> Result<Option<RawSample>> {
        if let Some(sample) = self.raw_sample.get() {
            return Ok(*sample);
        }
        let is_raw = self.is_folder || self.has_extension(&["bin", "raw"]);
        let first = if is_raw { self.files(&["bin"])?.into_iter().next() } else { None };
        let sample = first.map(|path| RawSample::read(&path)).transpose()?;
        Ok(*self.raw_sample.get_or_init(|| sample))
    }

    /// Returns true if it is a file with one of these extensions.
    pub(crate) fn has_extension(&self, extensions: &[&str]) -> bool {
        !self.is_folder && extensions.contains(&self.extension.as_str())
    }

    /// Lists the file itself, or the files of the folder with these extensions, in the order of their
    /// numbers.
    pub(crate) fn files(&self, extensions: &[&str]) -> Result<Vec<PathBuf>> {
        if !self.is_folder {
            return Ok(vec![self.path.clone()]);
        }
        if self.files.get().is_none() {
            let mut listing = Listing::default();
            list(&self.path, FOLDER_DEPTH, &mut listing)?;
            let relative =
                |p: &Path| p.strip_prefix(&self.path).unwrap_or(p).to_string_lossy().into_owned();
            listing.files.sort_by_cached_key(|p| Natural(relative(p)));
            let _ = self.files.set(listing);
        }
        let matches = |path: &&PathBuf| {
            let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
            extensions.contains(&extension.as_str())
        };
        let listed = self.files.get().into_iter().flat_map(|listing| &listing.files);
        Ok(listed.filter(matches).cloned().collect())
    }

    /// Returns a note on the entries of the folder that were skipped.
    pub(crate) fn note_on_skipped(&self) -> Option<String> {
        let skipped = &self.files.get()?.skipped;
        let name = skipped.first()?.file_name()?.to_string_lossy().into_owned();
        Some(format!(
            "{} entries of the folder are no regular files and were skipped, `{name}` among them",
            skipped.len()
        ))
    }

    /// Reads bytes from the middle of a file, at a multiple of `align` bytes.
    pub(crate) fn middle(&self, align: u64) -> Result<Vec<u8>> {
        let path = if self.is_folder {
            self.files(&["bin"])?.into_iter().next().unwrap_or_default()
        } else {
            self.path.clone()
        };
        let io = |e| Error::io("read", &path, e);
        let mut file = File::open(&path).map_err(io)?;
        let length = file.metadata().map_err(io)?.len();
        let from = (length / 2).saturating_sub(SAMPLE_BYTES / 2) / align * align;
        let mut bytes = Vec::new();
        file.seek(SeekFrom::Start(from)).map_err(io)?;
        file.take(SAMPLE_BYTES).read_to_end(&mut bytes).map_err(io)?;
        Ok(bytes)
    }
}

/// The entries of a folder and of the folders in it.
#[derive(Debug, Default)]
struct Listing {
    files: Vec<PathBuf>,
    /// Broken links, pipes, devices, and folders named like pictures.
    skipped: Vec<PathBuf>,
}

fn list(folder: &Path, depth: usize, listing: &mut Listing) -> Result<()> {
    let io = |e| Error::io("list the folder", folder, e);
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let path = entry.map_err(io)?.path();
        let hidden = path.file_name().is_some_and(|n| n.to_string_lossy().starts_with('.'));
        if hidden {
            continue;
        }
        if path.is_dir() {
            if path.extension().is_some_and(|e| e == "png" || e == "tif" || e == "tiff") {
                listing.skipped.push(path);
            } else if depth > 1 {
                list(&path, depth - 1, listing)?;
            }
        } else if path.is_file() {
            listing.files.push(path);
        } else {
            // Reading a named pipe would block forever.
            listing.skipped.push(path);
        }
        if listing.files.len() > FOLDER_FILES {
            return Err(Error::data(
                format!("more than {FOLDER_FILES} files"),
                folder,
                "name the folder of one capture",
            ));
        }
    }
    Ok(())
}

#[derive(PartialEq, Eq)]
struct Natural(String);

impl Ord for Natural {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        natural_order(&self.0, &other.0)
    }
}

impl PartialOrd for Natural {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}
