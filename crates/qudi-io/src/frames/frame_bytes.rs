//! Stored bytes of frames: in files, in a compressed stream, or scattered across an array whose frame axis is
//! not the slowest. Memory is bounded by a few frames.

use crate::frames::pipe::Pipe;
use qudi_core::{Error, Result};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Frames that lie one after the other in a file.
#[derive(Clone, Debug)]
pub(crate) struct Segment {
    pub(crate) path: PathBuf,
    /// Bytes before the first frame.
    pub(crate) start: u64,
    pub(crate) frames: u64,
}

/// A function that opens a stream at its beginning.
pub(crate) type Opener = Box<dyn Fn() -> Result<Box<dyn Read + Send>> + Send>;

/// The source of the bytes of frames.
pub(crate) enum FrameBytes {
    /// Files read in place, not mapped: resident memory stays flat, and a file that shrinks
    /// meanwhile is an error instead of a signal.
    Files(Files),
    /// A stream that can only go forward.
    Stream(Stream),
    /// Batches, where one frame costs as much as many: compressed chunks, or an array whose frame axis is not
    /// the slowest.
    Batched(Batched),
    /// Frames that arrive once.
    Pipe(Pipe),
    /// Some bytes of each frame.
    Picked(Box<Picked>),
}

impl FrameBytes {
    pub(crate) fn files(segments: Vec<Segment>, frame_bytes: usize) -> Self {
        Self::Files(Files::new(segments, frame_bytes))
    }

    /// Creates a source from an unnamed file.
    pub(crate) fn spool(segment: Segment, file: File, frame_bytes: usize) -> Self {
        Self::Files(Files { open: Some((0, file)), ..Files::new(vec![segment], frame_bytes) })
    }

    /// Creates a source from a stream; `after` says what its reader does once the last frame is read.
    pub(crate) fn stream(
        opener: Opener,
        frames: u64,
        frame_bytes: usize,
        after: StreamEnd,
        path: &Path,
    ) -> Self {
        Self::Stream(Stream {
            opener,
            reader: None,
            at: 0,
            frames,
            frame_bytes,
            after,
            path: path.to_owned(),
        })
    }

    /// Creates a source from one file, which is checked against a CRC-32 when its frames are read in order.
    pub(crate) fn checked(segment: Segment, frame_bytes: usize, checksum: Checksum) -> Self {
        let files = Files::new(vec![segment], frame_bytes);
        Self::Files(Files { checksum: Some(RunningChecksum::new(checksum)), ..files })
    }

    /// Creates a source from `fetch`, in multiples of `group` frames where memory allows.
    pub(crate) fn batched(fetch: Fetch, frames: u64, frame_bytes: usize, group: u64) -> Self {
        let fit = (BATCH_BYTES / frame_bytes).max(1) as u64;
        let at_once = if group <= fit { fit / group * group } else { fit };
        Self::Batched(Batched {
            fetch,
            frames,
            frame_bytes,
            at_once,
            range: 0..0,
            batch: Vec::new(),
        })
    }

    /// Selects `length` bytes of each frame, from byte `start` on.
    pub(crate) fn part_of_frames(self, start: usize, length: usize) -> Self {
        Self::Picked(Box::new(Picked { inner: self, start, step: 1, length, frame: Vec::new() }))
    }

    /// Selects every `step`-th byte of each frame, from byte `start` on.
    pub(crate) fn every_byte(self, start: usize, step: usize) -> Self {
        let length = self.frame_bytes() / step;
        Self::Picked(Box::new(Picked { inner: self, start, step, length, frame: Vec::new() }))
    }

    pub(crate) fn frames(&self) -> u64 {
        match self {
            Self::Files(files) => files.total,
            Self::Stream(stream) => stream.frames,
            Self::Batched(batched) => batched.frames,
            Self::Pipe(pipe) => pipe.arrived(),
            Self::Picked(picked) => picked.inner.frames(),
        }
    }

    pub(crate) fn frame_bytes(&self) -> usize {
        match self {
            Self::Files(files) => files.frame_bytes,
            Self::Stream(stream) => stream.frame_bytes,
            Self::Batched(batched) => batched.frame_bytes,
            Self::Pipe(pipe) => pipe.frame_bytes(),
            Self::Picked(picked) => picked.length,
        }
    }

    pub(crate) fn forward_only(&self) -> bool {
        match self {
            Self::Stream(_) | Self::Pipe(_) => true,
            Self::Files(_) | Self::Batched(_) => false,
            Self::Picked(picked) => picked.inner.forward_only(),
        }
    }

    /// Returns the number of all frames, if it is known.
    pub(crate) fn length(&self) -> Option<u64> {
        match self {
            Self::Pipe(pipe) => pipe.length(),
            Self::Picked(picked) => picked.inner.length(),
            _ => Some(self.frames()),
        }
    }

    /// Waits for `frames` frames, and returns how many there are.
    pub(crate) fn wait_for(&mut self, frames: u64, notes: &mut Vec<String>) -> Result<u64> {
        match self {
            Self::Pipe(pipe) => pipe.wait_for(frames, notes),
            Self::Picked(picked) => picked.inner.wait_for(frames, notes),
            _ => Ok(self.frames()),
        }
    }

    /// Allows to drop the frames before `frame`.
    pub(crate) fn discard_before(&mut self, frame: u64) {
        match self {
            Self::Pipe(pipe) => pipe.discard_before(frame),
            Self::Picked(picked) => picked.inner.discard_before(frame),
            Self::Files(_) | Self::Stream(_) | Self::Batched(_) => {}
        }
    }

    /// Compares what was not read yet with the checksum of the stored data, if they have one.
    pub(crate) fn verify(&mut self) -> Result<()> {
        match self {
            Self::Files(files) => files.verify(),
            Self::Stream(stream) => stream.verify(),
            Self::Picked(picked) => picked.inner.verify(),
            Self::Batched(_) | Self::Pipe(_) => Ok(()),
        }
    }

    /// Fills `bytes`, a whole number of frames, from frame `first` on.
    pub(crate) fn read(&mut self, first: u64, bytes: &mut [u8]) -> Result<()> {
        debug_assert_eq!(bytes.len() % self.frame_bytes(), 0);
        debug_assert!(first + (bytes.len() / self.frame_bytes()) as u64 <= self.frames());
        match self {
            Self::Files(files) => files.read(first, bytes),
            Self::Stream(stream) => stream.read(first, bytes),
            Self::Batched(batched) => batched.read(first, bytes),
            Self::Pipe(pipe) => pipe.read(first, bytes),
            Self::Picked(picked) => picked.read(first, bytes),
        }
    }
}

/// Some bytes of each frame, such as one channel.
pub(crate) struct Picked {
    inner: FrameBytes,
    start: usize,
    step: usize,
    length: usize,
    frame: Vec<u8>,
}

impl Picked {
    fn read(&mut self, first: u64, bytes: &mut [u8]) -> Result<()> {
        self.frame.resize(self.inner.frame_bytes(), 0);
        for (frame, out) in (first..).zip(bytes.chunks_exact_mut(self.length)) {
            self.inner.read(frame, &mut self.frame)?;
            let picked = self.frame[self.start..].iter().step_by(self.step);
            for (to, &byte) in out.iter_mut().zip(picked) {
                *to = byte;
            }
        }
        Ok(())
    }
}

/// Bytes of a long piece that one thread reads.
#[cfg(unix)]
const SHARED_BYTES: usize = 1 << 18;

pub(crate) struct Files {
    segments: Vec<Segment>,
    firsts: Vec<u64>,
    total: u64,
    frame_bytes: usize,
    open: Option<(usize, File)>,
    checksum: Option<RunningChecksum>,
}

/// The CRC-32 of a part of a file, which holds frames after a header.
#[derive(Clone, Debug)]
pub(crate) struct Checksum {
    pub(crate) expected: u32,
    /// Bytes of the file that the checksum covers.
    pub(crate) range: Range<u64>,
}

/// A checksum that grows while frames are read in order. Frames read out of order are not checked.
struct RunningChecksum {
    checksum: Checksum,
    hasher: crc32fast::Hasher,
    next: u64,
}

impl RunningChecksum {
    fn new(checksum: Checksum) -> Self {
        Self { checksum, hasher: crc32fast::Hasher::new(), next: 0 }
    }

    /// Adds `bytes`, the frames from `first` on, just read from `file` as `segment` places them.
    fn add(
        &mut self,
        first: u64,
        bytes: &[u8],
        frame_bytes: usize,
        segment: &Segment,
        file: &mut File,
    ) -> std::io::Result<()> {
        if first == 0 {
            self.hasher = crc32fast::Hasher::new();
            self.next = 0;
            file.seek(SeekFrom::Start(self.checksum.range.start))?;
            self.hash(file, segment.start - self.checksum.range.start)?;
        }
        if first != self.next {
            return Ok(());
        }
        self.hasher.update(bytes);
        self.next += (bytes.len() / frame_bytes) as u64;
        if self.next < segment.frames {
            return Ok(());
        }
        let end = segment.start + segment.frames * frame_bytes as u64;
        file.seek(SeekFrom::Start(end))?;
        self.hash(file, self.checksum.range.end.saturating_sub(end))?;
        self.compare()
    }

    /// Compares all of the file's part with the checksum.
    fn whole(&mut self, file: &mut File) -> std::io::Result<()> {
        let Range { start, end } = self.checksum.range;
        self.hasher = crc32fast::Hasher::new();
        file.seek(SeekFrom::Start(start))?;
        self.hash(file, end - start)?;
        self.compare()
    }

    fn compare(&self) -> std::io::Result<()> {
        let found = self.hasher.clone().finalize();
        let expected = self.checksum.expected;
        if found == expected { Ok(()) } else { Err(super::checksum::mismatch(found, expected)) }
    }

    fn hash(&mut self, file: &mut File, bytes: u64) -> std::io::Result<()> {
        let mut piece = vec![0; 1 << 16];
        let mut left = bytes;
        while left > 0 {
            let n = left.min(piece.len() as u64) as usize;
            file.read_exact(&mut piece[..n])?;
            self.hasher.update(&piece[..n]);
            left -= n as u64;
        }
        Ok(())
    }
}

impl Files {
    fn new(segments: Vec<Segment>, frame_bytes: usize) -> Self {
        let mut total = 0;
        let firsts = segments
            .iter()
            .map(|segment| {
                total += segment.frames;
                total - segment.frames
            })
            .collect();
        Self { segments, firsts, total, frame_bytes, open: None, checksum: None }
    }

    fn read(&mut self, mut first: u64, mut bytes: &mut [u8]) -> Result<()> {
        while !bytes.is_empty() {
            let at = self.firsts.partition_point(|&start| start <= first) - 1;
            let Segment { path, start, frames } = &self.segments[at];
            let within = first - self.firsts[at];
            let wanted = (bytes.len() / self.frame_bytes) as u64;
            let here = wanted.min(frames - within);
            let (piece, rest) = bytes.split_at_mut(here as usize * self.frame_bytes);
            if self.open.as_ref().is_none_or(|(open, _)| *open != at) {
                let file = File::open(path).map_err(|e| Error::io("open", path, e))?;
                self.open = Some((at, file));
            }
            let (_, file) = self.open.as_mut().expect("opened above");
            read_exact_at(file, start + within * self.frame_bytes as u64, piece)
                .map_err(|e| Error::io(format!("read frame {first} of"), path, e))?;
            if let Some(checksum) = &mut self.checksum {
                let segment = &self.segments[at];
                let added = checksum.add(first, piece, self.frame_bytes, segment, file);
                added.map_err(|e| unverified(e, path))?;
            }
            bytes = rest;
            first += here;
        }
        Ok(())
    }

    /// Reads what its checksum covers, unless all frames were read in order.
    fn verify(&mut self) -> Result<()> {
        let [Segment { path, frames, .. }] = &self.segments[..] else { return Ok(()) };
        let Some(checksum) = self.checksum.as_mut().filter(|sum| sum.next < *frames) else {
            return Ok(());
        };
        let compared = File::open(path).and_then(|mut file| checksum.whole(&mut file));
        compared.map_err(|e| unverified(e, path))
    }
}

/// Fills `bytes` from byte `start` of a file on; long pieces by several threads.
#[cfg(unix)]
fn read_exact_at(file: &mut File, start: u64, bytes: &mut [u8]) -> std::io::Result<()> {
    use rayon::prelude::*;
    use std::os::unix::fs::FileExt;
    if bytes.len() < 2 * SHARED_BYTES {
        return file.read_exact_at(bytes, start);
    }
    let shares = bytes.par_chunks_mut(SHARED_BYTES).enumerate();
    shares.try_for_each(|(n, bytes)| file.read_exact_at(bytes, start + (n * SHARED_BYTES) as u64))
}

/// Fills `bytes` from byte `start` of a file on.
#[cfg(not(unix))]
fn read_exact_at(file: &mut File, start: u64, bytes: &mut [u8]) -> std::io::Result<()> {
    file.seek(SeekFrom::Start(start))?;
    file.read_exact(bytes)
}

/// Returns the error of data whose checksum was not compared, or differs.
fn unverified(e: std::io::Error, path: &Path) -> Error {
    let ends = e.kind() == std::io::ErrorKind::UnexpectedEof;
    if ends || e.kind() == std::io::ErrorKind::InvalidData {
        return damaged(&e, path);
    }
    Error::io("check", path, e)
}

/// The end of a stream after its last frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum StreamEnd {
    /// Reads to the end, where decoders compare checksums.
    Verified,
    /// Stops, since the stream is damaged there.
    Ignored,
}

/// Returns the error of data that differ from their checksum.
fn damaged(e: &std::io::Error, path: &Path) -> Error {
    Error::data(format!("the stored data are damaged: {e}"), path, "copy or export the file again")
}

pub(crate) struct Stream {
    opener: Opener,
    reader: Option<Box<dyn Read + Send>>,
    at: u64,
    frames: u64,
    frame_bytes: usize,
    after: StreamEnd,
    path: PathBuf,
}

impl Stream {
    fn read(&mut self, first: u64, bytes: &mut [u8]) -> Result<()> {
        if self.reader.is_none() || first < self.at {
            self.reader = Some((self.opener)()?);
            self.at = 0;
        }
        let reader = self.reader.as_mut().expect("opened above");
        let fault = |frame: u64, path: &Path, e: std::io::Error| match e.kind() {
            std::io::ErrorKind::UnexpectedEof => Error::data(
                format!("the compressed data end before frame {frame} is complete"),
                path,
                "the file is truncated or damaged: copy or export it again",
            ),
            std::io::ErrorKind::InvalidInput | std::io::ErrorKind::InvalidData => Error::data(
                format!("the compressed data are damaged before frame {frame}: {e}"),
                path,
                "copy or export the file again",
            ),
            _ => Error::io(format!("read frame {frame} of"), path, e),
        };
        let skip = (first - self.at) * self.frame_bytes as u64;
        let skipped = std::io::copy(&mut reader.by_ref().take(skip), &mut std::io::sink());
        match skipped {
            Ok(n) if n == skip => {}
            Ok(_) => {
                return Err(fault(first, &self.path, std::io::ErrorKind::UnexpectedEof.into()));
            }
            Err(e) => return Err(fault(first, &self.path, e)),
        }
        self.at = first;
        reader.read_exact(bytes).map_err(|e| fault(first, &self.path, e))?;
        self.at += (bytes.len() / self.frame_bytes) as u64;
        if self.at == self.frames {
            self.verify()?;
        }
        Ok(())
    }

    /// Reads to the end, where decoders compare checksums.
    fn verify(&mut self) -> Result<()> {
        if let (StreamEnd::Verified, Some(reader)) = (self.after, &mut self.reader) {
            std::io::copy(reader, &mut std::io::sink()).map_err(|e| damaged(&e, &self.path))?;
            self.at = self.frames;
        }
        Ok(())
    }
}

/// A function that fetches frames `first..first + count` whole.
pub(crate) type Fetch = Box<dyn FnMut(u64, u64) -> Result<Vec<u8>> + Send>;

/// Frames fetched and kept in batches, where one alone would cost as much as many.
pub(crate) struct Batched {
    fetch: Fetch,
    frames: u64,
    frame_bytes: usize,
    at_once: u64,
    range: Range<u64>,
    batch: Vec<u8>,
}

/// Bytes of one batch.
const BATCH_BYTES: usize = 1 << 25;

impl Batched {
    fn read(&mut self, first: u64, bytes: &mut [u8]) -> Result<()> {
        for (frame, out) in (first..).zip(bytes.chunks_exact_mut(self.frame_bytes)) {
            if !self.range.contains(&frame) {
                let start = frame - frame % self.at_once;
                let count = self.at_once.min(self.frames - start);
                self.range = 0..0;
                self.batch = (self.fetch)(start, count)?;
                self.range = start..start + count;
            }
            let at = (frame - self.range.start) as usize * self.frame_bytes;
            out.copy_from_slice(&self.batch[at..at + self.frame_bytes]);
        }
        Ok(())
    }
}

/// Fetches frames of an array with axes `outer x frames x inner`, elements of `element` bytes, that
/// starts at byte `start` of the file `open`, or of the one at `path`.
pub(crate) fn strewn(
    path: &Path,
    mut open: Option<File>,
    start: u64,
    element: usize,
    [outer, frames, inner]: [usize; 3],
) -> FrameBytes {
    let size = outer * inner * element;
    let run = inner * element;
    let path = path.to_owned();
    let fetch = move |first: u64, count: u64| {
        let io = |e| Error::io("read", &path, e);
        if open.is_none() {
            open = Some(File::open(&path).map_err(io)?);
        }
        let file = open.as_mut().expect("opened above");
        let mut batch = vec![0; count as usize * size];
        let mut scratch = vec![0; count as usize * run];
        for o in 0..outer {
            let at = (o as u64 * frames as u64 + first) * run as u64;
            file.seek(SeekFrom::Start(start + at))
                .and_then(|_| file.read_exact(&mut scratch))
                .map_err(io)?;
            for (t, piece) in scratch.chunks_exact(run).enumerate() {
                let to = t * size + o * run;
                batch[to..to + run].copy_from_slice(piece);
            }
        }
        Ok(batch)
    };
    FrameBytes::batched(Box::new(fetch), frames as u64, size, 1)
}
