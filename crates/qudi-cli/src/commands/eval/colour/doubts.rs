//! Restored colours that are no linear light: their scores say little.

use qudi_core::metrics::{colour_psnr, common_gain};
use qudi_core::{Frame, srgb_to_linear};

/// Gain in dB by decoding from sRGB beyond which values are taken for encoded.
const ENCODED_GAIN: f64 = 1.0;

/// Share of values below zero that noise of restored black explains.
const MAX_NEGATIVE: f64 = 0.05;

/// What is doubtful in the frames of a file.
#[derive(Default)]
pub(super) struct Doubts {
    /// Frames without light.
    empty: usize,
    negative: usize,
    values: usize,
    /// Sums over frames of CPSNR as the values are, and decoded from sRGB.
    linear: f64,
    decoded: f64,
}

impl Doubts {
    /// Looks at a frame, whose CPSNR in linear light is `linear`.
    pub(super) fn add(&mut self, restored: &[Frame; 3], truth: &[Frame; 3], linear: f64) {
        let values = || restored.iter().flat_map(|plane| &plane.data);
        self.empty += usize::from(values().all(|&value| value <= 0.0));
        self.negative += values().filter(|&&value| value < 0.0).count();
        self.values += values().count();
        let light = restored.each_ref().map(|plane| {
            let value = |value: &f32| srgb_to_linear(value.clamp(0.0, 1.0));
            Frame { size: plane.size, data: plane.data.iter().map(value).collect() }
        });
        self.linear += linear;
        self.decoded += colour_psnr(&light, truth, common_gain(&light, truth), |value| value);
    }

    /// Describes what is doubtful in all `frames`, a sentence each.
    pub(super) fn remarks(&self, frames: usize) -> Vec<String> {
        let mut remarks = Vec::new();
        if self.empty > 0 {
            remarks.push(format!(
                "{} of {frames} restored frames have no light: they score as black pictures",
                self.empty
            ));
        }
        let negative = self.negative as f64 / self.values.max(1) as f64;
        if negative > MAX_NEGATIVE {
            remarks.push(format!(
                "{:.0} % of the restored values are below zero, and count as black: subtract no more than the dark counts",
                100.0 * negative
            ));
        }
        let number = frames.max(1) as f64;
        let (linear, decoded) = (self.linear / number, self.decoded / number);
        if decoded > linear + ENCODED_GAIN {
            remarks.push(format!(
                "decoded from sRGB, the restored frames would score {decoded:.2} dB instead of {linear:.2}: write linear light"
            ));
        }
        remarks
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_core::{Size, linear_to_srgb};

    const SIZE: Size = Size { height: 16, width: 16 };

    fn truth() -> [Frame; 3] {
        [0.1, 0.5, 0.9]
            .map(|most| Frame::from_fn(SIZE, |x, y| most * ((x + y) as f32 / 30.0).max(0.05)))
    }

    fn remarks(of: impl Fn(f32) -> f32) -> Vec<String> {
        let truth = truth();
        let restored = truth.each_ref().map(|plane| Frame {
            size: SIZE,
            data: plane.data.iter().map(|&value| of(value)).collect(),
        });
        let linear = colour_psnr(&restored, &truth, common_gain(&restored, &truth), |value| value);
        let mut doubts = Doubts::default();
        doubts.add(&restored, &truth, linear);
        doubts.remarks(1)
    }

    #[test]
    fn what_is_no_linear_light_is_named() {
        assert_eq!(remarks(|value| 0.3 * value), Vec::<String>::new());
        let encoded = remarks(linear_to_srgb);
        assert!(encoded.len() == 1 && encoded[0].contains("decoded from sRGB"), "{encoded:?}");
        let empty = remarks(|_| 0.0);
        assert!(empty[0].starts_with("1 of 1 restored frames have no light"), "{empty:?}");
        let negative = remarks(|value| value - 0.3);
        assert!(negative.iter().any(|text| text.contains("below zero")), "{negative:?}");
    }
}
