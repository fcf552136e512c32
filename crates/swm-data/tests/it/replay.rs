//! The replay buffer evicts the oldest episodes, provides samples while it grows, and can be saved and restored.

use crate::sample::{check, episode, rows, schema};
use swm_core::{Batch, Key};
use swm_data::{
    ClipSpec, Constants, GoalMixture, GoalSpec, ReplayBuffer, ReplayConfig, StepRange, WriteMode, WriteOptions, open,
};

fn config(num_steps: usize) -> ReplayConfig {
    let columns = ["state", "action", "pixels"].map(str::to_owned).to_vec();
    ReplayConfig { clip: ClipSpec { num_steps, frameskip: 1, columns }, batch_size: 32, ..ReplayConfig::default() }
}

fn filled(episodes: std::ops::Range<usize>, capacity: usize) -> ReplayBuffer {
    let buffer = ReplayBuffer::new(&schema(), capacity).expect("creating the replay buffer");
    let mut writer = buffer.writer();
    for e in episodes {
        let constants = Constants::from([("scene".to_owned(), vec![e as u8])]);
        writer.write_episode_with(&episode(e), &constants).expect("writing an episode");
    }
    writer.finish().expect("finishing the dataset");
    buffer
}

/// The episode and the row of the first step of every clip.
fn first_rows(batch: &Batch) -> Vec<(usize, usize)> {
    let state = |row| batch.row(row).get::<f64>("state").expect("reading the states").to_vec();
    (0..batch.rows()).map(|row| (state(row)[0] as usize, state(row)[1] as usize)).collect()
}

#[test]
fn evicts_the_oldest_episodes_and_snapshots_stay_unchanged() {
    let buffer = filled(0..6, 30);
    // Episodes have 5, 6, 7, 8, 9 and 10 rows.
    assert_eq!((buffer.rows(), buffer.episodes(), buffer.added()), (27, 3, 6));
    let before = buffer.snapshot();
    check(&*before, 3);
    assert_eq!(before.episodes()[0].index, 3);
    assert_eq!(before.constants(1).expect("reading constants")["scene"], [4]);
    buffer.add(&episode(6), &Constants::new()).expect("adding an episode");
    assert_eq!((buffer.rows(), buffer.episodes(), buffer.snapshot().episodes()[0].index), (30, 3, 4));
    check(&*before, 3);
    assert_ne!(
        before.content_hash().expect("hashing the content"),
        buffer.snapshot().content_hash().expect("hashing the content")
    );
    assert_eq!(buffer.writer().episodes(), 7, "a resumed collection continues after the evicted episodes");

    let small = ReplayBuffer::new(&schema(), 6).expect("creating the replay buffer");
    assert!(
        small
            .add(&episode(2), &Constants::new())
            .expect_err("an episode beyond the capacity")
            .to_string()
            .contains("capacity")
    );
    let mut given = episode(0);
    given.get_mut::<f32>("action").expect("accessing the actions").fill(0.5);
    small.add(&given, &Constants::new()).expect("an episode with an action in the last row");
    let last = StepRange::new(0, given.rows() - 1, 1);
    let read = small.snapshot().read(&["action"], &[last]).expect("reading the last action");
    assert_eq!(read.get::<f32>("action").expect("accessing the actions"), [0.5; 2]);
    given.get_mut::<f32>("action").expect("accessing the actions").fill(f32::NAN);
    let refused = small.add(&given, &Constants::new()).expect_err("missing actions before the last row");
    assert!(refused.to_string().contains("the action taken from this row's observation"), "{refused}");
    assert!(ReplayBuffer::new(&schema(), 0).is_err());
}

#[test]
fn sizes_beyond_any_memory_are_refused() {
    let error = ReplayBuffer::new(&schema(), usize::MAX).err().expect("a capacity of 2^64 rows").to_string();
    assert!(error.contains("bytes of a replay buffer"), "{error}");
    let huge = ReplayConfig { batch_size: 1 << 60, ..config(3) };
    let error = filled(0..2, 100).loader(huge).err().expect("a batch of 2^60 clips").to_string();
    assert!(error.contains("bytes of a batch"), "{error}");
}

#[test]
fn samples_windows_uniformly_and_reproducibly() {
    let buffer = filled(0..6, 100);
    let loader = buffer.loader(ReplayConfig { batch_size: 9000, ..config(3) }).expect("creating the loader");
    let batch = loader.sample(Key::new(1)).expect("sampling a batch");
    assert_eq!(first_rows(&batch), first_rows(&loader.sample(Key::new(1)).expect("sampling a batch")));
    let mut count = vec![[0_i32; 10]; 6];
    for (e, start) in first_rows(&batch) {
        assert!(start + 3 <= rows(e), "a window extends beyond its episode");
        count[e][start] += 1;
    }
    // The tolerance is five standard deviations of the count of one of 33 windows in 9000 draws.
    let counts = count.iter().flatten().filter(|&&n| n > 0);
    assert_eq!(counts.clone().count(), 33);
    assert!(counts.clone().all(|n| n.abs_diff(273) < 82), "{count:?}");
    // The latest twelve rows belong to the last two episodes.
    let recent = buffer.loader(ReplayConfig { recent: Some(12), ..config(1) }).expect("creating the loader");
    assert!(first_rows(&recent.sample(Key::new(2)).expect("sampling a batch")).iter().all(|&(e, _)| e >= 4));
    let goal =
        GoalSpec { name: "goal".into(), columns: vec!["state".into()], anchor: None, mixture: GoalMixture::LAST };
    let goals = buffer.loader(ReplayConfig { goals: vec![goal], ..config(1) }).expect("creating the loader");
    let batch = goals.sample(Key::new(0)).expect("sampling a batch");
    for (row, (e, _)) in first_rows(&batch).into_iter().enumerate() {
        let goal = batch.row(row).get::<f64>("goal_state").expect("reading the goals");
        assert_eq!((goal[0] as usize, goal[1] as usize + 1), (e, rows(e)));
    }
}

#[test]
fn samples_while_the_buffer_grows() {
    let buffer = filled(0..2, 200);
    let loader = buffer.loader(ReplayConfig { threads: 2, ..config(2) }).expect("creating the loader");
    let writer = buffer.clone();
    let writing = std::thread::spawn(move || {
        for e in 2..300 {
            writer.add(&episode(e), &Constants::new()).expect("adding an episode");
        }
    });
    let mut latest = 0;
    for batch in loader.batches(0) {
        let batch = batch.expect("reading the batch");
        let first_steps = first_rows(&batch);
        // Every window is complete, even if episodes are evicted in the meantime.
        for (row, &(e, start)) in first_steps.iter().enumerate() {
            let state = batch.row(row).get::<f64>("state").expect("reading the states");
            assert_eq!([state[3], state[4]], [e as f64, start as f64 + 1.0]);
            let pixel = batch.row(row).get::<u8>("pixels").expect("reading the images")[0];
            assert_eq!(usize::from(pixel), (3 * start + 20 * e) % 256);
        }
        let oldest = first_steps.iter().map(|first| first.0).min().unwrap_or(0);
        latest = latest.max(oldest);
        if oldest > 250 {
            break;
        }
    }
    assert!(latest > 250, "the loader samples added episodes");
    writing.join().expect("joining the writer");
    // Without a window, sampling fails and the stream ends.
    let empty = ReplayBuffer::new(&schema(), 10)
        .expect("creating the replay buffer")
        .loader(config(1))
        .expect("creating the loader");
    let mut batches = empty.batches(0);
    assert!(batches.next().is_some_and(|batch| batch.is_err()) && batches.next().is_none());
}

#[test]
fn restored_buffer_equals_the_saved_buffer() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("buffer.lance");
    let buffer = filled(0..6, 30);
    let state = |buffer: &ReplayBuffer| (buffer.rows(), buffer.episodes(), buffer.added());
    // The same episodes, without constants.
    let plain = ReplayBuffer::new(&schema(), 30).expect("creating the replay buffer");
    (0..6).for_each(|e| plain.add(&episode(e), &Constants::new()).expect("adding an episode"));
    assert_eq!(state(&plain), state(&buffer));
    let options = WriteOptions { mode: WriteMode::Create, ..WriteOptions::default() };
    plain.save(&path, options).expect("saving the buffer");
    let reader = open(&path).expect("opening the dataset");
    let restored = ReplayBuffer::restore(&*reader, 30).expect("restoring the buffer");
    assert_eq!(state(&restored), state(&plain));
    assert_eq!(restored.snapshot().episodes(), plain.snapshot().episodes());
    let drawn = |buffer: &ReplayBuffer| {
        let batch =
            buffer.loader(config(2)).expect("creating the loader").sample(Key::new(5)).expect("sampling a batch");
        (batch.bytes(0).to_vec(), batch.bytes(1).to_vec(), batch.bytes(2).to_vec())
    };
    assert!(drawn(&restored) == drawn(&plain), "the restored buffer draws the same samples");
    let smaller = ReplayBuffer::restore(&*reader, 20).expect("restoring the buffer");
    assert_eq!(state(&smaller), (19, 2, 6), "the smaller buffer holds the latest episodes");
}
