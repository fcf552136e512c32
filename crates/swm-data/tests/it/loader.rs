//! The loader yields every clip once per epoch, in an order that depends only on the seed and the epoch.

use crate::sample::{rows, write};
use std::path::PathBuf;
use std::sync::Arc;
use swm_core::{Batch, DType};
use swm_data::{BatchSlice, CacheConfig, ClipSpec, LoadedBatch, Loader, LoaderConfig, Reader, WriteMode, open};

const EPISODES: usize = 9;

fn dataset(group: usize) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    write(&path, WriteMode::Create, group, 0..EPISODES);
    (folder, path)
}

fn config(num_steps: usize, frameskip: usize) -> LoaderConfig {
    let columns = ["pixels", "action", "state"].map(str::to_owned).to_vec();
    LoaderConfig {
        clip: ClipSpec { num_steps, frameskip, columns },
        batch_size: 4,
        seed: 11,
        cache: CacheConfig::Off,
        ..LoaderConfig::default()
    }
}

fn load(reader: &Arc<dyn Reader>, config: LoaderConfig, epoch: u64, first: usize) -> Vec<Batch> {
    let loader = Loader::new(Arc::clone(reader), config).expect("creating the loader");
    let batches: Vec<Batch> =
        loader.epoch(epoch, first).map(|batch| batch.expect("reading the batch").into_batch()).collect();
    assert_eq!(batches.len(), loader.batches_per_epoch() - first);
    batches
}

/// `(episode, first row)` of every clip, decoded from its states.
fn clips(batches: &[Batch]) -> Vec<(usize, usize)> {
    let mut found = vec![];
    for batch in batches {
        for row in 0..batch.rows() {
            let state = batch.row(row).get::<f64>("state").expect("reading the states");
            found.push((state[0] as usize, state[1] as usize));
        }
    }
    found
}

fn bytes(batches: &[Batch]) -> Vec<Vec<u8>> {
    batches.iter().flat_map(|b| (0..b.schema().columns().len()).map(|c| b.bytes(c).to_vec())).collect()
}

#[test]
fn yields_every_clip_once_with_its_rows() {
    let (_folder, path) = dataset(2);
    let reader = open(&path).expect("opening the dataset");
    let (steps, skip) = (2, 3);
    let batches = load(&reader, config(steps, skip), 0, 0);
    let mut expected: Vec<(usize, usize)> =
        (0..EPISODES).flat_map(|e| (0..(rows(e) + 1).saturating_sub(steps * skip)).map(move |s| (e, s))).collect();
    let mut found = clips(&batches);
    assert_ne!(found, expected, "the clips are shuffled");
    found.sort_unstable();
    expected.sort_unstable();
    assert_eq!(found, expected);
    for batch in &batches {
        assert_eq!(batch.schema().columns()[1].shape, [steps, 2 * skip]);
        for row in 0..batch.rows() {
            let state = batch.row(row).get::<f64>("state").expect("reading the states");
            let (e, start) = (state[0] as usize, state[1] as usize);
            for k in 0..steps {
                assert_eq!(state[3 * k..3 * k + 2], [e as f64, (start + k * skip) as f64]);
                let frame = batch.row(row).get::<u8>("pixels").expect("reading the images");
                let frame = &frame[k * 16 * 24 * 3..(k + 1) * 16 * 24 * 3];
                let first = ((3 * (start + k * skip) + 20 * e) % 256) as u8;
                assert!(frame[0].abs_diff(first) < 40, "{} {first}", frame[0]);
            }
            // Actions of skipped rows are included, in order; only the action of an episode's last row is missing.
            let action = batch.row(row).get::<f32>("action").expect("reading the actions");
            for (i, pair) in action.chunks_exact(2).enumerate() {
                if start + i + 1 == rows(e) {
                    assert!(pair.iter().all(|v| v.is_nan()) && i + 1 == steps * skip);
                } else {
                    assert_eq!(pair, [e as f32, (start + i) as f32 / 4.0]);
                }
            }
        }
    }
}

#[test]
fn batch_order_depends_only_on_seed_and_epoch() {
    let (_folder, path) = dataset(2);
    let (_other_folder, other_path) = dataset(100);
    let reader = open(&path).expect("opening the dataset");
    let other = open(&other_path).expect("opening the dataset");
    let base = load(&reader, config(3, 1), 5, 0);
    for threads in [0, 1, 4] {
        for prefetch in [1, 3] {
            for cache in
                [CacheConfig::Off, CacheConfig::Memory { bytes: 1 << 30 }, CacheConfig::Memory { bytes: 20_000 }]
            {
                let config = LoaderConfig { threads, prefetch, cache, ..config(3, 1) };
                assert!(bytes(&load(&reader, config.clone(), 5, 0)) == bytes(&base), "{threads} {prefetch}");
                assert!(
                    bytes(&load(&other, config.clone(), 5, 0)) == bytes(&base),
                    "batches do not depend on the data files"
                );
                assert!(
                    bytes(&load(&reader, config, 5, 4)) == bytes(&base[4..]),
                    "a resumed epoch has the same batches"
                );
            }
        }
    }
    assert_ne!(clips(&load(&reader, config(3, 1), 6, 0)), clips(&base));
    assert_ne!(clips(&load(&reader, LoaderConfig { seed: 12, ..config(3, 1) }, 5, 0)), clips(&base));
    let plain = clips(&load(&reader, LoaderConfig { shuffle: false, ..config(3, 1) }, 5, 0));
    assert!(plain.is_sorted());
}

#[test]
fn slices_of_all_ranks_are_the_batch() {
    let (_folder, path) = dataset(2);
    let reader = open(&path).expect("opening the dataset");
    let all = Loader::new(Arc::clone(&reader), config(3, 1)).expect("creating the loader").clips();
    // The last batch has one or two clips, so that some ranks get nothing of it.
    let batch_size = (all - 1) / 2;
    let whole = load(&reader, LoaderConfig { batch_size, ..config(3, 1) }, 2, 0);
    assert!(whole.last().expect("a batch").rows() < 3, "the last batch is full");
    for ranks in 1..=9 {
        let slices: Vec<Vec<Batch>> = (0..ranks)
            .map(|rank| {
                let slice = BatchSlice { rank, ranks };
                load(&reader, LoaderConfig { batch_size, slice, ..config(3, 1) }, 2, 0)
            })
            .collect();
        for (index, batch) in whole.iter().enumerate() {
            for column in 0..batch.schema().columns().len() {
                let joined: Vec<u8> = slices.iter().flat_map(|slice| slice[index].bytes(column).to_vec()).collect();
                assert!(joined == batch.bytes(column), "{ranks} ranks, batch {index}, column {column}");
            }
            let sizes: Vec<usize> = slices.iter().map(|slice| slice[index].rows()).collect();
            assert!(sizes.iter().max() <= sizes.iter().min().map(|size| size + 1).as_ref(), "{sizes:?}");
        }
    }
    let outside = LoaderConfig { slice: BatchSlice { rank: 2, ranks: 2 }, ..config(3, 1) };
    let error = Loader::new(reader, outside).map(|_| ()).expect_err("a rank out of range is accepted").to_string();
    assert!(error.contains("rank 2 of 2"), "{error}");
}

#[test]
fn loader_follows_the_episode_selection_drop_last_and_the_first_batch() {
    let (_folder, path) = dataset(2);
    let reader = open(&path).expect("opening the dataset");
    let cache = CacheConfig::Memory { bytes: 1 << 30 };
    let some = LoaderConfig { episodes: Some(vec![7, 2]), cache, ..config(2, 1) };
    let loader = Loader::new(Arc::clone(&reader), some.clone()).expect("creating the loader");
    assert_eq!(loader.clips(), rows(2) + rows(7) - 2);
    let mut episodes: Vec<usize> = clips(&load(&reader, some.clone(), 0, 0)).iter().map(|c| c.0).collect();
    episodes.sort_unstable();
    episodes.dedup();
    assert_eq!(episodes, [2, 7]);
    let full = load(&reader, LoaderConfig { drop_last: true, ..some }, 0, 0);
    assert!(full.iter().all(|batch| batch.rows() == 4));
    // An epoch may be dropped early. An epoch that starts after the last batch is empty.
    let loader = Loader::new(Arc::clone(&reader), config(1, 1)).expect("creating the loader");
    assert_eq!(loader.epoch(0, 0).take(2).count(), 2);
    assert_eq!(loader.epoch(0, loader.batches_per_epoch()).count(), 0);
    assert_eq!(loader.schema().columns()[0].shape, [1, 16, 24, 3]);
    assert_eq!(loader.schema().columns()[2].dtype, DType::Float64);
}

#[test]
fn loader_reuses_batch_memory_and_reads_two_epochs_concurrently() {
    let (_folder, path) = dataset(2);
    let reader = open(&path).expect("opening the dataset");
    let loader = Loader::new(Arc::clone(&reader), config(1, 1)).expect("creating the loader");
    let read = |epoch: u64| -> Vec<Batch> {
        loader.epoch(epoch, 0).map(|batch| batch.expect("reading the batch").into_batch()).collect()
    };
    let (first, second) = (read(1), read(2));
    // The memory of dropped batches is reused, and resized to the rows of the next batch.
    let addresses = || -> Vec<(usize, Vec<u8>)> {
        let address_and_bytes = |batch: LoadedBatch| (batch.bytes(0).as_ptr() as usize, batch.bytes(0).to_vec());
        loader.epoch(1, 0).map(|batch| address_and_bytes(batch.expect("reading the batch"))).collect()
    };
    let (once, twice) = (addresses(), addresses());
    assert!(once.iter().chain(&twice).zip(first.iter().chain(&first)).all(|((_, a), b)| a == b.bytes(0)));
    let mut buffers: Vec<usize> = once.iter().chain(&twice).map(|(address, _)| *address).collect();
    buffers.sort_unstable();
    buffers.dedup();
    assert!(buffers.len() <= loader.prefetch() + 3, "{} buffers for {} batches", buffers.len(), 2 * once.len());
    let both: Vec<(LoadedBatch, LoadedBatch)> = loader
        .epoch(1, 0)
        .zip(loader.epoch(2, 0))
        .map(|(a, b)| (a.expect("reading the batch"), b.expect("reading the batch")))
        .collect();
    let split = |pick: fn(&(LoadedBatch, LoadedBatch)) -> &LoadedBatch| {
        both.iter().map(|pair| Batch::clone(pick(pair))).collect::<Vec<_>>()
    };
    assert!(bytes(&split(|pair| &pair.0)) == bytes(&first) && bytes(&split(|pair| &pair.1)) == bytes(&second));
}

#[test]
fn prefetch_count_respects_the_byte_budget() {
    let (_folder, path) = dataset(2);
    let reader = open(&path).expect("opening the dataset");
    let ahead = |prefetch_bytes| {
        let config = LoaderConfig { prefetch: 8, prefetch_bytes, ..config(2, 1) };
        Loader::new(Arc::clone(&reader), config).expect("creating the loader").prefetch()
    };
    // Four clips of two images, actions and states.
    let batch = 4 * 2 * (16 * 24 * 3 + 8 + 24);
    assert_eq!([0, batch, 3 * batch - 1, 1 << 30].map(ahead), [1, 1, 2, 8]);
}

#[test]
fn invalid_settings_are_explained() {
    let (_folder, path) = dataset(100);
    let reader = open(&path).expect("opening the dataset");
    let wrong = |config| Loader::new(Arc::clone(&reader), config).err().expect("the call must fail").to_string();
    let columns = |name: &str| ClipSpec { columns: vec![name.to_owned()], ..config(1, 1).clip };
    assert!(wrong(LoaderConfig { clip: columns("actions"), ..config(1, 1) }).contains("did you mean action"));
    assert!(wrong(config(4, 4)).contains("the longest has 11"));
    assert!(wrong(LoaderConfig { batch_size: 0, ..config(1, 1) }).contains("batch_size"));
    assert!(wrong(LoaderConfig { episodes: Some(vec![9]), ..config(1, 1) }).contains("positions below 9"));
    let twice = wrong(LoaderConfig { episodes: Some(vec![3, 5, 3]), ..config(1, 1) });
    assert!(twice.contains("episodes: 3 is there twice"), "{twice}");
    assert!(wrong(LoaderConfig { batch_size: 1000, drop_last: true, ..config(1, 1) }).contains("drop_last"));
}

#[test]
fn damaged_dataset_ends_the_epoch_with_an_error() {
    let (_folder, path) = dataset(2);
    let reader = open(&path).expect("opening the dataset");
    for entry in std::fs::read_dir(path.join("data")).expect("listing a folder") {
        std::fs::File::create(entry.expect("reading the folder entry").path()).expect("emptying a file");
    }
    for threads in [0, 2] {
        let loader =
            Loader::new(Arc::clone(&reader), LoaderConfig { threads, ..config(2, 1) }).expect("creating the loader");
        let results: Vec<_> = loader.epoch(0, 0).collect();
        assert!(results.last().is_some_and(Result::is_err), "{threads} threads");
    }
}
