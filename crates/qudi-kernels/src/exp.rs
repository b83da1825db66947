//! Exponential function in operations that vectorize.

/// Rounding constant `1.5 * 2^23`: adding it rounds an f32 to an integer.
const ROUNDING: f32 = 12_582_912.0;

/// Computes `exp(x)` to 2e-7 for x from -87 to 88; larger and smaller x are clamped. It reduces x to half a
/// power of two and evaluates a polynomial of degree six (Cephes, expf).
#[inline(always)]
pub(crate) fn exp(x: f32) -> f32 {
    let x = x.clamp(-87.0, 88.0);
    // Adding this number rounds to an integer and leaves it in the lowest bits. A cast would check the range
    // and does not vectorize.
    let shifted = x.mul_add(std::f32::consts::LOG2_E, ROUNDING);
    let n = shifted - ROUNDING;
    let r = n.mul_add(-0.693_359_4, x);
    let r = n.mul_add(2.121_944_4e-4, r);
    let p = 1.987_569_1e-4_f32
        .mul_add(r, 1.398_199_9e-3)
        .mul_add(r, 8.333_452e-3)
        .mul_add(r, 4.166_579_6e-2)
        .mul_add(r, 0.166_666_65)
        .mul_add(r, 0.5);
    let exponent = shifted.to_bits().wrapping_sub(ROUNDING.to_bits()).wrapping_add(127);
    let power = f32::from_bits(exponent << 23);
    (p.mul_add(r * r, r) + 1.0) * power
}

#[cfg(test)]
mod tests {
    use super::exp;

    #[test]
    fn exp_matches_the_library() {
        for i in -86_999..=87_999 {
            let x = i as f32 * 1e-3;
            let expected = f64::from(x).exp();
            let error = (f64::from(exp(x)) - expected).abs() / expected;
            assert!(error < 3e-7, "exp({x}) is off by {error:e}");
        }
    }
}
