//! Named tensors of `.pth` files written by PyTorch, and of SafeTensors files.
//!
//! Files are untrusted. The reader executes nothing, bounds the memory that it allocates, and reads a
//! tensor's bytes only after its type and shape have been matched with the network's.
//!
//! In a checkpoint with further content, the tensors are below `state_dict.`, `params.` or `model.`. The
//! names of networks trained on several devices begin with `module.`. These prefixes are removed from the
//! names here.

use crate::pickle::refuse_code;
use burn::tensor::{bf16, f16};
use pytorch_reader::{DType, PytorchReader};
use qudi_core::regular_file::{read_limited, require_regular};
use qudi_core::{Error, Result};
use safetensors::tensor::{Dtype, SafeTensors};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Maximum size of a SafeTensors file in bytes: the largest network, QUIVER with 64 features, has 630 MB.
const MAX_FILE_BYTES: u64 = 1 << 30;

/// Prefixes of the names in a checkpoint.
const PREFIXES: [&str; 6] =
    ["state_dict.module.", "state_dict.", "module.", "params_ema.", "params.", "model."];

/// An open file of weights.
pub struct StateDict {
    path: PathBuf,
    reader: Reader,
    /// Prefix of the names.
    prefix: &'static str,
    /// Shapes by name.
    shapes: BTreeMap<String, Vec<usize>>,
    /// Size of the file in bytes.
    length: u64,
}

enum Reader {
    Pytorch(PytorchReader),
    SafeTensors(Vec<u8>),
}

impl StateDict {
    /// Opens a file and reads the names of its tensors; values are read on request.
    ///
    /// # Errors
    /// [`Error`] if the file cannot be read, or is no dictionary of tensors.
    pub fn open(path: &Path) -> Result<Self> {
        if path.extension().is_some_and(|extension| extension == "safetensors") {
            return Self::of_bytes(read_limited(path, MAX_FILE_BYTES, "read the weights")?, path);
        }
        // A named pipe would wait for a writer, and code is refused before anything is read.
        let length = require_regular(path, "read the weights")?;
        refuse_code(path)?;
        let reader = PytorchReader::new(path).map_err(|e| {
            let help =
                "name a state dictionary that PyTorch's `torch.save` wrote, or download it again";
            Error::data(format!("not a readable file of weights: {e}"), path, help)
        })?;
        Ok(Self::new(path, Reader::Pytorch(reader), length))
    }

    /// Reads the names of a SafeTensors file in memory; `path` is used in errors only.
    ///
    /// # Errors
    /// [`Error::Data`] if it is not whole.
    pub fn of_bytes(bytes: Vec<u8>, path: &Path) -> Result<Self> {
        SafeTensors::deserialize(&bytes).map_err(|e| {
            let help = "convert the weights again, or copy the whole file";
            Error::data(format!("not a whole SafeTensors file: {e}"), path, help)
        })?;
        let length = bytes.len() as u64;
        Ok(Self::new(path, Reader::SafeTensors(bytes), length))
    }

    fn new(path: &Path, reader: Reader, length: u64) -> Self {
        let all: BTreeMap<String, Vec<usize>> = match &reader {
            Reader::Pytorch(reader) => {
                let tensors = reader.tensors().iter();
                tensors.map(|(name, tensor)| (name.clone(), tensor.shape().to_vec())).collect()
            }
            Reader::SafeTensors(bytes) => match SafeTensors::deserialize(bytes) {
                Ok(tensors) => tensors
                    .tensors()
                    .into_iter()
                    .map(|(name, tensor)| (name, tensor.shape().to_vec()))
                    .collect(),
                Err(_) => BTreeMap::new(),
            },
        };
        let is_there = |prefix: &&str| all.keys().any(|name| name.starts_with(*prefix));
        let prefix = PREFIXES.into_iter().find(is_there).unwrap_or("");
        let own = all
            .into_iter()
            .filter_map(|(name, shape)| Some((name.strip_prefix(prefix)?.to_owned(), shape)));
        let shapes = own.collect();
        Self { path: path.to_owned(), reader, prefix, shapes, length }
    }

    /// Returns the path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the size of the file in bytes.
    pub fn length(&self) -> u64 {
        self.length
    }

    /// Returns the value of a key in a SafeTensors file's metadata.
    pub fn metadata(&self, key: &str) -> Option<String> {
        let Reader::SafeTensors(bytes) = &self.reader else { return None };
        let (_, header) = SafeTensors::read_metadata(bytes).ok()?;
        header.metadata().as_ref()?.get(key).cloned()
    }

    /// Returns the names of all tensors, sorted.
    pub fn names(&self) -> Vec<String> {
        self.shapes.keys().cloned().collect()
    }

    /// Returns the shape of a tensor, or `None` if there is no tensor of this name.
    pub fn shape(&self, name: &str) -> Option<Vec<usize>> {
        self.shapes.get(name).cloned()
    }

    /// Reads the values of one tensor, row-major.
    ///
    /// # Errors
    /// [`Error::Data`] if there is no tensor of finite floats with this name and shape.
    pub fn read(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>> {
        let full = format!("{}{name}", self.prefix);
        let wrong = |what: String| {
            let help = "these are weights of another network, or the file is damaged";
            Error::data(what, &self.path, help)
        };
        let missing = || wrong(format!("`{name}` is missing"));
        let check = |found: &[usize], kind: &dyn std::fmt::Debug, floats: Option<Floats>| {
            if found != shape {
                return Err(wrong(format!("`{name}` is {found:?}, expected {shape:?}")));
            }
            floats.ok_or_else(|| {
                wrong(format!(
                    "`{name}` has numbers of type {kind:?}, expected floats of 32 or 16 bits"
                ))
            })
        };
        let (bytes, floats) = match &self.reader {
            Reader::Pytorch(reader) => {
                let tensor = reader.get(&full).ok_or_else(missing)?;
                let floats = match tensor.dtype() {
                    DType::F32 => Some(Floats::F32),
                    DType::F16 => Some(Floats::F16),
                    DType::BF16 => Some(Floats::Bf16),
                    _ => None,
                };
                let floats = check(tensor.shape(), &tensor.dtype(), floats)?;
                let bytes = tensor
                    .read()
                    .map_err(|e| wrong(format!("the values of `{name}` cannot be read: {e}")))?;
                (bytes, floats)
            }
            Reader::SafeTensors(bytes) => {
                let tensors = SafeTensors::deserialize(bytes).map_err(|e| wrong(e.to_string()))?;
                let tensor = tensors.tensor(&full).map_err(|_| missing())?;
                let floats = match tensor.dtype() {
                    Dtype::F32 => Some(Floats::F32),
                    Dtype::F16 => Some(Floats::F16),
                    Dtype::BF16 => Some(Floats::Bf16),
                    _ => None,
                };
                let floats = check(tensor.shape(), &tensor.dtype(), floats)?;
                (tensor.data().to_vec(), floats)
            }
        };
        let values = floats.values(&bytes);
        if values.len() != shape.iter().product::<usize>() {
            return Err(wrong(format!(
                "`{name}` has {} values, which does not match its shape",
                values.len()
            )));
        }
        if !values.iter().all(|value| value.is_finite()) {
            return Err(wrong(format!("`{name}` holds values that are not finite")));
        }
        Ok(values)
    }
}

/// Types of floats in files.
#[derive(Clone, Copy)]
enum Floats {
    F32,
    F16,
    Bf16,
}

impl Floats {
    fn values(self, bytes: &[u8]) -> Vec<f32> {
        let halves = || bytes.chunks_exact(2).map(|b| [b[0], b[1]]);
        match self {
            Self::F32 => {
                let words = bytes.chunks_exact(4).map(|b| [b[0], b[1], b[2], b[3]]);
                words.map(f32::from_le_bytes).collect()
            }
            Self::F16 => halves().map(|b| f16::from_le_bytes(b).to_f32()).collect(),
            Self::Bf16 => halves().map(|b| bf16::from_le_bytes(b).to_f32()).collect(),
        }
    }
}

impl std::fmt::Debug for StateDict {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("StateDict").field("path", &self.path).finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::StateDict;
    use crate::cases::uniform;
    use std::io::Write;
    use std::path::{Path, PathBuf};

    fn golden(name: &str) -> PathBuf {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden/perceptual");
        Path::new(folder).join(name)
    }

    fn expected(name: &str, count: usize) -> Vec<f32> {
        uniform(name, count).into_iter().map(|value| value as f32).collect()
    }

    #[test]
    fn reads_both_layouts_of_torch_save() {
        for name in ["zip.pth", "plain.pth"] {
            let file = StateDict::open(&golden(name)).unwrap();
            assert_eq!(file.read("a.weight", &[2, 3]).unwrap(), expected("a.weight", 6));
            assert_eq!(file.read("b.weight", &[3, 2, 1, 1]).unwrap(), expected("b.weight", 6));
            // Two views of one storage, and a transposed view.
            let both = expected("both", 10);
            assert_eq!(file.read("both.last", &[6]).unwrap(), both[4..]);
            assert_eq!(file.read("both.first", &[4]).unwrap(), both[..4]);
            let half = file.read("half", &[4]).unwrap();
            for (half, exact) in half.into_iter().zip(expected("half", 4)) {
                assert!((half - exact).abs() < 1e-3);
            }
            let turned = expected("turned", 6);
            let rows = [0, 2, 4, 1, 3, 5].map(|place| turned[place]);
            assert_eq!(file.read("turned", &[2, 3]).unwrap(), rows);
            for (tensor, shape, reason) in [
                ("missing", &[1][..], "missing"),
                ("a.weight", &[3, 2], "expected [3, 2]"),
                ("bad", &[2], "not finite"),
            ] {
                let error = file.read(tensor, shape).unwrap_err().to_string();
                assert!(error.contains(reason), "{name}: {error}");
            }
        }
    }

    /// Checks that a pickle that calls a function in place of a tensor executes nothing and gives no tensor.
    #[test]
    fn executes_no_code_of_a_pickle() {
        let file =
            StateDict::open(&golden("code.pth")).and_then(|file| file.read("a.weight", &[2, 3]));
        assert!(file.is_err());
    }

    /// A pickle that nothing reads calls a program: the file is no file of weights, though nothing runs.
    #[test]
    fn refuses_code_in_surplus_entries() {
        let mut bytes = std::io::Cursor::new(std::fs::read(golden("zip.pth")).unwrap());
        let mut archive = zip::ZipWriter::new_append(&mut bytes).unwrap();
        let stored = zip::write::SimpleFileOptions::default();
        archive.start_file("zip/extra.pkl", stored).unwrap();
        archive.write_all(b"\x80\x02cos\nsystem\nX\x04\0\0\0true\x85R.").unwrap();
        archive.finish().unwrap();
        let error = open(bytes.get_ref()).unwrap_err().to_string();
        assert!(error.contains("zip/extra.pkl") && error.contains("os.system"), "{error}");
        assert!(open(&std::fs::read(golden("zip.pth")).unwrap()).is_ok());
    }

    fn open(bytes: &[u8]) -> qudi_core::Result<StateDict> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), bytes).unwrap();
        StateDict::open(file.path())
    }

    #[test]
    fn survives_damaged_files() {
        for name in ["zip.pth", "plain.pth"] {
            let whole = std::fs::read(golden(name)).unwrap();
            for length in (0..whole.len()).step_by(3) {
                if let Ok(file) = open(&whole[..length]) {
                    let _ = file.read("a.weight", &[2, 3]);
                }
            }
            for place in 0..whole.len() {
                let mut bytes = whole.clone();
                bytes[place] ^= 1 << [0, 3, 7][place % 3];
                if let Ok(file) = open(&bytes) {
                    let _ = file.read("both.last", &[6]);
                }
            }
        }
        assert!(open(b"").is_err());
    }

    /// Checks that files whose nesting, lengths or memos would exhaust memory are refused.
    #[test]
    fn refuses_hostile_pickles() {
        let mut deep = vec![0x80, 2, b'N'];
        deep.resize(1 << 20, 0x85);
        deep.push(b'.');
        let mut lists = vec![0x80, 2];
        lists.resize(1 << 20, b']');
        let text = 3u32 << 20;
        let mut copies = [&[0x80, 2, b'X'][..], &text.to_le_bytes()].concat();
        copies.resize(copies.len() + text as usize, b'a');
        copies.extend(b"q\x000](");
        copies.extend(b"h\0".repeat(100_000));
        copies.extend(b"e.");
        // A list that contains itself is no dictionary either.
        for bytes in [
            &deep[..],
            &lists,
            &copies,
            b"\x80\x02X\xFF\xFF\xFF\xFFabc.",
            b"\x80\x02\x8A\xFF.",
            b"\x80\x04\x8D\xFF\xFF\xFF\xFF\xFF\xFF\xFF\x7Fa.",
            b"\x80\x02]q\0h\0a.",
            b"\x80\x02NN(\x86t.",
            b"\x80\x02h\x05.",
            b"\x80\x02R.",
            b"\x80\x02Q.",
        ] {
            assert!(open(bytes).is_err(), "{:?}", &bytes[..bytes.len().min(12)]);
        }
    }
}
