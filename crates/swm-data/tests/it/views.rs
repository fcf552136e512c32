//! Views of datasets: concatenated, merged, selected and split.

use crate::sample::{COLUMNS, check, episode, rows, schema, write};
use std::path::Path;
use std::sync::Arc;
use swm_core::{Batch, ColumnSpec, DType, Schema};
use swm_data::views::{concat, merge, select, subset};
use swm_data::{Part, Reader, Split, StepRange, WriteMode, WriteOptions, create, open};

fn dataset(path: &Path, episodes: std::ops::Range<usize>) -> Arc<dyn Reader> {
    write(path, WriteMode::Create, 2, episodes);
    open(path).expect("opening the dataset")
}

#[test]
fn concatenation_reads_like_one_dataset() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let parts =
        [(0, 3), (3, 4), (4, 9)].map(|(from, to)| dataset(&folder.path().join(format!("{from}.lance")), from..to));
    let all = concat(parts.to_vec()).expect("concatenating the datasets");
    check(&*all, 0);
    // One call reads rows of all parts in any order.
    let ranges = [(7, 1, 2), (0, 0, 3), (3, 2, 1), (7, 1, 2), (5, 0, 1)].map(|(e, s, n)| StepRange::new(e, s, n));
    let read = all.read(&["state", "episode_idx", "pixels"], &ranges).expect("reading rows");
    let expected: Vec<[f64; 2]> =
        ranges.iter().flat_map(|r| (r.start..r.start + r.length).map(|t| [r.episode as f64, t as f64])).collect();
    let states = read.get::<f64>("state").expect("reading the states").chunks(3);
    assert!(states.map(|state| [state[0], state[1]]).eq(expected.iter().copied()));
    assert!(
        read.to_f32("episode_idx")
            .expect("reading the values")
            .iter()
            .zip(&expected)
            .all(|(&a, b)| f64::from(a) == b[0])
    );
    assert!(all.read(&["state"], &[StepRange::new(9, 0, 1)]).is_err() && all.read(&["stat"], &ranges).is_err());
    assert_eq!(all.manifest(), parts[0].manifest(), "all parts have the same manifest");
    assert_ne!(all.content_hash().expect("hashing the content"), parts[0].content_hash().expect("hashing the content"));

    let few = select(Arc::clone(&parts[0]), &["state", "action"]).expect("selecting columns");
    let error = concat(vec![Arc::clone(&parts[1]), few])
        .err()
        .expect("a schema with other columns must be an error")
        .to_string();
    assert!(error.contains("dataset 2") && error.contains("pixels") && error.contains("select"), "{error}");
    assert!(concat(vec![]).is_err());
}

#[test]
fn merge_adds_columns_of_another_dataset() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let base = dataset(&folder.path().join("base.lance"), 0..5);
    let extra = Schema::new([ColumnSpec::new("embedding", DType::Float32, [2])]).expect("creating the schema");
    let embedded = |name: &str, longer: usize| {
        let path = folder.path().join(name);
        let mut writer = create(&path, &extra, WriteOptions::default()).expect("creating the dataset");
        for e in 0..5 {
            let mut batch = Batch::zeros(&extra, rows(e) + longer * (e / 4));
            let values = batch.get_mut::<f32>("embedding").expect("accessing the values").iter_mut().enumerate();
            values.for_each(|(i, value)| *value = (100 * e + i) as f32);
            writer.write_episode(&batch).expect("writing an episode");
        }
        writer.finish().expect("finishing the dataset");
        open(&path).expect("opening the dataset")
    };
    let other = embedded("other.lance", 0);
    let both = merge(Arc::clone(&base), Arc::clone(&other), &["embedding"]).expect("merging the datasets");
    check(&*both, 0);
    let read = both.read(&["embedding", "state"], &[StepRange::new(3, 1, 2)]).expect("reading rows");
    assert_eq!(read.get::<f32>("embedding").expect("reading the values"), [302.0, 303.0, 304.0, 305.0]);
    assert_eq!(read.get::<f64>("state").expect("reading the values")[..2], [3.0, 1.0]);
    assert!(both.footprint().expect("listing the files").iter().any(|(name, _)| name == "embedding"));

    let error = |other, columns: &[&str]| {
        merge(Arc::clone(&base), other, columns).err().expect("the call must fail").to_string()
    };
    assert!(error(embedded("long.lance", 1), &["embedding"]).contains("episode 4"));
    assert!(error(Arc::clone(&other), &["embeding"]).contains("did you mean embedding"));
    assert!(error(Arc::clone(&base), &["state"]).contains("a column of that name"));
}

#[test]
fn views_of_splits_keep_episode_indices_and_rows() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let all = dataset(&folder.path().join("d.lance"), 0..40);
    let parts = [Part::Train, Part::Validation, Part::Test].map(|part| {
        let chosen = Split::default().episodes(&*all, part).expect("listing the episodes of the part");
        subset(Arc::clone(&all), chosen).expect("selecting episodes")
    });
    let mut indices: Vec<i64> = parts.iter().flat_map(|part| part.episodes().iter().map(|e| e.index)).collect();
    indices.sort_unstable();
    assert_eq!(indices, (0..40).collect::<Vec<_>>());
    // A view of views: two columns of the concatenated validation and test episodes.
    let held_out = concat(vec![Arc::clone(&parts[1]), Arc::clone(&parts[2])]).expect("concatenating the datasets");
    let held_out = select(held_out, &["state", "action"]).expect("selecting columns");
    assert_eq!(held_out.schema().columns().len(), 4);
    for (position, stored) in held_out.episodes().iter().enumerate() {
        let read = held_out.read(&["state"], &[StepRange::new(position, 0, stored.length)]).expect("reading rows");
        let e = read.row(0).get::<f64>("state").expect("reading the states")[0] as usize;
        assert_eq!(
            (stored.length, Split::default().part(e as i64)),
            (rows(e), if position < 6 { Part::Validation } else { Part::Test })
        );
        assert_eq!(read.bytes(0), episode(e).bytes(2));
    }
    assert!(held_out.read(&["pixels"], &[StepRange::new(0, 0, 1)]).is_err(), "reading an unselected column must fail");
    for (positions, words) in [(vec![], "at least one"), (vec![40], "below 40"), (vec![1, 1], "twice")] {
        assert!(subset(Arc::clone(&all), positions).err().expect("the call must fail").to_string().contains(words));
    }
    assert_eq!(
        select(all, &COLUMNS).expect("selecting all columns").schema().columns().len(),
        schema().columns().len() + 1
    );
}
