//! Single-precision tensors as the bytes of a safetensors file.

use crate::nn::parameters::{HostTensor, Named};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use swm_core::{Error, Result};

/// Encodes tensors as a safetensors file.
///
/// # Errors
/// When the size of a tensor does not fit its shape.
pub(crate) fn encode(tensors: &Named<HostTensor>) -> Result<Vec<u8>> {
    let failed = |error| Error::external("writing safetensors", error);
    let bytes: Vec<(&String, Vec<usize>, Vec<u8>)> = tensors
        .iter()
        .map(|(name, t)| (name, t.shape.clone(), t.values.iter().flat_map(|v| v.to_le_bytes()).collect()))
        .collect();
    let views: Result<Vec<(&String, TensorView<'_>)>> = bytes
        .iter()
        .map(|(name, shape, bytes)| Ok((*name, TensorView::new(Dtype::F32, shape.clone(), bytes).map_err(failed)?)))
        .collect();
    safetensors::serialize(views?, None).map_err(failed)
}

/// Reads the tensors of a safetensors file.
///
/// # Errors
/// The problem, if the file is damaged, or a tensor holds elements of another type or values that are not finite.
pub(crate) fn decode(bytes: &[u8]) -> Result<Named<HostTensor>, String> {
    let tensors = SafeTensors::deserialize(bytes).map_err(|error| format!("is damaged ({error})"))?;
    tensors
        .iter()
        .map(|(name, view)| {
            if view.dtype() != Dtype::F32 {
                return Err(format!("'{name}' holds {:?} elements instead of single precision (F32)", view.dtype()));
            }
            let values: Vec<f32> = view.data().as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
            check_finite(name, &values)?;
            Ok((name.to_owned(), HostTensor { shape: view.shape().to_vec(), values }))
        })
        .collect()
}

/// Checks that the values of a tensor are finite.
///
/// # Errors
/// The problem, if a value is infinite or NaN.
pub(crate) fn check_finite(name: &str, values: &[f32]) -> Result<(), String> {
    match values.iter().find(|value| !value.is_finite()) {
        Some(value) => Err(format!("'{name}' holds the value {value}, which is not finite")),
        None => Ok(()),
    }
}
