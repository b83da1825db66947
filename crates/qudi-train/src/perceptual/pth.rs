//! Reads PyTorch's `.pth` files of weights: both layouts of `torch.save`, 32-bit floats.
//!
//! The newer layout (since PyTorch 1.6) is a zip archive of a pickle, `*/data.pkl`, and of one member
//! `*/data/KEY` for every storage. The older one is four pickles (a magic number, a version, facts about the
//! machine, the dictionary), a fifth with the keys of all storages, and then for every key the number of its
//! values in eight bytes, and the values. Files come from elsewhere: nothing in them is executed, and nothing
//! is allocated because they say so.

mod heap;
mod pickle;
#[cfg(test)]
mod tests;

use heap::{Heap, Value, View};
use qudi_core::{Result, SimError};
use std::collections::HashMap;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use zip::ZipArchive;

/// Longest dictionary, without the numbers: those of the networks here have some kilobytes.
const LONGEST_PICKLE: u64 = 4 << 20;

/// Longest name of a tensor, bytes: those of the networks here have at most forty.
const LONGEST_NAME: usize = 256;

/// What files of the older layout start with, a number of ten bytes: the lower eight.
const MAGIC: i64 = 0xA86A_20F9_469C_FC6C_u64 as i64;

/// Version of the older layout.
const VERSION: i64 = 1001;

/// One file of named tensors.
pub(super) struct StateDict {
    path: PathBuf,
    heap: Heap,
    tensors: HashMap<String, View>,
    numbers: Numbers,
}

/// Where the numbers are.
enum Numbers {
    /// Members of an archive, their names after this prefix.
    Zip(Box<ZipArchive<BufReader<File>>>, String),
    /// Places in the file, by key.
    Plain(BufReader<File>, HashMap<String, u64>),
}

impl StateDict {
    /// Reads the names; the numbers follow when asked for.
    ///
    /// # Errors
    /// [`SimError`] if it cannot be read, or is no dictionary of tensors.
    pub(super) fn open(path: &Path) -> Result<Self> {
        let failed = |e| SimError::io("read the weights", path, e);
        let mut file = BufReader::new(File::open(path).map_err(failed)?);
        let mut start = [0; 4];
        let length = (&mut file).take(4).read(&mut start).map_err(failed)?;
        file.rewind().map_err(failed)?;
        if start[..length] == *b"PK\x03\x04" {
            Self::zip(path, file)
        } else {
            Self::plain(path, file)
        }
    }

    fn zip(path: &Path, file: BufReader<File>) -> Result<Self> {
        let broken = |e: &dyn std::fmt::Display| refused(path, format!("a broken archive: {e}"));
        let mut archive = ZipArchive::new(file).map_err(|e| broken(&e))?;
        let name = archive.file_names().flatten().find(|name| name.ends_with("data.pkl"));
        let name = name.map(std::borrow::Cow::into_owned);
        let name = name.ok_or_else(|| refused(path, "an archive without `data.pkl`".into()))?;
        let mut bytes = Vec::new();
        let member = archive.by_name(&name).map_err(|e| broken(&e))?;
        member.take(LONGEST_PICKLE).read_to_end(&mut bytes).map_err(|e| broken(&e))?;
        let pickle = pickle::read(&bytes).map_err(|what| refused(path, what))?;
        let prefix = format!("{}data/", name.strip_suffix("data.pkl").unwrap_or_default());
        let numbers = Numbers::Zip(Box::new(archive), prefix);
        Self::new(path, pickle.heap, pickle.value, numbers)
    }

    fn plain(path: &Path, mut file: BufReader<File>) -> Result<Self> {
        let failed = |e| SimError::io("read the weights", path, e);
        let mut bytes = Vec::new();
        (&mut file).take(LONGEST_PICKLE).read_to_end(&mut bytes).map_err(failed)?;
        let mut at = 0;
        let mut next = || {
            let pickle = pickle::read(&bytes[at..])?;
            at += pickle.length;
            Ok(pickle)
        };
        let start: std::result::Result<_, String> = next();
        if !start.is_ok_and(|pickle| pickle.value == Value::Number(MAGIC)) {
            return Err(refused(path, "neither an archive nor the older layout".into()));
        }
        let refused = |what| refused(path, what);
        let version = next().map_err(refused)?.value;
        if version != Value::Number(VERSION) {
            return Err(refused(format!("version {version:?}, known is {VERSION}")));
        }
        next().map_err(refused)?; // the machine that wrote it
        let dictionary = next().map_err(refused)?;
        let keys = next().map_err(refused)?;
        let length = file.get_ref().metadata().map_err(failed)?.len();
        file.seek(SeekFrom::Start(at as u64)).map_err(failed)?;
        let places = places(&mut file, length, &keys, &dictionary.heap).map_err(refused)?;
        Self::new(path, dictionary.heap, dictionary.value, Numbers::Plain(file, places))
    }

    fn new(path: &Path, heap: Heap, value: Value, numbers: Numbers) -> Result<Self> {
        let entries = heap.entries(value).map_err(|what| refused(path, what))?;
        let tensors = entries.into_iter().filter_map(|(name, value)| match value {
            // Names are copied here, and one long name could stand in a short pickle many times.
            Value::Tensor(place) if name.len() <= LONGEST_NAME => {
                Some((name.to_owned(), heap.tensors[place].clone()))
            }
            _ => None,
        });
        Ok(Self { path: path.to_owned(), tensors: tensors.collect(), heap, numbers })
    }

    /// The values of one tensor, row-major.
    ///
    /// # Errors
    /// [`SimError::Data`] if there is no such tensor of finite floats of this shape.
    pub(super) fn read(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>> {
        let wrong = |what: String| {
            let help = "these are weights of another network, or the file is damaged";
            SimError::data(what, &self.path, help)
        };
        let Some(view) = self.tensors.get(name) else {
            return Err(wrong(format!("`{name}` is missing")));
        };
        if view.shape != shape {
            return Err(wrong(format!("`{name}` is {:?}, expected {shape:?}", view.shape)));
        }
        let storage = self.heap.storages[view.storage];
        let kind = &self.heap.texts[storage.kind];
        if kind != "torch FloatStorage" {
            return Err(wrong(format!("`{name}` is a {kind}, expected 32-bit floats")));
        }
        let count: usize = shape.iter().product();
        if !is_row_major(view) || view.offset.saturating_add(count) > storage.count {
            return Err(wrong(format!("`{name}` is not stored in rows")));
        }
        let mut bytes = vec![0; 4 * count]; // as much as the network wants, whatever the file says
        let key = &self.heap.texts[storage.key];
        let offset = (view.offset as u64).saturating_mul(4);
        self.numbers
            .read(key, offset, &mut bytes)
            .map_err(|e| wrong(format!("the values of `{name}` cannot be read: {e}")))?;
        let words = bytes.chunks_exact(4).map(|b| [b[0], b[1], b[2], b[3]]);
        let values: Vec<f32> = words.map(f32::from_le_bytes).collect();
        if values.iter().all(|value| value.is_finite()) {
            Ok(values)
        } else {
            Err(wrong(format!("`{name}` holds values that are no numbers")))
        }
    }
}

impl Numbers {
    /// Fills `bytes` from the storage `key`, from `offset` bytes on.
    fn read(&mut self, key: &str, offset: u64, bytes: &mut [u8]) -> std::io::Result<()> {
        match self {
            Self::Zip(archive, prefix) => {
                let mut member = archive.by_name(&format!("{prefix}{key}"))?;
                std::io::copy(&mut (&mut member).take(offset), &mut std::io::sink())?;
                member.read_exact(bytes)
            }
            Self::Plain(file, places) => {
                let place = places.get(key).ok_or(std::io::ErrorKind::NotFound)?;
                file.seek(SeekFrom::Start(place.saturating_add(offset)))?;
                file.read_exact(bytes)
            }
        }
    }
}

/// Where every storage of a file of the older layout starts; `file` stands at the first, `keys` lists them.
fn places(
    file: &mut BufReader<File>,
    length: u64,
    keys: &pickle::Pickle,
    heap: &Heap,
) -> std::result::Result<HashMap<String, u64>, String> {
    let sizes = heap.storages.iter().map(|storage| {
        let size = match heap.texts[storage.kind].as_str() {
            "torch DoubleStorage" | "torch LongStorage" => 8u64,
            "torch FloatStorage" | "torch IntStorage" => 4,
            "torch HalfStorage" | "torch BFloat16Storage" | "torch ShortStorage" => 2,
            _ => 1,
        };
        (heap.texts[storage.key].as_str(), (size, storage.count as u64))
    });
    let sizes: HashMap<_, _> = sizes.collect();
    let mut places = HashMap::new();
    let mut at = file.stream_position().map_err(|e| e.to_string())?;
    for &key in keys.heap.items(keys.value)? {
        let Value::Text(key) = key else { return Err("a key that is no text".into()) };
        let key = &keys.heap.texts[key];
        let mut count = [0; 8];
        file.read_exact(&mut count).map_err(|e| format!("the storages end too early: {e}"))?;
        let count = u64::from_le_bytes(count);
        let Some(&(size, expected)) = sizes.get(key.as_str()) else {
            return Err("a storage that no tensor uses".into());
        };
        let end = count.checked_mul(size).and_then(|bytes| bytes.checked_add(at + 8));
        let end = end.filter(|&end| end <= length && count == expected);
        let end = end.ok_or_else(|| format!("a storage of {count} values, {expected} expected"))?;
        places.insert(key.clone(), at + 8);
        let step = i64::try_from(end - at - 8).map_err(|e| e.to_string())?;
        file.seek_relative(step).map_err(|e| e.to_string())?;
        at = end;
    }
    Ok(places)
}

/// Whether the last index runs fastest, without gaps. Steps of sizes of one do not matter.
fn is_row_major(view: &View) -> bool {
    let mut expected = 1usize;
    let sizes = view.shape.iter().zip(&view.strides).rev();
    view.shape.len() == view.strides.len()
        && sizes.into_iter().all(|(&size, &stride)| {
            let fits = size == 1 || stride == expected;
            expected = expected.saturating_mul(size);
            fits
        })
}

fn refused(path: &Path, what: String) -> SimError {
    SimError::data(
        format!("no weights that can be read: {what}"),
        path,
        "name a file of weights (a state dictionary) that PyTorch's `torch.save` wrote; or copy or download it again",
    )
}
