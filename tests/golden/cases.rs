//! Reads the golden files that tests/golden/generate/network_goldens.py writes; its docstring gives the
//! format.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used, clippy::struct_field_names)]

use burn::tensor::{Device, Tensor, TensorData};
use safetensors::SafeTensors;
use serde_json::Value;

/// One golden file.
pub struct File {
    bytes: Vec<u8>,
    cases: Value,
}

/// One case of a file: inputs by formula, expected results from the file.
pub struct Case<'a> {
    pub name: &'a str,
    pub about: &'a Value,
    case: &'a Value,
    tensors: SafeTensors<'a>,
}

impl File {
    pub fn open(name: &str) -> Self {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden");
        let bytes = std::fs::read(format!("{folder}/{name}.safetensors")).unwrap();
        let (_, header) = SafeTensors::read_metadata(&bytes).unwrap();
        let cases = &header.metadata().as_ref().unwrap()["cases"];
        let cases = serde_json::from_str(cases).unwrap();
        Self { bytes, cases }
    }

    pub fn cases(&self) -> impl Iterator<Item = Case<'_>> {
        let tensors = || SafeTensors::deserialize(&self.bytes).unwrap();
        self.cases.as_object().unwrap().iter().map(move |(name, case)| Case {
            name,
            about: &case["about"],
            case,
            tensors: tensors(),
        })
    }

    pub fn case<'a>(&'a self, name: &str) -> Case<'a> {
        self.cases().find(|case| case.name == name).unwrap()
    }

    /// Returns a tensor of f32, by its name in the file.
    pub fn f32s(&self, name: &str) -> Vec<f32> {
        let tensors = SafeTensors::deserialize(&self.bytes).unwrap();
        let bytes = tensors.tensor(name).unwrap().data().chunks_exact(4);
        bytes.map(|bytes| f32::from_le_bytes(bytes.try_into().unwrap())).collect()
    }

    /// Returns a tensor of bytes, by its name in the file.
    pub fn bytes(&self, name: &str) -> Vec<u8> {
        SafeTensors::deserialize(&self.bytes).unwrap().tensor(name).unwrap().data().to_vec()
    }

    /// Returns a tensor of f64, by its name in the file.
    pub fn f64s(&self, name: &str) -> Vec<f64> {
        let tensors = SafeTensors::deserialize(&self.bytes).unwrap();
        let bytes = tensors.tensor(name).unwrap().data().chunks_exact(8);
        bytes.map(|bytes| f64::from_le_bytes(bytes.try_into().unwrap())).collect()
    }
}

impl Case<'_> {
    pub fn number(&self, key: &str) -> usize {
        self.about[key].as_u64().unwrap() as usize
    }

    pub fn is(&self, key: &str) -> bool {
        self.about[key].as_bool().unwrap_or(false)
    }

    fn shape<const D: usize>(value: &Value) -> [usize; D] {
        let shape: Vec<usize> =
            value.as_array().unwrap().iter().map(|n| n.as_u64().unwrap() as usize).collect();
        shape.try_into().unwrap()
    }

    pub fn has_input(&self, name: &str) -> bool {
        !self.case["inputs"][name].is_null()
    }

    /// Returns the values of an input.
    pub fn values(&self, name: &str) -> Vec<f32> {
        let input = &self.case["inputs"][name];
        if let Some(values) = input["values"].as_array() {
            return values.iter().map(|value| value.as_f64().unwrap() as f32).collect();
        }
        let shape = input["shape"].as_array().unwrap();
        let shape: Vec<usize> = shape.iter().map(|n| n.as_u64().unwrap() as usize).collect();
        let (offset, scale) = (input["offset"].as_f64().unwrap(), input["scale"].as_f64().unwrap());
        let uniform = uniform(&format!("input.{name}"), shape.iter().product());
        let mut values: Vec<f32> =
            uniform.iter().map(|value| (offset + scale * value) as f32).collect();
        let part = values.len() / shape[0];
        for index in self.zeroed(name) {
            values[index * part..(index + 1) * part].fill(0.0);
        }
        values
    }

    /// Returns the indices of the first dimension where an input and its gradient are zero.
    fn zeroed(&self, name: &str) -> Vec<usize> {
        let zero = self.case["inputs"][name]["zero"].as_array();
        zero.into_iter().flatten().map(|n| n.as_u64().unwrap() as usize).collect()
    }

    pub fn input<const D: usize>(&self, name: &str, device: &Device) -> Tensor<D> {
        let shape: [usize; D] = Self::shape(&self.case["inputs"][name]["shape"]);
        Tensor::from_data(TensorData::new(self.values(name), shape), device)
    }

    pub fn has_parameter(&self, name: &str) -> bool {
        !self.case["parameters"][name].is_null()
    }

    pub fn parameter<const D: usize>(&self, name: &str, device: &Device) -> Tensor<D> {
        let shape: [usize; D] = Self::shape(&self.case["parameters"][name]);
        Tensor::from_data(TensorData::new(parameter(name, &shape), shape), device)
    }

    /// Returns the shape of a parameter.
    pub fn parameter_shape(&self, name: &str) -> Vec<usize> {
        let shape = self.case["parameters"][name].as_array().unwrap();
        shape.iter().map(|side| side.as_u64().unwrap() as usize).collect()
    }

    /// Returns true if the file has the gradient of an input or of a parameter.
    pub fn has_gradient(&self, name: &str) -> bool {
        ["grad", "cut"].iter().any(|kind| self.expected(&format!("{kind}.{name}")).is_some())
    }

    /// Returns the names of all parameters.
    pub fn parameters(&self) -> Vec<&str> {
        self.case["parameters"].as_object().unwrap().keys().map(String::as_str).collect()
    }

    /// Returns the factors of an output in the sum whose gradients the file holds.
    pub fn cotangent<const D: usize>(&self, output: &str, device: &Device) -> Tensor<D> {
        let shape: [usize; D] = Self::shape(&self.case["outputs"][output]);
        let values = uniform(&format!("cotangent.{output}"), shape.iter().product());
        let values: Vec<f32> = values.iter().map(|&value| value as f32).collect();
        Tensor::from_data(TensorData::new(values, shape), device)
    }

    /// Returns the factors of [`Self::cotangent`], flattened.
    pub fn flat_cotangent(&self, output: &str, device: &Device) -> Tensor<1> {
        let shape = self.case["outputs"][output].as_array().unwrap();
        let count = shape.iter().map(|side| side.as_u64().unwrap() as usize).product();
        let values = uniform(&format!("cotangent.{output}"), count);
        let values: Vec<f32> = values.iter().map(|&value| value as f32).collect();
        Tensor::from_data(TensorData::new(values, [count]), device)
    }

    pub fn expected(&self, name: &str) -> Option<Vec<f32>> {
        let tensor = self.tensors.tensor(&format!("{}/{name}", self.name)).ok()?;
        let bytes = tensor.data().chunks_exact(4);
        Some(bytes.map(|bytes| f32::from_le_bytes(bytes.try_into().unwrap())).collect())
    }

    /// Checks that an output equals the reference to 1e-4 of its largest value.
    pub fn check_output<const D: usize>(&self, name: &str, got: Tensor<D>) {
        let got = got.into_data().try_to_vec::<f32>().unwrap();
        self.close(&format!("output.{name}"), &got, 1e-4);
    }

    /// Checks that a gradient equals the reference to 1e-3 of its largest value.
    pub fn check_gradient<const D: usize>(&self, name: &str, got: Tensor<D>) {
        let mut got = got.into_data().try_to_vec::<f32>().unwrap();
        if self.has_input(name) {
            let first = self.case["inputs"][name]["shape"][0].as_u64().unwrap() as usize;
            let part = got.len() / first;
            for index in self.zeroed(name) {
                got[index * part..(index + 1) * part].fill(0.0);
            }
        }
        let key = format!("cut.{name}");
        let Some(expected) = self.expected(&key) else {
            return self.close(&format!("grad.{name}"), &got, 1e-3);
        };
        let norm = got.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt();
        let probe = uniform(&format!("probe.{name}"), got.len());
        let product: f64 = got.iter().zip(probe).map(|(&v, probe)| f64::from(v) * probe).sum();
        let place = format!("{}/{key}", self.name);
        if expected[0] == 0.0 {
            assert!(norm < 1e-6, "{place}: norm {norm}, reference 0");
            return;
        }
        let scale = f64::from(expected[0]);
        assert!((norm / scale - 1.0).abs() < 1e-3, "{place}: norm {norm}, reference {scale}");
        let off = (product - f64::from(expected[1])).abs() / scale;
        assert!(off < 1e-3, "{place}: product {product}, reference {}", expected[1]);
        for (i, (&got, &expected)) in got.iter().zip(&expected[2..]).enumerate() {
            let off = f64::from((got - expected).abs()) / scale;
            assert!(off < 1e-3, "{place}: value {i} is {got}, reference {expected}");
        }
    }

    /// Checks that `got` equals a tensor of the case, relative to its largest value.
    pub fn close(&self, name: &str, got: &[f32], tolerance: f32) {
        let place = format!("{}/{name}", self.name);
        let expected = self.expected(name).unwrap_or_else(|| panic!("{place} is not in the file"));
        assert_eq!(got.len(), expected.len(), "{place}: number of values");
        let scale = expected.iter().fold(1e-6f32, |scale, value| scale.max(value.abs()));
        for (i, (&got, &expected)) in got.iter().zip(&expected).enumerate() {
            let off = (got - expected).abs() / scale;
            assert!(off < tolerance, "{place}: value {i} is {got}, reference {expected}");
        }
    }
}

/// Returns numbers in [-1, 1) that depend on the name and the place alone (tests/golden/generate/uniform.py).
pub fn uniform(name: &str, count: usize) -> Vec<f64> {
    let key = u64::from(crc32fast::hash(name.as_bytes())) << 32;
    (0..count as u64)
        .map(|i| {
            let mut z = (key | i).wrapping_add(0x9E37_79B9_7F4A_7C15);
            z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
            z ^= z >> 31;
            (z >> 40) as f64 / f64::from(1 << 24) * 2.0 - 1.0
        })
        .collect()
}

/// Returns the values of a weight or bias.
pub fn parameter(name: &str, shape: &[usize]) -> Vec<f32> {
    let count = shape.iter().product();
    let (mut offset, mut scale) = (0.0, 0.1);
    if shape.len() >= 2 {
        scale = (3.0 / (count / shape[0]) as f64).sqrt();
        if name.starts_with("flow.levels.") && name.ends_with(".layers.4.weight") {
            scale *= 4.0;
        }
    } else if name.ends_with(".weight") {
        (offset, scale) = (1.0, 0.2);
    }
    uniform(name, count).iter().map(|value| (offset + scale * value) as f32).collect()
}

/// Draws Gaussian noise by Box and Muller.
pub fn gaussian(name: &str, count: usize) -> Vec<f32> {
    let uniform: Vec<f64> =
        uniform(name, 2 * count).iter().map(|v| f64::midpoint(*v, 1.0)).collect();
    let (a, b) = uniform.split_at(count);
    let pairs = a.iter().zip(b);
    let radius = |a: f64| (-2.0 * a.max(2f64.powi(-24)).ln()).sqrt();
    pairs.map(|(&a, &b)| (radius(a) * (std::f64::consts::TAU * b).cos()) as f32).collect()
}
