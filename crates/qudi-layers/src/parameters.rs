//! Named parameters: initial values, and values from files.

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param, ParamId};
use burn::tensor::{Device, Tensor, TensorData};

/// Creates a parameter of zeros that takes no memory until it is filled or used, because sizes may come from
/// an untrusted file.
pub fn zeros<const D: usize>(shape: [usize; D], device: &Device) -> Param<Tensor<D>> {
    let init = move |device: &Device, require_grad: bool| {
        Tensor::zeros(shape, device).set_require_grad(require_grad)
    };
    Param::uninitialized(ParamId::new(), init, device.clone(), true, shape.into())
}

/// Sets every parameter of `module` to the values that `values` returns for its name and shape.
pub fn init_parameters<M: Module>(module: M, values: impl FnMut(&str, &[usize]) -> Vec<f32>) -> M {
    module.map(&mut Initialize { path: Vec::new(), values })
}

/// Lists the names and shapes of all parameters, in the order of the network.
pub fn parameter_shapes<M: Module>(module: &M) -> Vec<(String, Vec<usize>)> {
    let mut names = Names::default();
    module.visit(&mut names);
    names.list
}

struct Initialize<F> {
    path: Vec<String>,
    values: F,
}

impl<F: FnMut(&str, &[usize]) -> Vec<f32>> ModuleMapper for Initialize<F> {
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
        let mut initialized = Param::from_tensor(Tensor::from_data(data, &param.lazy_device()));
        initialized.id = param.id; // optimizers know parameters by it
        initialized
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
