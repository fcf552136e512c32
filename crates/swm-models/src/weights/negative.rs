//! Tensors that PyTorch saved with their negative bit: the file has their values with the opposite sign, and a mark in the pickle.
//! The crate that reads pickles ignores the mark.

use std::io::{BufReader, Read as _};
use std::path::Path;
use swm_core::{Error, Result, files};
use zip::ZipArchive;

/// The largest pickle that is searched, in bytes. The crate that reads pickles refuses larger ones.
const LARGEST_PICKLE: u64 = 256 << 20;

/// Whether a file that `torch.save` wrote has such a tensor, which `tensor.resolve_neg()` makes an ordinary one.
///
/// # Errors
/// When the file cannot be read.
pub fn any(path: &Path) -> Result<bool> {
    let read = |error| Error::io(path, "reading weights", error);
    let mut bytes = vec![];
    match ZipArchive::new(BufReader::new(files::open(path)?)) {
        Ok(mut zip) => {
            for index in 0..zip.len() {
                // What cannot be read is reported by the reader of the tensors.
                let Ok(entry) = zip.by_index(index) else { continue };
                if entry.name().is_ok_and(|name| name.ends_with("data.pkl")) {
                    bytes.clear();
                    let _ = entry.take(LARGEST_PICKLE).read_to_end(&mut bytes);
                    if marks(&bytes) {
                        return Ok(true);
                    }
                }
            }
            Ok(false)
        }
        // Before version 1.6, pickles stood at the start of the file.
        Err(_) => {
            files::open(path)?.take(LARGEST_PICKLE).read_to_end(&mut bytes).map_err(read)?;
            Ok(marks(&bytes))
        }
    }
}

/// Whether a pickle has the entry `neg: True`. The key is a text in either encoding, which the pickle may number before the
/// value follows.
fn marks(pickle: &[u8]) -> bool {
    const TRUE: u8 = 0x88;
    let is_true = |after: &[u8]| {
        matches!(after, [TRUE, ..] | [0x94, TRUE, ..] | [b'q', _, TRUE, ..] | [b'r', _, _, _, _, TRUE, ..])
    };
    [&b"X\x03\0\0\0neg"[..], &b"\x8c\x03neg"[..]].iter().any(|key| {
        pickle.windows(key.len()).enumerate().any(|(at, window)| window == *key && is_true(&pickle[at + key.len()..]))
    })
}
