//! The optimizers take the steps of Burn's own.
#![allow(clippy::unwrap_used)]

use burn::module::{Module, Param};
use burn::optim::{AdamConfig, AdjustLrFn, GradientsParams, ModuleOptimizer, MuonConfig};
use burn::tensor::{Device, Tensor};
use qudi_train::{Optimizer, OptimizerKind};

#[derive(Module, Debug)]
struct Values<const D: usize> {
    values: Param<Tensor<D>>,
}

/// Returns the largest difference after twenty steps towards a target, with our optimizer and with theirs.
fn apart<const D: usize>(
    kind: OptimizerKind,
    mut theirs: ModuleOptimizer,
    shape: [usize; D],
) -> f32 {
    let count = shape.iter().product::<usize>();
    let waves =
        |frequency: f32| -> Vec<f32> { (0..count).map(|i| (i as f32 * frequency).sin()).collect() };
    let tensor = |values: Vec<f32>, device: &Device| {
        Tensor::<1>::from_floats(values.as_slice(), device).reshape(shape)
    };
    let device = Device::flex().autodiff();
    let target: Tensor<D> = tensor(waves(1.3), &device);
    let mut module = Values { values: Param::from_tensor(tensor(waves(0.7), &device)) };
    let flat = |tensor: Tensor<D>| tensor.reshape([count]);
    let goal = flat(target.clone()).inner();
    let mut list = vec![Tensor::<1>::from_floats(waves(0.7).as_slice(), &Device::flex())];
    let mut ours = Optimizer::new(kind, &list, [("layer", shape.as_slice())], |_| false);
    for step in 0..20 {
        let lr = 0.05 / f64::from(step + 1);
        let loss = (module.values.val() - target.clone()).powi_scalar(2).sum();
        let gradients = GradientsParams::from_grads(loss.backward(), &module);
        let gradient = (list[0].clone() - goal.clone()) * 2.0;
        let scale = Tensor::from_floats([0.25], &Device::flex());
        list = ours.step(list, &[gradient * 4.0], &scale, lr);
        module = theirs.step(lr, module, gradients);
    }
    let ours = list.remove(0).into_data().try_into_vec::<f32>().unwrap();
    let theirs = flat(module.values.val()).into_data().try_into_vec::<f32>().unwrap();
    assert!(ours.iter().zip(waves(0.7)).any(|(a, b)| (a - b).abs() > 0.02), "nothing has moved");
    ours.iter().zip(&theirs).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

#[test]
fn adam_matches_burn() {
    let off = apart(OptimizerKind::Adam, AdamConfig::new().with_epsilon(1e-8).init(), [50]);
    assert!(off < 2e-6, "{off}");
}

#[test]
fn muon_matches_burn() {
    for shape in [[6, 11], [11, 6]] {
        let theirs = MuonConfig::new().with_adjust_lr_fn(AdjustLrFn::MatchRmsAdamW);
        let off = apart(OptimizerKind::Muon, theirs.init(), shape);
        assert!(off < 2e-5, "{shape:?}: {off}");
    }
}

/// Biases have no orthogonal steps: they take Adam's; and a layer without gradient no longer changes, also
/// where the mean of gradients that it had before is so small that its square is zero.
#[test]
fn muon_moves_matrices_alone() {
    let off = apart(OptimizerKind::Muon, AdamConfig::new().with_epsilon(1e-8).init(), [50]);
    assert!(off < 2e-6, "{off}");
    let list = vec![Tensor::<1>::ones([12], &Device::flex())];
    let mut optimizer =
        Optimizer::new(OptimizerKind::Muon, &list, [("layer", [3, 2, 2].as_slice())], |_| false);
    for mean in [0.0, 1e-23] {
        optimizer.mean = vec![Tensor::full([12], mean, &Device::flex())];
        let still: Vec<_> = list.iter().map(Tensor::zeros_like).collect();
        let one = Tensor::ones([1], &Device::flex());
        let moved = optimizer.step(list.clone(), &still, &one, 0.1).remove(0).into_data();
        assert_eq!(moved.try_into_vec::<f32>().unwrap(), [1.0; 12]);
    }
}
