//! Named tensors of the `.pth` files that PyTorch writes, and of SafeTensors files.
//!
//! Files come from elsewhere. The reader executes nothing, bounds what it builds, and reads a tensor's bytes
//! only after its type and shape are known to be those of the network.

use pytorch_reader::{DType, PytorchReader};
use qudi_core::regular_file::read_limited;
use qudi_core::{Error, Result};
use safetensors::tensor::{Dtype, SafeTensors};
use std::path::{Path, PathBuf};

/// Longest SafeTensors file: VGG16 up to its last used layer has 59 MB.
const LONGEST: u64 = 100 << 20;

/// An open file of weights.
pub(super) struct StateDict {
    path: PathBuf,
    reader: Reader,
}

enum Reader {
    Pytorch(PytorchReader),
    SafeTensors(Vec<u8>),
}

impl StateDict {
    /// Reads the names; the values follow when asked for.
    ///
    /// # Errors
    /// [`Error`] if the file cannot be read, or is no dictionary of tensors.
    pub(super) fn open(path: &Path) -> Result<Self> {
        if path.extension().is_some_and(|extension| extension == "safetensors") {
            let bytes = read_limited(path, LONGEST, "read the weights")?;
            SafeTensors::deserialize(&bytes).map_err(|e| {
                let help = "convert the weights again, or copy the whole file";
                Error::data(format!("not a whole SafeTensors file: {e}"), path, help)
            })?;
            return Ok(Self { path: path.to_owned(), reader: Reader::SafeTensors(bytes) });
        }
        // The reader names no file where one is missing.
        std::fs::metadata(path).map_err(|e| Error::io("read the weights", path, e))?;
        let reader = PytorchReader::new(path).map_err(|e| {
            let help =
                "name a state dictionary that PyTorch's `torch.save` wrote, or download it again";
            Error::data(format!("not a readable file of weights: {e}"), path, help)
        })?;
        Ok(Self { path: path.to_owned(), reader: Reader::Pytorch(reader) })
    }

    /// The values of one tensor, row-major.
    ///
    /// # Errors
    /// [`Error::Data`] if there is no such tensor of finite 32-bit floats of this shape.
    pub(super) fn read(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>> {
        let wrong = |what: String| {
            let help = "these are weights of another network, or the file is damaged";
            Error::data(what, &self.path, help)
        };
        let missing = || wrong(format!("`{name}` is missing"));
        let check = |found: &[usize], kind: &dyn std::fmt::Debug, is_f32: bool| {
            if found != shape {
                return Err(wrong(format!("`{name}` is {found:?}, expected {shape:?}")));
            }
            if !is_f32 {
                let what = format!("`{name}` has numbers of type {kind:?}, expected F32");
                return Err(wrong(what));
            }
            Ok(())
        };
        let bytes = match &self.reader {
            Reader::Pytorch(reader) => {
                let tensor = reader.get(name).ok_or_else(missing)?;
                check(tensor.shape(), &tensor.dtype(), tensor.dtype() == DType::F32)?;
                tensor
                    .read()
                    .map_err(|e| wrong(format!("the values of `{name}` cannot be read: {e}")))?
            }
            Reader::SafeTensors(bytes) => {
                let tensors = SafeTensors::deserialize(bytes).map_err(|e| wrong(e.to_string()))?;
                let tensor = tensors.tensor(name).map_err(|_| missing())?;
                check(tensor.shape(), &tensor.dtype(), tensor.dtype() == Dtype::F32)?;
                tensor.data().to_vec()
            }
        };
        let words = bytes.chunks_exact(4).map(|b| [b[0], b[1], b[2], b[3]]);
        let values: Vec<f32> = words.map(f32::from_le_bytes).collect();
        if values.len() != shape.iter().product::<usize>() {
            return Err(wrong(format!(
                "`{name}` has {} values, not those of its shape",
                values.len()
            )));
        }
        if !values.iter().all(|value| value.is_finite()) {
            return Err(wrong(format!("`{name}` holds values that are not finite")));
        }
        Ok(values)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::StateDict;
    use crate::cases::uniform;
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
            // Two views of one storage, and one whose rows are columns there.
            let both = expected("both", 10);
            assert_eq!(file.read("both.last", &[6]).unwrap(), both[4..]);
            assert_eq!(file.read("both.first", &[4]).unwrap(), both[..4]);
            let turned = expected("turned", 6);
            let rows = [0, 2, 4, 1, 3, 5].map(|place| turned[place]);
            assert_eq!(file.read("turned", &[2, 3]).unwrap(), rows);
            for (tensor, shape, reason) in [
                ("missing", &[1][..], "missing"),
                ("a.weight", &[3, 2], "expected [3, 2]"),
                ("half", &[4], "expected F32"),
                ("bad", &[2], "not finite"),
            ] {
                let error = file.read(tensor, shape).unwrap_err().to_string();
                assert!(error.contains(reason), "{name}: {error}");
            }
        }
    }

    /// The file calls a function in the place of a tensor: nothing is called, and there is no tensor.
    #[test]
    fn executes_no_code_of_a_pickle() {
        let file =
            StateDict::open(&golden("code.pth")).and_then(|file| file.read("a.weight", &[2, 3]));
        assert!(file.is_err());
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

    /// Depth that needs stack, lengths that need memory, memos that grow: all refused.
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
