//! The distances against the authors' LPIPS and a second writing of the others, and their gradients
//! (scripts/reference/perceptual.py).
#![allow(clippy::unwrap_used)]

use super::lpips::{Lpips, Net};
use super::{PERCEPTUAL_KINDS, Perceptual, PerceptualKind, Term};
use crate::cases::uniform;
use burn::tensor::{Device, Tensor};
use qudi_core::Size;
use qudi_model::tensor::{read, to_tensor};
use safetensors::SafeTensors;
use std::sync::OnceLock;

const SIZE: Size = Size { height: 64, width: 75 };

/// Every kind that measures something.
fn kinds() -> impl Iterator<Item = PerceptualKind> {
    PERCEPTUAL_KINDS.iter().copied().filter(|&kind| kind != PerceptualKind::None)
}

/// The reference's weights, by its formula.
fn weights(net: &str, name: &str, shape: &[usize]) -> Vec<f32> {
    let values = uniform(&format!("{net}.{name}"), shape.iter().product());
    let fan_in: usize = shape.iter().skip(1).product();
    let scaled = |value: f64| {
        if name.starts_with("lin") {
            value * value / 10.0
        } else if shape.len() > 1 {
            value * (6.0 / fan_in as f64).sqrt()
        } else {
            value * 0.05
        }
    };
    values.into_iter().map(|value| scaled(value) as f32).collect()
}

/// Distances with the reference's weights, made once on flex: VGG16's take a while.
fn term(kind: PerceptualKind) -> Perceptual {
    static TERMS: OnceLock<Vec<Perceptual>> = OnceLock::new();
    let terms = TERMS.get_or_init(|| kinds().map(|kind| make(kind, &Device::flex())).collect());
    terms.iter().find(|term| term.kind() == kind).unwrap().clone()
}

fn make(kind: PerceptualKind, device: &Device) -> Perceptual {
    let net = match kind {
        PerceptualKind::LpipsVgg => (Net::Vgg, "vgg"),
        PerceptualKind::LpipsAlex => (Net::Alex, "alex"),
        PerceptualKind::LpipsSqueeze => (Net::Squeeze, "squeeze"),
        _ => return Perceptual::load(kind, None, device).unwrap(),
    };
    let mut weights = |name: &str, shape: &[usize]| Ok(weights(net.1, name, shape));
    let lpips = Lpips::new(net.0, &mut weights, device).unwrap();
    Perceptual { kind, term: Term::Lpips(lpips) }
}

/// The golden file.
struct Golden(Vec<u8>);

impl Golden {
    fn open() -> Self {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden/perceptual");
        Self(std::fs::read(format!("{folder}/distances.safetensors")).unwrap())
    }

    fn image(&self, name: &str, device: &Device) -> Tensor<4> {
        let file = SafeTensors::deserialize(&self.0).unwrap();
        let tensor = file.tensor(name).unwrap();
        let values = tensor.data().iter().map(|&byte| (f64::from(byte) / 255.0) as f32).collect();
        to_tensor(values, SIZE, device)
    }

    fn values(&self, name: &str) -> Vec<f32> {
        let file = SafeTensors::deserialize(&self.0).unwrap();
        let bytes = file.tensor(name).unwrap();
        bytes.data().chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
    }
}

fn gradient(term: &Perceptual, p: &Tensor<4>, q: &Tensor<4>) -> Vec<f32> {
    let p = p.clone().autodiff().require_grad();
    let grads = term.loss(p.clone(), q.clone()).backward();
    read(p.grad(&grads).unwrap()).unwrap()
}

fn distances_agree(term: &Perceptual, device: &Device) {
    let golden = Golden::open();
    let name = term.kind().name();
    let (p, q) = (golden.image("p", device), golden.image("q", device));
    let got = read(term.distances(p.clone(), q.clone())).unwrap();
    let expected = golden.values(&format!("{name}/distance"));
    let scale = expected.iter().copied().fold(0.0, f32::max);
    for (got, expected) in got.iter().zip(&expected) {
        let off = (got - expected).abs() / scale;
        assert!(off < 1e-4, "{name}: {got}, reference {expected}");
    }
}

fn gradients_agree(term: &Perceptual, device: &Device) {
    let golden = Golden::open();
    let name = term.kind().name();
    let got = gradient(term, &golden.image("p", device), &golden.image("q", device));
    let expected = golden.values(&format!("{name}/gradient"));
    let norm = got.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt();
    let product: f64 =
        got.iter().zip(uniform("probe.p", got.len())).map(|(&v, probe)| f64::from(v) * probe).sum();
    let (largest, length) = (f64::from(expected[0]), f64::from(expected[1]));
    let off = [norm, product].map(|value| value / length);
    let off = [off[0] - 1.0, off[1] - f64::from(expected[2]) / length].map(f64::abs);
    let picked = got.iter().step_by(149).zip(&expected[3..]);
    let worst = picked.map(|(a, b)| f64::from((a - b).abs()) / largest).fold(0.0, f64::max);
    assert!(off.iter().all(|&off| off < 1e-3) && worst < 1e-3, "{name}: {off:?}, {worst}");
}

#[test]
fn distances_and_gradients_are_the_references() {
    for kind in kinds() {
        distances_agree(&term(kind), &Device::flex());
        gradients_agree(&term(kind), &Device::flex());
    }
}

/// Gradients of convolutions with many channels take ndarray minutes.
#[test]
fn other_backends_agree() {
    #[allow(deprecated)] // asked for by name
    let device = Device::ndarray();
    distances_agree(&make(PerceptualKind::LpipsSqueeze, &device), &device);
    for kind in [PerceptualKind::MsSsim, PerceptualKind::Oriented] {
        distances_agree(&make(kind, &device), &device);
        gradients_agree(&make(kind, &device), &device);
    }
}

#[test]
fn equal_images_have_no_distance_and_order_does_not_matter() {
    let golden = Golden::open();
    let device = Device::flex();
    let (p, q) = (golden.image("p", &device), golden.image("q", &device));
    for kind in kinds() {
        let term = term(kind);
        let same = read(term.distances(p.clone(), p.clone())).unwrap();
        assert!(same.iter().all(|d| d.abs() < 1e-6), "{kind:?}: {same:?}");
        let one_way = read(term.distances(p.clone(), q.clone())).unwrap();
        let other_way = read(term.distances(q.clone(), p.clone())).unwrap();
        for (a, b) in one_way.iter().zip(&other_way) {
            assert!((a - b).abs() < 1e-6, "{kind:?}: {a} and {b}");
        }
    }
}

#[test]
fn gradients_are_finite_where_nothing_is_to_see() {
    let golden = Golden::open();
    let device = Device::flex();
    let p = golden.image("p", &device).narrow(2, 10, 32).narrow(3, 20, 32);
    let (black, gray) = (p.zeros_like(), p.zeros_like() + 0.5);
    let negative = 1.0 - p.clone();
    let pairs = [
        (&p, &p),
        (&black, &black),
        (&black, &p),
        (&gray, &gray),
        (&gray, &black),
        (&gray, &p),
        (&p, &negative),
    ];
    for kind in kinds() {
        for (number, (p, q)) in pairs.iter().enumerate() {
            let value = read(term(kind).loss((*p).clone(), (*q).clone())).unwrap()[0];
            let gradient = gradient(&term(kind), p, q);
            let finite = value.is_finite() && gradient.iter().all(|value| value.is_finite());
            assert!(finite, "{kind:?}, pair {number}: {value}");
        }
    }
}

/// Along its gradient the distance changes as the gradient says. Elsewhere bends of the networks, which are
/// everywhere, hide small slopes.
#[test]
fn gradients_are_the_slopes_of_the_distances() {
    let golden = Golden::open();
    let device = Device::flex();
    let (p, q) = (golden.image("p", &device), golden.image("q", &device));
    for kind in kinds() {
        let term = term(kind);
        let gradient = gradient(&term, &p, &q);
        let largest = gradient.iter().fold(0f32, |largest, value| largest.max(value.abs()));
        let step = 2e-4;
        let along = to_tensor(gradient.clone(), SIZE, &device) * (step / largest);
        let at = |p: Tensor<4>| f64::from(read(term.loss(p, q.clone())).unwrap()[0]);
        let (after, before) = (at(p.clone() + along.clone()), at(p.clone() - along));
        let slope = (after - before) / (2.0 * f64::from(step));
        let squares: f64 = gradient.iter().map(|&value| f64::from(value).powi(2)).sum();
        let expected = squares / f64::from(largest);
        assert!((slope / expected - 1.0).abs() < 0.02, "{kind:?}: {slope}, {expected}");
    }
}

#[test]
fn the_smallest_images_can_be_compared() {
    let device = Device::flex();
    for kind in kinds() {
        let term = term(kind);
        let side = kind.smallest_side();
        let size = Size { height: side, width: side + 1 };
        assert!(term.check(size).is_ok());
        assert!(term.check(Size { height: side - 1, width: 999 }).is_err());
        let image = |name| {
            let values = uniform(name, size.pixels()).into_iter().map(|v| v as f32 * 0.5 + 0.5);
            to_tensor(values.collect(), size, &device)
        };
        let distance = read(term.loss(image("p"), image("q"))).unwrap()[0];
        assert!(distance > 0.0 && distance.is_finite(), "{kind:?}: {distance}");
    }
}

#[test]
fn recomputing_devices_are_served() {
    let golden = Golden::open();
    let device = Device::flex().autodiff().gradient_checkpointing();
    let q = golden.image("q", &device);
    for kind in [PerceptualKind::LpipsSqueeze, PerceptualKind::MsSsim, PerceptualKind::Oriented] {
        let p = golden.image("p", &device).require_grad();
        let grads = term(kind).loss(p.clone(), q.clone()).backward();
        let got = read(p.grad(&grads).unwrap()).unwrap();
        let expected = golden.values(&format!("{}/gradient", kind.name()));
        for (got, value) in got.iter().step_by(149).zip(&expected[3..]) {
            assert!((got - value).abs() < 1e-3 * expected[0], "{kind:?}: {got}, reference {value}");
        }
    }
}

/// A file with other tensors than the network's.
#[test]
fn weights_of_other_networks_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let other = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden/perceptual/zip.pth");
    for name in ["alexnet-owt-7be5be79.pth", "alex_lpips.pth"] {
        std::fs::copy(other, folder.path().join(name)).unwrap();
    }
    let kind = PerceptualKind::LpipsAlex;
    let error = Perceptual::load(kind, Some(folder.path()), &Device::flex()).unwrap_err();
    assert!(error.to_string().contains("`features.0.weight` is missing"), "{error}");
    assert!(error.place().unwrap().ends_with("alexnet-owt-7be5be79.pth"));
}

#[test]
fn no_term_is_zero() {
    let term = Perceptual::load(PerceptualKind::None, None, &Device::flex()).unwrap();
    let image = Tensor::<4>::ones([2, 1, 4, 4], &Device::flex());
    assert_eq!(read(term.loss(image.clone(), image * 0.5)).unwrap(), [0.0]);
}

#[test]
fn names_are_those_of_configurations() {
    for &kind in PERCEPTUAL_KINDS {
        assert_eq!(serde_json::to_string(&kind).unwrap(), format!("\"{}\"", kind.name()));
        assert_eq!(PerceptualKind::by_name(kind.name()).unwrap(), kind);
    }
    let error = PerceptualKind::by_name("lpips-vg").unwrap_err();
    assert!(error.help().unwrap().contains("did you mean `lpips-vgg`"), "{error:?}");
}
