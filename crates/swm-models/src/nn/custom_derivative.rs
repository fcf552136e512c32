//! [`with_derivative`]: a function with an explicit derivative.

use burn::tensor::Tensor;

/// Returns `value` as a function of `x` whose elementwise derivative is `derivative`; both are outside of any graph.
///
/// The difference that is added to the value is exactly 0, and its gradient is the derivative times the incoming
/// gradient. The graph then holds one product, whatever the function.
///
/// # Shapes
/// All tensors have the same shape.
pub fn with_derivative<const D: usize>(x: Tensor<D>, value: Tensor<D>, derivative: Tensor<D>) -> Tensor<D> {
    let zero = x.clone() - x.inner().autodiff();
    zero * derivative.autodiff() + value.autodiff()
}
