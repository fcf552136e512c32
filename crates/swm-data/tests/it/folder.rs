//! The format `folder`. The long runs:
//!
//! ```text
//! cargo test --release --workspace --test it -- --ignored folder::
//! ```

use crate::{format_suite, fuzz};
use swm_data::{WriteMode, open};

#[test]
fn it_does_what_formats_do() {
    format_suite::all("d.folder");
}

#[test]
fn a_killed_writer_keeps_committed_episodes() {
    format_suite::killed("d.folder", 4);
}

#[test]
#[ignore = "a minute"]
fn a_writer_killed_at_50_moments_keeps_committed_episodes() {
    format_suite::killed("d.folder", 50);
}

fn damaged(cases: u64) {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("d.folder");
    format_suite::write(&path, WriteMode::Create, 0..3);
    let report = fuzz::dataset("folder", &path, cases, fuzz::read_everything);
    // A picture in the place of another is one that nothing tells apart.
    let changed: Vec<&String> = report.changed.iter().filter(|change| !change.contains("replaced by")).collect();
    assert!(changed.is_empty(), "{changed:?}");
    assert!(report.refused as u64 > cases / 2, "{report:?}");
}

#[test]
fn damaged_folders_are_refused() {
    damaged(400);
}

#[test]
#[ignore = "minutes"]
fn folders_damaged_in_10000_ways_are_refused() {
    damaged(10_000);
}

#[test]
fn what_an_interrupted_writer_left_may_be_damaged() {
    // A journal, and column files that are still empty.
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("d.folder");
    let mut writer = format_suite::writer(&path, WriteMode::Create).expect("creates");
    (0..4).for_each(|e| writer.write_episode(&crate::sample::episode(e)).expect("writes"));
    let journal = std::fs::read(path.join("ep_len.journal")).expect("a journal");
    let whole = open(&path).expect("opens").episodes().len();
    assert_eq!(whole, 4);
    let copy = folder.path().join("copy.folder");
    fuzz::copy_all(&path, &copy);
    let read = |bytes: &[u8]| {
        std::fs::write(copy.join("ep_len.journal"), bytes).expect("writes");
        open(&copy)?;
        fuzz::read_everything(&copy)
    };
    let report = fuzz::bytes("journal", &journal, 300, read);
    assert!(report.refused > 30, "{report:?}");
    for cut in (0..journal.len()).step_by(journal.len() / 40) {
        std::fs::write(copy.join("ep_len.journal"), &journal[..cut]).expect("writes");
        let reader = open(&copy).expect("what was whole is read");
        assert!(reader.episodes().len() < 4);
        format_suite::check(&*reader, 0);
    }
}
