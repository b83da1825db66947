//! Search of PyTorch files for anything that loading them elsewhere would run. Nothing is run here; but a
//! file that holds code is not a file of weights, whoever made it.

use qudi_core::limits::RECORD_BYTES;
use qudi_core::regular_file::open_regular;
use qudi_core::{Error, Result};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;
use std::rc::Rc;
use zip::ZipArchive;

/// Pickles before the values of a file from before PyTorch 1.6: magic number, version, system, weights, keys.
const FORMER_PICKLES: usize = 5;

/// Names that files of weights call for: what `torch.load` admits with `weights_only`.
const ADMITTED: &[(&str, &[&str])] = &[
    ("collections", &["OrderedDict", "Counter", "defaultdict"]),
    ("_codecs", &["encode"]),
    ("numpy", &["dtype", "ndarray"]),
    ("numpy.core.multiarray", &["scalar", "_reconstruct"]),
    ("numpy._core.multiarray", &["scalar", "_reconstruct"]),
    ("torch.serialization", &["_get_layout"]),
    ("torch.nn.parameter", &["Parameter"]),
];

/// Refuses a file in which a pickle calls for anything but tensors and plain containers.
///
/// # Errors
/// [`Error`] if it cannot be read, or holds code.
pub(super) fn refuse_code(path: &Path) -> Result<()> {
    let io = |e| Error::io("read the weights", path, e);
    let mut reader = BufReader::new(open_regular(path, "read the weights")?);
    let mut magic = [0; 4];
    let read = reader.read(&mut magic).map_err(io)?;
    if magic[..read] != *b"PK\x03\x04" {
        let mut head = magic[..read].to_vec();
        reader.take(RECORD_BYTES).read_to_end(&mut head).map_err(io)?;
        return check_former(&head).map_err(|what| refused(&what, path));
    }
    let file = open_regular(path, "read the weights")?;
    check_archive(file).map_err(|what| refused(&what, path))
}

fn refused(what: &str, path: &Path) -> Error {
    Error::data(
        format!("the file may run code where it is loaded: {what}"),
        path,
        "get the weights from their authors, or have them saved as SafeTensors",
    )
}

/// Checks all pickles of an archive.
fn check_archive(file: File) -> std::result::Result<(), String> {
    let mut archive = ZipArchive::new(BufReader::new(file)).map_err(|e| e.to_string())?;
    for index in 0..archive.len() {
        let entry = archive.by_index(index).map_err(|e| e.to_string())?;
        let name = entry.name().map_err(|e| e.to_string())?.into_owned();
        let lower = name.to_lowercase();
        let extension = Path::new(&lower).extension().unwrap_or_default().to_owned();
        if extension == "py" || lower.contains("/code/") {
            return Err(format!("`{name}` is a program"));
        }
        // Tensors lie in `data/`; what is no tensor may be a pickle whatever its name.
        let is_tensor = lower.split('/').rev().nth(1) == Some("data");
        if is_tensor && extension != "pkl" {
            continue;
        }
        let mut bytes = Vec::new();
        entry.take(RECORD_BYTES).read_to_end(&mut bytes).map_err(|e| e.to_string())?;
        let is_pickle = extension == "pkl" || bytes.first() == Some(&0x80);
        if is_pickle {
            check_pickle(&bytes).map_err(|what| format!("`{name}`: {what}"))?;
        }
    }
    Ok(())
}

/// Checks the pickles at the beginning of a file without archive.
fn check_former(bytes: &[u8]) -> std::result::Result<(), String> {
    let mut rest = bytes;
    for _ in 0..FORMER_PICKLES {
        if rest.is_empty() {
            break;
        }
        rest = &rest[check_pickle(rest)?..];
    }
    Ok(())
}

/// Checks one pickle, and returns its length.
fn check_pickle(bytes: &[u8]) -> std::result::Result<usize, String> {
    let last = [None, None];
    let mut pickle = Pickle { bytes, at: 0, last, memo: BTreeMap::new(), numbered: None };
    while pickle.step()? {}
    Ok(pickle.at)
}

/// Longest name that may be called for.
const NAME_BYTES: usize = 100;

/// Most strings that a pickle keeps for later.
const MAX_KEPT: usize = 1 << 20;

/// A walk over the operations of a pickle.
struct Pickle<'a> {
    bytes: &'a [u8],
    at: usize,
    /// The last two things pushed, where they are short strings: names of what is called for.
    last: [Option<Rc<str>>; 2],
    /// Short strings that are kept for later.
    memo: BTreeMap<usize, Rc<str>>,
    /// Things kept without a number, or none if numbers are given: no program writes both.
    numbered: Option<usize>,
}

impl<'a> Pickle<'a> {
    fn take(&mut self, count: usize) -> std::result::Result<&'a [u8], String> {
        let end = self.at.checked_add(count).filter(|&end| end <= self.bytes.len());
        let end = end.ok_or("a pickle is cut off")?;
        let taken = &self.bytes[self.at..end];
        self.at = end;
        Ok(taken)
    }

    fn line(&mut self) -> std::result::Result<String, String> {
        let rest = &self.bytes[self.at..];
        let length = rest.iter().position(|&byte| byte == b'\n').ok_or("a pickle is cut off")?;
        self.at += length + 1;
        Ok(String::from_utf8_lossy(&rest[..length]).into_owned())
    }

    /// Reads a number of `count` bytes.
    fn number(&mut self, count: usize) -> std::result::Result<usize, String> {
        let bytes = self.take(count)?;
        let number = bytes.iter().rev().fold(0u64, |sum, &byte| sum << 8 | u64::from(byte));
        usize::try_from(number).map_err(|e| e.to_string())
    }

    /// Skips content whose length is a number of `count` bytes, and returns it.
    fn counted(&mut self, count: usize) -> std::result::Result<&'a [u8], String> {
        let length = self.number(count)?;
        self.take(length)
    }

    fn text(&mut self, count: usize) -> std::result::Result<(), String> {
        let text = String::from_utf8_lossy(self.counted(count)?);
        self.push(Some(&text));
        Ok(())
    }

    /// Pushes a string, or something else.
    fn push(&mut self, text: Option<&str>) {
        self.last.swap(0, 1);
        self.last[1] = text.filter(|text| text.len() <= NAME_BYTES).map(Rc::from);
    }

    /// Keeps what was pushed last under a number, or under the next one.
    fn keep(&mut self, number: Option<usize>) -> std::result::Result<(), String> {
        let number = match (number, self.numbered) {
            (Some(number), None) => number,
            (None, count) if count.is_some() || self.memo.is_empty() => {
                let next = count.unwrap_or(0);
                self.numbered = Some(next + 1);
                next
            }
            _ => return Err("a pickle keeps things in two ways".to_owned()),
        };
        match &self.last[1] {
            Some(text) => self.memo.insert(number, Rc::clone(text)),
            None => self.memo.remove(&number),
        };
        if self.memo.len() > MAX_KEPT {
            return Err(format!("a pickle keeps more than {MAX_KEPT} strings"));
        }
        Ok(())
    }

    /// Pushes what is kept under a number.
    fn recall(&mut self, number: usize) {
        self.last.swap(0, 1);
        self.last[1] = self.memo.get(&number).cloned();
    }

    /// Takes one operation; returns false at the end. Python's `pickletools` lists the operations.
    fn step(&mut self) -> std::result::Result<bool, String> {
        let operation = self.number(1)? as u8;
        match operation {
            b'.' => return Ok(false),
            // Module and name, as lines; `INST` calls at once.
            b'c' | b'i' => {
                let (module, name) = (self.line()?, self.line()?);
                admit(&module, &name)?;
            }
            // Module and name were pushed before.
            0x93 => {
                let [module, name] = &self.last;
                let text = |text: &Option<Rc<str>>| text.as_deref().unwrap_or_default().to_owned();
                admit(&text(module), &text(name))?;
                self.push(None);
            }
            // Names of a registry of extensions.
            0x82..=0x84 => return Err("an extension is called for".to_owned()),
            b'F' | b'I' | b'L' | b'P' => {
                self.line()?;
                self.push(None);
            }
            b'S' | b'V' => {
                let line = self.line()?;
                self.push(Some(line.trim_matches(['\'', '"'])));
            }
            b'p' => {
                let number = self.line()?.trim().parse().unwrap_or(usize::MAX);
                self.keep(Some(number))?;
            }
            b'g' => {
                let number = self.line()?.trim().parse().unwrap_or(usize::MAX);
                self.recall(number);
            }
            b'q' | b'r' => {
                let number = self.number(if operation == b'q' { 1 } else { 4 })?;
                self.keep(Some(number))?;
            }
            b'h' | b'j' => {
                let number = self.number(if operation == b'h' { 1 } else { 4 })?;
                self.recall(number);
            }
            0x94 => self.keep(None)?,
            b'X' | b'T' => self.text(4)?,
            b'U' | 0x8c => self.text(1)?,
            0x8d => self.text(8)?,
            b'C' | 0x8a => drop(self.counted(1)?),
            b'B' | 0x8b => drop(self.counted(4)?),
            0x8e | 0x96 => drop(self.counted(8)?),
            b'J' => drop(self.take(4)?),
            b'M' => drop(self.take(2)?),
            b'G' | 0x95 => drop(self.take(8)?),
            b'K' | 0x80 => drop(self.take(1)?),
            b'('
            | b')'
            | b']'
            | b'}'
            | b'0'
            | b'1'
            | b'2'
            | b'N'
            | b'Q'
            | b'R'
            | b'a'
            | b'b'
            | b'd'
            | b'e'
            | b'l'
            | b'o'
            | b's'
            | b't'
            | b'u'
            | 0x81
            | 0x85..=0x89
            | 0x8f..=0x92
            | 0x97
            | 0x98 => self.push(None),
            other => return Err(format!("an operation {other:#04x} that no pickle has")),
        }
        Ok(true)
    }
}

/// Refuses what tensors do not need.
fn admit(module: &str, name: &str) -> std::result::Result<(), String> {
    let listed = ADMITTED.iter().any(|(m, names)| *m == module && names.contains(&name));
    let is_type = |name: &str| {
        ["Storage", "Tensor"].iter().any(|end| name.ends_with(end))
            || ["Size", "device", "dtype", "_utils"].contains(&name)
            || ["float", "bfloat", "int", "uint", "half", "double", "long", "bool", "complex"]
                .iter()
                .any(|start| name.starts_with(start))
    };
    let of_torch = matches!(module, "torch" | "torch.storage" | "torch.cuda") && is_type(name)
        || module == "torch._utils" && name.starts_with("_rebuild_")
        || module == "torch._tensor" && name == "_rebuild_from_type_v2";
    let plain = [
        "set",
        "frozenset",
        "list",
        "dict",
        "tuple",
        "int",
        "float",
        "complex",
        "bool",
        "bytearray",
        "bytes",
        "str",
        "slice",
        "range",
    ];
    let of_python = matches!(module, "builtins" | "__builtin__") && plain.contains(&name);
    if listed || of_torch || of_python {
        return Ok(());
    }
    Err(format!("it calls for `{module}.{name}`"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn admits_tensors_and_refuses_everything_else() {
        for good in [
            &b"\x80\x02ccollections\nOrderedDict\nq\x00)Rq\x01."[..],
            b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\nq\x00.",
            b"\x80\x04\x8c\x05torch\x94\x8c\x0cFloatStorage\x94\x93\x94.",
            b"\x80\x04\x8c\x05torch\x94\x8c\x04Size\x94\x93\x94h\x00\x8c\x0bHalfStorage\x94\x93\x94.",
            b"\x80\x02}q\x00X\x01\x00\x00\x00aq\x01K\x01s.",
        ] {
            assert_eq!(check_pickle(good), Ok(good.len()), "{good:?}");
        }
        for bad in [
            &b"\x80\x02cos\nsystem\nq\x00X\x04\x00\x00\x00true\x85R."[..],
            b"cposix\nsystem\n(S'true'\ntR.",
            b"(S'true'\nios\nsystem\n.",
            b"\x80\x04\x8c\x08builtins\x94\x8c\x04eval\x94\x93\x94.",
            b"\x80\x02ctorch.hub\nload\n.",
            b"\x80\x02\x82\x01.",
            b"\x80\x02X\xff\xff\xff\xff",
        ] {
            assert!(check_pickle(bad).is_err(), "{bad:?}");
        }
    }
}
