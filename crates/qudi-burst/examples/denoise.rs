//! Denoises one image with BM3D, for comparison with other programs.
//!
//!     cargo run --release -p qudi-burst --example denoise -- NOISY.npy SIGMA OUT.npy
//!
//! Prints the fastest of three runs in seconds. RAYON_NUM_THREADS sets the threads.
#![allow(clippy::print_stdout)]

use qudi_burst::bm3d;
use qudi_core::Error;
use qudi_core::npy::{read_image, write_header};
use std::path::Path;
use std::time::Instant;

fn main() -> qudi_core::Result<()> {
    let args: Vec<String> = std::env::args().collect();
    let [_, noisy, sigma, out] = args.as_slice() else {
        return Err(Error::request("three arguments", "command line", "NOISY.npy SIGMA OUT.npy"));
    };
    let image = read_image(Path::new(noisy))?;
    let sigma = sigma.parse().unwrap_or(0.0);
    let mut fastest = f64::INFINITY;
    let mut denoised = image.clone();
    for _ in 0..3 {
        let start = Instant::now();
        denoised = bm3d(&image, sigma);
        fastest = fastest.min(start.elapsed().as_secs_f64());
    }
    println!("{fastest:.4}");
    let mut bytes = Vec::new();
    let write = |e| Error::io("write", Path::new(out), e);
    write_header(&mut bytes, "<f4", &[image.size.height, image.size.width]).map_err(write)?;
    bytes.extend(denoised.data.iter().flat_map(|v| v.to_le_bytes()));
    std::fs::write(out, bytes).map_err(write)
}
