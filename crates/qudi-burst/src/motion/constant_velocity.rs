//! Constant velocity of every patch, estimated from the counts of all frames.

use super::grid::Grid;
use super::pyramid::smooth;
use super::velocity_search::VelocitySearch;
use crate::patch::PatchMotion;
use crate::prepared_burst::PreparedBurst;
use qudi_core::Frame;
use rayon::prelude::*;

/// Spacing in frames of the anchors at which velocities are searched. The velocities of other frames follow
/// from these.
const ANCHOR_SPACING: usize = 6;

/// Constant velocity of every patch of a window, estimated from its counts alone.
#[derive(Debug)]
pub(crate) struct ConstantVelocity {
    /// Smoothed counts.
    pub(crate) smoothed: Vec<Frame>,
    /// Velocities of the patches of every frame, `[frame][patch]`.
    velocities: PatchMotion,
}

impl ConstantVelocity {
    /// Finds the velocities of a window, or returns `None` if it has too few frames. A patch is static or
    /// moves with the whole frame unless another velocity fits better by `evidence` nats.
    pub(crate) fn find(burst: &PreparedBurst, evidence: f32) -> Option<Self> {
        let frames = &burst.frames;
        if frames.len() < 3 {
            return None;
        }
        let search = VelocitySearch::new(frames, &burst.moments);
        let grid = &burst.grid;
        let anchors =
            ((frames.len() - 1) % ANCHOR_SPACING / 2..frames.len()).step_by(ANCHOR_SPACING);
        let found: Vec<_> = anchors.map(|k| (k, search.velocities(grid, k, evidence))).collect();
        let of = |frame: usize| {
            let (anchor, velocities) = found.iter().min_by_key(|(k, _)| k.abs_diff(frame))?;
            let time = *anchor as f32 - frame as f32;
            Some((0..grid.len()).map(|i| carried(grid, velocities, i, time)).collect())
        };
        let velocities = (0..frames.len()).map(of).collect::<Option<_>>()?;
        Some(Self { smoothed: frames.par_iter().map(smooth).collect(), velocities })
    }

    /// Returns the velocities of the patches of frame `frame`, in pixels per frame.
    pub(crate) fn velocities(&self, frame: usize) -> &[[f32; 2]] {
        &self.velocities[frame]
    }

    /// Returns the motion of every patch of frame `reference` to every frame.
    pub(crate) fn motion(&self, reference: usize) -> PatchMotion {
        let velocities = &self.velocities[reference];
        let time = |k: usize| k as f32 - reference as f32;
        (0..self.smoothed.len())
            .map(|k| velocities.iter().map(|v| v.map(|v| v * time(k))).collect())
            .collect()
    }
}

/// Returns the velocity of patch `i` given the velocities `time` frames later: the velocity of the patch that
/// it has moved to.
fn carried(grid: &Grid, velocities: &[[f32; 2]], i: usize, time: f32) -> [f32; 2] {
    let centre = grid.corner(i).map(|corner| (corner + grid.side / 2) as f32);
    let mut v = velocities[i];
    for _ in 0..2 {
        let there = [centre[0] + time * v[0], centre[1] + time * v[1]];
        v = velocities[grid.around(there)[0]];
    }
    v
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::patch::SIDE;
    use qudi_core::Size;

    const SIZE: Size = Size { height: 96, width: 112 };

    #[test]
    fn carries_velocities_along_their_own_motion() {
        let grid = Grid::new(SIZE, SIDE, SIDE / 2);
        // The left half moves right by two pixels per frame, the right half is static.
        let border = |x: usize| if x < 48 { [2.0, 0.0] } else { [0.0, 0.0] };
        let velocities: Vec<[f32; 2]> =
            (0..grid.len()).map(|i| border(grid.corner(i)[0])).collect();
        for i in 0..grid.len() {
            let [x, _] = grid.corner(i);
            let found = carried(&grid, &velocities, i, 2.0);
            // Two frames later, a patch within four pixels of the border has crossed it.
            if x < 40 {
                assert_eq!(found, [2.0, 0.0]);
            } else if x > 48 {
                assert_eq!(found, [0.0, 0.0]);
            }
        }
    }
}
