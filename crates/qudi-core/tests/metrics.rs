//! PSNR and SSIM against scikit-image, GMSD against SciPy: `tests/golden/metrics`, made by
//! `tests/golden/generate/metrics.py`.
#![allow(clippy::unwrap_used)]

use qudi_core::metrics::{gain_aligned_psnr, gaussian_ssim, gmsd, psnr, ssim};
use qudi_core::npy::read_image;
use std::path::Path;

#[test]
fn metrics_match_independent_references() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/metrics");
    let text = std::fs::read_to_string(folder.join("figures.json")).unwrap();
    let figures: serde_json::Value = serde_json::from_str(&text).unwrap();
    for (name, expected) in figures.as_object().unwrap() {
        let image = |what: &str| read_image(&folder.join(format!("{name}-{what}.npy"))).unwrap();
        let (estimate, truth) = (image("estimate"), image("truth"));
        let found = [
            ("psnr", psnr(&estimate, &truth)),
            ("psnr_a", gain_aligned_psnr(&estimate, &truth)),
            ("ssim", ssim(&estimate, &truth).unwrap()),
            ("ssim_g", gaussian_ssim(&estimate, &truth).unwrap()),
            ("gmsd", gmsd(&estimate, &truth).unwrap()),
        ];
        for (metric, value) in found {
            let expected = expected[metric].as_f64().unwrap();
            assert!((value - expected).abs() < 1e-6, "{name} {metric}: {value} {expected}");
        }
    }
}
