//! Operations and blocks that are easy to get nearly right.

use super::{check_parameters, devices, none, sum};
use crate::cases::{Case, File, parameter};
use crate::flornn::{correlation, splat_average};
use crate::parts::{
    Corners, charbonnier, deform_conv, dense_blocks_renamed, gradient_loss, masked_warp, quarter,
    resize, warp_zeros,
};
use crate::quiver::alignment::GatedFusion;
use crate::quiver::reconstructor::Reconstructor;
use burn::tensor::{Device, Tensor};
use qudi_kernels::warp;
use qudi_layers::{DenseBlock, init_parameters};

type Warp = fn(Tensor<4>, Tensor<4>) -> Tensor<4>;
type Loss = fn(Tensor<4>, Tensor<4>) -> Tensor<1>;
type Inputs<'a> = [(&'a str, &'a Tensor<4>)];

/// Checks an output, and the gradients of inputs.
fn check(case: &Case<'_>, output: Tensor<4>, inputs: &Inputs<'_>) {
    let gradients = sum(case, &[("y", output)]).backward();
    for (name, input) in inputs {
        case.check_gradient(name, input.grad(&gradients).unwrap());
    }
}

#[test]
fn operations_match_pytorch() {
    let file = File::open("learned/parts");
    for device in devices() {
        let input = |case: &str, name: &str| -> Tensor<4> {
            file.case(case).input(name, &device).require_grad()
        };
        let case = file.case("deform_conv");
        let [x, offset, mask] = ["x", "offset", "mask"].map(|name| input("deform_conv", name));
        let weight: Tensor<4> = case.parameter("weight", &device);
        let bias: Tensor<1> = case.parameter("bias", &device);
        let y = deform_conv(x.clone(), offset.clone(), mask.clone(), weight, bias);
        check(&case, y, &[("x", &x), ("offset", &offset), ("mask", &mask)]);

        let warps: [(&str, Warp, bool); 4] = [
            ("warp_zeros", warp_zeros, true),
            ("warp_border", warp, true),
            ("warp_masked", masked_warp, false),
            ("splat", splat_average, false),
        ];
        for (name, warp, moves) in warps {
            let (x, flow) = (input(name, "x"), input(name, "flow"));
            let inputs: &Inputs<'_> = &[("x", &x), ("flow", &flow)];
            let y = warp(x.clone(), flow.clone());
            check(&file.case(name), y, &inputs[..=usize::from(moves)]);
        }

        let (first, second) = (input("correlation", "first"), input("correlation", "second"));
        let y = correlation(first.clone(), second.clone());
        check(&file.case("correlation"), y, &[("first", &first), ("second", &second)]);

        let sizes = [
            ("up2_corner", [8, 12], Corners::Centres),
            ("up2_edge", [8, 12], Corners::Edges),
            ("resize", [7, 11], Corners::Edges),
            ("resize_less", [3, 5], Corners::Edges),
            ("reduce_2", [4, 6], Corners::Edges),
            ("reduce_4", [2, 3], Corners::Edges),
        ];
        for (name, size, corners) in sizes {
            let x = input(name, "x");
            check(&file.case(name), resize(x.clone(), size, corners), &[("x", &x)]);
        }
        let x = input("bicubic", "x");
        check(&file.case("bicubic"), quarter(x.clone()), &[("x", &x)]);

        let losses: [(&str, Loss); 2] =
            [("gradient_loss", gradient_loss), ("charbonnier", charbonnier)];
        for (name, loss) in losses {
            let case = file.case(name);
            let x = input(name, "x");
            let value = loss(x.clone(), case.input("truth", &device));
            case.check_output("loss", value.clone());
            case.check_gradient("x", x.grad(&value.backward()).unwrap());
        }
    }
}

/// Values at which another form of GELU shows.
#[test]
fn blocks_with_gelu_match_pytorch() {
    let file = File::open("learned/blocks");
    let device = Device::flex().autodiff();
    let wide = |case: &Case<'_>| -> Tensor<4> { case.input("x", &device).require_grad() };

    let case = file.case("dense");
    let dense = DenseBlock::zeros(6, 4, &device);
    let dense = init_parameters(dense, |ours, shape| parameter(&dense_blocks_renamed(ours), shape));
    let x = wide(&case);
    let gradients = sum(&case, &[("y", dense.forward_gelu(x.clone()))]).backward();
    case.check_gradient("x", x.grad(&gradients).unwrap());
    check_parameters(&case, &gradients, &dense, &dense_blocks_renamed, none);

    let case = file.case("gated");
    let gated = init_parameters(GatedFusion::zeros(3, &device), parameter);
    let x = wide(&case);
    let gradients = sum(&case, &[("y", gated.forward(x.clone()))]).backward();
    case.check_gradient("x", x.grad(&gradients).unwrap());
    check_parameters(&case, &gradients, &gated, &str::to_owned, none);

    let case = file.case("reconstruct");
    let name = |ours: &str| {
        let full = Reconstructor::authors_name(&format!("recons3.{ours}"));
        full["recons3.".len()..].to_owned()
    };
    let reconstructor = Reconstructor::zeros(4, &device);
    let reconstructor = init_parameters(reconstructor, |ours, shape| parameter(&name(ours), shape));
    let [h, f, image] =
        ["h", "f", "image"].map(|name| -> Tensor<4> { case.input(name, &device).require_grad() });
    let (y, features, next) = reconstructor.forward(h.clone(), f.clone(), image.clone());
    let outputs = [("image", y), ("f", features), ("next", next)];
    let gradients = sum(&case, &outputs).backward();
    for (name, input) in [("h", &h), ("f", &f), ("image", &image)] {
        case.check_gradient(name, input.grad(&gradients).unwrap());
    }
    check_parameters(&case, &gradients, &reconstructor, &name, none);
}
