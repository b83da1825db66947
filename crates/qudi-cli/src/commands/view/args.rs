//! Options of `qudi view`.

use crate::args::given::Given;
use crate::args::{Network, Reading, Steps, number};
use crate::commands::restore::args::Restore;
use crate::methods::Method;
use clap::{Args as ClapArgs, ValueHint};
use std::path::PathBuf;

/// Look at a capture in a browser: a slider over time and methods, restoring what is looked at
///
/// Serves one page to this computer alone, and prints its address. Only who knows the address can open it; it
/// changes with every start. Ctrl-C stops it.
#[derive(Debug, ClapArgs)]
pub(crate) struct View {
    #[command(flatten)]
    pub(crate) given: Given,
    /// The capture: a file or a folder in any format
    #[arg(value_hint = ValueHint::AnyPath)]
    pub(crate) capture: PathBuf,
    /// Port of the address [default: a free one]
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = number::whole::<u16>(1..=65535))]
    pub(crate) port: Option<u16>,
    /// Sensor that took it: a name or a .toml file [default: known from record or format]
    #[arg(long, value_name = "NAME|FILE")]
    pub(crate) sensor: Option<String>,
    /// Incident photons per pixel and frame [default: from the record, or estimated]
    #[arg(long, value_name = "PPP", allow_negative_numbers = true, value_parser = number::real(number::PPP))]
    pub(crate) ppp: Option<f64>,
    #[command(flatten)]
    pub(crate) steps: Steps,
    #[command(flatten)]
    pub(crate) network: Network,
    #[command(flatten)]
    pub(crate) reading: Reading,
}

impl View {
    /// Returns the options of a restoration by `method`, or by the default one, whose frames are not written.
    pub(crate) fn restore(&self, method: Option<&'static Method>) -> Restore {
        // Methods without a network take none of its flags.
        let is_network = method.is_none_or(Method::is_network);
        let (given, steps, network) = if is_network {
            (self.given.clone(), self.steps, self.network.clone())
        } else {
            (Given::default(), Steps::default(), Network::default())
        };
        Restore {
            given,
            capture: self.capture.clone(),
            output: "-".to_owned(),
            method,
            sensor: self.sensor.clone(),
            ppp: self.ppp,
            gain: None,
            mean_level: None,
            seed: None,
            gray: false,
            wb: None,
            challenge: false,
            backbones: None,
            overlap: 3,
            every: None,
            tonemap: None,
            fps: None,
            shard: None,
            float: false,
            chi_map: None,
            side_by_side: None,
            html: None,
            uncertainty: None,
            steps,
            network,
            reading: self.reading.clone(),
        }
    }
}
