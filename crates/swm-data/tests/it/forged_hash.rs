//! A table of a stranger whose data files state the content hashes of other episodes.

use crate::fuzz::copy_all;
use crate::objects;
use crate::sample::{check, write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use swm_data::doctor::examine;
use swm_data::{CacheConfig, Location, Reader, StepRange, WriteMode, checksum, open, views};

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

/// Makes the manifests of a table exchange two columns of its data file.
fn exchange_columns(table: &Path, columns: [usize; 2]) {
    let name = data_file(table).file_name().and_then(|name| name.to_str()).expect("a name").to_owned();
    for manifest in table.join("_versions").read_dir().expect("a folder").flatten() {
        let mut bytes = std::fs::read(manifest.path()).expect("a manifest");
        let after: Vec<usize> =
            (name.len()..bytes.len()).filter(|&end| bytes[..end].ends_with(name.as_bytes())).collect();
        for begin in after {
            // After the name, the fields of the columns: a list of small numbers with the number 2 in the message, and their
            // count. The transaction has it, too.
            assert_eq!(bytes[begin], 0x12);
            bytes.swap(begin + 2 + columns[0], begin + 2 + columns[1]);
        }
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
        let cached = |reader: &Arc<dyn Reader>| images(&*cache.over(Arc::clone(reader), &["pixels"]).expect("a cache"));
        let (theirs, ours) = (cached(&strange), cached(&own));
        assert!(ours == images(&*own) && ours != theirs, "named {is_named}");

        let diagnosis = examine(&*strange, &[], &mut swm_core::run::Control::new()).expect("a diagnosis");
        let finding = diagnosis.findings.iter().find(|it| it.what.contains("content hash")).expect("a finding");
        assert_eq!((&finding.episodes[..], diagnosis.intact.len()), (&[0, 1, 2, 3, 4, 5][..], 0));
    }
}

#[test]
fn caches_know_which_column_of_a_file_is_which() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let (own, strange) = (folder.path().join("own.lance"), folder.path().join("strange.lance"));
    write(&own, WriteMode::Create, 6, 0..6);
    copy_all(&own, &strange);
    let read = |path: &Path| open(path).expect("a dataset");
    // Of the stored columns, `pixels` is the first after the two indices, and `goal` the last.
    exchange_columns(&strange, [2, 8]);
    let goals =
        |reader: &dyn Reader| reader.read(&["goal"], &[StepRange::new(0, 0, 3)]).expect("rows").bytes(0).to_vec();
    let (own, strange) = (read(&own), read(&strange));
    assert!(goals(&*own) != goals(&*strange), "the columns are exchanged");
    assert_eq!(own.content_hash().expect("a hash"), strange.content_hash().expect("a hash"), "it is only stated");
    assert_ne!(own.cache_key().expect("a key"), strange.cache_key().expect("a key"));
    let diagnosis = examine(&*strange, &[], &mut swm_core::run::Control::new()).expect("a diagnosis");
    assert!(diagnosis.findings.iter().any(|it| it.what.contains("content hash")), "{:?}", diagnosis.findings);
}

/// A folder with a bucket that has a table, the table, and its location on a web server.
fn on_a_web_server() -> (tempfile::TempDir, PathBuf, Location) {
    let folder = tempfile::tempdir().expect("creating a folder");
    let table = folder.path().join("bucket/d.lance");
    std::fs::create_dir(folder.path().join("bucket")).expect("creating a bucket");
    write(&table, WriteMode::Create, 6, 0..6);
    let web = objects::serve(folder.path(), false);
    (folder, table, Location::parse(&format!("{web}/bucket/d.lance")).expect("a location"))
}

/// Changes a byte of the data file that no value depends on: a digit of a content hash.
fn change_a_byte(table: &Path) {
    let path = data_file(table);
    let mut bytes = std::fs::read(&path).expect("a data file");
    let digit = stated(&bytes)[0].start;
    bytes[digit] = if bytes[digit] == b'0' { b'1' } else { b'0' };
    std::fs::write(&path, bytes).expect("writing the data file");
}

#[test]
fn data_files_in_an_object_store_are_compared_with_their_names() {
    let (folder, table, location) = on_a_web_server();
    let reader = open(&location).expect("opening the dataset");
    let expected = checksum(&*reader).expect("the checksum");
    assert_eq!(expected, checksum(&*open(&table).expect("opening the files")).expect("their checksum"));
    assert_eq!(reader.irregularities().expect("reading the dataset"), []);

    change_a_byte(&table);
    let reader = open(&location).expect("opening the dataset");
    check(&*reader, 0);
    let own = folder.path().join("own.lance");
    write(&own, WriteMode::Create, 6, 0..6);
    let (own, cache) = (open(&own).expect("opening the files"), CacheConfig::Memory { bytes: 1 << 20 });
    let views = [
        Ok(Arc::clone(&reader)),
        cache.over(Arc::clone(&reader), &["state"]),
        views::subset(Arc::clone(&reader), vec![1]),
        views::concat(vec![Arc::clone(&own), Arc::clone(&reader)]),
        views::merge(Arc::clone(&reader), Arc::clone(&own), &[]),
        views::merge(own, Arc::clone(&reader), &[]),
    ];
    for view in views {
        let error = checksum(&*view.expect("a view")).expect_err("another file").to_string();
        assert!(error.contains("the hash in its name") && error.contains("d.lance/data/"), "{error}");
    }
    let found = examine(&*reader, &[], &mut swm_core::run::Control::new()).expect("a diagnosis");
    let finding = found.findings.iter().find(|finding| finding.what.contains("the hash in its name"));
    assert_eq!(finding.map(|finding| finding.episodes.len()), Some(6), "{found:?}");
    assert!(found.intact.is_empty());
}

#[test]
fn data_files_in_an_object_store_that_are_replaced_while_they_are_open_are_refused() {
    let (_folder, table, location) = on_a_web_server();
    let reader = open(&location).expect("opening the dataset");
    let rows = [StepRange::new(0, 0, 2)];
    reader.read(&["state"], &rows).expect("reading rows");
    change_a_byte(&table);
    let error = reader.read(&["pixels"], &rows).expect_err("another file").to_string();
    assert!(error.contains("replaced since the dataset was opened"), "{error}");
    check(&*open(&location).expect("opening it again"), 0);
}
