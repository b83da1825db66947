//! Parameters by name: initial values, and values from elsewhere.

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::{Tensor, TensorData};
use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};

/// Gives every parameter of `module` the values that `values` has for its name and shape.
pub fn fill<M: Module>(module: M, values: impl FnMut(&str, &[usize]) -> Vec<f32>) -> M {
    module.map(&mut Fill { path: Vec::new(), values })
}

/// Names and shapes of all parameters, in the order of the network.
pub fn parameters<M: Module>(module: &M) -> Vec<(String, Vec<usize>)> {
    let mut names = Names::default();
    module.visit(&mut names);
    names.list
}

struct Fill<F> {
    path: Vec<String>,
    values: F,
}

impl<F: FnMut(&str, &[usize]) -> Vec<f32>> ModuleMapper for Fill<F> {
    fn enter_module(&mut self, name: &str, _container: &str) {
        self.path.push(name.into());
    }

    fn exit_module(&mut self, _name: &str, _container: &str) {
        self.path.pop();
    }

    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let shape = param.lazy_shape();
        let values = (self.values)(&self.path.join("."), shape.as_slice());
        let data = TensorData::new(values, shape);
        let mut filled = Param::from_tensor(Tensor::from_data(data, &param.lazy_device()));
        filled.id = param.id; // optimizers know parameters by it
        filled
    }
}

#[derive(Default)]
struct Names {
    path: Vec<String>,
    list: Vec<(String, Vec<usize>)>,
}

impl ModuleVisitor for Names {
    fn enter_module(&mut self, name: &str, _container: &str) {
        self.path.push(name.into());
    }

    fn exit_module(&mut self, _name: &str, _container: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        self.list.push((self.path.join("."), param.lazy_shape().to_vec()));
    }
}

/// Initial values: uniform with the variance that keeps signals' size through a ReLU (He et al. 2015) or a plain
/// layer. The last layer of every residual branch starts at zero: so a deep network starts as its shortcuts.
pub(super) fn initial(seed: u64, name: &str, shape: &[usize]) -> Vec<f32> {
    let count: usize = shape.iter().product();
    if shape.len() == 1 {
        let is_norm = name.ends_with(".weight");
        return vec![if is_norm { 1.0 } else { 0.0 }; count];
    }
    let in_unet = name.starts_with("unet.");
    let last = [
        "conv2.weight",
        "project.weight",
        "unet.out.weight",
        "pre.out.weight",
        "trust.out.weight",
        "error.out.weight",
    ];
    let draft = name.starts_with("drafts.") && name.ends_with(".out.weight");
    if last.iter().any(|last| name.ends_with(last)) || name.ends_with("layers.4.weight") || draft {
        return vec![0.0; count];
    }
    let gain = if in_unet { 3.0 } else { 6.0 };
    let bound = (gain / (count / shape[0]) as f32).sqrt();
    // A stream of its own for every name: adding a layer leaves the others as they were.
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(name.bytes().fold(0xCBF2_9CE4_8422_2325, |hash: u64, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01B3) // FNV-1a
    }));
    (0..count).map(|_| random.random_range(-bound..bound)).collect()
}
