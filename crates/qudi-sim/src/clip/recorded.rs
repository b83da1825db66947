//! Recorded clips as exposures: each output frame sees `instants` recorded frames in turn.

use super::{AssumedWhite, ClipInfo, Exposure, ExposureSource, FrameReader};
use qudi_core::flow::Flow;
use qudi_core::{Frame, Result, Size};

/// Reader that repeats every frame of another one.
pub(super) struct Repeated {
    reader: Box<dyn FrameReader>,
    times: u64,
    /// The current frame, and its remaining repetitions.
    current: Option<(Frame, u64)>,
}

impl Repeated {
    /// Creates a reader that repeats every frame of `reader` `times` times.
    pub(super) fn new(reader: Box<dyn FrameReader>, times: u64) -> Self {
        Self { reader, times, current: None }
    }
}

impl FrameReader for Repeated {
    fn size(&self) -> Size {
        self.reader.size()
    }

    fn frames(&self) -> Option<u64> {
        self.reader.frames().map(|frames| frames.saturating_mul(self.times))
    }

    fn assumed_white(&mut self) -> Result<AssumedWhite> {
        self.reader.assumed_white()
    }

    fn next(&mut self) -> Result<Option<Frame>> {
        if let Some((frame, left)) = &mut self.current
            && *left > 0
        {
            *left -= 1;
            return Ok(Some(frame.clone()));
        }
        let next = self.reader.next()?;
        if self.times > 1 {
            self.current = next.clone().map(|frame| (frame, self.times - 1));
        }
        Ok(next)
    }
}

pub(super) struct Recorded {
    reader: Box<dyn FrameReader>,
    instants: usize,
    left: Option<u64>,
    assumed_white: AssumedWhite,
}

impl Recorded {
    /// Creates a source of at most `limit` exposures of `instants` recorded frames each, without an
    /// incomplete last one.
    pub(super) fn new(
        mut reader: Box<dyn FrameReader>,
        instants: usize,
        limit: Option<u64>,
    ) -> Result<Self> {
        let assumed_white = reader.assumed_white()?;
        Ok(Self { reader, instants, left: limit, assumed_white })
    }
}

impl ExposureSource for Recorded {
    fn info(&self) -> ClipInfo {
        let there = self.reader.frames().map(|n| n / self.instants as u64);
        let frames = match (there, self.left) {
            (Some(there), Some(limit)) => Some(there.min(limit)),
            (there, _) => there,
        };
        ClipInfo { size: self.reader.size(), frames, assumed_white: self.assumed_white }
    }

    fn next(&mut self) -> Result<Option<Exposure>> {
        match &mut self.left {
            Some(0) => return Ok(None),
            Some(left) => *left -= 1,
            None => {}
        }
        let mut instants = Vec::with_capacity(self.instants);
        while instants.len() < self.instants {
            let Some(frame) = self.reader.next()? else { return Ok(None) };
            instants.push(frame);
        }
        Ok(Some(Exposure { instants, middle: None, colour: None }))
    }

    fn flow(&self, _: u64) -> Option<Flow> {
        None
    }
}
