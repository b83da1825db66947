//! What the U-Net knows of diffusion time.

/// Numbers that describe a sensor and its light.
pub const SENSOR_NUMBERS: usize = 11;

/// Sines, then cosines, of `t * 10000^(-j / (size / 2 - 1))` for every time; in f64, the angles are large.
pub(super) fn sinusoids(times: &[usize], size: usize) -> Vec<f32> {
    let half = size / 2;
    let scale = (half.max(2) - 1) as f64;
    let angle = |t: usize, j: usize| t as f64 * 10_000f64.powf(-(j as f64) / scale);
    let mut values = Vec::with_capacity(times.len() * size);
    for &t in times {
        values.extend((0..half).map(|j| angle(t, j).sin() as f32));
        values.extend((0..half).map(|j| angle(t, j).cos() as f32));
    }
    values
}
