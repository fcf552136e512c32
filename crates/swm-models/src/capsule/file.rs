//! The bytes of a capsule.

use super::{Capsule, Description, Evaluation, Reference, VERSION, damaged};
use crate::nn::parameters::{HostTensor, Named};
use crate::tensor_file::check_finite;
use half::f16;
use safetensors::SafeTensorError;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use swm_core::{Batch, ColumnSpec, DType, Error, Manifest, Result, Schema, manifest};

/// The key of the document in the metadata of the file.
const KEY: &str = "swm_capsule";

/// The prefixes of the tensors that are not weights.
const INPUT: &str = "reference/input/";
const OUTPUT: &str = "reference/output/";
const STARTS: &str = "starts/";
const ROWS: &str = "rows/";

/// The most rows of a batch in a capsule.
const MAX_ROWS: usize = 64;

/// The most tensors of a capsule: weights, outputs, and columns of batches.
const MAX_TENSORS: usize = 4096;

/// The document, without its hash.
#[derive(Serialize, Deserialize)]
struct Document {
    version: u64,
    checkpoint: Value,
    manifest: Manifest,
    description: Description,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    evaluation: Option<Value>,
}

/// A tensor of any type.
struct Tensor<'a> {
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Cow<'a, [u8]>,
}

/// Tensors by name.
type Tensors<'a> = BTreeMap<String, Tensor<'a>>;

/// Returns the bytes of the file, and the hash of the capsule.
pub(super) fn encode(capsule: &Capsule) -> Result<(Vec<u8>, String)> {
    let document = Document {
        version: VERSION,
        checkpoint: capsule.checkpoint.clone(),
        manifest: capsule.manifest.clone(),
        description: capsule.description.clone(),
        evaluation: capsule.evaluation.as_ref().map(|evaluation| evaluation.record.clone()),
    };
    let mut tensors: Tensors<'_> =
        capsule.weights.iter().map(|(name, tensor)| (name.clone(), weight(tensor))).collect();
    add_batch(&mut tensors, INPUT, &capsule.reference.inputs);
    tensors.extend(capsule.reference.outputs.iter().map(|(name, tensor)| (format!("{OUTPUT}{name}"), single(tensor))));
    if let Some(evaluation) = &capsule.evaluation {
        add_batch(&mut tensors, STARTS, &evaluation.starts);
        evaluation.rows.iter().for_each(|rows| add_batch(&mut tensors, ROWS, rows));
    }
    if tensors.len() > MAX_TENSORS {
        let problem = format!("it has {} tensors, more than {MAX_TENSORS}", tensors.len());
        return Err(Error::config("the capsule", problem, "pack a model of fewer tensors"));
    }
    let mut document = serde_json::to_value(document).map_err(|error| Error::external("writing a capsule", error))?;
    let hash = digest(&document, &tensors);
    document["hash"] = Value::String(hash.clone());
    let failed = |error: SafeTensorError| Error::external("writing a capsule", error);
    let views = tensors.iter().map(|(name, tensor)| {
        let view = TensorView::new(tensor.dtype, tensor.shape.clone(), &tensor.bytes);
        Ok((name, view.map_err(failed)?))
    });
    let views: Vec<(&String, TensorView<'_>)> = views.collect::<Result<_>>()?;
    let metadata = HashMap::from([(KEY.to_owned(), document.to_string())]);
    Ok((safetensors::serialize(views, Some(metadata)).map_err(failed)?, hash))
}

/// Whether these are the bytes of a capsule, damaged or not.
pub(super) fn is_capsule(bytes: &[u8]) -> bool {
    let header = SafeTensors::read_metadata(bytes);
    header.is_ok_and(|(_, header)| header.metadata().as_ref().is_some_and(|metadata| metadata.contains_key(KEY)))
}

/// Reads the bytes of the file `path`.
pub(super) fn decode(path: &Path, bytes: &[u8]) -> Result<Capsule> {
    let (mut document, mut tensors) = parts(path, bytes)?;
    check_version(path, &document)?;
    let hash = document.as_object_mut().and_then(|fields| fields.remove("hash"));
    if hash != Some(Value::String(digest(&document, &tensors))) {
        return Err(damaged(path, "its hash differs from its content".to_owned()));
    }
    let Document { checkpoint, manifest, description, evaluation, .. } =
        serde_json::from_value(document).map_err(|error| damaged(path, error.to_string()))?;
    let failed = |problem: String| damaged(path, problem);
    // What is shown of a training is its manifest, what is loaded its configuration.
    let shown = Some(&manifest.config).filter(|config| manifest.kind == "train" && !config.is_null());
    if shown.is_some() && checkpoint.get("config") != shown {
        return Err(failed("the configuration in its manifest differs from that of its checkpoint".to_owned()));
    }
    let inputs = take_batch(&mut tensors, INPUT).map_err(failed)?;
    let inputs = inputs.ok_or_else(|| failed("it has no reference batch".to_owned()))?;
    let (starts, rows) =
        (take_batch(&mut tensors, STARTS).map_err(failed)?, take_batch(&mut tensors, ROWS).map_err(failed)?);
    let evaluation = match (evaluation, starts) {
        (Some(record), Some(starts)) => Some(Evaluation { record, starts, rows }),
        (None, None) if rows.is_none() => None,
        _ => return Err(failed("it has only a part of the record of an evaluation".to_owned())),
    };
    let (mut weights, mut outputs) = (Named::new(), Named::new());
    for (name, tensor) in tensors {
        let values = floats(&name, &tensor).map_err(failed)?;
        let tensor = HostTensor { shape: tensor.shape, values };
        match name.strip_prefix(OUTPUT) {
            Some(name) => outputs.insert(name.to_owned(), tensor),
            None if name.contains('/') => return Err(failed(format!("it has a tensor '{name}', which is unknown"))),
            None => weights.insert(name, tensor),
        };
    }
    let reference = Reference { inputs, outputs };
    Ok(Capsule { checkpoint, manifest, description, weights, reference, evaluation })
}

/// Returns the document with its hash, and the tensors.
fn parts<'a>(path: &Path, bytes: &'a [u8]) -> Result<(Value, Tensors<'a>)> {
    let foreign = |problem: String| {
        Error::corrupt(path, problem, "give the folder of a checkpoint, or a file that `swm checkpoints pack` wrote")
    };
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(|error| match error {
        SafeTensorError::MetadataIncompleteBuffer => damaged(path, format!("is damaged ({error})")),
        _ => foreign(format!("is no capsule ({error})")),
    })?;
    let text = header.metadata().as_ref().and_then(|metadata| metadata.get(KEY));
    let text = text.ok_or_else(|| foreign(format!("is no capsule: its metadata has no '{KEY}'")))?;
    let count = header.tensors().len();
    if count > MAX_TENSORS {
        return Err(damaged(path, format!("it has {count} tensors, more than {MAX_TENSORS}")));
    }
    let document: Value = serde_json::from_str(text).map_err(|error| damaged(path, error.to_string()))?;
    let file = SafeTensors::deserialize(bytes).map_err(|error| damaged(path, format!("is damaged ({error})")))?;
    let tensors = file.iter().map(|(name, view)| {
        let (dtype, shape, bytes) = (view.dtype(), view.shape().to_vec(), Cow::Borrowed(view.data()));
        (name.to_owned(), Tensor { dtype, shape, bytes })
    });
    Ok((document, tensors.collect()))
}

/// Refuses a capsule of another version.
fn check_version(path: &Path, document: &Value) -> Result<()> {
    let version = document.get("version").and_then(Value::as_u64);
    if version == Some(VERSION) {
        return Ok(());
    }
    let given = version.map_or("no version".to_owned(), |version| format!("version {version}"));
    let writer = document.pointer("/manifest/swm_version").and_then(Value::as_str).unwrap_or("that reads it");
    Err(Error::corrupt(
        path,
        format!("it is a capsule of {given}, and this program reads version {VERSION}"),
        format!(
            "convert it with stable-worldmodel {writer}: `swm checkpoints export FILE DIR --format checkpoint`, then \
             `swm checkpoints pack DIR -o FILE` with this program"
        ),
    ))
}

/// Returns the hash of a document and of tensors.
fn digest(document: &Value, tensors: &Tensors<'_>) -> String {
    let mut text = document.to_string();
    for (name, tensor) in tensors {
        let hash = manifest::hash(&tensor.bytes);
        text.push_str(&format!("\n{name:?} {:?} {:?} {hash}", tensor.dtype, tensor.shape));
    }
    manifest::hash(text.as_bytes())
}

/// Encodes a weight: half precision if it has two or more axes and no value changes, else single precision.
fn weight(tensor: &HostTensor) -> Tensor<'static> {
    let half = || tensor.values.iter().map(|&value| f16::from_f32(value));
    if tensor.shape.len() < 2
        || half().zip(&tensor.values).any(|(half, value)| half.to_f32().to_bits() != value.to_bits())
    {
        return single(tensor);
    }
    let bytes = half().flat_map(f16::to_le_bytes).collect();
    Tensor { dtype: Dtype::F16, shape: tensor.shape.clone(), bytes: Cow::Owned(bytes) }
}

fn single(tensor: &HostTensor) -> Tensor<'static> {
    let bytes = tensor.values.iter().flat_map(|value| value.to_le_bytes()).collect();
    Tensor { dtype: Dtype::F32, shape: tensor.shape.clone(), bytes: Cow::Owned(bytes) }
}

/// Returns the values of a weight or an output.
fn floats(name: &str, tensor: &Tensor<'_>) -> Result<Vec<f32>, String> {
    let bytes = &tensor.bytes;
    let values: Vec<f32> = match tensor.dtype {
        Dtype::F16 => bytes.as_chunks::<2>().0.iter().map(|b| f16::from_le_bytes(*b).to_f32()).collect(),
        Dtype::F32 => bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect(),
        other => return Err(format!("'{name}' holds {other:?} elements instead of F16 or F32")),
    };
    check_finite(name, &values)?;
    Ok(values)
}

/// Adds the columns of a batch as tensors.
fn add_batch(tensors: &mut Tensors<'_>, prefix: &str, batch: &Batch) {
    for (index, column) in batch.schema().columns().iter().enumerate() {
        let shape = [&[batch.rows()], &column.shape[..]].concat();
        let tensor = Tensor { dtype: dtype(column.dtype), shape, bytes: Cow::Owned(batch.bytes(index).to_vec()) };
        tensors.insert(format!("{prefix}{}", column.name), tensor);
    }
}

/// Removes the tensors with a prefix and returns them as a batch; `None` if there are none.
fn take_batch(tensors: &mut Tensors<'_>, prefix: &str) -> Result<Option<Batch>, String> {
    let names: Vec<String> = tensors.keys().filter(|name| name.starts_with(prefix)).cloned().collect();
    let taken: Vec<(String, Tensor<'_>)> =
        names.into_iter().filter_map(|name| Some((name[prefix.len()..].to_owned(), tensors.remove(&name)?))).collect();
    let Some(rows) = taken.first().map(|(_, tensor)| tensor.shape.first().copied().unwrap_or(0)) else {
        return Ok(None);
    };
    let mut columns = vec![];
    for (name, tensor) in &taken {
        if tensor.shape.first() != Some(&rows) || !(1..=MAX_ROWS).contains(&rows) {
            return Err(format!("'{prefix}{name}' has the shape {:?}, not 1 to {MAX_ROWS} equal rows", tensor.shape));
        }
        let all = [DType::Bool, DType::U8, DType::Int32, DType::Int64, DType::Float32, DType::Float64];
        let found = all.into_iter().find(|&known| dtype(known) == tensor.dtype);
        let Some(dtype) = found else { return Err(format!("'{prefix}{name}' holds {:?} elements", tensor.dtype)) };
        columns.push(ColumnSpec::new(name.clone(), dtype, &tensor.shape[1..]));
    }
    let filled = Schema::new(columns).and_then(|schema| {
        let mut batch = Batch::try_zeros(&schema, rows)?;
        for (index, (_, tensor)) in taken.iter().enumerate() {
            batch.bytes_mut(index).copy_from_slice(&tensor.bytes);
        }
        Ok(batch)
    });
    filled.map(Some).map_err(|error| error.to_string())
}

fn dtype(dtype: DType) -> Dtype {
    match dtype {
        DType::Bool => Dtype::BOOL,
        DType::U8 => Dtype::U8,
        DType::Int32 => Dtype::I32,
        DType::Int64 => Dtype::I64,
        DType::Float32 => Dtype::F32,
        DType::Float64 => Dtype::F64,
    }
}
