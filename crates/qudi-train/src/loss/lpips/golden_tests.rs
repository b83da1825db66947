//! The distances and their gradients against the authors' LPIPS (tests/golden/generate/perceptual.py).
#![allow(clippy::unwrap_used)]

use super::{Images, Lpips, Net, PERCEPTUAL_KINDS, PerceptualKind};
use crate::cases::uniform;
use burn::tensor::{Device, Tensor};
use qudi_core::Size;
use qudi_kernels::{ComputePrecision, with_precision};
use qudi_layers::tensor::{read, to_tensor};
use safetensors::SafeTensors;
use std::sync::OnceLock;

const SIZE: Size = Size { height: 64, width: 75 };

const NETS: [(&str, Net); 2] = [("vgg", Net::Vgg), ("alex", Net::Alex)];

/// Returns the reference's weights, by its formula.
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

/// Returns the distances with the reference's weights, made once on flex: VGG16's take a while.
fn lpips(name: &str) -> Lpips {
    static ALL: OnceLock<Vec<Lpips>> = OnceLock::new();
    let gray = |(name, net)| make(name, net, Images::Gray, &Device::flex());
    let all = ALL.get_or_init(|| NETS.map(gray).into());
    let at = NETS.iter().position(|net| net.0 == name).unwrap();
    all[at].clone()
}

fn make(name: &str, net: Net, images: Images, device: &Device) -> Lpips {
    let mut weights = |weight: &str, shape: &[usize]| Ok(weights(name, weight, shape));
    Lpips::new(net, images, &mut weights, device).unwrap()
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

/// Gray images have the same distance as colours of three equal planes, and a change of hue has one.
#[test]
fn colours_of_equal_planes_are_gray_images() {
    let device = Device::flex();
    let (gray, colour) = (lpips("alex"), make("alex", Net::Alex, Images::Colour, &device));
    let golden = Golden::open();
    let (p, q) = (golden.image("p", &device), golden.image("q", &device));
    let three = |plane: &Tensor<4>| Tensor::cat(vec![plane.clone(); 3], 1);
    let expected = read(gray.distances(p.clone(), q.clone())).unwrap();
    let got = read(colour.distances(three(&p), three(&q))).unwrap();
    for (got, expected) in got.iter().zip(expected) {
        assert!((got - expected).abs() < 1e-4 * expected, "{got} {expected}");
    }
    let tinted = Tensor::cat(vec![p.clone(), p.clone(), p.clone() * 0.5], 1);
    assert!(read(colour.distances(three(&p), tinted)).unwrap()[0] > 1e-3);
}

fn gradient(lpips: &Lpips, p: &Tensor<4>, q: &Tensor<4>) -> Vec<f32> {
    let p = p.clone().autodiff().require_grad();
    let grads = lpips.loss(p.clone(), q.clone()).backward();
    read(p.grad(&grads).unwrap()).unwrap()
}

fn distances_agree(name: &str, lpips: &Lpips, device: &Device) {
    let golden = Golden::open();
    let (p, q) = (golden.image("p", device), golden.image("q", device));
    let got = read(lpips.distances(p.clone(), q.clone())).unwrap();
    let expected = golden.values(&format!("lpips-{name}/distance"));
    let scale = expected.iter().copied().fold(0.0, f32::max);
    for (got, expected) in got.iter().zip(&expected) {
        let off = (got - expected).abs() / scale;
        assert!(off < 1e-4, "{name}: {got}, reference {expected}");
    }
}

fn gradients_agree(name: &str, lpips: &Lpips, device: &Device) {
    let golden = Golden::open();
    let got = gradient(lpips, &golden.image("p", device), &golden.image("q", device));
    let expected = golden.values(&format!("lpips-{name}/gradient"));
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
fn distances_and_gradients_match_reference() {
    for (name, _) in NETS {
        distances_agree(name, &lpips(name), &Device::flex());
        gradients_agree(name, &lpips(name), &Device::flex());
    }
}

/// Training multiplies numbers of 16 bits here, too.
#[test]
fn gradients_in_sixteen_bits_point_the_same_way() {
    let golden = Golden::open();
    let device = Device::flex();
    let (p, q) = (golden.image("p", &device), golden.image("q", &device));
    for (name, _) in NETS {
        let lpips = lpips(name);
        let [exact, rounded] = [ComputePrecision::F32, ComputePrecision::Bf16]
            .map(|precision| with_precision(precision, || gradient(&lpips, &p, &q)));
        let product = |a: &[f32], b: &[f32]| -> f64 {
            a.iter().zip(b).map(|(&a, &b)| f64::from(a) * f64::from(b)).sum()
        };
        let lengths = product(&exact, &exact) * product(&rounded, &rounded);
        let cosine = product(&exact, &rounded) / lengths.sqrt();
        assert!(cosine > 0.95 && cosine < 1.0 - 1e-9, "{name}: {cosine}");
    }
}

/// Gradients of convolutions with many channels take ndarray minutes.
#[test]
fn distances_on_ndarray_match_reference() {
    #[allow(deprecated)] // asked for by name
    let device = Device::ndarray();
    distances_agree("alex", &make("alex", Net::Alex, Images::Gray, &device), &device);
}

/// Red, green and blue are planes of the golden images, taken for values of [-1, 1] as torchmetrics does by
/// default.
#[test]
fn distances_of_colours_match_reference() {
    let (golden, device) = (Golden::open(), Device::flex());
    let (p, q) = (golden.image("p", &device), golden.image("q", &device));
    let plane = |images: &Tensor<4>, n: usize| (images.clone().narrow(0, n, 1) + 1.0) * 0.5;
    let first = Tensor::cat(vec![plane(&p, 0), plane(&p, 1), plane(&q, 0)], 1);
    let second = Tensor::cat(vec![plane(&q, 0), plane(&p, 1), plane(&q, 1)], 1);
    let lpips = make("alex", Net::Alex, Images::Colour, &device);
    let got = read(lpips.distances(first, second)).unwrap()[0];
    let expected = golden.values("lpips-alex/colour")[0];
    assert!((got / expected - 1.0).abs() < 1e-4, "{got}, reference {expected}");
}

#[test]
fn distance_is_symmetric_and_zero_for_equal_images() {
    let golden = Golden::open();
    let device = Device::flex();
    let (p, q) = (golden.image("p", &device), golden.image("q", &device));
    for (name, _) in NETS {
        let lpips = lpips(name);
        let same = read(lpips.distances(p.clone(), p.clone())).unwrap();
        assert!(same.iter().all(|d| d.abs() < 1e-6), "{name}: {same:?}");
        let one_way = read(lpips.distances(p.clone(), q.clone())).unwrap();
        let other_way = read(lpips.distances(q.clone(), p.clone())).unwrap();
        for (a, b) in one_way.iter().zip(&other_way) {
            assert!((a - b).abs() < 1e-6, "{name}: {a} and {b}");
        }
    }
}

#[test]
fn gradients_of_flat_images_are_finite() {
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
    for (name, _) in NETS {
        let lpips = lpips(name);
        for (number, (p, q)) in pairs.iter().enumerate() {
            let value = read(lpips.loss((*p).clone(), (*q).clone())).unwrap()[0];
            let gradient = gradient(&lpips, p, q);
            let finite = value.is_finite() && gradient.iter().all(|value| value.is_finite());
            assert!(finite, "{name}, pair {number}: {value}");
        }
    }
}

/// Along its gradient the distance changes as the gradient says. In other directions the kinks of the
/// networks' ReLUs hide small slopes.
#[test]
fn gradient_is_the_slope_of_the_distance() {
    let golden = Golden::open();
    let device = Device::flex();
    let (p, q) = (golden.image("p", &device), golden.image("q", &device));
    for (name, _) in NETS {
        let lpips = lpips(name);
        let gradient = gradient(&lpips, &p, &q);
        let largest = gradient.iter().fold(0f32, |largest, value| largest.max(value.abs()));
        let step = 2e-4;
        let along = to_tensor(gradient.clone(), SIZE, &device) * (step / largest);
        let at = |p: Tensor<4>| f64::from(read(lpips.loss(p, q.clone())).unwrap()[0]);
        let (after, before) = (at(p.clone() + along.clone()), at(p.clone() - along));
        let slope = (after - before) / (2.0 * f64::from(step));
        let squares: f64 = gradient.iter().map(|&value| f64::from(value).powi(2)).sum();
        let expected = squares / f64::from(largest);
        assert!((slope / expected - 1.0).abs() < 0.02, "{name}: {slope}, {expected}");
    }
}

#[test]
fn smallest_images_can_be_compared() {
    let device = Device::flex();
    for (name, net) in NETS {
        let lpips = lpips(name);
        let side = net.smallest_side();
        let size = Size { height: side, width: side + 1 };
        assert!(lpips.check(size).is_ok());
        assert!(lpips.check(Size { height: side - 1, width: 999 }).is_err());
        let image = |name| {
            let values = uniform(name, size.pixels()).into_iter().map(|v| v as f32 * 0.5 + 0.5);
            to_tensor(values.collect(), size, &device)
        };
        let distance = read(lpips.loss(image("p"), image("q"))).unwrap()[0];
        assert!(distance > 0.0 && distance.is_finite(), "{name}: {distance}");
    }
}

#[test]
fn gradients_with_checkpointing_match_reference() {
    let golden = Golden::open();
    let device = Device::flex().autodiff().gradient_checkpointing();
    let q = golden.image("q", &device);
    let p = golden.image("p", &device).require_grad();
    let grads = lpips("alex").loss(p.clone(), q.clone()).backward();
    let got = read(p.grad(&grads).unwrap()).unwrap();
    let expected = golden.values("lpips-alex/gradient");
    for (got, value) in got.iter().step_by(149).zip(&expected[3..]) {
        assert!((got - value).abs() < 1e-3 * expected[0], "{got}, reference {value}");
    }
}

#[test]
fn rejects_weights_of_other_networks() {
    let folder = tempfile::tempdir().unwrap();
    let other = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden/perceptual/zip.pth");
    for name in ["alexnet-owt-7be5be79.pth", "alex_lpips.pth"] {
        std::fs::copy(other, folder.path().join(name)).unwrap();
    }
    let kind = PerceptualKind::LpipsAlex;
    let error = Lpips::load(kind, Some(folder.path()), &Device::flex()).unwrap_err();
    assert!(error.to_string().contains("`features.0.weight` is missing"), "{error}");
    assert!(error.place().unwrap().ends_with("alexnet-owt-7be5be79.pth"));
}

#[test]
fn perceptual_kinds_have_one_name_in_recipes_and_errors() {
    for &kind in PERCEPTUAL_KINDS {
        assert_eq!(serde_json::to_string(&kind).unwrap(), format!("\"{}\"", kind.name()));
        let text = format!("\"{}\"", kind.name());
        assert_eq!(serde_json::from_str::<PerceptualKind>(&text).unwrap(), kind);
    }
    let error = PerceptualKind::by_name("lpips-vg").unwrap_err();
    assert!(error.help().unwrap().contains("did you mean `lpips-vgg`"), "{error:?}");
}
