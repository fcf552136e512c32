//! Weights of others: read from safetensors and PyTorch files and from the Hugging Face hub, written for PyTorch.
//!
//! - [`read`] a file of any of these kinds: `.safetensors`, `.pt`, `.pth`, `.bin`, `.ckpt`.
//! - [`fetch`] a file of the Hugging Face hub, or [`locate`] the weights of one of its repositories.
//! - [`torch::write`] a state dict that `torch.load(weights_only=True)` reads.
//! - [`names`]: what a vision transformer's weights are called by the versions of `transformers`.
//! - [`fill`] a module, naming whatever does not fit.
//!
//! Nothing in a file is ever executed: of pickles, only what describes tensors is understood.

pub mod hub;
pub(crate) mod keys;
pub mod names;
pub(crate) mod reference;
pub mod torch;

pub use hub::{fetch, locate};
pub use names::Naming;
pub(crate) use torch::BATCHES_TRACKED;

use crate::nn::parameters::{self, HostTensor, Named};
use burn::module::Module;
use half::{bf16, f16};
use pytorch_reader::{DType as Torch, PytorchError, PytorchReader};
use safetensors::{Dtype, SafeTensors};
use std::path::Path;
use swm_core::{Error, Result};

/// The tensors of a file, in single precision; half precision is widened, integers and doubles are converted.
///
/// Of a training checkpoint that keeps weights under `state_dict`, only those are returned.
///
/// # Errors
/// When the file cannot be read, is of another kind or damaged, or holds what is no tensor of real numbers.
pub fn read(path: &Path) -> Result<Named<HostTensor>> {
    let tensors = match path.extension().and_then(|end| end.to_str()) {
        Some("safetensors") => safetensors(path)?,
        Some("pt" | "pth" | "bin" | "ckpt") => pickled(path)?,
        _ => {
            let fix = "give a .safetensors, .pt, .pth, .bin or .ckpt file";
            return Err(Error::corrupt(path, "is no file of weights by its name", fix));
        }
    };
    let nested: Named<HostTensor> = tensors
        .iter()
        .filter_map(|(name, tensor)| Some((name.strip_prefix("state_dict.")?.to_owned(), tensor.clone())))
        .collect();
    Ok(if nested.is_empty() { tensors } else { nested })
}

/// The tensors of a safetensors file.
fn safetensors(path: &Path) -> Result<Named<HostTensor>> {
    let bytes = std::fs::read(path).map_err(|error| Error::io(path, "reading weights", error))?;
    let file = SafeTensors::deserialize(&bytes).map_err(|error| damaged(path, error.to_string()))?;
    file.iter()
        .map(|(name, view)| {
            let kind = match view.dtype() {
                Dtype::F64 => Torch::F64,
                Dtype::F32 => Torch::F32,
                Dtype::F16 => Torch::F16,
                Dtype::BF16 => Torch::BF16,
                Dtype::I64 => Torch::I64,
                Dtype::I32 => Torch::I32,
                Dtype::I16 => Torch::I16,
                Dtype::I8 => Torch::I8,
                Dtype::U8 => Torch::U8,
                Dtype::BOOL => Torch::Bool,
                other => return Err(damaged(path, format!("'{name}' holds {other:?}"))),
            };
            Ok((name.to_owned(), HostTensor { shape: view.shape().to_vec(), values: widen(kind, view.data()) }))
        })
        .collect()
}

/// The tensors of a file that `torch.save` wrote.
fn pickled(path: &Path) -> Result<Named<HostTensor>> {
    let reader = PytorchReader::new(path).map_err(|error| match error {
        PytorchError::Io(error) if error.kind() != std::io::ErrorKind::InvalidData => {
            Error::io(path, "reading weights", error)
        }
        other => damaged(path, other.to_string()),
    })?;
    reader
        .into_tensors()
        .into_iter()
        .map(|(name, tensor)| {
            let bytes = tensor.read().map_err(|error| damaged(path, error.to_string()))?;
            Ok((name, HostTensor { shape: tensor.shape().to_vec(), values: widen(tensor.dtype(), &bytes) }))
        })
        .collect()
}

/// Little-endian numbers of a kind in single precision.
#[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
fn widen(kind: Torch, bytes: &[u8]) -> Vec<f32> {
    fn each<const N: usize>(bytes: &[u8], number: impl Fn([u8; N]) -> f32) -> Vec<f32> {
        bytes.as_chunks::<N>().0.iter().map(|chunk| number(*chunk)).collect()
    }
    match kind {
        Torch::F64 => each(bytes, |b| f64::from_le_bytes(b) as f32),
        Torch::F32 => each(bytes, f32::from_le_bytes),
        Torch::F16 => each(bytes, |b| f16::from_le_bytes(b).to_f32()),
        Torch::BF16 => each(bytes, |b| bf16::from_le_bytes(b).to_f32()),
        Torch::I64 => each(bytes, |b| i64::from_le_bytes(b) as f32),
        Torch::I32 => each(bytes, |b| i32::from_le_bytes(b) as f32),
        Torch::I16 => each(bytes, |b| f32::from(i16::from_le_bytes(b))),
        Torch::I8 => each(bytes, |b| f32::from(i8::from_le_bytes(b))),
        Torch::U64 => each(bytes, |b| u64::from_le_bytes(b) as f32),
        Torch::U32 => each(bytes, |b| u32::from_le_bytes(b) as f32),
        Torch::U16 => each(bytes, |b| f32::from(u16::from_le_bytes(b))),
        Torch::U8 | Torch::Bool => each(bytes, |[b]| f32::from(b)),
    }
}

fn damaged(path: &Path, problem: String) -> Error {
    Error::corrupt(path, problem, "save the state dict again, as safetensors or with torch.save")
}

/// A module with weights in place of its own: each of its parameters and buffers must be there, in its shape, and
/// nothing else. `what` says what the module is, such as "the model of config.json".
///
/// # Errors
/// Naming the first weight that is missing, of another shape, or not of the module.
pub fn fill<M: Module>(module: M, weights: &Named<HostTensor>, path: &Path, what: &str) -> Result<M> {
    let wanted = parameters::shapes(&module);
    let wrong = |problem: String| Err(Error::corrupt(path, problem, format!("give the weights of {what}")));
    for (name, shape) in &wanted {
        match weights.get(name) {
            Some(tensor) if &tensor.shape == shape => {}
            Some(tensor) => return wrong(format!("'{name}' is {:?}, but {what} makes it {shape:?}", tensor.shape)),
            None => return wrong(format!("'{name}' is missing, which {what} asks for")),
        }
    }
    match weights.keys().find(|name| !wanted.contains_key(*name)) {
        Some(name) => wrong(format!("'{name}' is no weight of {what}")),
        None => Ok(parameters::load(module, weights)),
    }
}
