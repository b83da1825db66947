//! Weights and gradients as flat lists, in the order of the network.

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::{Gradients, Tensor};

/// Returns the values of all parameters, `[values]` each, outside autodiff.
pub fn parameters<M: Module>(network: &M) -> Vec<Tensor<1>> {
    let mut collect = Collect { gradients: None, list: Vec::new() };
    network.visit(&mut collect);
    collect.list
}

/// Returns the gradients for all parameters, `[values]` each; zero for parameters that the loss does not
/// depend on.
pub fn gradients<M: Module>(network: &M, gradients: &Gradients) -> Vec<Tensor<1>> {
    let mut collect = Collect { gradients: Some(gradients), list: Vec::new() };
    network.visit(&mut collect);
    collect.list
}

/// Returns the network with other values, in the order and with the sizes of [`parameters`].
#[must_use]
pub fn with_parameters<M: Module>(network: M, values: Vec<Tensor<1>>) -> M {
    network.map(&mut Replace { values: values.into_iter() })
}

/// Returns the network with gradients for only the parameters that learn, in the order of [`parameters`].
pub(super) fn with_frozen<M: Module>(network: M, learns: &[bool]) -> M {
    network.map(&mut Freeze { learns: learns.iter() })
}

struct Freeze<'a> {
    learns: std::slice::Iter<'a, bool>,
}

impl ModuleMapper for Freeze<'_> {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let learns = self.learns.next().expect("one answer for every parameter");
        param.set_require_grad(*learns)
    }
}

struct Collect<'a> {
    gradients: Option<&'a Gradients>,
    list: Vec<Tensor<1>>,
}

impl ModuleVisitor for Collect<'_> {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let value = param.val();
        let wanted = match self.gradients {
            None => value.inner(),
            Some(gradients) => value.grad(gradients).unwrap_or_else(|| value.inner().zeros_like()),
        };
        self.list.push(wanted.flatten(0, D - 1));
    }
}

struct Replace {
    values: std::vec::IntoIter<Tensor<1>>,
}

impl ModuleMapper for Replace {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let (id, old, mapper) = param.consume();
        let new = self.values.next().expect("one list of values for every parameter");
        let new = new.reshape(old.shape());
        let new = if old.is_require_grad() { Tensor::from_inner(new).require_grad() } else { new };
        Param::from_mapped_value(id, new, mapper)
    }
}
