//! The losses of the learned methods, as their authors have them.

use super::Bursts;
use crate::import::Network;
use crate::memdeblur::{BatchStatistics, Mode};
use crate::parts::{charbonnier, frame};
use crate::student_teacher::{KernelPrediction, matching_loss, reconstruction_losses};
use crate::{flornn, memdeblur, spk2imgnet};
use burn::module::ParamId;
use burn::tensor::Tensor;
use std::collections::HashMap;

/// Terms by name, with their weights.
type Terms = Vec<(&'static str, Tensor<1>)>;

/// The terms of the loss, and the statistics that the network keeps, by their parameters.
pub(super) fn losses(
    network: &Network,
    teachers: &[KernelPrediction],
    bursts: &Bursts,
    step: u64,
) -> (Terms, HashMap<ParamId, Tensor<1>>) {
    let Bursts { counts, truth, frames, .. } = bursts;
    let frames = *frames;
    let each = |x: &Tensor<4>| (0..frames).map(|t| frame(x, frames, t)).collect::<Vec<_>>();
    // Frames as channels.
    let joined = |x: &Tensor<4>| {
        let [images, _, height, width] = x.dims();
        x.clone().reshape([images / frames, frames, height, width])
    };
    let copies = |x: &Tensor<4>, channels: usize| x.clone().repeat(&[1, channels, 1, 1]);
    let mut statistics = HashMap::new();
    let terms = match network {
        Network::Quiver(network) => {
            let restored = network.forward(counts.clone(), frames);
            let [full, half, quarter, pre] = network.losses(restored, truth, frames);
            vec![("image", full), ("half", half), ("quarter", quarter), ("pre", pre)]
        }
        Network::Emvd(network) => {
            let error = network.error(each(counts), &each(truth));
            vec![("image", error), ("transforms", network.transform_loss())]
        }
        Network::FloRnn(network) => {
            let channels = network.channels();
            let window: Vec<_> = (0..network.window())
                .map(|t| copies(&frame(counts, frames, t), channels))
                .collect();
            let flows = network.flows(&window);
            let wanted = copies(&frame(truth, frames, 1), channels);
            vec![("image", flornn::loss(network.forward(&window, &flows), wanted))]
        }
        Network::Spk2ImgNet(network) => {
            let (image, estimates) = network.forward(&joined(counts));
            let [image, estimates] = spk2imgnet::losses(image, estimates, joined(truth));
            vec![("image", image), ("estimates", estimates)]
        }
        Network::MemDeblur(network) => {
            let [counts, truth] = [counts, truth].map(|x| copies(x, network.channels()));
            let batch = BatchStatistics::default();
            let outputs = network.forward(&counts, frames, Mode::Training(Some(&batch)));
            let [quarter, half, full] = memdeblur::losses(outputs, &truth);
            statistics = batch.into_moved();
            vec![("image", full), ("half", half), ("quarter", quarter)]
        }
        Network::Rvrt(network) => {
            let [counts, truth] = [counts, truth].map(|x| copies(x, network.channels()));
            vec![("image", charbonnier(network.forward(counts, frames), truth))]
        }
        Network::StudentTeacher(student) => {
            let still = bursts.still.as_ref().unwrap_or(counts);
            let seen = [joined(truth), joined(still)];
            of_student(
                student,
                teachers,
                joined(counts),
                seen,
                &frame(truth, frames, frames / 2),
                step,
            )
        }
    };
    (terms, statistics)
}

/// Of a student and its teachers, who see other bursts of the same scene: the student resembles them, and they learn
/// from the truth alone.
fn of_student(
    student: &KernelPrediction,
    teachers: &[KernelPrediction],
    counts: Tensor<4>,
    seen: [Tensor<4>; 2],
    truth: &Tensor<4>,
    step: u64,
) -> Terms {
    let restored = student.forward(counts);
    let [image, frames] = reconstruction_losses(&restored, truth, step);
    let mut terms = vec![("image", image), ("frames", frames)];
    let taught: Vec<_> =
        teachers.iter().zip(seen).map(|(teacher, burst)| teacher.forward(burst)).collect();
    if let [motion, denoising] = &taught[..] {
        terms.push(("teachers", matching_loss(&restored, [motion, denoising])));
        for (name, teacher) in [("motion", motion), ("denoising", denoising)] {
            let [image, frames] = reconstruction_losses(teacher, truth, step);
            terms.push((name, image + frames));
        }
    }
    terms
}
