//! The sinusoidal embedding of timesteps (Vaswani et al. 2017, section 3.5).

/// Computes sines, then cosines, of `t * 10000^(-j / (size / 2 - 1))` for every timestep; in f64, for the
/// angles are large.
pub(crate) fn sinusoids(timesteps: &[usize], size: usize) -> Vec<f32> {
    let half = size / 2;
    let scale = (half.max(2) - 1) as f64;
    let angle = |t: usize, j: usize| t as f64 * 10_000f64.powf(-(j as f64) / scale);
    let mut values = Vec::with_capacity(timesteps.len() * size);
    for &t in timesteps {
        values.extend((0..half).map(|j| angle(t, j).sin() as f32));
        values.extend((0..half).map(|j| angle(t, j).cos() as f32));
    }
    values
}
