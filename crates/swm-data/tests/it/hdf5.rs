//! The format `hdf5`. The long runs:
//!
//! ```text
//! cargo test --release --workspace --test it -- --ignored hdf5::
//! ```

use crate::{format_suite, fuzz};
use swm_data::{WriteMode, open};

#[test]
fn it_does_what_formats_do() {
    format_suite::all("d.h5");
}

#[test]
fn a_killed_writer_keeps_committed_episodes() {
    format_suite::killed("d.h5", 4);
}

#[test]
#[ignore = "a minute"]
fn a_writer_killed_at_50_moments_keeps_committed_episodes() {
    format_suite::killed("d.h5", 50);
}

fn damaged(cases: u64) {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("d.h5");
    format_suite::write(&path, WriteMode::Create, 0..3);
    let report = fuzz::dataset("hdf5", &path, cases, fuzz::read_everything);
    println!("{} refused, {} same, {} changed", report.refused, report.same, report.changed.len());
    println!("{:#?}", report.changed);
}

#[test]
fn damaged_files_are_refused() {
    damaged(400);
}

#[test]
#[ignore = "minutes"]
fn files_damaged_in_10000_ways_are_refused() {
    damaged(10_000);
}

#[test]
fn many_chunks_need_trees_of_several_levels() {
    // 64 chunks a leaf, 4096 below a node of the second level: three levels, in groups that end anywhere.
    use swm_core::{Batch, ColumnSpec, DType, Schema};
    use swm_data::{CommitPolicy, StepRange, WriteOptions, create};
    let schema = Schema::new([ColumnSpec::new("large", DType::U8, [2048]), ColumnSpec::new("small", DType::Int64, [])]);
    let schema = schema.expect("schema");
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("d.h5");
    let commit = CommitPolicy { episodes: 3, ..CommitPolicy::default() };
    let mut total = 0_usize;
    for part in 0..4 {
        let options = WriteOptions { mode: WriteMode::Append, commit, ..WriteOptions::default() };
        let mut writer = create(&path, &schema, options).expect("creates");
        for e in 0..60 {
            let rows = (e * 7 + part) % 40;
            let mut batch = Batch::zeros(&schema, rows + 1);
            for t in 0..=rows {
                batch.row_mut(t).at::<u8>(0).fill((total % 251) as u8);
                batch.row_mut(t).set(1, &[total as i64]);
                total += 1;
            }
            writer.write_episode(&batch).expect("writes");
        }
        writer.finish().expect("finishes");
    }
    assert!(total > 4096 + 64);
    let reader = open(&path).expect("opens");
    let mut row = 0;
    for (position, episode) in reader.episodes().iter().enumerate() {
        let read = reader.read(&["large", "small"], &[StepRange::new(position, 0, episode.length)]).expect("reads");
        for t in 0..episode.length {
            assert_eq!(read.row(t).get::<i64>("small").expect("a number"), [row as i64]);
            assert!(read.row(t).get::<u8>("large").expect("bytes").iter().all(|&byte| byte == (row % 251) as u8));
            row += 1;
        }
    }
    assert_eq!(row, total);
}
