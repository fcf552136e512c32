//! Online learning: a world collects into a replay buffer while a learner reads from the buffer.

use crate::line::ENTRY;
use crate::memory::Memory;
use std::thread::scope;
use swm_core::run::Control;
use swm_core::{RandomPolicy, VariationRequest};
use swm_data::{ClipSpec, ReplayBuffer, ReplayConfig};
use swm_eval::{CollectConfig, World, WorldConfig};

fn world() -> World {
    let config = WorldConfig { envs: 3, image: Some((2, 3)), threads: 1, ..WorldConfig::default() };
    World::new(&ENTRY, config).expect("creating the world")
}

fn config(episodes: usize) -> CollectConfig {
    let variation = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
    CollectConfig { episodes, seed: 11, variation, policy: "random".into(), ..CollectConfig::default() }
}

#[test]
fn replay_buffer_is_read_while_episodes_are_collected() {
    let mut world = world();
    let mut policy = RandomPolicy::new(world.spec(), 3);
    let buffer =
        ReplayBuffer::new(&world.collect_schema(&config(1)).expect("creating the schema of collected episodes"), 120)
            .expect("creating the replay buffer");
    let collect_into_buffer = |world: &mut World, policy: &mut RandomPolicy, episodes| {
        world
            .collect(policy, buffer.writer(), &config(episodes), &mut Control::default())
            .expect("the collection succeeds")
    };
    collect_into_buffer(&mut world, &mut policy, 5);
    let columns = ["state", "action", "reward"].map(str::to_owned).to_vec();
    let clip = ClipSpec { num_steps: 2, frameskip: 1, columns };
    let loader =
        buffer.loader(ReplayConfig { clip, batch_size: 16, ..ReplayConfig::default() }).expect("creating the loader");
    scope(|scope| {
        let reading = scope.spawn(|| {
            // Reads until new episodes have replaced the first episodes.
            loader.batches(0).take(100_000).take_while(|batch| batch.is_ok() && buffer.added() < 60).count()
        });
        let collected = collect_into_buffer(&mut world, &mut policy, 60);
        assert_eq!(
            (collected.episodes, collected.added),
            (60, 55),
            "the collection continues after the first five episodes"
        );
        assert!(reading.join().is_ok());
    });
    // The buffer holds the last episodes of the same collection into a dataset.
    let memory = Memory::default();
    let mut other_world = self::world();
    let mut policy = RandomPolicy::new(other_world.spec(), 3);
    other_world
        .collect(&mut policy, memory.writer(), &config(60), &mut Control::default())
        .expect("the collection succeeds");
    let expected = memory.episodes.lock().expect("no thread has panicked");
    let snapshot = buffer.snapshot();
    assert!(snapshot.episodes().len() < 60 && buffer.rows() <= 120);
    for (position, episode) in snapshot.episodes().iter().enumerate() {
        let all_rows = [swm_data::StepRange::new(position, 0, episode.length)];
        let read = snapshot.read(&["state", "reward"], &all_rows).expect("the buffer is readable");
        let recorded = &expected[episode.index as usize];
        for (i, name) in ["state", "reward"].into_iter().enumerate() {
            assert_eq!(
                read.bytes(i),
                recorded.bytes(recorded.schema().index(name).expect("finding the column")),
                "{name}"
            );
        }
    }
}
