//! `qudi publish`: weights in half the space, with the hash that proves them.

use super::args::Publish;
use crate::args::Global;
use crate::error::{CliError, Result};
use crate::report::Report;
use crate::weights::{Weights, sha256};
use burn::tensor::Device;
use qudi_baselines::import::describe;
use qudi_core::Error;
use qudi_core::atomic_file::{PendingFile, refuse_taken};
use qudi_model::checkpoint::{Precision, save};
use qudi_model::config::NetworkKind;
use qudi_model::diffusion::Diffusion;
use qudi_model::regression::Regression;
use qudi_model::window::Window;
use serde_json::json;

pub(crate) fn run(args: &Publish, global: &Global, report: &Report) -> Result<()> {
    let overwrite = global.overwrite();
    let path = &args.output;
    if path.extension() != Some("safetensors".as_ref()) {
        return Err(CliError::new(
            "weights are .safetensors",
            path.display(),
            "name a .safetensors file",
        ));
    }
    let device = Device::flex();
    if let Ok(Some(contents)) = describe(&args.weights, &device) {
        return Err(CliError::new(
            format!("weights of {}, a learned method of others", contents.method.name()),
            args.weights.display(),
            "publish them as they are: --weights METHOD=FILE reads them",
        ));
    }
    let weights = Weights::File(args.weights.clone());
    let mut description = weights.describe()?;
    let parameters = description.network.parameters(&device);
    let hash_path = path.with_extension("sha256");
    for taken in [path, hash_path.as_path()] {
        refuse_taken(taken, overwrite)?;
    }
    match (description.network.kind(), args.steps) {
        (NetworkKind::Regression, Some(_)) => {
            return Err(CliError::new(
                "a regression has no reverse steps",
                "--steps",
                "leave it out, or publish weights of a diffusion",
            ));
        }
        (NetworkKind::Regression, None) => {
            let (network, _) = weights.load::<Regression>(&device)?;
            save(&network, &description, Precision::Half, path, overwrite)?;
        }
        (kind, steps) => {
            let sampling = description.sampling.get_or_insert_default();
            sampling.steps = steps.map_or(sampling.steps, usize::from);
            if kind == NetworkKind::Window {
                let (network, _) = weights.load::<Window>(&device)?;
                save(&network, &description, Precision::Half, path, overwrite)?;
            } else {
                let (network, _) = weights.load::<Diffusion>(&device)?;
                save(&network, &description, Precision::Half, path, overwrite)?;
            }
        }
    }
    let bytes = std::fs::read(path).map_err(|e| Error::io("read the weights", path, e))?;
    let hash = sha256(&bytes);
    PendingFile::write_whole(&hash_path, format!("{hash}\n").as_bytes(), overwrite)?;
    let text = format!(
        "{}   {parameters} parameters in {} bytes\n  sha-256   {hash}\n",
        path.display(),
        bytes.len()
    );
    report.result(
        &text,
        || json!({"output": path, "parameters": parameters, "bytes": bytes.len(), "sha256": hash}),
    )
}
