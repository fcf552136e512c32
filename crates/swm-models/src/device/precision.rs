//! The precision of matrix products on a GPU. Weights, sums and everything else stay in single precision.

use super::is_cpu;
use burn::tensor::{FloatDType, Tensor};
use std::fmt;
use std::sync::OnceLock;
use swm_core::{Error, Result};

/// The precision of the factors of matrix products.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Precision {
    /// 32 bits, as on the CPU. A GPU's matrix unit may round factors to 19 bits (TF32).
    #[default]
    Single,
    /// Bfloat16: 8 bits of precision, and the range of single precision.
    Bf16,
    /// Half precision: 11 bits of precision, up to 65504.
    F16,
}

/// The precision of this process on GPUs.
static CHOSEN: OnceLock<Precision> = OnceLock::new();

impl Precision {
    const ALL: [(Self, &'static str); 3] = [(Self::Single, "f32"), (Self::Bf16, "bf16"), (Self::F16, "f16")];

    /// The names that `--device` takes after a comma.
    pub(super) fn names() -> Vec<&'static str> {
        Self::ALL.iter().map(|(_, name)| *name).collect()
    }

    pub(super) fn parse(text: &str) -> Option<Self> {
        Self::ALL.iter().find(|(_, name)| *name == text).map(|(precision, _)| *precision)
    }

    /// Makes this the precision of the process.
    ///
    /// # Errors
    /// When the process computes in another precision already: open models would compute in both.
    pub(super) fn choose(self) -> Result<()> {
        let chosen = *CHOSEN.get_or_init(|| self);
        if chosen == self {
            return Ok(());
        }
        let problem = format!("{self}, and this process computes in {chosen}");
        Err(Error::config("the precision of the GPU", problem, format!("pass {chosen}, or start another process")))
    }

    /// The precision of matrix products on GPUs in this process.
    pub fn chosen() -> Self {
        CHOSEN.get().copied().unwrap_or_default()
    }

    /// Converts a factor of a matrix product to this precision.
    ///
    /// # Shapes
    /// Maps `[…]` to the same shape.
    pub fn lower<const D: usize>(self, x: Tensor<D>) -> Tensor<D> {
        match self {
            Self::Single => x,
            Self::Bf16 => x.cast(FloatDType::BF16),
            Self::F16 => x.cast(FloatDType::F16),
        }
    }

    /// Converts a product to single precision.
    ///
    /// # Shapes
    /// Maps `[…]` to the same shape.
    pub fn raise<const D: usize>(self, x: Tensor<D>) -> Tensor<D> {
        match self {
            Self::Single => x,
            Self::Bf16 | Self::F16 => x.cast(FloatDType::F32),
        }
    }
}

impl fmt::Display for Precision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(Self::ALL[*self as usize].1)
    }
}

/// Multiplies matrices in the precision of the process; the product is in single precision. The CPU multiplies in single
/// precision.
///
/// # Shapes
/// `[…, m, k]` and `[…, k, n]` give `[…, m, n]`.
pub(crate) fn matmul<const D: usize>(a: Tensor<D>, b: Tensor<D>) -> Tensor<D> {
    let precision = Precision::chosen();
    if precision == Precision::Single || is_cpu(&a.device()) {
        return a.matmul(b);
    }
    precision.raise(precision.lower(a).matmul(precision.lower(b)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;

    #[test]
    fn names_and_precisions_correspond() {
        for (index, (precision, name)) in Precision::ALL.into_iter().enumerate() {
            assert_eq!((precision as usize, Precision::parse(name)), (index, Some(precision)));
            assert_eq!(precision.to_string(), name);
        }
        assert_eq!((Precision::parse("f64"), Precision::chosen()), (None, Precision::Single));
    }

    #[test]
    fn factors_have_the_precision_and_products_are_single() {
        let x = Tensor::<2>::from_floats([[1.0, 1.001], [0.1, 3.0]], &Device::flex());
        let values = |x: Tensor<2>| x.into_data().iter::<f32>().collect::<Vec<_>>();
        let there_and_back = |precision: Precision| values(precision.raise(precision.lower(x.clone())));
        assert_eq!(there_and_back(Precision::Single), values(x.clone()));
        // 8 and 11 bits of precision: 1.001 is nearest to 1, and to 1 + 2^-10.
        assert_eq!(there_and_back(Precision::Bf16)[..2], [1.0, 1.0]);
        assert_eq!(there_and_back(Precision::F16)[..2], [1.0, 1.0 + 1.0 / 1024.0]);
        assert_eq!(values(matmul(x.clone(), x.clone())), values(x.clone().matmul(x)));
    }
}
