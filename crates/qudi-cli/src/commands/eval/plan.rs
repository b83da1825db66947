//! The plan of an evaluation: its arguments, checked once.

use super::args::{Eval, External, Protocol};
use super::external::check_names;
use super::perceptual::Perceptual;
use super::score::Row;
use super::table1;
use crate::args::{Shard, Sum};
use crate::capture::checked_mean_level;
use crate::device;
use crate::error::{CliError, Result};
use crate::methods::Method;
use crate::methods::network::OwnNetwork;
use crate::methods::options::NetworkOptions;
use crate::methods::trained::provenance;
use qudi_core::PppDefinition;
use qudi_core::atomic_file::Overwrite;
use qudi_io::description::{MaskChoice, ReadOptions};
use qudi_layers::Provenance;
use qudi_train::loss::lpips::Images;
use std::path::PathBuf;
use std::rc::Rc;

/// A method and how it is asked.
#[derive(Clone, Debug)]
pub(super) struct Contender {
    pub(super) method: &'static Method,
    /// Its weights, if it is a learned method of others that was trained here.
    pub(super) trained: Option<String>,
    /// Training data of its weights, where it is left out of other light and sensors.
    pub(super) provenance: Option<Provenance>,
    /// Its diffusion steps, where there are several numbers of them to compare.
    pub(super) steps: Option<usize>,
    pub(super) network: NetworkOptions,
}

impl Contender {
    /// Makes its row at a light level, without scores.
    pub(super) fn row(&self, ppp: f64) -> Row {
        let (method, trained) = (self.method.name.to_owned(), self.trained.clone());
        Row { trained, steps: self.steps, ..Row::new(method, ppp) }
    }
}

/// Everything that an evaluation is asked for.
#[derive(Debug)]
pub(super) struct Plan {
    /// The clip, the folder of clips, or the capture.
    pub(super) data: String,
    pub(super) contenders: Vec<Contender>,
    /// Light levels; none for the default of clips, or the light of the capture.
    pub(super) ppp: Vec<f64>,
    /// Meaning of the light levels of clips.
    pub(super) ppp_def: Option<PppDefinition>,
    pub(super) sensor: Option<String>,
    /// The gain of a capture.
    pub(super) gain: Option<f64>,
    /// Frames of each clip, or of the capture, at most.
    pub(super) frames: Option<u64>,
    pub(super) protocol: Protocol,
    /// Names of the requested clips; none for all.
    pub(super) clips: Vec<String>,
    pub(super) seed: Option<u64>,
    /// The mean level that methods are given.
    pub(super) mean_level: Option<f64>,
    /// Frames that neighbouring windows share.
    pub(super) overlap: u64,
    pub(super) export_photons: Option<PathBuf>,
    pub(super) external: Vec<External>,
    pub(super) shard: Option<Shard>,
    /// True if pictures are drawn.
    pub(super) pictures: bool,
    /// LPIPS, if it is measured.
    pub(super) perceptual: Option<Rc<Perceptual>>,
    /// True if appearance is measured.
    pub(super) appearance: bool,
    /// Options for reading a capture.
    pub(super) read: ReadOptions,
    /// Number of frames that are summed, if it is given.
    pub(super) sum: Option<Sum>,
    pub(super) overwrite: Overwrite,
}

impl Plan {
    /// Checks the arguments.
    ///
    /// # Errors
    /// [`CliError`] for unknown methods and arguments that do not go together.
    pub(super) fn new(args: &Eval, overwrite: Overwrite) -> Result<Self> {
        checked_mean_level(args.mean_level)?;
        check_names(&args.external)?;
        let mut steps = args.steps.clone();
        steps.sort_unstable();
        steps.dedup();
        let mut network = args.network.options(steps.first().copied(), &args.given);
        if args.backbones.is_some() {
            // LPIPS is computed there, too.
            network.device_flag = None;
        }
        let methods = if args.table1 { table1::methods(&network) } else { args.method.clone() };
        network.check_methods(&methods)?;
        let contenders = contenders(&methods, &network, &steps, args.table1)?;
        if args.table1 && args.protocol == Protocol::Quiver {
            let help = "leave one of them out";
            let what = "the table compares all methods on the same photons";
            return Err(CliError::new(what, "--table1, --protocol quiver", help));
        }
        let perceptual = match &args.backbones {
            None => None,
            Some(folder) => {
                let device = device::open(&network.device)?.device;
                Some(Rc::new(Perceptual::load(folder, Images::Gray, device)?))
            }
        };
        let plan = Self {
            data: args.data.clone(),
            contenders,
            ppp: args.ppp.clone(),
            ppp_def: args.ppp_def,
            sensor: args.sensor.clone(),
            gain: args.gain,
            frames: args.frames,
            protocol: args.protocol,
            clips: args.clips.clone(),
            seed: args.seed,
            mean_level: args.mean_level,
            overlap: args.overlap,
            export_photons: args.export_photons.clone(),
            external: args.external.clone(),
            shard: args.shard,
            pictures: args.html.is_some(),
            perceptual,
            appearance: args.appearance,
            read: args.reading.options(MaskChoice::Auto),
            sum: args.reading.sum(),
            overwrite,
        };
        if args.capture {
            plan.check_capture(args.min_psnr.is_some())?;
        } else {
            plan.check_clips()?;
        }
        Ok(plan)
    }

    /// Returns true if light and sensor are as in the paper's table.
    pub(super) fn has_light_of_paper(&self) -> bool {
        let incident = self.ppp_def.is_none_or(|definition| definition == PppDefinition::Incident);
        incident && self.sensor.as_deref().is_none_or(|sensor| sensor == "qudi-paper")
    }

    /// Refuses what needs a truth.
    fn check_capture(&self, has_bar: bool) -> Result<()> {
        let refused = [
            (self.protocol == Protocol::Quiver, "--protocol"),
            (self.export_photons.is_some(), "--export-photons"),
            (!self.external.is_empty(), "--external"),
            (has_bar, "--min-psnr"),
        ];
        if let Some((_, option)) = refused.iter().find(|(given, _)| *given) {
            return Err(CliError::new(
                "a capture has no truth, and its photons are drawn already",
                option,
                "leave it out, or evaluate on clips without --capture",
            ));
        }
        if self.ppp.len() > 1 {
            return Err(CliError::new(
                format!("{} light levels for one capture", self.ppp.len()),
                "--ppp",
                "give the light of this capture, or leave it out",
            ));
        }
        if self.frames == Some(0) {
            return Err(CliError::new("no frames", "--frames", "ask for at least 1"));
        }
        Ok(())
    }

    /// Refuses what does not go with clips.
    fn check_clips(&self) -> Result<()> {
        if self.protocol == Protocol::Quiver
            && (self.export_photons.is_some() || !self.external.is_empty())
        {
            return Err(CliError::new(
                "the quiver protocol draws new photons for every window",
                "--protocol",
                "other programs are compared under the strict protocol",
            ));
        }
        if self.sum == Some(Sum::Auto) {
            return Err(CliError::new(
                "clips are exposed as they are asked for",
                "--sum",
                "give the number of binary frames that are summed, as in --sum 7",
            ));
        }
        // Those two say how clips are exposed.
        let read = ReadOptions { sum: None, size: None, ..self.read.clone() };
        if read != ReadOptions::default() {
            return Err(CliError::new(
                "options for reading captures, and DATA is taken for clips",
                &self.data,
                "add --capture if it is a capture, or leave them out",
            ));
        }
        Ok(())
    }
}

/// Returns every method once, and the diffusion once for every number of steps, fewest first.
fn contenders(
    methods: &[&'static Method],
    network: &NetworkOptions,
    steps: &[usize],
    leaves_out: bool,
) -> Result<Vec<Contender>> {
    let mut contenders = Vec::new();
    for &method in methods {
        let trained = network.trained_here(method)?;
        let provenance = if leaves_out { provenance(method, network)? } else { None };
        let own = method.as_own().map(|choice| OwnNetwork::new(network, choice)).transpose()?;
        let diffuses = own.is_some_and(|own| own.kind().is_diffusion());
        let network = network.clone();
        let plain = Contender { method, trained, provenance, steps: None, network };
        if diffuses && steps.len() > 1 {
            contenders.extend(steps.iter().map(|&steps| Contender {
                steps: Some(steps),
                network: NetworkOptions { steps: Some(steps), ..plain.network.clone() },
                ..plain.clone()
            }));
        } else {
            contenders.push(plain);
        }
    }
    Ok(contenders)
}
