//! Frames from a pipe: each one once, in order, their number known at the end only. Frames are kept until
//! they are released, so that the first window can be read more than once.

use qudi_core::{Error, Result};
use std::collections::VecDeque;
use std::io::Read;
use std::path::Path;

/// Name of the pipe in messages.
pub(crate) const STDIN: &str = "standard input";

/// Output frames of a pipe that statistics read: one window of the paper's network.
pub(crate) const FIRST_WINDOW: u64 = 11;

/// Bytes that may follow the last frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Tail<'a> {
    /// Bytes after the last frame that are no part of it.
    pub(crate) trailer: u64,
    /// Other trailers, known by their content.
    pub(crate) known: &'a [&'static [u8]],
    /// True to drop an incomplete frame instead of refusing it.
    pub(crate) lenient: bool,
}

/// Frames of equal length from a reader.
pub(crate) struct Pipe {
    reader: Box<dyn Read + Send>,
    frame_bytes: usize,
    /// Frames that a header promises.
    promised: Option<u64>,
    tail: Tail<'static>,
    arrived: u64,
    /// The latest frames.
    kept: VecDeque<Vec<u8>>,
    /// First frame that is kept.
    kept_from: u64,
    ended: bool,
}

impl Pipe {
    pub(crate) fn new(
        reader: Box<dyn Read + Send>,
        frame_bytes: usize,
        promised: Option<u64>,
        tail: Tail<'static>,
    ) -> Self {
        let kept = VecDeque::new();
        Self { reader, frame_bytes, promised, tail, arrived: 0, kept, kept_from: 0, ended: false }
    }

    /// Sets the length of a frame and the number that a header promises, before any has arrived.
    pub(crate) fn lay_out(&mut self, frame_bytes: usize, promised: u64) {
        debug_assert_eq!(self.arrived, 0);
        (self.frame_bytes, self.promised) = (frame_bytes, Some(promised));
    }

    /// Returns the number of frames that have arrived.
    pub(crate) fn arrived(&self) -> u64 {
        self.arrived
    }

    pub(crate) fn frame_bytes(&self) -> usize {
        self.frame_bytes
    }

    /// Returns the number of all frames, if it is known yet.
    pub(crate) fn length(&self) -> Option<u64> {
        if self.ended { Some(self.arrived) } else { self.promised }
    }

    /// Waits until `frames` frames have arrived or the pipe ends, and returns how many have.
    pub(crate) fn wait_for(&mut self, frames: u64, notes: &mut Vec<String>) -> Result<u64> {
        while self.arrived < frames && !self.ended {
            if self.promised == Some(self.arrived) {
                self.ended = true;
                break;
            }
            // The buffer grows as bytes arrive: a header may promise frames larger than memory.
            let mut frame = Vec::new();
            (&mut self.reader)
                .take(self.frame_bytes as u64)
                .read_to_end(&mut frame)
                .map_err(|e| Error::io("read", Path::new(STDIN), e))?;
            if frame.len() < self.frame_bytes {
                self.end(&frame, notes)?;
                break;
            }
            self.arrived += 1;
            if self.arrived > self.kept_from {
                self.kept.push_back(frame);
            }
        }
        Ok(self.arrived)
    }

    /// Ends the pipe after `rest` bytes of a frame.
    fn end(&mut self, rest: &[u8], notes: &mut Vec<String>) -> Result<()> {
        self.ended = true;
        let (whole, bytes) = (self.arrived, self.frame_bytes);
        let missing = self.promised.filter(|&promised| promised > whole);
        let trailer = rest.len() as u64 == self.tail.trailer || self.tail.known.contains(&rest);
        let what = match missing {
            None if trailer => {
                if rest == b"ERROR" {
                    let text = "the pipe ends in ERROR: the camera stopped early";
                    notes.push(text.to_owned());
                }
                return Ok(());
            }
            Some(promised) => format!(
                "the pipe ended too early: its header promises {promised} frames, {whole} whole ones came"
            ),
            None => format!(
                "the pipe ended inside a frame: {} of {bytes} bytes came after {whole} whole ones",
                rest.len()
            ),
        };
        if self.tail.lenient && whole > 0 {
            notes.push(what);
            return Ok(());
        }
        Err(Error::data(
            what,
            Path::new(STDIN),
            "look for what went wrong before the pipe, check `size` and `format`, or keep the whole frames with `lenient`",
        ))
    }

    /// Drops the frames before `frame`.
    pub(crate) fn discard_before(&mut self, frame: u64) {
        self.kept_from = self.kept_from.max(frame);
        while !self.kept.is_empty() && self.arrived - (self.kept.len() as u64) < frame {
            self.kept.pop_front();
        }
    }

    /// Fills `bytes`, a whole number of frames, from frame `first` on.
    pub(crate) fn read(&self, first: u64, bytes: &mut [u8]) -> Result<()> {
        let oldest = self.arrived - self.kept.len() as u64;
        for (frame, out) in (first..).zip(bytes.chunks_exact_mut(self.frame_bytes)) {
            let kept = frame.checked_sub(oldest).and_then(|at| self.kept.get(at as usize));
            let kept = kept.ok_or_else(|| {
                Error::request(
                    format!("frame {frame} of a pipe, which holds {oldest} to {}", self.arrived),
                    STDIN,
                    "a pipe goes by once: store the capture in a file to go back in it",
                )
            })?;
            out.copy_from_slice(kept);
        }
        Ok(())
    }

    /// Returns the bytes of the frames that are kept.
    pub(crate) fn kept_bytes(&self) -> Vec<u8> {
        self.kept.iter().flatten().copied().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TAIL: Tail<'static> = Tail { trailer: 0, known: &[b"DONE"], lenient: false };

    fn pipe(bytes: &'static [u8], promised: Option<u64>, tail: Tail<'static>) -> Pipe {
        Pipe::new(Box::new(bytes), 3, promised, tail)
    }

    #[test]
    fn pipe_keeps_frames_until_released() {
        let mut pipe = pipe(b"aaabbbcccdddeee", None, TAIL);
        let mut notes = Vec::new();
        assert_eq!((pipe.wait_for(2, &mut notes).unwrap(), pipe.length()), (2, None));
        let mut two = [0; 6];
        for _ in 0..2 {
            pipe.read(0, &mut two).unwrap();
            assert_eq!(&two, b"aaabbb");
        }
        pipe.discard_before(3);
        assert_eq!(pipe.wait_for(5, &mut notes).unwrap(), 5);
        pipe.read(3, &mut two).unwrap();
        assert_eq!(&two, b"dddeee");
        assert!(pipe.read(2, &mut two).is_err(), "released before it came");
        assert!(pipe.read(4, &mut two).is_err(), "never came");
        assert_eq!(pipe.kept.len(), 2);
        assert_eq!((pipe.wait_for(9, &mut notes).unwrap(), pipe.length()), (5, Some(5)));
        assert!(notes.is_empty());
    }

    #[test]
    fn rejects_or_reports_ends_inside_frames() {
        let all = |mut pipe: Pipe| {
            let mut notes = Vec::new();
            pipe.wait_for(9, &mut notes).map(|n| (n, notes.len()))
        };
        let lenient = Tail { lenient: true, ..TAIL };
        assert!(all(pipe(b"aaabb", None, TAIL)).is_err());
        assert_eq!(all(pipe(b"aaabb", None, lenient)).unwrap(), (1, 1));
        assert!(all(pipe(b"aaabbb", Some(3), TAIL)).is_err());
        assert_eq!(all(pipe(b"aaabbb", Some(3), lenient)).unwrap(), (2, 1));
        assert!(all(pipe(b"aa", None, lenient)).is_err(), "nothing whole came");
        assert_eq!(all(pipe(b"aaabb", None, Tail { trailer: 2, ..TAIL })).unwrap(), (1, 0));
        assert_eq!(all(pipe(b"aaabbbxx", Some(2), TAIL)).unwrap(), (2, 0), "no more is read");
    }

    #[test]
    fn skips_trailers_of_cameras() {
        let mut four = Pipe::new(Box::new(&b"aaaaabbbbbDONE"[..]), 5, None, TAIL);
        let mut notes = Vec::new();
        assert_eq!(four.wait_for(9, &mut notes).unwrap(), 2);
        assert!(notes.is_empty());
    }
}
