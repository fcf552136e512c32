//! [`with_derivative`]: a function with an explicit derivative.

use burn::tensor::Tensor;

/// Returns `value` with the elementwise derivative `derivative` with respect to `x`; both are detached tensors.
///
/// Computes `(x - detach(x)) * derivative + value`. The first term is exactly 0 and carries the gradient, so the graph
/// contains one product for any function.
///
/// # Shapes
/// All tensors have the same shape.
pub fn with_derivative<const D: usize>(x: Tensor<D>, value: Tensor<D>, derivative: Tensor<D>) -> Tensor<D> {
    let zero = x.clone() - x.inner().autodiff();
    zero * derivative.autodiff() + value.autodiff()
}
