//! Merging: the mean of the counts of all frames along the motion, as an image. Every frame is sampled once.
//! Means come first: the sensor's response is not straight, and what single counts say about the light is
//! neither negative nor beyond saturation, so that means of it have a bias.

use super::config::{FOLD, IMAGE};
use super::input::MIDDLE;
use super::motion::paths::Paths;
use crate::sensor::RESPONSE_STEPS;
use burn::tensor::Tensor;
use qudi_kernels::{MergeRule, merged_frames};
use qudi_layers::resample::{avg_pool2, mean_around, pixel_shuffle, pixel_unshuffle};

/// Scale of images.
const SCALE: f32 = 3.0;

/// Channels of [`Merged::planes`].
pub(super) const MERGED: usize = 2 * IMAGE;

/// How neighbours are weighted where counts are merged.
const OF_COUNTS: MergeRule = MergeRule { tolerance: 3.0, power: 2 };

/// How neighbours are weighted where frames with errors of their own are averaged.
pub(super) const OF_FRAMES: MergeRule = MergeRule { tolerance: 0.5, power: 1 };

/// The distance in frames of the farthest neighbours that frames are averaged with.
pub(super) const FARTHEST_FRAME: usize = 3;

/// Merged frames, and the number of frames without weights whose mean would have as little noise:
/// `[images, 1, H, W]` each.
#[derive(Clone, Debug)]
pub(super) struct Merged {
    pub(super) mean: Tensor<4>,
    pub(super) frames: Tensor<4>,
}

impl Merged {
    /// Merges all frames of every burst with each of them.
    ///
    /// # Shapes
    /// - counts: counts over full scale, `[bursts * frames, 1, H, W]`
    /// - response: images of mean counts, `[bursts, 257]`
    /// - known: the cleanest frames so far in image units, whose differences decide on the weights,
    ///   `[bursts * frames, 1, H, W]`
    /// - sigma: usual errors of `known`, `[bursts * frames, 1, 1, 1]`
    pub(super) fn along(
        paths: &Paths,
        counts: &Tensor<4>,
        response: &Tensor<2>,
        known: &Tensor<4>,
        sigma: &Tensor<4>,
    ) -> Self {
        let images = Tensor::cat(vec![known.clone(), counts.clone()], 1);
        let Self { mean, frames } = Self::by_rule(paths, usize::MAX, &images, sigma, OF_COUNTS);
        Self { mean: image(mean, response), frames }
    }

    /// Merges the last channel of all frames up to `reach` frames away. Differences of the first channel
    /// decide on the weights.
    fn by_rule(
        paths: &Paths,
        reach: usize,
        images: &Tensor<4>,
        sigma: &Tensor<4>,
        rule: MergeRule,
    ) -> Self {
        let flows = paths.up_to(reach);
        if let Some(merged) = merged_frames(images, sigma, flows, paths.frames(), rule) {
            let [mean, frames] = [0, 1].map(|channel| merged.clone().narrow(1, channel, 1));
            return Self { mean, frames };
        }
        let channel = |x: &Tensor<4>, channel| x.clone().narrow(1, channel, 1);
        let last = images.dims()[1] - 1;
        let mut sum = channel(images, last);
        let mut total = sum.ones_like();
        let mut squares = sum.ones_like();
        for (place, aligned) in paths.aligned(images, reach) {
            let difference = channel(&aligned, 0) - channel(&place.part(images, false), 0);
            let weight = inverse_weight(difference / place.part(sigma, false), rule).recip();
            let [images, _, h, w] = weight.dims();
            let weight = pixel_shuffle(weight.expand([images, IMAGE, h, w]), FOLD);
            let weighted = channel(&aligned, last) * weight.clone();
            let square = weight.clone().powi_scalar(2);
            let all = place.whole(Tensor::cat(vec![weighted, weight, square], 1));
            sum = sum + channel(&all, 0);
            total = total + channel(&all, 1);
            squares = squares + channel(&all, 2);
        }
        Self { mean: sum / total.clone(), frames: total.powi_scalar(2) / squares }
    }

    /// Returns the same inside autodiff, without gradient.
    pub(super) fn from_inner(merged: Self) -> Self {
        let Self { mean, frames } = merged;
        Self { mean: Tensor::from_inner(mean), frames: Tensor::from_inner(frames) }
    }

    /// Returns the same outside autodiff.
    pub(super) fn inner(&self) -> Self {
        Self { mean: self.mean.clone().inner(), frames: self.frames.clone().inner() }
    }

    /// Returns the planes that the cells of the fusion see, `[images, 8, H / 2, W / 2]`.
    pub(super) fn planes(&self) -> Tensor<4> {
        let image = pixel_unshuffle((self.mean.clone() - MIDDLE) * SCALE, FOLD);
        Tensor::cat(vec![image, self.planes_of_frames()], 1)
    }

    /// Returns the logarithm of the number of frames, `[images, 4, H / 2, W / 2]`.
    pub(super) fn planes_of_frames(&self) -> Tensor<4> {
        pixel_unshuffle(self.frames.clone().log(), FOLD)
    }
}

/// Looks up the image of mean counts over full scale in the table of their burst.
fn image(counts: Tensor<4>, response: &Tensor<2>) -> Tensor<4> {
    /// Below the last level, where a number of 32 bits still is.
    const LAST: f32 = RESPONSE_STEPS as f32 - 1e-3;
    let (shape, [bursts, _]) = (counts.dims(), response.dims());
    let pixels = shape.iter().product::<usize>() / bursts;
    let place = (counts * RESPONSE_STEPS as f32).clamp(0.0, LAST).reshape([bursts, pixels]);
    let below = place.clone().int();
    let part = place - below.clone().float();
    let low = response.clone().gather(1, below.clone());
    let high = response.clone().gather(1, below + 1);
    (low.clone() + (high - low) * part).reshape(shape)
}

/// Returns one over the weight of a neighbour, at half the resolution, from its difference in units of usual
/// errors. Squared differences are averaged over 10 x 10 pixels.
pub(super) fn inverse_weight(difference: Tensor<4>, rule: MergeRule) -> Tensor<4> {
    let square = mean_around(avg_pool2(difference.powi_scalar(2)), 2);
    (square / rule.tolerance).powi_scalar(rule.power) + 1.0
}

/// Averages every frame with its nearest neighbours, as far as they agree: what one gets wrong, others often
/// do not. No gradient passes.
///
/// # Shapes
/// - images: `[bursts * frames, 1, H, W]`
/// - sigma: of usual errors, `[bursts * frames, 1, 1, 1]`
pub(super) fn averaged(images: &Tensor<4>, sigma: &Tensor<4>, paths: &Paths) -> Tensor<4> {
    Merged::by_rule(paths, FARTHEST_FRAME, images, sigma, OF_FRAMES).mean
}

#[cfg(test)]
mod tests {
    use super::super::motion::flow::WindowFlow;
    use super::super::scenes::{FRAMES, error, inner, moving, noise, sigma};
    use super::*;
    use burn::tensor::Device;
    use qudi_kernels::with_stock_operations;

    /// Returns a straight response: counts of full scale belong to an image of 2, no counts to one of -2.
    fn response() -> Tensor<2> {
        let steps = RESPONSE_STEPS as i64;
        let levels = Tensor::<1, burn::tensor::Int>::arange(0..steps + 1, &Device::flex()).float();
        (levels * (4.0 / steps as f32) - 2.0).unsqueeze()
    }

    fn merged(image: &Tensor<4>, known: &Tensor<4>, flow: &WindowFlow) -> Merged {
        let counts = (image.clone() + 2.0) * 0.25;
        Merged::along(&Paths::new(flow, FRAMES), &counts, &response(), known, &sigma(0.05))
    }

    #[test]
    fn noise_falls_as_the_number_of_frames_says() {
        for speed in [0.0, 0.7] {
            let (truth, flow) = moving(speed);
            let merged = merged(&(truth.clone() + noise(0.3)), &truth, &flow);
            let middle = |x: Tensor<4>| x.narrow(0, FRAMES / 2, 1);
            let frames = inner(&middle(merged.frames)).mean().into_scalar::<f32>();
            assert!(frames > 0.95 * FRAMES as f32, "{frames} frames at {speed} pixels a frame");
            let share = error(&middle(merged.mean), &middle(truth)) / (0.3 * 0.3);
            assert!(share * frames < 1.3, "{share} of the noise at {speed} pixels a frame");
        }
    }

    /// A frame that shows something else is merged with none, and no frame with it.
    #[test]
    fn frames_that_show_something_else_are_left_out() {
        let (truth, flow) = moving(0.0);
        let other = FRAMES - 1;
        let parts = vec![truth.clone().narrow(0, 0, other), noise(0.4).narrow(0, 0, 1)];
        let shown = Tensor::cat(parts, 0);
        let merged = merged(&shown, &shown, &flow);
        let frames = |frame: usize| {
            inner(&merged.frames.clone().narrow(0, frame, 1)).mean().into_scalar::<f32>()
        };
        assert!(frames(other) < 1.1, "{} frames", frames(other));
        assert!((frames(0) - other as f32).abs() < 0.1, "{} frames", frames(0));
        assert!(error(&merged.mean.narrow(0, 0, 1), &truth.narrow(0, 0, 1)) < 1e-4);
    }

    /// Means of counts from 0 and full scale say what single ones cannot.
    #[test]
    fn images_of_means_have_no_bias() {
        let device = Device::flex();
        let ends = [0.0, 1.0, 0.5, 1.0, 0.5].map(|c| Tensor::full([1, 1, 32, 32], c, &device));
        let counts = Tensor::cat(ends.to_vec(), 0);
        let (known, flow) = (counts.zeros_like(), moving(0.0).1);
        let bent = response().powi_scalar(2) + response();
        let paths = Paths::new(&flow, FRAMES);
        let merged = Merged::along(&paths, &counts, &bent, &known, &sigma(0.05));
        let expected = (0.6f32 * 4.0 - 2.0).powi(2) + 0.6 * 4.0 - 2.0;
        let got = inner(&merged.mean).mean().into_scalar::<f32>();
        assert!((got - expected).abs() < 2e-3, "{got}, not {expected}");
    }

    #[test]
    fn errors_of_their_own_are_averaged() {
        for speed in [0.0, 1.3] {
            let (truth, flow) = moving(speed);
            let frames = truth.clone() + noise(0.05);
            let average = averaged(&frames, &sigma(0.1), &Paths::new(&flow, FRAMES));
            let share = error(&average, &truth) / error(&frames, &truth);
            assert!(share < 0.45, "{share} of the error at {speed} pixels a frame");
        }
    }

    /// A frame that shows something else stays as it is.
    #[test]
    fn frames_that_do_not_agree_are_left_out() {
        let (frames, flow) = moving(0.0);
        let middle = FRAMES / 2;
        let other = noise(0.4).narrow(0, middle, 1);
        let parts = [frames.clone().narrow(0, 0, middle), other.clone()];
        let rest = frames.narrow(0, middle + 1, FRAMES - middle - 1);
        let frames = Tensor::cat([parts.to_vec(), vec![rest]].concat(), 0);
        let average = averaged(&frames, &sigma(0.05), &Paths::new(&flow, FRAMES));
        let change = error(&average.narrow(0, middle, 1), &other);
        assert!(change < 0.05 * 0.16, "{change}");
    }

    /// Two bursts that differ, merged in one operation and by Burn's own.
    #[test]
    fn one_operation_merges_as_many_do() {
        let [truth, other] = [0.0, 1.3].map(|speed| moving(speed).0);
        let frames = Tensor::cat(vec![truth + noise(0.2), other + noise(0.1)], 0);
        let pairs = moving(0.8).1.pairs;
        let [later, earlier] =
            [0, 1].map(|k| pairs.clone().narrow(0, k * (FRAMES - 1), FRAMES - 1));
        let both = |x: Tensor<4>| Tensor::cat(vec![x.clone(), x * 0.5], 0);
        let pairs = Tensor::cat(vec![both(later), both(earlier)], 0);
        let paths = Paths::new(&WindowFlow { pairs, scale: FOLD }, FRAMES);
        let images = Tensor::cat(vec![frames.clone(), frames.clone() * 0.7], 1);
        let sigma = Tensor::cat(vec![sigma(0.2), sigma(0.4)], 0);
        for (reach, rule) in [(usize::MAX, OF_COUNTS), (2, OF_FRAMES)] {
            let merge = || Merged::by_rule(&paths, reach, &images, &sigma, rule);
            let (got, expected) = (merge(), with_stock_operations(merge));
            assert!(got.frames.clone().mean().into_scalar::<f32>() > 1.5);
            for (got, expected) in [(got.mean, expected.mean), (got.frames, expected.frames)] {
                let difference = (got - expected).abs().max().into_scalar::<f32>();
                assert!(difference < 1e-4, "{difference}");
            }
        }
    }
}
