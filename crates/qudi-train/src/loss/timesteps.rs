//! The timesteps that the network learns at.

use qudi_model::diffusion::sampler::TIMES;
use qudi_model::diffusion::schedule::NoiseSchedule;

/// Turns two uniform numbers in [0, 1) into a timestep to train at: a fraction `noise_start_fraction` of all
/// samples is at the noisiest one, where sampling begins, the others follow [`NoiseSchedule::time_at`].
pub fn training_timestep(kind: f64, place: f64, noise_start_fraction: f64) -> usize {
    if kind < noise_start_fraction {
        return TIMES - 1;
    }
    NoiseSchedule::cosine(TIMES).time_at(place)
}

/// The timestep of the estimate before `timestep`: noisier by a tenth of all timesteps, on the scale of their roots.
pub(super) fn previous_timestep(timestep: usize) -> usize {
    let times = TIMES as f64;
    let share = ((timestep + 1) as f64 / times).sqrt() + 0.1;
    ((times * share * share).round() as usize - 1).min(TIMES - 1)
}
