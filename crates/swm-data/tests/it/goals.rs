//! The loader draws goals with every clip, reproducibly.

use crate::sample::{rows, write};
use std::sync::Arc;
use swm_core::Batch;
use swm_data::{CacheConfig, ClipSpec, GoalMixture, GoalSpec, Loader, LoaderConfig, Reader, WriteMode, open};

fn load(reader: &Arc<dyn Reader>, config: LoaderConfig, epoch: u64, first: usize) -> Vec<Batch> {
    let loader = Loader::new(Arc::clone(reader), config).expect("creating the loader");
    loader.epoch(epoch, first).map(|batch| batch.expect("reading the batch").into_batch()).collect()
}

fn config(goals: &[(&str, GoalMixture)]) -> LoaderConfig {
    let goal = |&(name, mixture): &(&str, GoalMixture)| GoalSpec {
        name: name.to_owned(),
        columns: ["state", "pixels"].map(str::to_owned).to_vec(),
        anchor: None,
        mixture,
    };
    LoaderConfig {
        clip: ClipSpec { num_steps: 2, frameskip: 2, columns: ["state", "action"].map(str::to_owned).to_vec() },
        goals: goals.iter().map(goal).collect(),
        batch_size: 5,
        seed: 3,
        ..LoaderConfig::default()
    }
}

#[test]
fn goals_are_rows_at_the_reported_offsets() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    write(&path, WriteMode::Create, 3, 0..9);
    let reader = open(&path).expect("opening the dataset");
    let goals = [("goal", GoalMixture::default()), ("end", GoalMixture::LAST), ("later", GoalMixture::FUTURE)];
    let batches = load(&reader, config(&goals), 0, 0);
    // A clip has two steps of two rows; a goal after the second step requires one more row.
    let expected: usize = (0..9).map(|e| (rows(e) + 1).saturating_sub(5)).sum();
    assert_eq!(batches.iter().map(Batch::rows).sum::<usize>(), expected);
    let shapes: Vec<&[usize]> = batches[0].schema().columns()[2..5].iter().map(|c| &c.shape[..]).collect();
    assert_eq!(shapes, [&[1, 3][..], &[1, 16, 24, 3], &[]]);
    for batch in &batches {
        for row in (0..batch.rows()).map(|row| batch.row(row)) {
            let state = row.get::<f64>("state").expect("reading the states");
            let (e, now) = (state[0], state[4]);
            for name in ["goal", "end", "later"] {
                let goal = row.get::<f64>(&format!("{name}_state")).expect("reading the goal");
                let offset = row.get::<i64>(&format!("{name}_offset")).expect("reading the offset")[0];
                if offset >= 0 {
                    assert_eq!((goal[0], goal[1]), (e, now + offset as f64), "{name}");
                } else {
                    assert!(name == "goal" && (goal[0] != e || goal[1] < now));
                }
                let pixel = f64::from(row.get::<u8>(&format!("{name}_pixels")).expect("reading the image")[0]);
                let drawn = (3.0 * goal[1] + 20.0 * goal[0]) % 256.0;
                assert!((pixel - drawn).abs() < 40.0, "the goal image belongs to another row: {pixel} {drawn}");
                match name {
                    "end" => assert_eq!(goal[1] as usize + 1, rows(e as usize)),
                    "later" => assert!(offset > 0 && offset % 2 == 0),
                    _ => {}
                }
            }
        }
    }
}

#[test]
fn goals_are_reproducible_and_differ_between_epochs() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    write(&path, WriteMode::Create, 3, 0..9);
    let reader = open(&path).expect("opening the dataset");
    let goals = [("goal", GoalMixture::default())];
    let states = |config: LoaderConfig, epoch, first| -> Vec<f64> {
        let batches = load(&reader, config, epoch, first);
        batches.iter().flat_map(|batch| batch.get::<f64>("goal_state").expect("reading the goals").to_vec()).collect()
    };
    let base = states(config(&goals), 4, 0);
    let other = LoaderConfig { threads: 0, cache: CacheConfig::Off, batch_size: 7, ..config(&goals) };
    assert_eq!(states(other, 4, 0), base, "goals depend neither on threads nor on the batch size");
    assert_eq!(states(config(&goals), 4, 2), base[2 * 5 * 3..], "a resumed epoch has the same goals");
    assert_ne!(states(config(&goals), 5, 0), base);
    // With one selected episode, all goals belong to the selected episode.
    let selected = LoaderConfig { episodes: Some(vec![6]), ..config(&[("goal", GoalMixture::RANDOM)]) };
    assert!(states(selected, 0, 0).chunks(3).all(|state| state[0] == 6.0));
    let refused = Loader::new(reader, config(&[("goal", GoalMixture { last: 0.5, ..GoalMixture::RANDOM })]));
    assert!(refused.err().expect("the call must fail").to_string().contains("add up to 1"));
}
