//! Which parts of a network have learnt: it decides how the network can restore.

use crate::network::Qudi;
use burn::module::{Module, ModuleVisitor, Param};
use burn::tensor::Tensor;
use qudi_core::{Error, Result};
use qudi_layers::tensor::read;
use serde::{Deserialize, Serialize};

/// Which parts of a network have learnt.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ModelKind {
    /// The pre-denoiser alone: the U-Net changes nothing, and samples would not differ.
    Regression,
    /// The U-Net, after the pre-denoiser, which learnt without simulated measurements: frames are
    /// pre-denoised once for all steps.
    DiffusionAfterRegression,
    /// All parts together: frames are pre-denoised again in every step.
    Diffusion,
}

/// The layers that decide: the last one of the U-Net, and the pre-denoiser's for simulated measurements.
const UNET_OUT: [&str; 2] = ["unet.out.weight", "unet.out.bias"];
const SIMULATED_IN: &str = "pre.simulated_in.weight";

impl ModelKind {
    /// The kind of a network whose parameters are zero where `is_zero` says so of their names.
    pub(super) fn from_zeros(mut is_zero: impl FnMut(&str) -> bool) -> Self {
        if UNET_OUT.iter().all(|name| is_zero(name)) {
            Self::Regression
        } else if is_zero(SIMULATED_IN) {
            Self::DiffusionAfterRegression
        } else {
            Self::Diffusion
        }
    }

    /// The kind of a network in memory.
    ///
    /// # Errors
    /// [`Error`] if the device fails.
    pub fn of(network: &Qudi) -> Result<Self> {
        let mut zeros = Zeros { path: Vec::new(), names: Vec::new(), error: None };
        network.visit(&mut zeros);
        match zeros.error {
            Some(error) => Err(error),
            None => Ok(Self::from_zeros(|name| zeros.names.iter().any(|zero| zero == name))),
        }
    }
}

/// The names of the deciding parameters that are zero.
struct Zeros {
    path: Vec<String>,
    names: Vec<String>,
    error: Option<Error>,
}

impl ModuleVisitor for Zeros {
    fn enter_module(&mut self, name: &str, _container: &str) {
        self.path.push(name.into());
    }

    fn exit_module(&mut self, _name: &str, _container: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let name = self.path.join(".");
        if name != SIMULATED_IN && !UNET_OUT.contains(&name.as_str()) {
            return;
        }
        match read(param.val()) {
            Ok(values) if values.iter().all(|&value| value == 0.0) => self.names.push(name),
            Ok(_) => (),
            Err(error) => self.error = Some(error),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::NetworkConfig;
    use crate::network::init_parameters;
    use burn::tensor::Device;

    #[test]
    fn kind_follows_from_the_parts_that_are_zero() {
        let config = NetworkConfig::preset("tiny").unwrap_or_else(|e| panic!("{e}"));
        let network = || config.init(1, &Device::flex());
        let kind = |network: &Qudi| ModelKind::of(network).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(kind(&network()), ModelKind::Regression);
        let with = |zero: &'static str| {
            init_parameters(network(), move |name, shape| {
                vec![if name == zero { 0.0 } else { 1e-7 }; shape.iter().product()]
            })
        };
        assert_eq!(kind(&with("")), ModelKind::Diffusion);
        assert_eq!(kind(&with(SIMULATED_IN)), ModelKind::DiffusionAfterRegression);
        assert_eq!(kind(&with(UNET_OUT[0])), ModelKind::Diffusion);
    }
}
