//! A table of a stranger whose data files state the content hashes of other episodes.

use crate::sample::write;
use std::path::{Path, PathBuf};
use swm_data::doctor::examine;
use swm_data::{CacheConfig, Reader, StepRange, WriteMode, open};

/// The only data file of a table.
fn data_file(table: &Path) -> PathBuf {
    let mut files = table.join("data").read_dir().expect("a folder").flatten();
    files.next().expect("a data file").path()
}

/// Replaces equally long bytes wherever they are.
fn replace(bytes: &mut [u8], old: &[u8], new: &[u8]) -> usize {
    let found: Vec<usize> =
        (0..=bytes.len().saturating_sub(old.len())).filter(|&at| bytes[at..].starts_with(old)).collect();
    found.iter().for_each(|&at| bytes[at..at + old.len()].copy_from_slice(new));
    found.len()
}

/// The places of the hashes that a data file states.
fn stated(bytes: &[u8]) -> Vec<std::ops::Range<usize>> {
    const BEFORE: &[u8] = br#""hash":""#;
    let ends = (BEFORE.len()..=bytes.len()).filter(|&end| bytes[..end].ends_with(BEFORE));
    ends.map(|end| end..end + 64).collect()
}

/// Makes the data file of `table` state the hashes of `of`, and gives it a name that is its hash, or none.
fn forge(table: &Path, of: &Path, is_named: bool) {
    let (path, truth) = (data_file(table), std::fs::read(data_file(of)).expect("a data file"));
    let mut bytes = std::fs::read(&path).expect("a data file");
    let places = stated(&bytes);
    assert_eq!(places.len(), 6);
    for (to, from) in places.into_iter().zip(stated(&truth)) {
        bytes[to].copy_from_slice(&truth[from]);
    }
    let old = path.file_name().and_then(|name| name.to_str()).expect("a name").to_owned();
    let hash = if is_named { blake3::hash(&bytes).to_hex().to_string() } else { "z".repeat(64) };
    let new = old.replacen(&old[..64], &hash, 1);
    std::fs::write(path.with_file_name(&new), bytes).expect("writing the data file");
    std::fs::remove_file(&path).expect("removing the data file");
    for manifest in table.join("_versions").read_dir().expect("a folder").flatten() {
        let mut bytes = std::fs::read(manifest.path()).expect("a manifest");
        replace(&mut bytes, old.as_bytes(), new.as_bytes());
        replace(&mut bytes, b"swmSEAL1", b"xxxSEAL1");
        std::fs::write(manifest.path(), bytes).expect("writing a manifest");
    }
}

fn images(reader: &dyn Reader) -> Vec<u8> {
    let rows: Vec<_> = reader.episodes().iter().enumerate().map(|(i, it)| StepRange::new(i, 0, it.length)).collect();
    reader.read(&["pixels"], &rows).expect("reading rows").bytes(0).to_vec()
}

#[test]
fn caches_do_not_trust_it_and_the_doctor_finds_it() {
    for is_named in [false, true] {
        let folder = tempfile::tempdir().expect("creating a folder");
        let (own, strange) = (folder.path().join("own.lance"), folder.path().join("strange.lance"));
        write(&own, WriteMode::Create, 6, 0..6);
        // Episodes of the same lengths with other values.
        write(&strange, WriteMode::Create, 6, 7..13);
        forge(&strange, &own, is_named);
        let (own, strange) = (open(&own).expect("a dataset"), open(&strange).expect("a dataset"));
        let hashes = [&own, &strange].map(|reader| reader.content_hash().expect("a hash"));
        assert_eq!(hashes[0], hashes[1], "the hashes are only stated");

        let cache = CacheConfig::Disk { folder: folder.path().join("cache"), bytes: 1 << 30 };
        let cached = |reader: &std::sync::Arc<dyn Reader>| {
            images(&*cache.over(std::sync::Arc::clone(reader), &["pixels"]).expect("a cache"))
        };
        let (theirs, ours) = (cached(&strange), cached(&own));
        assert!(ours == images(&*own) && ours != theirs, "named {is_named}");

        let diagnosis = examine(&*strange, &[], &mut swm_core::run::Control::new()).expect("a diagnosis");
        let finding = diagnosis.findings.iter().find(|it| it.what.contains("content hash")).expect("a finding");
        assert_eq!((&finding.episodes[..], diagnosis.intact.len()), (&[0, 1, 2, 3, 4, 5][..], 0));
    }
}
