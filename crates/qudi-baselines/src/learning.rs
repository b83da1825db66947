//! What training needs of the learned methods: initial weights, their authors' losses, names of parameters.

mod initial;
mod losses;

use crate::import::{Method, Network};
use crate::sizes::Sizes;
use crate::student_teacher::{ANNEALING, KernelPrediction};
use burn::module::{Module, list_param_ids};
use burn::tensor::{Device, Tensor};
use initial::initial_values;
use qudi_layers::{init_parameters, parameter_shapes};
use std::collections::BTreeMap;

/// The teachers of a student, by what they know.
const TEACHERS: [&str; 2] = ["motion", "denoising"];

/// A learned method that learns: the network, and what helps to train it.
#[derive(Module, Debug)]
pub struct Baseline {
    network: Network,
    /// The teachers of a student: of motion without noise, and of noise without motion. They learn at the same time.
    teachers: Vec<KernelPrediction>,
}

/// Bursts to learn from, in units of counts over full scale.
///
/// # Shapes
/// - counts, truth, still: `[bursts * frames, 1, height, width]`
#[derive(Clone, Debug)]
pub struct Bursts {
    /// What the sensor counted.
    pub counts: Tensor<4>,
    /// What it would have counted on average, without saturation.
    pub truth: Tensor<4>,
    /// Counts of the frame that a student restores, as often as there are frames; for networks with teachers.
    pub still: Option<Tensor<4>>,
    /// Frames of a burst.
    pub frames: usize,
}

/// The losses of some bursts.
#[derive(Debug)]
pub struct Losses {
    /// The terms by name, `[1]` each, with their weights: training minimises the sum.
    pub terms: Vec<(&'static str, Tensor<1>)>,
    /// Values of parameters after the step, by their places in the network, `[values]` each: statistics that it keeps
    /// of what passes through it.
    pub statistics: Vec<(usize, Tensor<1>)>,
}

impl Baseline {
    /// The network without weights: it takes no memory yet.
    pub fn uninitialized(sizes: Sizes, device: &Device) -> Self {
        let teacher = |_| match sizes {
            Sizes::StudentTeacher(sizes) => Some(KernelPrediction::zeros(sizes, device)),
            _ => None,
        };
        let teachers = TEACHERS.iter().filter_map(teacher).collect();
        Self { network: sizes.network(device), teachers }
    }

    /// The network with its initial weights.
    pub fn init(sizes: Sizes, seed: u64, device: &Device) -> Self {
        let network = sizes.network(device);
        let name = |ours: &str| sizes.network(device).file_name(ours);
        Self::trained(initialized(network, sizes, seed, &name), sizes, seed, device)
    }

    /// A network with weights. A student's teachers, which files do not hold, have initial weights.
    pub fn trained(network: Network, sizes: Sizes, seed: u64, device: &Device) -> Self {
        let Self { teachers, .. } = Self::uninitialized(sizes, device);
        Self { network, teachers: initialized(teachers, sizes, seed, &teacher_name) }
    }

    /// The network alone, for use.
    pub fn network(&self) -> &Network {
        &self.network
    }

    /// Names of all parameters, as in files, with their shapes, in the order of the network.
    pub fn parameter_shapes(&self) -> Vec<(String, Vec<usize>)> {
        let name = |ours: &str| match ours.strip_prefix("network.") {
            Some(own) => self.network.file_name(own),
            None => teacher_name(ours.strip_prefix("teachers.").unwrap_or(ours)),
        };
        parameter_shapes(self).into_iter().map(|(ours, shape)| (name(&ours), shape)).collect()
    }

    /// Whether it learns from frames that are held still, too.
    pub fn needs_still_frames(sizes: Sizes) -> bool {
        sizes.method() == Method::StudentTeacher
    }

    /// The losses of bursts at a step, from 0, of so many `steps`. The network and they are on an autodiff device;
    /// bursts have a number of frames that its sizes allow.
    pub fn losses(&self, bursts: &Bursts, step: u64, steps: u64) -> Losses {
        let shrunk = ANNEALING.max(steps) as f64 / steps.max(1) as f64;
        let step = (step as f64 * shrunk) as u64;
        let (terms, moved) = losses::losses(&self.network, &self.teachers, bursts, step);
        let places = list_param_ids(self).into_iter().enumerate();
        let moved = places.filter_map(|(place, id)| Some((place, moved.get(&id)?.clone())));
        Losses { terms, statistics: moved.collect() }
    }
}

/// The name of a teacher's parameter, of its number and ours.
fn teacher_name(ours: &str) -> String {
    let (number, own) = ours.split_once('.').unwrap_or(("", ours));
    let teacher = number.parse().ok().and_then(|number: usize| TEACHERS.get(number));
    format!("{}.{}", teacher.copied().unwrap_or_default(), KernelPrediction::file_name(own))
}

/// A module with initial weights; `name` is that of one of our parameters in files.
fn initialized<M: Module>(module: M, sizes: Sizes, seed: u64, name: &dyn Fn(&str) -> String) -> M {
    let shapes = parameter_shapes(&module).into_iter();
    let shapes: BTreeMap<_, _> = shapes.map(|(ours, shape)| (name(&ours), shape)).collect();
    init_parameters(module, |ours, shape| {
        let name = name(ours);
        let weight = name.strip_suffix(".bias").map(|layer| format!("{layer}.weight"));
        let of_weight = weight.and_then(|weight| shapes.get(&weight));
        initial_values(sizes, seed, &name, shape, of_weight.map(Vec::as_slice))
    })
}
