//! Steps along orthogonal matrices (Muon; Jordan et al. 2024): every singular direction of a layer's weights
//! moves by as much as every other, also those whose gradients are small.

use burn::tensor::Tensor;

/// The share of the running mean of gradients that a step keeps.
pub(super) const MOMENTUM: f64 = 0.95;

/// Coefficients of the Newton-Schulz iteration, and its number of rounds, by Jordan et al. 2024.
const NEWTON_SCHULZ: [f64; 3] = [3.4445, -4.7750, 2.0315];
const ROUNDS: usize = 5;

/// The root mean square of a step at a learning rate of 1: about as large as with Adam (Liu et al. 2025,
/// section 2.2).
const STEP: f64 = 0.2;

/// Rows and columns of the weights of a layer as a matrix, outputs by inputs; nothing for biases and scales.
pub(super) fn matrix(shape: &[usize]) -> Option<[usize; 2]> {
    let (&rows, others) = shape.split_first()?;
    let columns: usize = others.iter().product();
    (rows > 1 && columns > 1).then_some([rows, columns])
}

/// Returns the steps at a learning rate of 1 for `count` matrices with these rows and columns.
///
/// # Shapes
/// - momentum: `[count * rows * columns]`
/// - output: the same
pub(super) fn step(momentum: Tensor<1>, count: usize, [rows, columns]: [usize; 2]) -> Tensor<1> {
    let matrices = momentum.reshape([count, rows, columns]);
    let is_tall = rows > columns;
    let wide = if is_tall { matrices.swap_dims(1, 2) } else { matrices };
    let size = STEP * (rows.max(columns) as f64).sqrt();
    let orthogonal = orthogonalized(wide) * size;
    let matrices = if is_tall { orthogonal.swap_dims(1, 2) } else { orthogonal };
    matrices.reshape([count * rows * columns])
}

/// Lower bound of the norm. Without gradient the mean of a layer shrinks until its squares are zero in 32
/// bits; the bound prevents a division by zero, and the layer no longer changes.
const LEAST_NORM: f32 = 1e-7;

/// Returns the matrices, `[count, rows, columns]`, with singular values between about 0.7 and 1.2; zeros stay
/// zeros.
///
/// Every round multiplies `x` by a polynomial of `x x^T`. Rows are few and columns many, so that the rounds
/// multiply the square matrices alone, and their product is applied to `x` once.
fn orthogonalized(matrices: Tensor<3>) -> Tensor<3> {
    let squares = matrices.clone().powi_scalar(2).sum_dim(2).sum_dim(1);
    let x = matrices / squares.sqrt().clamp_min(LEAST_NORM);
    let [_, rows, _] = x.dims();
    let [a, b, c] = NEWTON_SCHULZ;
    let identity = Tensor::<2>::eye(rows, &x.device()).unsqueeze::<3>() * a;
    let mut gram = x.clone().matmul(x.clone().swap_dims(1, 2));
    let mut product: Option<Tensor<3>> = None;
    for round in 1..=ROUNDS {
        let square = gram.clone().matmul(gram.clone());
        let polynomial = gram.clone() * b + square * c + identity.clone();
        if round < ROUNDS {
            // All of them are functions of one matrix, and commute.
            gram = polynomial.clone().matmul(polynomial.clone()).matmul(gram);
        }
        product = Some(match product {
            None => polynomial,
            Some(product) => polynomial.matmul(product),
        });
    }
    product.expect("at least one round").matmul(x)
}
