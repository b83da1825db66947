//! Synthetic scenes as exposures, rendered at the instants that each exposure needs.

use super::{AssumedWhite, ClipInfo, Exposure, ExposureSource};
use crate::scene::Scene;
use qudi_core::Result;
use qudi_core::flow::Flow;

pub(super) struct Synthetic {
    scene: Scene,
    frames: u64,
    instants: usize,
    next: u64,
    assumed_white: AssumedWhite,
}

impl Synthetic {
    pub(super) fn new(
        scene: Scene,
        frames: u64,
        instants: usize,
        assumed_white: AssumedWhite,
    ) -> Self {
        Self { scene, frames, instants, next: 0, assumed_white }
    }
}

impl ExposureSource for Synthetic {
    fn info(&self) -> ClipInfo {
        let Self { frames, assumed_white, .. } = *self;
        ClipInfo { size: self.scene.size, frames: Some(frames), assumed_white }
    }

    fn next(&mut self) -> Result<Option<Exposure>> {
        if self.next == self.frames {
            return Ok(None);
        }
        let middle = self.next as f64;
        self.next += 1;
        // The exposure lasts from half a frame before its middle to half a frame after.
        let n = self.instants;
        let time = |i: usize| middle + (i as f64 + 0.5) / n as f64 - 0.5;
        let instants = (0..n).map(|i| self.scene.render(time(i))).collect();
        let middle = n.is_multiple_of(2).then(|| self.scene.render(middle));
        Ok(Some(Exposure { instants, middle, colour: None }))
    }

    fn flow(&self, index: u64) -> Option<Flow> {
        Some(self.scene.flow(index as f64, (index + 1) as f64))
    }
}
