//! Surfaces of layers.

use qudi_core::{Frame, Size};
use std::f64::consts::TAU;
use std::sync::Arc;

/// Surface of a layer in its own coordinates, with values in [0, 1].
#[derive(Clone, Debug)]
pub enum Paint {
    /// One value.
    Flat(f32),
    /// A sine grating.
    Grating {
        /// Mean value.
        mean: f32,
        /// Amplitude; `mean +- amplitude` stays in [0, 1].
        amplitude: f32,
        /// Cycles per pixel along x and y.
        frequency: [f64; 2],
        /// Phase in cycles.
        phase: f64,
    },
    /// An image, mirrored at its borders, with halved copies for small magnifications.
    Image(Arc<Vec<Frame>>),
    /// A resolution chart: star, bars, slanted edge and grey steps.
    Chart(Size),
}

impl Paint {
    /// Creates the paint of a picture.
    pub fn image(frame: Frame) -> Self {
        let mut levels = vec![frame];
        while let Some(half) = halved(&levels[levels.len() - 1]) {
            levels.push(half);
        }
        Self::Image(Arc::new(levels))
    }

    /// Returns the value at a local point seen at magnification `scale`.
    pub(super) fn value(&self, [x, y]: [f64; 2], scale: f64) -> f32 {
        match self {
            Self::Flat(value) => *value,
            Self::Grating { mean, amplitude, frequency, phase } => {
                let cycles = x * frequency[0] + y * frequency[1] + phase;
                mean + amplitude * (TAU * cycles).sin() as f32
            }
            Self::Image(levels) => {
                let level = (-scale.log2()).round().clamp(0.0, (levels.len() - 1) as f64) as usize;
                let step = f64::from(1u32 << level);
                bicubic(&levels[level], (x + 0.5) / step - 0.5, (y + 0.5) / step - 0.5)
            }
            Self::Chart(size) => chart(*size, x, y) as f32,
        }
    }
}

/// Halves the size by 2 x 2 means; `None` below 2 pixels.
fn halved(frame: &Frame) -> Option<Frame> {
    let size = Size { height: frame.size.height / 2, width: frame.size.width / 2 };
    (size.height >= 2 && size.width >= 2).then(|| {
        Frame::from_fn(size, |x, y| {
            let (top, bottom) = (frame.row(2 * y), frame.row(2 * y + 1));
            0.25 * (top[2 * x] + top[2 * x + 1] + bottom[2 * x] + bottom[2 * x + 1])
        })
    })
}

/// Returns the index into a mirrored signal of length `n` (no repeated border sample).
fn mirror(i: i64, n: usize) -> usize {
    if n == 1 {
        return 0;
    }
    let period = 2 * (n as i64 - 1);
    let i = i.rem_euclid(period);
    i.min(period - i) as usize
}

/// Interpolates by Catmull-Rom splines (Keys 1981, a = -1/2), clipped to [0, 1].
fn bicubic(frame: &Frame, x: f64, y: f64) -> f32 {
    let weights = |t: f64| {
        [
            ((-0.5 * t + 1.0) * t - 0.5) * t,
            (1.5 * t - 2.5) * t * t + 1.0,
            ((-1.5 * t + 2.0) * t + 0.5) * t,
            (0.5 * t - 0.5) * t * t,
        ]
    };
    let (x0, y0) = (x.floor(), y.floor());
    let (wx, wy) = (weights(x - x0), weights(y - y0));
    let columns: [usize; 4] =
        std::array::from_fn(|k| mirror(x0 as i64 + k as i64 - 1, frame.size.width));
    let mut sum = 0.0;
    for (k, wy) in wy.iter().enumerate() {
        let row = frame.row(mirror(y0 as i64 + k as i64 - 1, frame.size.height));
        let across: f64 = columns.iter().zip(wx).map(|(&c, w)| w * f64::from(row[c])).sum();
        sum += wy * across;
    }
    sum.clamp(0.0, 1.0) as f32
}

/// Returns a soft step one pixel wide around zero distance.
fn step(distance: f64) -> f64 {
    (0.5 + distance).clamp(0.0, 1.0)
}

/// Draws bars of a period in pixels, with soft edges.
fn bars(position: f64, period: f64) -> f64 {
    step(period / TAU * (TAU * position / period).sin())
}

/// Draws the chart on a plane of `size`, in units of the shorter side.
fn chart(size: Size, x: f64, y: f64) -> f64 {
    let unit = size.height.min(size.width) as f64;
    let (dx, dy) = (x - 0.5 * (size.width - 1) as f64, y - 0.5 * (size.height - 1) as f64);
    let (u, v) = (dx / unit, dy / unit);
    let radius = dx.hypot(dy);
    let (dark, bright) = (0.08, 0.92);
    let between = |share: f64| dark + (bright - dark) * share;
    if radius < 0.26 * unit {
        const SPOKES: f64 = 32.0;
        return between(step(radius / SPOKES * (SPOKES * dy.atan2(dx)).sin()));
    }
    if (-0.46..-0.32).contains(&v) {
        // Bars, coarse to fine: 16, 12, 8, 6, 4, 3 pixels per pair.
        let periods = [16.0, 12.0, 8.0, 6.0, 4.0, 3.0];
        let cell = ((u + 0.48) / 0.16).floor();
        let within = (u + 0.48) / 0.16 - cell;
        if (0.0..6.0).contains(&cell) && within < 0.85 {
            return between(bars(dx, periods[cell as usize]));
        }
    }
    if (0.32..0.46).contains(&v) && u.abs() < 0.48 {
        return between(((u + 0.48) / 0.96 * 8.0).floor() / 7.0);
    }
    if u.abs() > 0.32 && u.abs() < 0.46 && v.abs() < 0.26 {
        // Edge at 5 degrees.
        return between(step((dx - 0.39 * unit * u.signum()) + dy * 0.0875));
    }
    0.5
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bicubic_passes_through_samples_and_mirrors() {
        let size = Size { height: 5, width: 7 };
        let frame = Frame::from_fn(size, |x, y| (x * 3 + y) as f32 / 30.0);
        assert!((bicubic(&frame, 4.0, 3.0) - frame.row(3)[4]).abs() < 1e-6);
        assert!((bicubic(&frame, -2.0, 1.0) - frame.row(1)[2]).abs() < 1e-6);
        assert!(
            (bicubic(&frame, 3.5, 2.0) - 0.5 * (frame.row(2)[3] + frame.row(2)[4])).abs() < 1e-6
        );
    }

    #[test]
    fn averages_far_views_without_aliasing() {
        let size = Size { height: 32, width: 32 };
        let paint = Paint::image(Frame::from_fn(size, |x, y| ((x + y) % 2) as f32));
        assert!((paint.value([10.0, 10.0], 0.25) - 0.5).abs() < 0.01);
    }
}
