//! The exact law of a count: `P(y | detections expected)`.
//!
//! Everything that is drawn, tabulated or tested in this crate comes from these sums, in f64.

use super::{Response, Sensor};

/// Arrivals in a dead time beyond which a counter is saturated.
const MAX_DEAD_TIMES: f64 = 10.0;

/// Distribution of the number of electrons, and their conversion into an output value.
#[derive(Clone, Debug)]
pub struct CountLaw {
    pub(crate) response: Response,
    /// Largest output value; for binary sensors also the number of summed frames.
    pub(crate) max_count: u16,
    pub(crate) gain: f64,
    pub(crate) read_noise: f64,
    pub(crate) full_well: f64,
    /// Dead time as a fraction of the exposure; 0 for none.
    pub(crate) dead_time: f64,
    /// DN that are added before values below zero are cut off, where counts are drawn; 0 for none.
    pub(crate) pedestal: f64,
}

impl CountLaw {
    /// Creates the law of `sensor` at a gain in DN/e-.
    pub fn new(sensor: &Sensor, gain: f64) -> Self {
        Self {
            response: sensor.response,
            max_count: sensor.max_count(),
            gain,
            read_noise: sensor.read_noise,
            full_well: sensor.full_well.electrons(),
            dead_time: sensor.dead_time(),
            pedestal: 0.0,
        }
    }

    /// Draws counts above a pedestal of `dn`, so that noise below it is not cut off.
    pub(crate) fn above(mut self, dn: f64) -> Self {
        self.pedestal = dn;
        self
    }

    /// Returns the law of one binary frame of a summed sensor.
    pub(crate) fn single_frame(mut self) -> Self {
        self.max_count = 1;
        self
    }

    /// Dead time as a fraction of the exposure; 0 for none.
    pub(crate) fn dead_time(&self) -> f64 {
        self.dead_time
    }

    /// Computes `P(y = j)` for `j` in `0..=max_count`, at `detections` expected per output frame
    /// (`QE * theta + dark`).
    pub fn probabilities(&self, detections: f64) -> Vec<f64> {
        let tails = self.tails(detections);
        let above = std::iter::once(1.0).chain(tails.iter().copied());
        let below = tails.iter().copied().chain(std::iter::once(0.0));
        above.zip(below).map(|(a, b)| a - b).collect()
    }

    /// Computes `P(y > j)` for `j` in `0..max_count`: sums of positive terms, exact also where tiny.
    pub(crate) fn tails(&self, detections: f64) -> Vec<f64> {
        let n = usize::from(self.max_count);
        if self.response == Response::Binary {
            return binomial_tails(n, -(-detections / n as f64).exp_m1());
        }
        let (mut tails, mut total) = (vec![0.0; n], 0.0);
        self.for_each_electron_count(detections, |k, p| {
            total += p;
            let (low, high) = self.uncertain_outputs(k);
            for tail in &mut tails[..low] {
                *tail += p;
            }
            for (j, tail) in tails[low..high].iter_mut().enumerate() {
                *tail += p * self.exceeds(low + j, k);
            }
        });
        // At strong light the logarithms behind the terms cost a few digits of their sum.
        for tail in &mut tails {
            *tail = (*tail / total).min(1.0);
        }
        tails
    }

    /// Computes the mean output value at `detections` expected per output frame.
    pub fn mean(&self, detections: f64) -> f64 {
        if self.response == Response::Binary {
            let n = f64::from(self.max_count);
            return -n * (-detections / n).exp_m1();
        }
        let (mut mean, mut total) = (0.0, 0.0);
        self.for_each_electron_count(detections, |k, p| {
            total += p;
            let (low, high) = self.uncertain_outputs(k);
            let rest: f64 = (low..high).map(|j| self.exceeds(j, k)).sum();
            mean += p * (low as f64 + rest);
        });
        mean / total
    }

    /// Returns the limit of the mean output for unbounded light.
    fn largest_mean(&self) -> f64 {
        // A counter that is dead for a while after each count has room for so many.
        let room = if self.dead_time > 0.0 { self.dead_time.recip().ceil() } else { f64::INFINITY };
        let most = self.full_well.min(room);
        if self.response == Response::Binary || most.is_infinite() {
            return f64::from(self.max_count);
        }
        let (low, high) = self.uncertain_outputs(most);
        low as f64 + (low..high).map(|j| self.exceeds(j, most)).sum::<f64>()
    }

    /// Computes the expected detections per output frame whose mean output value is `mean`: the inverse of
    /// [`CountLaw::mean`], clamped to between 0 and half a count below saturation of the output or of the
    /// full well.
    pub fn detections_for_mean(&self, mean: f64) -> f64 {
        let largest = self.largest_mean();
        let target = mean.min(largest - 0.5f64.min(0.5 * largest));
        let brightest = if self.dead_time > 0.0 { MAX_DEAD_TIMES / self.dead_time } else { 1e9 };
        let mut high = 1.0;
        while self.mean(high) < target && high < brightest {
            high *= 2.0;
        }
        let mut low = 0.0;
        for _ in 0..50 {
            let middle = 0.5 * (low + high);
            if self.mean(middle) < target { low = middle } else { high = middle }
        }
        0.5 * (low + high)
    }

    /// Computes `P(y > j | k electrons)`.
    pub(crate) fn exceeds(&self, j: usize, k: f64) -> f64 {
        let k = k.min(self.full_well);
        if self.read_noise == 0.0 {
            return f64::from(u8::from((self.gain * k).round_ties_even() > j as f64));
        }
        let threshold = (j as f64 + 0.5) / self.gain;
        0.5 * libm::erfc((threshold - k) / (std::f64::consts::SQRT_2 * self.read_noise))
    }

    /// Returns the range of thresholds `j` that the output for `k` electrons neither always nor never exceeds
    /// (to 12 standard deviations of the read noise: 1e-33).
    fn uncertain_outputs(&self, k: f64) -> (usize, usize) {
        let n = usize::from(self.max_count);
        let k = k.min(self.full_well);
        let low = (self.gain * (k - 12.0 * self.read_noise)).floor() - 1.0;
        let high = (self.gain * (k + 12.0 * self.read_noise)).ceil() + 2.0;
        let low = low.clamp(0.0, n as f64) as usize;
        (low, (high.clamp(0.0, n as f64) as usize).max(low))
    }

    /// Calls `f(k, P(k electrons))` over all `k` that matter.
    fn for_each_electron_count(&self, mean: f64, mut f: impl FnMut(f64, f64)) {
        if self.dead_time > 0.0 {
            let mut at_least = 1.0;
            for k in 0u32.. {
                let next = counted_at_least(k + 1, mean, self.dead_time);
                f(f64::from(k), at_least - next);
                if next <= 0.0 || (f64::from(k) > mean && next < 1e-18) {
                    break;
                }
                at_least = next;
            }
            return;
        }
        for_each_poisson(mean, f);
    }
}

/// Computes `P(N >= k)` of a non-paralysable counter that starts live: the k-th count needs k arrivals
/// within the time that k-1 dead times leave (renewal theory; Mueller 1973).
fn counted_at_least(k: u32, mean: f64, dead_time: f64) -> f64 {
    let live = 1.0 - f64::from(k.saturating_sub(1)) * dead_time;
    if k == 0 {
        return 1.0;
    }
    if live <= 0.0 {
        return 0.0;
    }
    let mut below = 0.0;
    for_each_poisson(mean * live, |j, p| {
        if j < f64::from(k) {
            below += p;
        }
    });
    (1.0 - below).max(0.0)
}

/// Calls `f(k, pmf)` for the Poisson law over its support down to 1e-30 of the mode.
pub(crate) fn for_each_poisson(mean: f64, mut f: impl FnMut(f64, f64)) {
    if mean <= 0.0 {
        return f(0.0, 1.0);
    }
    let mode = mean.floor();
    let at_mode = (mode * mean.ln() - mean - libm::lgamma(mode + 1.0)).exp();
    let (mut k, mut p) = (mode, at_mode);
    // Downwards to where it starts to matter, then upwards through the mode.
    let mut falling = Vec::new();
    while k > 0.0 && p > at_mode * 1e-30 {
        p *= k / mean;
        k -= 1.0;
        falling.push((k, p));
    }
    for (k, p) in falling.into_iter().rev() {
        f(k, p);
    }
    (k, p) = (mode, at_mode);
    while p > at_mode * 1e-30 {
        f(k, p);
        k += 1.0;
        p *= mean / k;
    }
}

/// Computes `P(S > j)` for `j` in `0..n`, S binomial.
fn binomial_tails(n: usize, p: f64) -> Vec<f64> {
    let mut tails = vec![0.0; n];
    if p <= 0.0 {
        return tails;
    }
    let q = 1.0 - p;
    let mut above = 0.0;
    for s in (1..=n).rev() {
        let log_choose = libm::lgamma(n as f64 + 1.0)
            - libm::lgamma(s as f64 + 1.0)
            - libm::lgamma((n - s) as f64 + 1.0);
        let rest = if n == s { 0.0 } else { (n - s) as f64 * q.ln() };
        above += (log_choose + s as f64 * p.ln() + rest).exp();
        tails[s - 1] = above;
    }
    tails
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor::Gain;

    fn law(bits: u8, gain: f64, read_noise: f64) -> CountLaw {
        let mut sensor = Sensor::load("ideal").unwrap();
        sensor.bits = bits;
        sensor.gain = Gain::Fixed(gain);
        sensor.read_noise = read_noise;
        CountLaw::new(&sensor, gain)
    }

    #[test]
    fn probabilities_sum_to_one_at_every_light_level() {
        for lambda in [0.0, 1e-9, 0.01, 4.2, 210.0, 5000.0] {
            for (bits, gain, noise) in
                [(1, 1.0, 0.0), (3, 1.077, 0.2), (8, 0.5, 0.0), (12, 1.0, 2.0)]
            {
                let p = law(bits, gain, noise).probabilities(lambda);
                assert!((p.iter().sum::<f64>() - 1.0).abs() < 1e-12, "{lambda} {bits}");
                assert!(p.iter().all(|&p| p > -1e-12));
            }
        }
    }

    #[test]
    fn law_without_noise_and_clipping_is_poisson() {
        let p = law(8, 1.0, 0.0).probabilities(4.2);
        // scipy.stats.poisson.pmf([0, 1, 5, 20], 4.2)
        for (k, expected) in [
            (0, 0.014_995_576_820_477_703),
            (1, 0.062_981_422_646_006_38),
            (5, 0.163_315_867_434_904_9),
            (20, 1.798_143_581_311_381e-8),
        ] {
            assert!((p[k] / expected - 1.0).abs() < 1e-6, "{k}: {}", p[k]);
        }
        assert!((law(16, 1.0, 0.0).mean(4.2) - 4.2).abs() < 1e-12);
    }

    #[test]
    fn inverts_the_mean_response() {
        for law in [law(3, 1.077, 0.2), law(12, 0.5, 0.3)] {
            for detections in [0.5, 2.0, 4.2] {
                let back = law.detections_for_mean(law.mean(detections));
                assert!((back - detections).abs() < 1e-6, "{back} {detections}");
            }
            assert!(law.detections_for_mean(f64::from(law.max_count)).is_finite());
        }
    }

    /// A full well that the output cannot fill saturates all the same.
    #[test]
    fn full_well_bounds_the_inverse_response() {
        for (gain, most) in [(0.02, 4.0), (0.002, 0.5), (1.0, 7.0)] {
            let mut law = law(3, gain, 0.2);
            law.full_well = 200.0;
            let detections = law.detections_for_mean(7.0);
            assert!(detections < 300.0, "{gain}: {detections}");
            assert!(law.mean(detections) < most, "{gain}: {}", law.mean(detections));
        }
    }

    #[test]
    fn round_half_even_matches_numpy() {
        // gain 0.5 sends 1, 3, 5 electrons to 0.5, 1.5, 2.5, which round to 0, 2, 2.
        let law = law(3, 0.5, 0.0);
        for (k, y) in [(1.0, 0), (2.0, 1), (3.0, 2), (4.0, 2), (5.0, 2), (6.0, 3)] {
            assert_eq!((0..7).filter(|&j| law.exceeds(j, k) > 0.5).count(), y, "{k} electrons");
        }
    }

    /// Counts that a dead time leaves no room for are saturated, and found soon.
    #[test]
    fn dead_time_bounds_the_inverse_response() {
        let mut law = law(8, 1.0, 0.0);
        law.dead_time = 0.01;
        let detections = law.detections_for_mean(250.0);
        assert!((900.0..1100.0).contains(&detections), "{detections}");
        let back = law.detections_for_mean(law.mean(30.0));
        assert!((back - 30.0).abs() < 1e-6, "{back}");
    }

    #[test]
    fn dead_time_lowers_the_mean_as_renewal_theory_says() {
        let mut law = law(16, 1.0, 0.0);
        law.dead_time = 0.01;
        // Cox, Renewal Theory (1962): E[N] = t / mu + (sigma^2 - mu^2) / (2 mu^2); a counter that
        // begins live is one that began a dead time earlier.
        let (lambda, d) = (50.0, 0.01);
        let (mu, sigma) = (d + 1.0 / lambda, 1.0 / lambda);
        let expected = (1.0 + d) / mu + (sigma * sigma - mu * mu) / (2.0 * mu * mu);
        assert!((law.mean(lambda) - expected).abs() < 1e-6, "{} {expected}", law.mean(lambda));
    }
}
