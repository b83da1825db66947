//! Options of commands that may run the network.

use super::given::{DIFFUSION, Given, OWN};
use super::number;
use crate::methods::options::NetworkOptions;
use clap::{Args as ClapArgs, ValueEnum, ValueHint};
use qudi_baselines::import::{METHODS, Method};
use qudi_layers::TILE;
use qudi_model::ComputePrecision;
use qudi_model::diffusion::FlowSource;
use qudi_model::diffusion::sampler::Sampler;
use qudi_model::diffusion::timesteps::TimestepSpacing;
use std::path::{Path, PathBuf};

/// Options of networks.
#[derive(Clone, Debug, Default, ClapArgs)]
#[command(next_help_heading = "Networks (methods qudi, qudi-regression, qudi-diffusion)")]
pub(crate) struct Network {
    /// Weights that `qudi train` wrote [default: built in]; for learned methods of others
    /// METHOD=FILE, as in emvd=emvd.pth,quiver=quiver.pth (no commas in names)
    #[arg(long, value_name = "[METHOD=]FILE,...", value_delimiter = ',', value_hint = ValueHint::FilePath)]
    weights: Vec<WeightsOf>,
    /// qudi-diffusion: spacing of the timesteps [default: as the weights say]
    #[arg(long, value_name = "NAME", groups = [OWN, DIFFUSION])]
    spacing: Option<SpacingName>,
    /// qudi-diffusion: sampler [default: ddim]
    #[arg(long, value_name = "NAME", groups = [OWN, DIFFUSION])]
    sampler: Option<SamplerName>,
    /// qudi-diffusion: passes; each after the first one finds the motion between the frames that the one
    /// before restored, and corrects them: 2 take 1.6 to 1.8 times as long [default: 1]
    #[arg(long, value_name = "N", groups = [OWN, DIFFUSION], allow_negative_numbers = true, value_parser = number::whole::<usize>(1..=10))]
    passes: Option<usize>,
    /// qudi-diffusion: what finds the motion between frames [default: matched, if the weights can follow it]
    #[arg(long, value_name = "NAME", groups = [OWN, DIFFUSION])]
    flow: Option<FlowName>,
    /// qudi-diffusion: correct the mean of one step once more along the counts, and predict its uncertainty
    #[arg(long, groups = [OWN, DIFFUSION])]
    correct: bool,
    /// qudi-diffusion: samples drawn; the result is their mean, --uncertainty their standard deviation
    /// [default: 1]
    #[arg(long, value_name = "K", groups = [OWN, DIFFUSION], allow_negative_numbers = true, value_parser = number::whole::<usize>(1..=1000))]
    samples: Option<usize>,
    /// Where it runs: auto, cpu, ndarray, wgpu, vulkan, cuda, metal, or one of several, as wgpu:1 (`qudi info
    /// --devices`) [default: auto]
    #[arg(long, value_name = "NAME")]
    device: Option<String>,
    /// Side of the tiles that a network sees at once, in pixels: memory grows with its square [default: 512]
    #[arg(long, value_name = "PIXELS", allow_negative_numbers = true, value_parser = number::whole::<usize>(1..=1 << 16))]
    tile: Option<usize>,
    /// Numbers that its convolutions multiply; sums have 32 bits with each [default: bf16 on processors that
    /// multiply it faster, else f32]
    #[arg(long, value_name = "NAME", group = OWN)]
    precision: Option<PrecisionName>,
}

impl Network {
    /// Returns the weights of a network of this project, if they are named.
    pub(crate) fn own_weights(&self) -> Option<&Path> {
        self.weights.iter().find(|weights| weights.method.is_none()).map(|w| w.file.as_path())
    }

    /// Returns the device, if it is named.
    pub(crate) fn device(&self) -> Option<&str> {
        self.device.as_deref()
    }

    /// All files of weights.
    pub(crate) fn weight_files(&self) -> impl Iterator<Item = &PathBuf> {
        self.weights.iter().map(|weights| &weights.file)
    }

    /// Returns the options for a number of steps, with their defaults filled in; `given` are the flags on the
    /// command line.
    pub(crate) fn options(&self, steps: Option<usize>, given: &Given) -> NetworkOptions {
        let weights = self.own_weights().map(|_| "--weights".to_owned());
        NetworkOptions {
            own_file: self.own_weights().map(Path::to_owned),
            own_files: self.weights.iter().filter(|weights| weights.method.is_none()).count(),
            learned: self
                .weights
                .iter()
                .filter_map(|weights| Some((weights.method?, weights.file.clone())))
                .collect(),
            steps,
            spacing: self.spacing.map(SpacingName::spacing),
            sampler: self.sampler.map_or_else(Sampler::default, SamplerName::sampler),
            passes: self.passes.unwrap_or(1),
            correct: self.correct,
            flow: self.flow.map(FlowName::source),
            samples: self.samples.unwrap_or(1),
            device: self.device.clone().unwrap_or_else(|| "auto".to_owned()),
            tile: self.tile.unwrap_or(TILE),
            precision: self.precision.map(PrecisionName::precision),
            tile_flag: self.tile.is_some().then_some("--tile"),
            device_flag: self.device.is_some().then_some("--device"),
            given: Given { own: weights.or_else(|| given.own.clone()), ..given.clone() },
        }
    }
}

/// Weights, and the learned method that they are of; none for the networks of this project.
#[derive(Clone, Debug, PartialEq, Eq)]
struct WeightsOf {
    method: Option<Method>,
    file: PathBuf,
}

impl std::str::FromStr for WeightsOf {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let name = text.split_once('=').map(|(name, _)| name);
        let method = name.and_then(Method::by_name);
        let is_name = |name: &str| name.chars().all(|c| c.is_ascii_alphanumeric() || c == '-');
        if method.is_none() && name.is_some_and(is_name) && !Path::new(text).exists() {
            let all = METHODS.map(Method::name).join(", ");
            return Err(format!("no learned method has this name; there are {all}"));
        }
        let file = match method {
            Some(method) => &text[method.name().len() + 1..],
            None => text,
        };
        if file.is_empty() {
            return Err("no file is named".to_owned());
        }
        Ok(Self { method, file: file.into() })
    }
}

/// Number of reverse steps of the diffusion.
#[derive(Clone, Copy, Debug, Default, ClapArgs)]
#[command(next_help_heading = "Networks (methods qudi, qudi-regression, qudi-diffusion)")]
pub(crate) struct Steps {
    /// qudi-diffusion: reverse steps. More steps draw sharper pictures, whose details are invented; the paper
    /// takes 10 [default: as the weights say]
    #[arg(long, value_name = "N", groups = [OWN, DIFFUSION], allow_negative_numbers = true, value_parser = number::whole::<usize>(1..=1000))]
    pub(crate) steps: Option<usize>,
}

/// Precisions of products.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum PrecisionName {
    /// 32 bits
    F32,
    /// 16 bits, 8 of them for the value
    Bf16,
}

impl PrecisionName {
    fn precision(self) -> ComputePrecision {
        match self {
            Self::F32 => ComputePrecision::F32,
            Self::Bf16 => ComputePrecision::Bf16,
        }
    }
}

/// Spacings.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum SpacingName {
    /// Evenly, as in the paper
    Linear,
    /// As densely as training drew timesteps, by how much noise there is: sharper pictures in as many steps
    LogLogistic,
}

impl SpacingName {
    fn spacing(self) -> TimestepSpacing {
        match self {
            Self::Linear => TimestepSpacing::Linear,
            Self::LogLogistic => TimestepSpacing::LogLogistic,
        }
    }
}

/// What finds the motion.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum FlowName {
    /// Patches, matched on the processor in the counts of all frames and on better frames
    Matched,
    /// The network, as in the paper: less exact, in about 0.7 of the time
    Learnt,
}

impl FlowName {
    fn source(self) -> FlowSource {
        match self {
            Self::Matched => FlowSource::Matched,
            Self::Learnt => FlowSource::Learnt,
        }
    }
}

/// Samplers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum SamplerName {
    /// No fresh noise on the way (eta 0)
    Ddim,
    /// The noise of the posterior at every step
    Ancestral,
}

impl SamplerName {
    fn sampler(self) -> Sampler {
        match self {
            Self::Ddim => Sampler::Ddim,
            Self::Ancestral => Sampler::Ancestral,
        }
    }
}
