//! Pretrained weights: read from safetensors and PyTorch files and from the Hugging Face hub, and written for PyTorch.
//!
//! - [`read`]: the tensors of a `.safetensors`, `.pt`, `.pth`, `.bin` or `.ckpt` file.
//! - [`fetch`]: downloads a file of the Hugging Face hub. [`locate`]: finds a local file of weights or downloads the
//!   weights of a repository.
//! - [`torch::write`]: a state dict that `torch.load(weights_only=True)` reads.
//! - [`names`]: the names of a vision transformer's weights in versions of the Python package `transformers`.
//! - [`encoder::fill`]: replaces the weights of an encoder by those of another model's encoder.
//! - [`fill`]: replaces the weights of a module and reports weights that do not fit.
//!
//! Pickles are never executed: the reader accepts only the operations that describe tensors.

pub(crate) mod encoder;
pub mod hub;
pub(crate) mod keys;
pub mod names;
mod negative;
pub(crate) mod reference;
pub mod torch;

pub use hub::{fetch, locate};
pub use names::Naming;
pub(crate) use torch::BATCHES_TRACKED;

use crate::nn::parameters::{self, HostTensor, Named};
use burn::module::Module;
use half::{bf16, f16};
use pytorch_reader::{DType as Torch, PickleValue, PytorchError, PytorchReader};
use safetensors::{Dtype, SafeTensors};
use std::collections::{HashMap, HashSet};
use std::path::Path;
use swm_core::{Error, Result, files};

/// Reads the tensors of a file in single precision; half precision is widened, integers and doubles are converted.
///
/// For a training checkpoint with weights under `state_dict`, returns those weights only.
///
/// # Errors
/// When the file cannot be read, has another format, is damaged, or holds an object that is not a tensor of finite real
/// values.
pub fn read(path: &Path) -> Result<Named<HostTensor>> {
    let tensors = match path.extension().and_then(|end| end.to_str()) {
        Some("safetensors") => safetensors(path)?,
        Some("pt" | "pth" | "bin" | "ckpt") => pickled(path)?,
        _ => {
            let fix = "give a .safetensors, .pt, .pth, .bin or .ckpt file";
            return Err(Error::corrupt(path, "does not have the extension of a file of weights", fix));
        }
    };
    let nested: Named<HostTensor> = tensors
        .iter()
        .filter_map(|(name, tensor)| Some((name.strip_prefix("state_dict.")?.to_owned(), tensor.clone())))
        .collect();
    let tensors = if nested.is_empty() { tensors } else { nested };
    match tensors.iter().find(|(_, tensor)| !tensor.values.iter().all(|value| value.is_finite())) {
        Some((name, _)) => Err(Error::corrupt(
            path,
            format!("'{name}' has values that are not finite"),
            "give weights of a training that did not diverge",
        )),
        None => Ok(tensors),
    }
}

/// The tensors of a safetensors file.
fn safetensors(path: &Path) -> Result<Named<HostTensor>> {
    let bytes = files::read(path, u64::MAX)?;
    let file = SafeTensors::deserialize(&bytes).map_err(|error| damaged(path, error.to_string()))?;
    file.iter()
        .map(|(name, view)| {
            let dtype = match view.dtype() {
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
                other => return Err(damaged(path, format!("'{name}' has the type {other:?}, which is not supported"))),
            };
            Ok((name.to_owned(), HostTensor { shape: view.shape().to_vec(), values: widen(dtype, view.data()) }))
        })
        .collect()
}

/// How much larger than their file the tensors of a PyTorch file may be, for tensors that share their elements.
const LARGEST_EXPANSION: u64 = 8;

/// The tensors of a file that `torch.save` wrote.
fn pickled(path: &Path) -> Result<Named<HostTensor>> {
    let length = files::open(path)?.metadata().map_err(|error| Error::io(path, "reading weights", error))?.len();
    let reader = PytorchReader::new(path).map_err(|error| match error {
        PytorchError::Io(error) if error.kind() != std::io::ErrorKind::InvalidData => {
            Error::io(path, "reading weights", error)
        }
        other => damaged(path, other.to_string()),
    })?;
    if negative::any(path)? {
        let problem = "it has a tensor with the negative bit, whose values have the opposite sign";
        return Err(Error::corrupt(path, problem, "call `resolve_neg()` on its tensors and save them again"));
    }
    let entries = PytorchReader::read_pickle_data(path, None).map_err(|error| damaged(path, error.to_string()))?;
    if let Some(name) = doubled(&entries, reader.tensors()) {
        let problem =
            format!("it has two entries of the name '{name}', of nested dictionaries and of a name with dots");
        return Err(Error::corrupt(path, problem, "remove one of the two, and save the file again"));
    }
    // A tensor can repeat the elements of its storage, so its shape alone does not limit its size.
    let mut left = length.saturating_mul(LARGEST_EXPANSION).saturating_add(1 << 20);
    reader
        .into_tensors()
        .into_iter()
        .map(|(name, tensor)| {
            left = left.checked_sub(tensor.byte_len() as u64).ok_or_else(|| {
                damaged(path, format!("its tensors are more than {LARGEST_EXPANSION} times larger than the file"))
            })?;
            let bytes = tensor.read().map_err(|error| damaged(path, error.to_string()))?;
            Ok((name, HostTensor { shape: tensor.shape().to_vec(), values: widen(tensor.dtype(), &bytes) }))
        })
        .collect()
}

/// Returns the name of a tensor, its keys joined with dots, that is the name of another tensor as well.
fn doubled<T>(entries: &PickleValue, tensors: &HashMap<String, T>) -> Option<String> {
    /// The tensors, those that were seen, and the length of the longest name.
    struct Names<'a, T>(&'a HashMap<String, T>, HashSet<String>, usize);

    impl<T> Names<'_, T> {
        /// Returns the name that an entry below `name`, or one of those in it, has in common with an earlier tensor.
        fn repeated(&mut self, entry: &PickleValue, key: &str, name: &mut String) -> Option<String> {
            let length = name.len();
            // Names that are too long for a tensor are not written.
            if length + key.len() > self.2 {
                return None;
            }
            if !name.is_empty() {
                name.push('.');
            }
            name.push_str(key);
            let found = match entry {
                PickleValue::Dict(_) | PickleValue::List(_) => self.repeated_in(entry, name),
                _ => (self.0.contains_key(name) && !self.1.insert(name.clone())).then(|| name.clone()),
            };
            name.truncate(length);
            found
        }

        fn repeated_in(&mut self, entries: &PickleValue, name: &mut String) -> Option<String> {
            match entries {
                PickleValue::Dict(entries) => {
                    let mut entries = entries.iter().filter(|(_, entry)| has_tensors(entry));
                    entries.find_map(|(key, entry)| self.repeated(entry, key, name))
                }
                PickleValue::List(entries) => {
                    let mut entries = entries.iter().enumerate().filter(|(_, entry)| has_tensors(entry));
                    entries.find_map(|(index, entry)| self.repeated(entry, &index.to_string(), name))
                }
                _ => None,
            }
        }
    }
    /// Whether an entry is a tensor or may hold some.
    fn has_tensors(entry: &PickleValue) -> bool {
        match entry {
            PickleValue::Dict(_) | PickleValue::List(_) => true,
            PickleValue::Unsupported(kind) => kind == "torch.Tensor",
            _ => false,
        }
    }
    let longest = tensors.keys().map(String::len).max().unwrap_or(0);
    Names(tensors, HashSet::new(), longest).repeated_in(entries, &mut String::new())
}

/// Converts little-endian values of a type to single precision.
fn widen(dtype: Torch, bytes: &[u8]) -> Vec<f32> {
    fn each<const N: usize>(bytes: &[u8], convert: impl Fn([u8; N]) -> f32) -> Vec<f32> {
        bytes.as_chunks::<N>().0.iter().map(|chunk| convert(*chunk)).collect()
    }
    match dtype {
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

/// Replaces the weights of a module: `weights` must hold every parameter and buffer of the module, with the same
/// shapes, and nothing else. `what` names the module in errors, such as "the model of config.json".
///
/// # Errors
/// When a weight is missing, has another shape, or is not a weight of the module; the error names the first such
/// weight.
pub fn fill<M: Module>(module: M, weights: &Named<HostTensor>, path: &Path, what: &str) -> Result<M> {
    match mismatch(&parameters::shapes(&module), weights, what) {
        Some(problem) => Err(Error::corrupt(path, problem, format!("give the weights of {what}"))),
        None => Ok(parameters::load(module, weights)),
    }
}

/// The first difference between weights and the shapes that `what` requires, or `None` if the shapes agree.
pub(crate) fn mismatch(shapes: &Named<Vec<usize>>, weights: &Named<HostTensor>, what: &str) -> Option<String> {
    for (name, shape) in shapes {
        match weights.get(name) {
            Some(tensor) if &tensor.shape == shape => {}
            Some(tensor) => {
                return Some(format!("'{name}' has the shape {:?}, but {what} requires {shape:?}", tensor.shape));
            }
            None => return Some(format!("'{name}' is missing from the weights of {what}")),
        }
    }
    let unknown = weights.keys().find(|name| !shapes.contains_key(*name))?;
    Some(format!("'{unknown}' is not a weight of {what}"))
}
