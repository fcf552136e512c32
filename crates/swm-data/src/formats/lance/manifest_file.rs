//! The file of a manifest: Lance's bytes, with a checksum that other readers skip.

use bytes::Bytes;
use lance_io::object_store::ObjectStore;
use lance_table::format::{IndexMetadata, Manifest};
use lance_table::io::commit::write_manifest_file_to_path;
use object_store::ObjectStoreExt as _;
use object_store::path::Path as StorePath;

/// Start of the checksum in a manifest's file; a BLAKE3 hash of all other bytes of the file follows. The checksum is
/// stored before Lance's protobuf message, whose offset is in the file's footer, so other readers skip the checksum.
const CHECKSUM_TAG: &[u8; 8] = b"swmSEAL1";
/// Size of the checksum in bytes: the tag and the hash.
const CHECKSUM_LEN: usize = CHECKSUM_TAG.len() + 32;
/// Size of the footer in bytes: offset of the message, format versions, and magic number.
const FOOTER: usize = 16;
/// The largest size of a file that is read as a whole, in bytes: the manifest of a million fragments is smaller.
const LARGEST: u64 = 256 << 20;

/// Reads a manifest or another file of metadata as a whole.
pub async fn read_whole(objects: &ObjectStore, path: &StorePath) -> lance_core::Result<Bytes> {
    let object = objects.inner.get(path).await?;
    match object.meta.size {
        0..=LARGEST => Ok(object.bytes().await?),
        size => Err(corrupt(format!("{path} has {size} bytes, of at most {LARGEST}"))),
    }
}

/// The file of a manifest as Lance writes it, with a checksum.
pub async fn encode(
    manifest: &mut Manifest,
    indices: Option<Vec<IndexMetadata>>,
    path: &StorePath,
    transaction: lance_table::format::Transaction,
) -> lance_core::Result<Vec<u8>> {
    let memory = ObjectStore::memory();
    write_manifest_file_to_path(&memory, manifest, indices, path, Some(transaction)).await?;
    with_checksum(&memory.read_one_all(path).await?)
}

/// Offset of the message in a manifest's file.
fn message_start(file: &[u8]) -> lance_core::Result<usize> {
    let start = file.len().checked_sub(FOOTER).and_then(|at| file[at..].first_chunk());
    let start = start.and_then(|&bytes| usize::try_from(u64::from_le_bytes(bytes)).ok());
    start.filter(|&start| start <= file.len() - FOOTER).ok_or_else(|| corrupt("a manifest is truncated".to_owned()))
}

/// Adds a checksum before the message of a manifest's file.
fn with_checksum(plain: &[u8]) -> lance_core::Result<Vec<u8>> {
    let start = message_start(plain)?;
    let (before, message) = plain.split_at(start);
    let mut after = message.to_vec();
    let footer = after.len() - FOOTER;
    after[footer..footer + 8].copy_from_slice(&((start + CHECKSUM_LEN) as u64).to_le_bytes());
    let hash = blake3::Hasher::new().update(before).update(&after).finalize();
    Ok([before, CHECKSUM_TAG, hash.as_bytes(), &after].concat())
}

/// Verifies the checksum of a manifest's file, if there is one. Manifests of other writers have no checksum.
pub fn verify_checksum(file: &[u8]) -> lance_core::Result<()> {
    let start = message_start(file)?;
    let Some(checksum) = start.checked_sub(CHECKSUM_LEN).filter(|&checksum| file[checksum..].starts_with(CHECKSUM_TAG))
    else {
        return Ok(());
    };
    let hash = blake3::Hasher::new().update(&file[..checksum]).update(&file[start..]).finalize();
    if file[checksum + CHECKSUM_TAG.len()..start] == *hash.as_bytes() {
        return Ok(());
    }
    Err(corrupt("the newest manifest does not match its hash".to_owned()))
}

/// An error that reports a damaged manifest.
pub fn corrupt(problem: String) -> lance_core::Error {
    lance_core::Error::internal(problem)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checksum_detects_flipped_bits() {
        let plain = [&b"transaction"[..], &7_u32.to_le_bytes(), b"message", &11_u64.to_le_bytes(), b"\0\0\x02\0LANC"];
        let plain = plain.concat();
        assert!(verify_checksum(&plain).is_ok(), "a manifest of another writer has no checksum");
        let intact = with_checksum(&plain).expect("adding a checksum");
        assert_eq!(&intact[message_start(&intact).expect("a message")..][4..11], b"message");
        assert!(verify_checksum(&intact).is_ok());
        for at in (0..intact.len()).filter(|at| !(11..19).contains(at)) {
            let mut damaged = intact.clone();
            damaged[at] ^= 4;
            let in_message_offset = at >= intact.len() - FOOTER && at < intact.len() - 8;
            assert!(verify_checksum(&damaged).is_err() || in_message_offset, "byte {at}");
        }
    }
}
