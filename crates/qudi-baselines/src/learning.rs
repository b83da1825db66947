//! Training of the learned methods: initial weights, losses, names of parameters.

mod initial;

use crate::method::{Network, Sizes};
use crate::parts::frame;
use burn::module::{Module, ParamId, list_param_ids};
use burn::tensor::{Device, Tensor};
use initial::initial_values;
use qudi_layers::{init_parameters, parameter_shapes};
use std::collections::{BTreeMap, HashMap};

pub(crate) use initial::{Law, ends_with_any, kaiming};

/// A learned method that learns: the network, and what helps to train it.
#[derive(Module, Debug)]
pub struct Baseline {
    network: Network,
    /// Networks that learn at the same time and that it learns from.
    teachers: Vec<Network>,
}

/// Bursts to learn from, in units of counts over full scale.
///
/// # Shapes
/// - counts, truth, still: `[bursts * frames, 1, height, width]`
#[derive(Clone, Debug)]
pub struct Bursts {
    /// Counts of the sensor.
    pub counts: Tensor<4>,
    /// Expected counts, without saturation.
    pub truth: Tensor<4>,
    /// Counts of the frame that is restored, as often as there are frames; for networks with teachers.
    pub still: Option<Tensor<4>>,
    /// Frames of a burst.
    pub frames: usize,
}

/// The losses of some bursts.
#[derive(Debug)]
pub struct Losses {
    /// The terms by name, `[1]` each, with their weights: training minimises the sum.
    pub terms: Vec<(&'static str, Tensor<1>)>,
    /// Values of parameters after the step, by their places in the network, `[values]` each: statistics that
    /// it keeps of what passes through it.
    pub statistics: Vec<(usize, Tensor<1>)>,
}

/// The losses of a network, with the statistics by parameter.
#[derive(Debug)]
pub(crate) struct NetworkLosses {
    pub(crate) terms: Vec<(&'static str, Tensor<1>)>,
    pub(crate) statistics: HashMap<ParamId, Tensor<1>>,
}

impl From<Vec<(&'static str, Tensor<1>)>> for NetworkLosses {
    fn from(terms: Vec<(&'static str, Tensor<1>)>) -> Self {
        Self { terms, statistics: HashMap::new() }
    }
}

impl Bursts {
    /// Splits bursts into their frames, `[bursts, 1, height, width]` each.
    pub(crate) fn each(&self, x: &Tensor<4>) -> Vec<Tensor<4>> {
        (0..self.frames).map(|t| frame(x, self.frames, t)).collect()
    }

    /// Returns bursts with their frames as channels, `[bursts, frames, height, width]`.
    pub(crate) fn as_channels(&self, x: &Tensor<4>) -> Tensor<4> {
        let [images, _, height, width] = x.dims();
        x.clone().reshape([images / self.frames, self.frames, height, width])
    }

    /// Returns counts and truth as images of `channels` equal channels.
    pub(crate) fn copies(&self, channels: usize) -> [Tensor<4>; 2] {
        [&self.counts, &self.truth].map(|x| x.clone().repeat(&[1, channels, 1, 1]))
    }
}

impl Baseline {
    /// Makes the network without weights: it takes no memory yet.
    pub fn uninitialized(sizes: Sizes, device: &Device) -> Self {
        let teachers = sizes.method().teachers().iter().map(|_| sizes.network(device)).collect();
        Self { network: sizes.network(device), teachers }
    }

    /// Makes the network with its initial weights.
    pub fn init(sizes: Sizes, seed: u64, device: &Device) -> Self {
        let network = sizes.network(device);
        let name = |ours: &str| sizes.network(device).file_name(ours);
        Self::trained(initialized(network, sizes, seed, &name), sizes, seed, device)
    }

    /// Takes a network with weights. Teachers, which files do not hold, have initial weights.
    pub fn trained(network: Network, sizes: Sizes, seed: u64, device: &Device) -> Self {
        let Self { teachers, .. } = Self::uninitialized(sizes, device);
        let name = |ours: &str| teacher_name(&network, ours);
        let teachers = initialized(teachers, sizes, seed, &name);
        Self { network, teachers }
    }

    /// Returns the network alone, for use.
    pub fn network(&self) -> &Network {
        &self.network
    }

    /// Returns the names of all parameters, as in files, with their shapes, in the order of the network.
    pub fn parameter_shapes(&self) -> Vec<(String, Vec<usize>)> {
        let name = |ours: &str| match ours.strip_prefix("network.") {
            Some(own) => self.network.file_name(own),
            None => teacher_name(&self.network, ours.strip_prefix("teachers.").unwrap_or(ours)),
        };
        parameter_shapes(self).into_iter().map(|(ours, shape)| (name(&ours), shape)).collect()
    }

    /// Returns true if networks of these sizes learn from frames without motion, too.
    pub fn needs_still_frames(sizes: Sizes) -> bool {
        !sizes.method().teachers().is_empty()
    }

    /// Computes the losses of bursts at a step, from 0, of so many `steps`. The network and they are on an
    /// autodiff device; bursts have a number of frames that its sizes allow.
    pub fn losses(&self, bursts: &Bursts, step: u64, steps: u64) -> Losses {
        let NetworkLosses { terms, statistics } =
            self.network.losses(&self.teachers, bursts, step, steps);
        let places = list_param_ids(self).into_iter().enumerate();
        let moved = places.filter_map(|(place, id)| Some((place, statistics.get(&id)?.clone())));
        Losses { terms, statistics: moved.collect() }
    }
}

/// Returns the name of a teacher's parameter from its number and ours.
fn teacher_name(student: &Network, ours: &str) -> String {
    let (number, own) = ours.split_once('.').unwrap_or(("", ours));
    let teachers = student.method().teachers();
    let teacher = number.parse().ok().and_then(|number: usize| teachers.get(number));
    format!("{}.{}", teacher.copied().unwrap_or_default(), student.file_name(own))
}

/// Gives a module initial weights; `name` is the name of one of our parameters in files.
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
