//! Rolling shutter: rows that are exposed one after the other.

use crate::frame::Frame;
use crate::sensor::Sensor;

/// Rolling shutter: the last row sees the scene at the time of the frame, rows above it see earlier times.
///
/// Times are rounded to the instants of an exposure, so that fast motion needs several instants per native
/// frame. Before the first exposure the scene is assumed static.
#[derive(Clone, Debug)]
pub struct RollingShutter {
    /// Time from the first row to the last, in output frames.
    delay: f64,
    /// Instants of the previous exposure.
    before: Vec<Frame>,
}

impl RollingShutter {
    /// Creates the shutter of `sensor`.
    pub fn new(sensor: &Sensor) -> Self {
        let delay = sensor.rolling_shutter / f64::from(sensor.frames_summed);
        Self { delay, before: Vec::new() }
    }

    /// Returns true if rows are exposed at different times.
    pub fn rolls(&self) -> bool {
        self.delay > 0.0
    }

    /// Returns the instants of the next exposure as the rows see them.
    pub fn roll(&mut self, instants: &[Frame]) -> Vec<Frame> {
        if !self.rolls() {
            return instants.to_vec();
        }
        let mut rolled = instants.to_vec();
        for (number, frame) in rolled.iter_mut().enumerate() {
            let size = frame.size;
            for y in 0..size.height {
                let share = 1.0 - (y + 1) as f64 / size.height as f64;
                let back = (self.delay * share * instants.len() as f64).round() as usize;
                let seen = if let Some(at) = number.checked_sub(back) {
                    &instants[at]
                } else {
                    let at = (self.before.len() + number).saturating_sub(back);
                    self.before.get(at).unwrap_or(&instants[0])
                };
                let row = y * size.width..(y + 1) * size.width;
                frame.data[row].copy_from_slice(seen.row(y));
            }
        }
        self.before = instants.to_vec();
        rolled
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::Size;

    const SIZE: Size = Size { height: 4, width: 2 };

    /// Creates instants whose value is their time, in instants.
    fn exposure(number: usize, count: usize) -> Vec<Frame> {
        (0..count).map(|i| Frame::filled(SIZE, (number * count + i) as f32)).collect()
    }

    fn shutter(rolling_shutter: f64, frames_summed: u32) -> RollingShutter {
        let sensor = Sensor::load("spad-qvga").unwrap();
        RollingShutter::new(&Sensor { frames_summed, rolling_shutter, ..sensor })
    }

    fn columns(frames: &[Frame]) -> Vec<Vec<f32>> {
        frames.iter().map(|frame| (0..4).map(|y| frame.row(y)[1]).collect()).collect()
    }

    #[test]
    fn rows_lie_behind_by_their_share_of_a_native_frame() {
        let mut shutter = shutter(1.0, 2);
        // Four instants for each of two native frames: rows are 3, 2, 1 and 0 of them behind.
        let first = columns(&shutter.roll(&exposure(0, 8)));
        assert_eq!(first[0], [0.0, 0.0, 0.0, 0.0], "nothing is known of what was before");
        assert_eq!(first[7], [4.0, 5.0, 6.0, 7.0]);
        let second = columns(&shutter.roll(&exposure(1, 8)));
        assert_eq!(second[0], [5.0, 6.0, 7.0, 8.0]);
        assert_eq!(second[3], [8.0, 9.0, 10.0, 11.0]);
    }

    #[test]
    fn a_global_shutter_changes_nothing() {
        let mut shutter = shutter(0.0, 7);
        assert!(!shutter.rolls());
        assert_eq!(shutter.roll(&exposure(3, 7)), exposure(3, 7));
    }
}
