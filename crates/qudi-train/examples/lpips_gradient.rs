//! The gradient of LPIPS with the published weights, for `scripts/compare/lpips.py`.
//!
//!     cargo run -p qudi-train --example lpips_gradient -- FOLDER TERM P.npy Q.npy
//!
//! prints LPIPS of the gray images P and Q in [0, 1], then its gradient for P, a number a line.
#![allow(clippy::print_stdout, clippy::unwrap_used)]

use burn::tensor::Device;
use qudi_core::npy::read_image;
use qudi_layers::tensor::{read, to_tensor};
use qudi_train::loss::lpips::{Lpips, PerceptualKind};
use std::path::Path;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [folder, term, p, q] = arguments.as_slice() else { panic!("FOLDER TERM P.npy Q.npy") };
    let device = Device::flex().autodiff();
    let kind = PerceptualKind::by_name(term).unwrap();
    let lpips = Lpips::load(kind, Some(Path::new(folder)), &device).unwrap().unwrap();
    let [p, q] = [p, q].map(|path| {
        let frame = read_image(Path::new(path)).unwrap();
        to_tensor(frame.data, frame.size, &device)
    });
    let p = p.require_grad();
    let distance = lpips.loss(p.clone(), q);
    println!("{}", distance.clone().into_scalar::<f32>());
    for value in read(p.grad(&distance.backward()).unwrap()).unwrap() {
        println!("{value:e}");
    }
}
