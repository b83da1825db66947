//! The timesteps that the network learns at.

use qudi_model::diffusion::schedule::NoiseSchedule;
use qudi_model::diffusion::timesteps::{NUM_TIMESTEPS, log_logistic_timestep};

/// Turns two uniform numbers in [0, 1) into a timestep to train at: a fraction `noise_start_fraction` of all
/// samples is at the noisiest one, where sampling begins, the others follow [`log_logistic_timestep`].
pub fn training_timestep(kind: f64, place: f64, noise_start_fraction: f64) -> usize {
    if kind < noise_start_fraction {
        return NUM_TIMESTEPS - 1;
    }
    log_logistic_timestep(&NoiseSchedule::cosine(NUM_TIMESTEPS), place)
}

/// The timestep of the estimate before `timestep`: noisier by a tenth of all timesteps, on the scale of their
/// roots.
pub(super) fn previous_timestep(timestep: usize) -> usize {
    let all = NUM_TIMESTEPS as f64;
    let share = ((timestep + 1) as f64 / all).sqrt() + 0.1;
    ((all * share * share).round() as usize - 1).min(NUM_TIMESTEPS - 1)
}
