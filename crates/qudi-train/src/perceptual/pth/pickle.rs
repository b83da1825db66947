//! As much of Python's pickle as state dictionaries need: a stack machine that builds lists, dictionaries and
//! references to stored numbers, and calls nothing.
//!
//! Written from the comments of CPython's `Lib/pickletools.py` (the meaning of each code) and from what
//! `torch.save` writes, protocol 2. Every length is checked against what is left of the input before it is used,
//! so memory grows with the length of the input and with nothing that it claims.

use super::heap::{Heap, Refusal, Storage, Value, View, whole};
use std::collections::HashMap;

/// A finished pickle.
#[derive(Debug)]
pub(super) struct Pickle {
    /// The value.
    pub(super) value: Value,
    /// What it refers to.
    pub(super) heap: Heap,
    /// Bytes that it took.
    pub(super) length: usize,
}

/// Reads the pickle at the start of `bytes`.
pub(super) fn read(bytes: &[u8]) -> Result<Pickle, Refusal> {
    let mut machine = Machine { bytes, ..Machine::default() };
    loop {
        let code = machine.take(1)?[0];
        if code == b'.' {
            let value = machine.pop()?;
            return Ok(Pickle { value, heap: machine.heap, length: machine.at });
        }
        machine.step(code)?;
    }
}

#[derive(Default)]
struct Machine<'a> {
    bytes: &'a [u8],
    at: usize,
    stack: Vec<Value>,
    marks: Vec<usize>,
    memo: HashMap<u32, Value>,
    heap: Heap,
}

impl Machine<'_> {
    fn step(&mut self, code: u8) -> Result<(), Refusal> {
        match code {
            0x80 => drop(self.take(1)?), // protocol
            b'(' => self.marks.push(self.stack.len()),
            b'N' => self.stack.push(Value::Nothing),
            0x88 => self.stack.push(Value::Number(1)),
            0x89 => self.stack.push(Value::Number(0)),
            b'K' | b'M' | b'J' | 0x8A => self.number(code)?,
            b'G' => {
                self.take(8)?; // a fraction: nothing that a state dictionary needs
                self.stack.push(Value::Nothing);
            }
            b'U' => self.text(1)?,
            b'T' | b'X' => self.text(4)?,
            b'c' => {
                let (module, class) = (self.line()?, self.line()?);
                let name = self.keep(format!("{module} {class}"));
                self.stack.push(Value::Name(name));
            }
            b'q' | b'r' => {
                let place = self.length(if code == b'q' { 1 } else { 4 })? as u32;
                let value = *self.stack.last().ok_or("a value is missing")?;
                self.memo.insert(place, value);
            }
            b'h' | b'j' => {
                let place = self.length(if code == b'h' { 1 } else { 4 })? as u32;
                let value = *self.memo.get(&place).ok_or("a value that was not kept")?;
                self.stack.push(value);
            }
            b']' | b'}' | b')' => self.list(Vec::new()),
            b't' => {
                let items = self.marked()?;
                self.list(items);
            }
            0x85..=0x87 => {
                let count = usize::from(code - 0x84);
                let first = self.stack.len().checked_sub(count).ok_or("a value is missing")?;
                let items = self.stack.split_off(first);
                self.list(items);
            }
            b'a' => {
                let item = self.pop()?;
                self.extend(&[item])?;
            }
            b's' => {
                let (value, key) = (self.pop()?, self.pop()?);
                self.extend(&[key, value])?;
            }
            b'e' | b'u' => {
                let items = self.marked()?;
                self.extend(&items)?;
            }
            b'Q' => self.storage()?,
            b'R' => self.call()?,
            b'b' => drop(self.pop()?), // attributes: metadata of the modules
            _ => return Err(format!("code {code:#04x}, which no state dictionary needs")),
        }
        Ok(())
    }

    fn take(&mut self, count: usize) -> Result<&[u8], Refusal> {
        let end = self.at.checked_add(count).filter(|&end| end <= self.bytes.len());
        let end = end.ok_or("it ends too early")?;
        let part = &self.bytes[self.at..end];
        self.at = end;
        Ok(part)
    }

    /// A little-endian length of `width` bytes.
    fn length(&mut self, width: usize) -> Result<usize, Refusal> {
        let bytes = self.take(width)?.iter().rev();
        Ok(bytes.fold(0, |sum, &byte| sum << 8 | usize::from(byte)))
    }

    fn number(&mut self, code: u8) -> Result<(), Refusal> {
        let value = match code {
            b'K' => self.length(1)? as i64,
            b'M' => self.length(2)? as i64,
            b'J' => i64::from(self.length(4)? as u32 as i32),
            _ => {
                // Of the magic number, which has ten bytes, the low eight are kept.
                let width = self.length(1)?;
                let bytes = self.take(width)?;
                let negative = bytes.last().is_some_and(|&high| high >= 0x80);
                let mut low = [if negative { 0xFF } else { 0 }; 8];
                let kept = width.min(8);
                low[..kept].copy_from_slice(&bytes[..kept]);
                i64::from_le_bytes(low)
            }
        };
        self.stack.push(Value::Number(value));
        Ok(())
    }

    fn text(&mut self, width: usize) -> Result<(), Refusal> {
        let count = self.length(width)?;
        let text = String::from_utf8_lossy(self.take(count)?).into_owned();
        let place = self.keep(text);
        self.stack.push(Value::Text(place));
        Ok(())
    }

    fn line(&mut self) -> Result<String, Refusal> {
        let rest = &self.bytes[self.at..];
        let count = rest.iter().position(|&byte| byte == b'\n').ok_or("it ends too early")?;
        let line = String::from_utf8_lossy(&rest[..count]).into_owned();
        self.at += count + 1;
        Ok(line)
    }

    fn keep(&mut self, text: String) -> usize {
        self.heap.texts.push(text);
        self.heap.texts.len() - 1
    }

    fn list(&mut self, items: Vec<Value>) {
        self.heap.lists.push(items);
        self.stack.push(Value::List(self.heap.lists.len() - 1));
    }

    fn pop(&mut self) -> Result<Value, Refusal> {
        let floor = self.marks.last().copied().unwrap_or(0);
        let value = if self.stack.len() > floor { self.stack.pop() } else { None };
        value.ok_or_else(|| "a value is missing".into())
    }

    /// The values since the last mark.
    fn marked(&mut self) -> Result<Vec<Value>, Refusal> {
        let mark = self.marks.pop().ok_or("a mark is missing")?;
        // Less than the mark is left if a tuple of fixed length reached below it.
        if mark > self.stack.len() {
            return Err("a value is missing".into());
        }
        Ok(self.stack.split_off(mark))
    }

    fn extend(&mut self, items: &[Value]) -> Result<(), Refusal> {
        match self.stack.last() {
            Some(&Value::List(place)) => self.heap.lists[place].extend_from_slice(items),
            _ => return Err("items for what is no list".into()),
        }
        Ok(())
    }

    /// `('storage', class, key, device, count, ...)` becomes a storage.
    fn storage(&mut self) -> Result<(), Refusal> {
        let id = self.pop()?;
        let [Value::Text(word), Value::Name(class), Value::Text(key), _, count, ..] =
            self.heap.items(id)?
        else {
            return Err("a reference to something other than stored numbers".into());
        };
        if self.heap.texts[*word] != "storage" {
            return Err("a reference to something other than stored numbers".into());
        }
        let storage = Storage { kind: *class, key: *key, count: whole(*count)? };
        self.heap.storages.push(storage);
        self.stack.push(Value::Storage(self.heap.storages.len() - 1));
        Ok(())
    }

    /// The few calls that build tensors and dictionaries, done here; any other is refused.
    fn call(&mut self) -> Result<(), Refusal> {
        let (arguments, callee) = (self.pop()?, self.pop()?);
        let Value::Name(name) = callee else { return Err("a call of what has no name".into()) };
        let arguments = self.heap.items(arguments)?;
        let result = match (self.heap.texts[name].as_str(), arguments) {
            ("collections OrderedDict", []) => {
                self.list(Vec::new());
                return Ok(());
            }
            // Not copied: a short pickle could ask for many copies of a long list.
            ("collections OrderedDict", &[pairs @ Value::List(_)]) => pairs,
            (
                "torch._utils _rebuild_tensor_v2" | "torch._utils _rebuild_tensor",
                &[Value::Storage(storage), offset, shape, strides, ..],
            ) => {
                let view = View {
                    storage,
                    offset: whole(offset)?,
                    shape: self.heap.wholes(shape)?,
                    strides: self.heap.wholes(strides)?,
                };
                self.heap.tensors.push(view);
                Value::Tensor(self.heap.tensors.len() - 1)
            }
            (
                "torch._utils _rebuild_parameter" | "torch.nn.parameter Parameter",
                &[tensor @ Value::Tensor(_), ..],
            ) => tensor,
            (other, _) => return Err(format!("a call of `{}`", short(other))),
        };
        self.stack.push(result);
        Ok(())
    }
}

/// At most the first forty characters.
fn short(text: &str) -> String {
    text.chars().take(40).collect()
}
