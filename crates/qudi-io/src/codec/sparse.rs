//! SPAD512S sparse mode: 32-bit little-endian indices of fired pixels, with a delimiter at the end of each
//! frame.

use super::{Format, Recognition};
use crate::description::{CaptureInfo, Certainty, FormatOption, Orientation, ReadOptions};
use crate::frames::CountFrames;
use crate::frames::chain::Chain;
use crate::recognition::Probe;
use qudi_core::Size;
use qudi_core::{Error, Result};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

pub(crate) const FORMAT: Format = Format {
    name: "spad512s-sparse",
    title: "SPAD512S sparse index stream",
    options: &[FormatOption::Size],
    probe: |probe| {
        if !probe.is_folder && !probe.has_extension(&["bin", "raw"]) {
            return Ok(None);
        }
        let Some(first) = probe.files(&["bin"])?.into_iter().next() else {
            return Ok(None);
        };
        let length = std::fs::metadata(&first).map_err(|e| Error::io("open", &first, e))?.len();
        if !length.is_multiple_of(4) {
            return Ok(None);
        }
        let middle = probe.middle(4)?;
        let mut words = middle.chunks_exact(4).map(word);
        let stream = words.all(|word| word <= ARRAY.pixels() as u32);
        let words: Vec<u32> = middle.chunks_exact(4).map(word).collect();
        let delimiters = words.iter().filter(|&&w| w == ARRAY.pixels() as u32).count();
        // Indices in no order, with delimiters between them: no picture looks like this.
        let several = words.len() > 4 && delimiters > 0 && words.iter().any(|&w| w > 0xffff);
        let reasons = ["every word is a pixel index or the delimiter"];
        Ok((stream && several).then(|| Recognition::new(Certainty::Certain, &reasons)))
    },
    open,
};

const ARRAY: Size = Size { height: 512, width: 512 };

fn word(bytes: &[u8]) -> u32 {
    u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]])
}

struct SparseFrames {
    file: File,
    path: PathBuf,
    size: Size,
    /// Word at which each frame starts, and the end of the last one.
    starts: Vec<u64>,
    words: Vec<u8>,
}

fn open(
    probe: &Probe,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<Box<dyn CountFrames>> {
    let size = options.size.unwrap_or(ARRAY);
    info.preset = Some("spad512s");
    info.max_count = Some(1);
    info.vendor = Orientation::Rot90;
    info.orient = Orientation::Vendor;
    let files = probe.files(&["bin"])?;
    if let [path] = files.as_slice() {
        return Ok(Box::new(open_file(path, size, options, info)?));
    }
    let mut lengths = Vec::with_capacity(files.len());
    for path in &files {
        lengths.push(open_file(path, size, options, info)?.frames());
    }
    let (options, template) = (options.clone(), info.clone());
    let opener = move |part: usize| -> Result<Box<dyn CountFrames>> {
        Ok(Box::new(open_file(&files[part], size, &options, &mut template.clone())?))
    };
    Ok(Box::new(Chain::new(size, &lengths, Box::new(opener))))
}

fn open_file(
    path: &Path,
    size: Size,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<SparseFrames> {
    let mut file = File::open(path).map_err(|e| Error::io("read", path, e))?;
    let starts = index(&mut file, size, path, options, info)?;
    Ok(SparseFrames { file, path: path.to_owned(), size, starts, words: Vec::new() })
}

/// Reads the stream once, checks every index, and notes where frames start.
fn index(
    file: &mut File,
    size: Size,
    path: &Path,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<Vec<u64>> {
    let delimiter = size.pixels() as u32;
    let mut reader = BufReader::with_capacity(1 << 20, file);
    let mut starts = vec![0];
    let (mut at, mut piece, mut held) = (0u64, vec![0u8; 1 << 20], 0);
    loop {
        let n = reader.read(&mut piece[held..]).map_err(|e| Error::io("read", path, e))?;
        held += n;
        for bytes in piece[..held].chunks_exact(4) {
            let word = word(bytes);
            at += 1;
            if word == delimiter {
                starts.push(at);
            } else if word > delimiter {
                return Err(Error::data(
                    format!("word {} is {word}, beyond the last pixel of {size}", at - 1),
                    path,
                    "not a sparse stream of this array: check `format` and `size`",
                ));
            }
        }
        let rest = held % 4;
        piece.copy_within(held - rest..held, 0);
        held = rest;
        if n == 0 {
            break;
        }
    }
    let open_words = at - starts[starts.len() - 1];
    if held > 0 || open_words > 0 {
        let what = format!("the last frame has no delimiter after its {open_words} photons");
        if !options.lenient {
            return Err(Error::data(
                what,
                path,
                "the stream was cut off: copy it again, or drop the last frame with `lenient`",
            ));
        }
        info.notes.push(format!("{what}: dropped"));
    }
    if starts.len() < 2 {
        return Err(Error::data("no whole frame", path, "check `format` and `size`"));
    }
    Ok(starts)
}

impl CountFrames for SparseFrames {
    fn frames(&self) -> u64 {
        self.starts.len() as u64 - 1
    }

    fn size(&self) -> Size {
        self.size
    }

    fn read(&mut self, frame: u64, counts: &mut [u16]) -> Result<()> {
        counts.fill(0);
        let (from, to) = (self.starts[frame as usize], self.starts[frame as usize + 1] - 1);
        self.words.resize((to - from) as usize * 4, 0);
        let io = |e| Error::io(format!("read frame {frame} of"), &self.path, e);
        self.file.seek(SeekFrom::Start(from * 4)).map_err(io)?;
        self.file.read_exact(&mut self.words).map_err(io)?;
        for index in self.words.chunks_exact(4).map(word) {
            // Checked while indexing, but the file may have changed since.
            if let Some(count) = counts.get_mut(index as usize) {
                *count = 1;
            }
        }
        Ok(())
    }
}
