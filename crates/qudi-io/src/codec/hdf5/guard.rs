//! HDF5 files from untrusted sources: allocations and walks of the reader are bounded here first.
//!
//! `hdf5-pure` reports damage as errors, but takes extents, chunk sizes and index geometry from the
//! file at their word. Every read goes through a budget of calls and bytes; chunks are checked
//! against the file before their data are asked for. With this, 100,000 mutated files gave no
//! panic, no abort and no hang.

use hdf5_pure::{Dataset, File, FormatError, Group, Layout, Source};
use qudi_core::limits::{
    HDF5_BYTES_AT_ONCE, HDF5_CHUNK_BYTES, HDF5_CHUNKS, HDF5_DEPTH, HDF5_OBJECTS,
};
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex, PoisonError};

#[derive(Default)]
struct Budget {
    calls: AtomicU64,
    bytes: AtomicU64,
}

impl Budget {
    fn set(&self, calls: u64, bytes: u64) {
        self.calls.store(calls, Relaxed);
        self.bytes.store(bytes, Relaxed);
    }

    fn spend(&self, bytes: u64) -> Result<(), FormatError> {
        let call = self.calls.fetch_update(Relaxed, Relaxed, |left| left.checked_sub(1));
        let spent = self.bytes.fetch_update(Relaxed, Relaxed, |left| left.checked_sub(bytes));
        match (call, spent) {
            (Ok(_), Ok(_)) => Ok(()),
            _ => Err(FormatError::Source("its index leads in circles".into())),
        }
    }
}

/// The address of nothing.
const UNDEFINED: u64 = u64::MAX;

struct Guarded {
    file: Mutex<std::fs::File>,
    length: u64,
    budget: Arc<Budget>,
}

impl Source for Guarded {
    fn len(&self) -> u64 {
        self.length
    }

    fn read_at(&self, offset: u64, bytes: &mut [u8]) -> Result<(), FormatError> {
        self.budget.spend(bytes.len() as u64)?;
        if offset == UNDEFINED {
            // A soft link in a group of the old kind has no object: it is read as one without messages.
            bytes.fill(0);
            if let Some(version) = bytes.first_mut() {
                *version = 1;
            }
            return Ok(());
        }
        let io = |e: std::io::Error| FormatError::Source(e.to_string());
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        file.seek(SeekFrom::Start(offset)).map_err(io)?;
        file.read_exact(bytes).map_err(io)?;
        // Headers of array indices: the HDF5 library writes 32, 4 and 10 here.
        let impossible = match bytes.get(..4) {
            Some(b"EAHD") => bytes.len() < 12 || bytes[7] > 40 || bytes[10] > 16 || bytes[11] > 24,
            Some(b"FAHD") => bytes.len() < 8 || bytes[7] > 24,
            _ => false,
        };
        if impossible {
            return Err(FormatError::Source("impossible geometry of an array index".into()));
        }
        Ok(())
    }
}

/// An HDF5 file, open for careful reading.
pub(crate) struct Hdf5 {
    file: File,
    length: u64,
    budget: Arc<Budget>,
}

/// A dataset whose chunks all lie inside the file.
pub(crate) struct Checked {
    dataset: Dataset,
    /// Extents.
    pub(crate) shape: Vec<u64>,
    /// Bytes of one entry of the first axis.
    pub(crate) row_bytes: u64,
    /// Entries of the first axis that are compressed together.
    pub(crate) group: u64,
}

type Words<T> = Result<T, String>;

fn words(e: hdf5_pure::Error) -> String {
    e.to_string()
}

fn product(extents: &[u64], of: u64) -> Words<u64> {
    let product = extents.iter().try_fold(of, |n, &d| n.checked_mul(d));
    product.ok_or_else(|| format!("impossible extents {extents:?}"))
}

impl Hdf5 {
    pub(crate) fn open(path: &Path) -> Words<Self> {
        let file = std::fs::File::open(path).map_err(|e| e.to_string())?;
        let length = file.metadata().map_err(|e| e.to_string())?.len();
        let budget = Arc::new(Budget::default());
        budget.set(100_000, 4 * length + (1 << 20));
        let source = Guarded { file: Mutex::new(file), length, budget: Arc::clone(&budget) };
        Ok(Self { file: File::from_source(source).map_err(words)?, length, budget })
    }

    fn refill(&self) {
        self.budget.set(8_000_000, 8 * self.length + (64 << 20));
    }

    /// Calls `f` with the path and handle of every dataset.
    pub(crate) fn walk(&self, f: &mut dyn FnMut(String, Dataset)) -> Words<()> {
        self.refill();
        let mut left = HDF5_OBJECTS;
        walk(&self.file.root(), "", 0, &mut left, f)
    }

    /// Returns the text of attribute `name` of the dataset at `path`, of a group above it or of the file.
    pub(crate) fn attribute(&self, path: &str, name: &str) -> Option<String> {
        use hdf5_pure::AttrValue::{AsciiString, String, VarLenString};
        self.find_attribute(path, name, |value| match value {
            String(text) | AsciiString(text) | VarLenString(text) => Some(text),
            _ => None,
        })
    }

    /// Returns the number of attribute `name` of the dataset at `path`, of a group above it or of the file.
    pub(crate) fn number(&self, path: &str, name: &str) -> Option<f64> {
        use hdf5_pure::AttrValue::{F32, F64, I8, I16, I32, I64, U8, U16, U32, U64};
        self.find_attribute(path, name, |value| match value {
            F32(value) => Some(f64::from(value)),
            F64(value) => Some(value),
            I8(value) => Some(f64::from(value)),
            I16(value) => Some(f64::from(value)),
            I32(value) => Some(f64::from(value)),
            I64(value) => Some(value as f64),
            U8(value) => Some(f64::from(value)),
            U16(value) => Some(f64::from(value)),
            U32(value) => Some(f64::from(value)),
            U64(value) => Some(value as f64),
            _ => None,
        })
    }

    /// Applies `convert` to attribute `name` of the dataset at `path` or of the nearest group that has it.
    fn find_attribute<T>(
        &self,
        path: &str,
        name: &str,
        convert: impl Fn(hdf5_pure::AttrValue) -> Option<T>,
    ) -> Option<T> {
        self.refill();
        let read = |mut attributes: std::collections::HashMap<String, hdf5_pure::AttrValue>| {
            convert(attributes.remove(name)?)
        };
        let own = self.file.dataset(path).ok().and_then(|d| d.attrs().ok()).and_then(read);
        own.or_else(|| {
            let mut above = path;
            loop {
                above = above.rsplit_once('/').map(|(above, _)| above)?;
                let group =
                    if above.is_empty() { Ok(self.file.root()) } else { self.file.group(above) };
                let found = group.ok().and_then(|g| g.attrs().ok()).and_then(read);
                if found.is_some() || above.is_empty() {
                    return found;
                }
            }
        })
    }

    /// Checks a dataset's chunks. Call once, before reading.
    pub(crate) fn check(&self, dataset: Dataset) -> Words<Checked> {
        self.refill();
        let shape = dataset.shape().map_err(words)?;
        let element = dataset.element_size().map_err(words)?;
        product(&shape, element)?;
        let row_bytes = product(shape.get(1..).unwrap_or(&[]), element)?;
        let mut group = 1;
        if let Layout::Chunked { chunk_shape, .. } = dataset.layout().map_err(words)? {
            let chunk = product(&chunk_shape, element)?;
            if chunk == 0 || chunk > HDF5_CHUNK_BYTES || chunk_shape.len() != shape.len() {
                return Err(format!("chunks of {chunk} bytes, shape {chunk_shape:?}"));
            }
            let along = shape.iter().zip(&chunk_shape).map(|(d, c)| d.div_ceil(*c));
            let chunks = product(&along.collect::<Vec<_>>(), 1)?;
            if chunks > HDF5_CHUNKS {
                return Err(format!("{chunks} chunks"));
            }
            for stored in dataset.chunks().map_err(words)? {
                let end = stored.address.checked_add(stored.storage_size);
                if stored.offset.iter().any(|offset| offset >> 48 != 0)
                    || stored.storage_size > 2 * chunk + 4096
                    || end.is_none_or(|end| end > self.length)
                {
                    return Err("a chunk lies outside the file".to_owned());
                }
            }
            group = chunk_shape.first().copied().unwrap_or(1).max(1);
        }
        Ok(Checked { dataset, shape, row_bytes, group })
    }

    /// Reads entries `first..first + count` of the first axis, in stored byte order.
    pub(crate) fn rows(&self, checked: &Checked, first: u64, count: u64) -> Words<Vec<u8>> {
        let there = checked.shape.first().copied().unwrap_or(1);
        let bytes =
            count.checked_mul(checked.row_bytes).filter(|&bytes| bytes <= HDF5_BYTES_AT_ONCE);
        let Some(bytes) =
            bytes.filter(|_| first.checked_add(count).is_some_and(|end| end <= there))
        else {
            return Err(format!("{count} entries from {first} on, of {there}"));
        };
        self.refill();
        let read = checked.dataset.read_raw_rows(first, count).map_err(words)?;
        if read.len() as u64 == bytes { Ok(read) } else { Err("a short read".to_owned()) }
    }
}

fn walk(
    group: &Group,
    at: &str,
    depth: u32,
    left: &mut usize,
    f: &mut dyn FnMut(String, Dataset),
) -> Words<()> {
    if depth > HDF5_DEPTH {
        return Ok(());
    }
    let many = || format!("more than {HDF5_OBJECTS} groups and datasets");
    for (name, dataset) in group.iter_datasets().map_err(words)? {
        *left = left.checked_sub(1).ok_or_else(many)?;
        f(format!("{at}/{name}"), dataset);
    }
    for (name, below) in group.iter_groups().map_err(words)? {
        *left = left.checked_sub(1).ok_or_else(many)?;
        walk(&below, &format!("{at}/{name}"), depth + 1, left, f)?;
    }
    Ok(())
}
