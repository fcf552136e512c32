//! Online learning: a world collects into a replay buffer while a learner reads from it.

use crate::line::ENTRY;
use crate::memory::Memory;
use std::thread::scope;
use swm_core::run::Control;
use swm_core::{RandomPolicy, VariationRequest};
use swm_data::{ClipSpec, ReplayBuffer, ReplayConfig};
use swm_eval::{CollectConfig, World, WorldConfig};

fn world() -> World {
    let config = WorldConfig { envs: 3, image: Some((2, 3)), threads: 1, ..WorldConfig::default() };
    World::new(&ENTRY, config).expect("a valid world")
}

fn config(episodes: usize) -> CollectConfig {
    let variation = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
    CollectConfig { episodes, seed: 11, variation, policy: "random".to_owned(), goal: false, first: 0 }
}

#[test]
fn collecting_and_reading_run_concurrently() {
    let mut world = world();
    let mut policy = RandomPolicy::new(world.spec(), 3);
    let buffer = ReplayBuffer::new(&world.collect_schema(false).expect("a valid schema"), 120).expect("a valid buffer");
    let into = |world: &mut World, policy: &mut RandomPolicy, episodes| {
        world
            .collect(policy, buffer.writer(), &config(episodes), &mut Control::default())
            .expect("the collection succeeds")
    };
    into(&mut world, &mut policy, 5);
    let columns = ["state", "action", "reward"].map(str::to_owned).to_vec();
    let clip = ClipSpec { num_steps: 2, frameskip: 1, columns };
    let loader =
        buffer.loader(ReplayConfig { clip, batch_size: 16, ..ReplayConfig::default() }).expect("a valid loader");
    scope(|scope| {
        let reading = scope.spawn(|| {
            // Reads until new episodes have replaced the first ones.
            loader.batches(0).take(100_000).take_while(|batch| batch.is_ok() && buffer.added() < 60).count()
        });
        let collected = into(&mut world, &mut policy, 60);
        assert_eq!((collected.episodes, collected.added), (60, 55), "continues after the first five");
        assert!(reading.join().is_ok());
    });
    // The buffer holds the last episodes of the same collection into a dataset.
    let memory = Memory::default();
    let mut again = self::world();
    let mut policy = RandomPolicy::new(again.spec(), 3);
    again.collect(&mut policy, memory.writer(), &config(60), &mut Control::default()).expect("the collection succeeds");
    let expected = memory.episodes.lock().expect("no thread has panicked");
    let kept = buffer.snapshot();
    assert!(kept.episodes().len() < 60 && buffer.rows() <= 120);
    for (position, episode) in kept.episodes().iter().enumerate() {
        let whole = [swm_data::StepRange::new(position, 0, episode.length)];
        let read = kept.read(&["state", "reward"], &whole).expect("the buffer is readable");
        let recorded = &expected[episode.index as usize];
        for (i, name) in ["state", "reward"].into_iter().enumerate() {
            assert_eq!(read.bytes(i), recorded.bytes(recorded.schema().index(name).expect("a column")), "{name}");
        }
    }
}
