//! State dicts in PyTorch's format: a zip archive of a pickle, which describes the tensors, and the values of the
//! tensors.

use crate::nn::parameters::{HostTensor, Named};
use std::io::{Seek, Write};
use std::path::Path;
use swm_core::{Error, Result, files};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

/// The name of the batch counter of a batch normalisation, a scalar: the only integer in a state dict.
pub const BATCHES_TRACKED: &str = "num_batches_tracked";

/// Writes a state dict that `torch.load(path, weights_only=True)` reads: single precision, except for the counters of
/// batch normalisations ([`BATCHES_TRACKED`]), which are integers in PyTorch.
///
/// # Errors
/// When writing fails.
pub fn write(path: &Path, tensors: &Named<HostTensor>) -> Result<()> {
    let mut bytes = std::io::Cursor::new(vec![]);
    archive(&mut bytes, tensors).map_err(|error| Error::io(path, "writing weights", error.into()))?;
    files::write(path, &bytes.into_inner())
}

fn archive(file: impl Write + Seek, tensors: &Named<HostTensor>) -> zip::result::ZipResult<()> {
    let mut zip = ZipWriter::new(file);
    // PyTorch maps values into memory if they are aligned to 64 bytes.
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored).with_alignment(64);
    let mut entry = |name: &str, bytes: &[u8]| {
        zip.start_file(format!("weights/{name}"), options)?;
        zip.write_all(bytes).map_err(zip::result::ZipError::from)
    };
    entry("data.pkl", &pickle(tensors))?;
    entry("byteorder", b"little")?;
    for (index, (name, tensor)) in tensors.iter().enumerate() {
        let bytes: Vec<u8> = if is_counter(name) {
            tensor.values.iter().flat_map(|value| (*value as i64).to_le_bytes()).collect()
        } else {
            tensor.values.iter().flat_map(|value| value.to_le_bytes()).collect()
        };
        entry(&format!("data/{index}"), &bytes)?;
    }
    entry("version", b"3\n")?;
    zip.finish()?;
    Ok(())
}

fn is_counter(name: &str) -> bool {
    name.ends_with(BATCHES_TRACKED)
}

/// The pickle (protocol 2) of an ordered dictionary of tensors. The values of the tensors are in `data/0`, `data/1` and
/// so on.
fn pickle(tensors: &Named<HostTensor>) -> Vec<u8> {
    let mut out = vec![0x80, 2];
    empty_dict(&mut out);
    out.push(b'(');
    for (index, (name, tensor)) in tensors.iter().enumerate() {
        text(&mut out, name);
        global(&mut out, "torch._utils", "_rebuild_tensor_v2");
        out.push(b'(');
        // The storage as a persistent id: ("storage", type, key, device, count).
        out.push(b'(');
        text(&mut out, "storage");
        global(&mut out, "torch", if is_counter(name) { "LongStorage" } else { "FloatStorage" });
        text(&mut out, &index.to_string());
        text(&mut out, "cpu");
        integer(&mut out, tensor.values.len());
        out.extend(b"tQ");
        // Offset, shape, strides, requires_grad, hooks.
        integer(&mut out, 0);
        tuple(&mut out, &tensor.shape);
        tuple(&mut out, &strides(&tensor.shape));
        out.push(0x89);
        empty_dict(&mut out);
        out.extend(b"tR");
    }
    out.extend(b"u.");
    out
}

/// Appends an empty `collections.OrderedDict`.
fn empty_dict(out: &mut Vec<u8>) {
    global(out, "collections", "OrderedDict");
    out.extend(b")R");
}

fn global(out: &mut Vec<u8>, module: &str, name: &str) {
    out.extend(format!("c{module}\n{name}\n").bytes());
}

fn text(out: &mut Vec<u8>, text: &str) {
    out.push(b'X');
    out.extend((text.len() as u32).to_le_bytes());
    out.extend(text.bytes());
}

/// Appends an integer, as a long of eight bytes.
fn integer(out: &mut Vec<u8>, value: usize) {
    out.extend([0x8a, 8]);
    out.extend((value as u64).to_le_bytes());
}

fn tuple(out: &mut Vec<u8>, values: &[usize]) {
    out.push(b'(');
    values.iter().for_each(|value| integer(out, *value));
    out.push(b't');
}

/// The row-major strides of a shape, in elements.
fn strides(shape: &[usize]) -> Vec<usize> {
    (0..shape.len()).map(|axis| shape[axis + 1..].iter().product()).collect()
}
