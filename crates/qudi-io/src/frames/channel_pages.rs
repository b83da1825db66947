//! One channel of a stack whose channels are pages of their own.

use super::count_frames::CountFrames;
use qudi_core::{Result, Size};

/// Every page of one channel; channels take turns after `run` pages.
pub(crate) struct ChannelPages {
    inner: Box<dyn CountFrames>,
    channels: u64,
    channel: u64,
    run: u64,
}

impl ChannelPages {
    /// Selects the pages of `channel` out of `channels`; `None` if the pages do not fill whole turns.
    pub(crate) fn new(
        inner: Box<dyn CountFrames>,
        channels: u64,
        channel: u64,
        run: u64,
    ) -> Option<Self> {
        let turn = channels.checked_mul(run)?;
        let fits = channel < channels && inner.frames() > 0 && inner.frames().is_multiple_of(turn);
        fits.then_some(Self { inner, channels, channel, run })
    }
}

impl CountFrames for ChannelPages {
    fn frames(&self) -> u64 {
        self.inner.frames() / self.channels
    }

    fn size(&self) -> Size {
        self.inner.size()
    }

    fn read(&mut self, frame: u64, counts: &mut [u16]) -> Result<()> {
        let (turn, within) = (frame / self.run, frame % self.run);
        self.inner.read((turn * self.channels + self.channel) * self.run + within, counts)
    }

    fn ignore(&mut self, pixels: &[bool]) {
        self.inner.ignore(pixels);
    }

    fn forward_only(&self) -> bool {
        self.inner.forward_only()
    }
}
