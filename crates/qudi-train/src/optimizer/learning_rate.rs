//! The learning rate over a run: linear warm-up, then half a cosine down to a floor.

use crate::recipe::TrainConfig;
use std::f64::consts::PI;

/// Returns the rate of step `step`, from 0.
pub fn learning_rate(config: &TrainConfig, step: u64) -> f64 {
    if step < config.warmup {
        return config.lr * (step + 1) as f64 / config.warmup as f64;
    }
    let length = config.steps.saturating_sub(config.warmup).max(1) as f64;
    let place = ((step - config.warmup) as f64 / length).min(1.0);
    config.min_lr + (config.lr - config.min_lr) * 0.5 * (1.0 + (PI * place).cos())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Recipe;

    #[test]
    fn rate_climbs_then_falls_to_the_floor() {
        let mut config = Recipe::load("tiny", &[]).unwrap().train;
        (config.lr, config.min_lr, config.warmup, config.steps) = (1e-3, 1e-5, 10, 110);
        let rate = |step| learning_rate(&config, step);
        assert!((rate(0) - 1e-4).abs() < 1e-12);
        assert!((rate(9) - 1e-3).abs() < 1e-12);
        assert!((rate(10) - 1e-3).abs() < 1e-12);
        assert!((rate(60) - 0.5 * (1e-3 + 1e-5)).abs() < 1e-12);
        assert!((rate(110) - 1e-5).abs() < 1e-12);
        assert!((rate(1000) - 1e-5).abs() < 1e-12);
        assert!((10..110).all(|step| rate(step) >= rate(step + 1)));
    }
}
