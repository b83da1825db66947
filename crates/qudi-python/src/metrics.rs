//! Metrics of an image against the truth.

use crate::errors::exception;
use burn::tensor::{Device, Tensor, TensorData};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use qudi_core::metrics::{gain_aligned_psnr, gmsd, psnr, ssim};
use qudi_core::{Frame, Size};
use qudi_train::loss::lpips::{Lpips as Network, PerceptualKind};
use std::path::PathBuf;

/// Returns a metric of two images of `height` rows, given as the bytes of their float32 values; `None` where
/// they are too small for it.
#[pyfunction]
pub(crate) fn compare(
    py: Python<'_>,
    metric: &str,
    estimate: Vec<u8>,
    truth: Vec<u8>,
    height: usize,
) -> PyResult<Option<f64>> {
    let (estimate, truth) = (frame(&estimate, height)?, frame(&truth, height)?);
    py.detach(|| match metric {
        "psnr" => Ok(Some(psnr(&estimate, &truth))),
        "psnr_aligned" => Ok(Some(gain_aligned_psnr(&estimate, &truth))),
        "ssim" => Ok(ssim(&estimate, &truth)),
        "gmsd" => Ok(gmsd(&estimate, &truth)),
        _ => Err(PyValueError::new_err(format!("no metric named `{metric}`"))),
    })
}

/// LPIPS with its weights.
#[pyclass(frozen)]
pub(crate) struct Lpips(Network);

#[pymethods]
impl Lpips {
    /// Reads the weights of `lpips-vgg` or `lpips-alex` from a folder, or from where Burn keeps them.
    #[new]
    fn new(py: Python<'_>, kind: &str, folder: Option<PathBuf>) -> PyResult<Self> {
        let load = move || {
            let kind = PerceptualKind::by_name(kind)?;
            Network::load(kind, folder.as_deref(), &Device::flex())
        };
        let network = py.detach(load).map_err(|error| exception(error.into()))?;
        network.map(Self).ok_or_else(|| PyValueError::new_err("no network is named"))
    }

    /// Returns the distance of two images of `height` rows.
    fn distance(
        &self,
        py: Python<'_>,
        estimate: Vec<u8>,
        truth: Vec<u8>,
        height: usize,
    ) -> PyResult<f64> {
        let (estimate, truth) = (frame(&estimate, height)?, frame(&truth, height)?);
        self.0.check(truth.size).map_err(|error| exception(error.into()))?;
        Ok(py.detach(|| {
            let [estimate, truth] = [estimate, truth].map(|frame| {
                let shape = [1, 1, frame.size.height, frame.size.width];
                let data = frame.data.into_iter().map(|value| value.clamp(0.0, 1.0)).collect();
                Tensor::<4>::from_data(TensorData::new::<f32, _>(data, shape), &Device::flex())
            });
            f64::from(self.0.loss(estimate, truth).into_scalar::<f32>())
        }))
    }
}

fn frame(bytes: &[u8], height: usize) -> PyResult<Frame> {
    let data: Vec<f32> =
        bytes.chunks_exact(4).map(|b| f32::from_ne_bytes([b[0], b[1], b[2], b[3]])).collect();
    let width = data.len() / height.max(1);
    let size = Size::new(height, width, "shape").map_err(|error| exception(error.into()))?;
    if size.pixels() != data.len() {
        return Err(PyValueError::new_err("rows of different lengths"));
    }
    Ok(Frame { size, data })
}
