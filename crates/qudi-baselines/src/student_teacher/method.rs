//! The student of two teachers among the learned methods.

use super::{
    ANNEALING_STEPS, KernelPrediction, MULTIPLE, Sizes, matching_loss, reconstruction_losses,
};
use crate::import::Shapes;
use crate::learning::{Bursts, Law, NetworkLosses};
use crate::method::LearnedMethod;
use crate::parts::frame;
use crate::restorer::Window;
use burn::tensor::{Device, Tensor};
use qudi_core::Result;

impl LearnedMethod for KernelPrediction {
    type Sizes = Sizes;

    const RECIPE: &'static str = include_str!("../../recipes/student-teacher.toml");
    const MARK: &'static str = "kernels.weight";
    const MULTIPLE: usize = MULTIPLE;
    const BYTES: usize = 195;
    // One of motion without noise, one of noise without motion.
    const TEACHERS: &'static [&'static str] = &["motion", "denoising"];

    fn init(sizes: Sizes, device: &Device) -> Self {
        Self::zeros(sizes, device)
    }

    fn sizes(shapes: &Shapes<'_>) -> Result<Sizes> {
        let frames = shapes.side("extractor.0.weight", 1)?;
        Ok(Sizes {
            frames,
            features: shapes.side("extractor.0.weight", 0)?,
            kernel: (shapes.side("kernels.weight", 0)? / frames).isqrt(),
        })
    }

    fn describe(s: Sizes) -> String {
        let (side, frames) = (s.kernel, s.frames);
        format!("{} features, kernels of {side} x {side}, {frames} frames", s.features)
    }

    fn numbers(s: Sizes) -> Vec<usize> {
        vec![s.frames, s.features, s.kernel]
    }

    fn features(s: Sizes) -> usize {
        s.features
    }

    fn problem(s: Sizes) -> Option<&'static str> {
        s.kernel.is_multiple_of(2).then_some("kernels have odd sides")
    }

    fn other_lengths(s: Sizes, frames: usize) -> Option<String> {
        (frames != s.frames).then(|| s.frames.to_string())
    }

    fn file_name(name: &str) -> String {
        Self::file_name(name)
    }

    /// Lets kernels start as the mean of all frames.
    fn initial_law(s: Sizes, name: &str, shape: &[usize]) -> Option<Law> {
        let taps = s.kernel * s.kernel;
        let centre = |place: usize| if place % taps == taps / 2 { 1.0 } else { 0.0 };
        name.ends_with("kernels.bias").then(|| Law::These((0..shape[0]).map(centre).collect()))
    }

    fn context(&self) -> [usize; 2] {
        let frames = self.frames();
        [frames / 2, frames - 1 - frames / 2]
    }

    fn restore(&self, window: Window<'_>) -> Result<Vec<Tensor<4>>> {
        let frames = window.around(self.context());
        window.each(|first| {
            let seen = frames[first..first + self.frames()].to_vec();
            self.forward(Tensor::cat(seen, 1)).image
        })
    }

    /// Computes the loss of the student, which resembles its teachers, and the teachers' own: they see other
    /// bursts of the same scene, and learn from the truth alone.
    fn losses(&self, teachers: &[&Self], bursts: &Bursts, step: u64) -> NetworkLosses {
        let still = bursts.still.as_ref().unwrap_or(&bursts.counts);
        let truth = frame(&bursts.truth, bursts.frames, bursts.frames / 2);
        let restored = self.forward(bursts.as_channels(&bursts.counts));
        let [image, frames] = reconstruction_losses(&restored, &truth, step);
        let mut terms = vec![("image", image), ("frames", frames)];
        let seen = [&bursts.truth, still];
        let taught = teachers.iter().zip(seen);
        let taught: Vec<_> =
            taught.map(|(teacher, burst)| teacher.forward(bursts.as_channels(burst))).collect();
        if let [motion, denoising] = &taught[..] {
            terms.push(("teachers", matching_loss(&restored, [motion, denoising])));
            for (name, teacher) in Self::TEACHERS.iter().copied().zip([motion, denoising]) {
                let [image, frames] = reconstruction_losses(teacher, &truth, step);
                terms.push((name, image + frames));
            }
        }
        terms.into()
    }

    /// Lets the weight of the filtered frames fall as far in a short training as in the authors'.
    fn authors_step(step: u64, steps: u64) -> u64 {
        let factor = ANNEALING_STEPS.max(steps) as f64 / steps.max(1) as f64;
        (step as f64 * factor) as u64
    }
}
