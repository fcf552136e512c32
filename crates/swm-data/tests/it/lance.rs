//! The format `lance`.

use crate::sample::{COLUMNS, check, episode, manifest, options, rows, schema, write};
use rand::Rng as _;
use std::path::Path;
use swm_core::{Batch, ColumnSpec, DType, Error, Key, Schema};
use swm_data::{CommitPolicy, Constants, ImageCodec, StepRange, WriteMode, WriteOptions, column_stats, create, open};

fn failure(path: &Path, schema: &Schema, mode: WriteMode) -> String {
    match create(path, schema, options(mode)) {
        Ok(_) => panic!("{} was accepted", path.display()),
        Err(error) => error.to_string(),
    }
}

#[test]
fn written_episodes_round_trip() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("with space ü%20.lance");
    write(&path, WriteMode::Create, 2, 0..9);
    let reader = open(&path).expect("opening the dataset");
    assert_eq!(reader.episodes().len(), 9);
    check(&*reader, 0);
    assert_eq!(reader.manifest(), Some(manifest(3)));
    // Names and types are unchanged, with index columns first.
    let mut expected = vec![ColumnSpec::new("episode_idx", DType::Int32, []), schema().columns()[5].clone()];
    expected.extend(schema().columns().iter().filter(|c| c.name != "step_idx").cloned());
    assert_eq!(reader.schema().columns(), expected);
    // A folder that contains one table can also be opened.
    assert_eq!(open(folder.path()).expect("opening the dataset").episodes(), reader.episodes());
    let on_disk: u64 = reader.footprint().expect("listing the files").iter().map(|(_, bytes)| bytes).sum();
    assert!(on_disk > 5_000, "{on_disk}");
}

/// The default policy commits after seconds or megabytes.
#[test]
fn synced_episodes_are_stored_while_the_writer_is_open() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    let mut writer = create(&path, &schema(), options(WriteMode::Create)).expect("creating the dataset");
    for index in 0..3 {
        writer.write_episode(&episode(index)).expect("writing");
        writer.sync().expect("committing");
        assert_eq!(open(&path).expect("opening the dataset").episodes().len(), index + 1);
    }
    writer.finish().expect("finishing");
}

#[test]
fn reads_row_ranges_in_the_requested_order() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    write(&path, WriteMode::Create, 3, 0..12);
    let reader = open(&path).expect("opening the dataset");
    let mut rng = Key::new(1).rng();
    for _ in 0..20 {
        let ranges: Vec<StepRange> = (0..rng.random_range(1..12))
            .map(|_| {
                let e = rng.random_range(0..12);
                let start = rng.random_range(0..rows(e));
                StepRange::new(e, start, rng.random_range(0..=rows(e) - start))
            })
            .collect();
        let read = reader.read(&["goal", "state", "step_idx", "episode_idx", "pixels"], &ranges).expect("reading rows");
        let mut row = 0;
        for range in &ranges {
            for t in range.start..range.start + range.length {
                assert_eq!(read.row(row).at::<f64>(1), [range.episode as f64, t as f64, -0.5]);
                assert_eq!(read.row(row).at::<i64>(2), [t as i64]);
                assert_eq!(read.row(row).at::<i32>(3), [range.episode as i32]);
                assert!(read.row(row).at::<u8>(0)[0].abs_diff(100 + range.episode as u8) < 4);
                let first = ((3 * t + 20 * range.episode) % 256) as u8;
                assert!(read.row(row).at::<u8>(4)[0].abs_diff(first) < 40);
                row += 1;
            }
        }
        assert_eq!(row, read.rows());
    }
}

#[test]
fn invalid_columns_and_rows_are_explained() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    write(&path, WriteMode::Create, 3, 0..2);
    let reader = open(&path).expect("opening the dataset");
    let wrong = |column, range| reader.read(&[column], &[range]).expect_err("an invalid request").to_string();
    assert!(wrong("pixel", StepRange::new(0, 0, 1)).contains("did you mean pixels"));
    assert!(wrong("state", StepRange::new(2, 0, 1)).contains("positions below 2"));
    assert!(wrong("state", StepRange::new(0, 3, 3)).contains("rows below 5"));
    let short =
        reader.read_column("state", &[StepRange::new(0, 0, 1)], &mut [0; 5]).expect_err("a buffer that is too small");
    assert!(short.to_string().contains("24 for 1 rows"), "{short}");
    let missing =
        open(folder.path().join("none.lance")).err().expect("opening a missing dataset must be an error").to_string();
    assert!(missing.contains("there is no such dataset"), "{missing}");
    let unknown =
        open(Path::new("/nowhere/at.all")).err().expect("opening a missing dataset must be an error").to_string();
    assert!(unknown.contains("no such dataset") && unknown.contains("lance"), "{unknown}");
}

#[test]
fn writer_follows_the_create_append_and_overwrite_modes() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    write(&path, WriteMode::Append, 100, 0..3);
    assert!(failure(&path, &schema(), WriteMode::Create).contains("exists already"));

    let mut writer = create(&path, &schema(), options(WriteMode::Append)).expect("continuing the dataset");
    assert_eq!(writer.episodes(), 3);
    writer.write_episode(&episode(3)).expect("writing an episode");
    assert_eq!(writer.episodes(), 4);
    // Dropping the writer commits as `finish` does, but cannot report errors.
    drop(writer);
    let reader = open(&path).expect("opening the dataset");
    check(&*reader, 0);
    assert_eq!(reader.episodes().iter().map(|e| e.index).collect::<Vec<_>>(), [0, 1, 2, 3]);

    // A newer manifest replaces the older manifest.
    let newer = WriteOptions { manifest: Some(manifest(4)), ..options(WriteMode::Append) };
    create(&path, &schema(), newer).expect("continuing the dataset").finish().expect("finishing the dataset");
    assert_eq!(open(&path).expect("opening the dataset").manifest(), Some(manifest(4)));

    write(&path, WriteMode::Overwrite, 100, 5..7);
    let reader = open(&path).expect("opening the dataset");
    assert_eq!(reader.episodes().len(), 2);
    check(&*reader, 5);
    assert_eq!(std::fs::read_dir(path.join("data")).expect("listing a folder").count(), 1, "old files are removed");
}

#[test]
fn opens_an_empty_dataset() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    write(&path, WriteMode::Create, 1, 0..0);
    let reader = open(&path).expect("opening the dataset");
    assert!(reader.episodes().is_empty());
    assert_eq!(reader.schema().columns().len(), 9);
    assert_eq!(reader.read(&COLUMNS, &[]).expect("reading rows").rows(), 0);
    write(&path, WriteMode::Append, 1, 0..2);
    check(&*open(&path).expect("opening the dataset"), 0);
}

#[test]
fn appending_requires_the_schema_of_the_dataset() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    write(&path, WriteMode::Create, 100, 0..2);
    let with = |change: &dyn Fn(&mut Vec<ColumnSpec>)| {
        let mut columns = schema().columns().to_vec();
        change(&mut columns);
        failure(&path, &Schema::new(columns).expect("creating the schema"), WriteMode::Append)
    };
    assert!(with(&|columns| columns[1].shape = vec![3]).contains("appending to"));
    assert!(with(&|columns| columns[0].shape = vec![16, 16, 3]).contains("[16, 24, 3]"));
    assert!(with(&|columns| columns[3].dtype = DType::Float64).contains("reward float32"));
    assert!(with(&|columns| columns.truncate(4)).contains("the columns it has"));
    assert!(with(&|columns| columns.push(ColumnSpec::new("more", DType::U8, []))).contains("more"));
    // The order of columns does not matter.
    let mut columns = schema().columns().to_vec();
    columns.reverse();
    let reordered = Schema::new(columns).expect("creating the schema");
    let mut other = Batch::zeros(&reordered, rows(2));
    for (i, column) in reordered.columns().iter().enumerate() {
        other.bytes_mut(i).copy_from_slice(episode(2).bytes(schema().index(&column.name).expect("finding the column")));
    }
    let mut writer = create(&path, &reordered, options(WriteMode::Append)).expect("continuing the dataset");
    assert!(
        writer
            .write_episode(&episode(2))
            .expect_err("columns in another order")
            .to_string()
            .contains("writing an episode")
    );
    writer.write_episode(&other).expect("writing an episode");
    writer.finish().expect("finishing the dataset");
    check(&*open(&path).expect("opening the dataset"), 0);
}

#[test]
fn rejects_episodes_that_break_the_time_convention() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let mut writer =
        create(folder.path().join("d.lance"), &schema(), options(WriteMode::Create)).expect("creating the dataset");
    let mut refuse = |change: &dyn Fn(&mut Batch), expected: &str| {
        let mut bad = episode(2);
        change(&mut bad);
        let error = writer.write_episode(&bad).expect_err("writing the episode must fail").to_string();
        assert!(error.contains(expected), "{error}");
    };
    refuse(&|e| e.get_mut::<f32>("action").expect("accessing the actions")[3] = f32::NAN, "row 1 of 7");
    refuse(&|e| e.get_mut::<f32>("action").expect("accessing the actions")[13] = 0.0, "final observation");
    refuse(&|e| e.get_mut::<i64>("variation.agent.color").expect("accessing the colours")[4] = 1 << 30, "within ±2^24");
    refuse(&|e| e.resize(0), "without rows");
    assert_eq!(writer.episodes(), 0);
    writer.write_episode(&episode(0)).expect("writing a valid episode");
    writer.finish().expect("finishing the dataset");

    let discrete = Schema::new([ColumnSpec::new("action", DType::Int64, [])]).expect("creating the schema");
    let mut writer =
        create(folder.path().join("i.lance"), &discrete, options(WriteMode::Create)).expect("creating the dataset");
    let mut batch = Batch::zeros(&discrete, 3);
    assert!(writer.write_episode(&batch).expect_err("writing the episode must fail").to_string().contains("-1"));
    batch.get_mut::<i64>("action").expect("accessing the actions")[2] = -1;
    writer.write_episode(&batch).expect("writing an episode");
    batch.get_mut::<i64>("action").expect("accessing the actions")[0] = -1;
    assert!(writer.write_episode(&batch).is_err());
}

#[test]
fn content_hash_depends_on_the_episodes_but_not_on_the_data_files() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = |name: &str| folder.path().join(name);
    write(&path("a.lance"), WriteMode::Create, 1, 0..5);
    write(&path("b.lance"), WriteMode::Create, 100, 0..3);
    write(&path("b.lance"), WriteMode::Append, 100, 3..5);
    write(&path("c.lance"), WriteMode::Create, 1, 1..6);
    let hash = |name: &str| open(path(name)).expect("opening the dataset").content_hash().expect("hashing the content");
    assert_eq!(hash("a.lance"), hash("b.lance"));
    assert_ne!(hash("a.lance"), hash("c.lance"));
}

#[test]
fn png_and_qoi_images_are_stored_exactly() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    for (position, codec) in [ImageCodec::Png, ImageCodec::Qoi].into_iter().enumerate() {
        let lossless = WriteOptions { codec, ..options(WriteMode::Append) };
        let mut writer = create(&path, &schema(), lossless).expect("creating the dataset");
        writer.write_episode(&episode(1)).expect("writing an episode");
        writer.finish().expect("finishing the dataset");
        let reader = open(&path).expect("opening the dataset");
        let read = reader.read(&["pixels"], &[StepRange::new(position, 0, rows(1))]).expect("reading rows");
        assert_eq!(read.bytes(0), episode(1).bytes(0));
    }
    let invalid = WriteOptions { codec: ImageCodec::Jpeg { quality: 0 }, ..options(WriteMode::Create) };
    let error = create(folder.path().join("e.lance"), &schema(), invalid).err().expect("the call must fail");
    assert!(error.is_usage());
}

#[test]
fn several_threads_read_concurrently() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    write(&path, WriteMode::Create, 2, 0..12);
    let reader = open(&path).expect("opening the dataset");
    std::thread::scope(|scope| {
        for _ in 0..8 {
            scope.spawn(|| {
                for _ in 0..5 {
                    check(&*reader, 0);
                }
            });
        }
    });
}

#[test]
fn concurrent_writers_both_append() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    let threads = 4;
    let episodes_per_thread = 25;
    std::thread::scope(|scope| {
        for thread in 0..threads {
            let path = &path;
            scope.spawn(move || {
                let commit = CommitPolicy { episodes: 1, ..CommitPolicy::default() };
                let options = WriteOptions { commit, ..options(WriteMode::Append) };
                let mut writer = create(path, &schema(), options).expect("continuing the dataset");
                for e in 0..episodes_per_thread {
                    writer.write_episode(&episode(thread * episodes_per_thread + e)).expect("writing an episode");
                }
                writer.finish().expect("finishing the dataset");
            });
        }
    });
    let reader = open(&path).expect("opening the dataset");
    let indices: Vec<i64> = reader.episodes().iter().map(|episode| episode.index).collect();
    assert_eq!(indices, (0..(threads * episodes_per_thread) as i64).collect::<Vec<_>>());
    // The state identifies the episode.
    let firsts: Vec<StepRange> = (0..threads * episodes_per_thread).map(|at| StepRange::new(at, 0, 1)).collect();
    let read = reader.read(&["state"], &firsts).expect("reading rows");
    let mut found: Vec<usize> =
        read.get::<f64>("state").expect("reading the states").chunks(3).map(|s| s[0] as usize).collect();
    for thread in 0..threads {
        let own: Vec<usize> = found.iter().copied().filter(|e| e / episodes_per_thread == thread).collect();
        assert!(own.is_sorted(), "episodes of one writer keep their order");
    }
    found.sort_unstable();
    assert_eq!(found, (0..threads * episodes_per_thread).collect::<Vec<_>>());
    assert_eq!(
        std::fs::read_dir(path.join("data")).expect("listing a folder").count(),
        threads * episodes_per_thread,
        "no file is left over"
    );
}

#[test]
fn writer_of_a_replaced_dataset_fails() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    let mut first = create(&path, &schema(), options(WriteMode::Append)).expect("creating the dataset");
    let other = Schema::new([ColumnSpec::new("other", DType::Float32, [])]).expect("creating the schema");
    create(&path, &other, options(WriteMode::Overwrite))
        .expect("replacing the dataset")
        .finish()
        .expect("finishing the dataset");
    first.write_episode(&episode(0)).expect("queueing an episode");
    let error = first.finish().expect_err("a replaced table").to_string();
    assert!(error.contains("another process replaced"), "{error}");
    assert!(open(&path).expect("opening the dataset").episodes().is_empty());
}

#[test]
fn stores_doubles_exactly_but_keeps_the_precision_of_older_tables() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    let schema = Schema::new([ColumnSpec::new("state", DType::Float64, [2])]).expect("creating the schema");
    let mut batch = Batch::zeros(&schema, 3);
    let values = [0.1, 1e300, f64::MIN_POSITIVE, -7.0, f64::NAN, 1.0 / 3.0];
    batch.get_mut::<f64>("state").expect("accessing the states").copy_from_slice(&values);
    let mut writer = create(&path, &schema, options(WriteMode::Create)).expect("creating the dataset");
    writer.write_episode(&batch).expect("writing an episode");
    writer.finish().expect("finishing the dataset");
    let all = [StepRange::new(0, 0, 3)];
    let bits = |reader: &dyn swm_data::Reader| -> Vec<u64> {
        let read = reader.read(&["state"], &all).expect("reading rows");
        read.get::<f64>("state").expect("reading the states").iter().map(|v| v.to_bits()).collect()
    };
    assert_eq!(bits(&*open(&path).expect("opening the dataset")), values.map(f64::to_bits));
    // A table of the first version stored all numeric columns in single precision; appending keeps this precision.
    let old = folder.path().join("old.lance");
    crate::fuzz::copy_all(&Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/interop/single.lance"), &old);
    let existing = open(&old).expect("opening the dataset").episodes().len();
    write(&old, WriteMode::Append, 1, existing..existing + 2);
    let reader = open(&old).expect("opening the dataset");
    assert_eq!(reader.episodes().len(), existing + 2);
    check(&*reader, 0);
}

#[test]
fn constants_round_trip_and_are_part_of_the_content_hash() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    let scene = |e: usize| {
        let xml = format!("<mujoco><body pos=\"{}\"/></mujoco>", e / 2).repeat(50).into_bytes();
        Constants::from([("scene.xml".to_owned(), xml), ("raw".to_owned(), vec![e as u8, 0, 255])])
    };
    let commit = CommitPolicy { episodes: 4, ..CommitPolicy::default() };
    let mut writer =
        create(&path, &schema(), WriteOptions { commit, ..options(WriteMode::Create) }).expect("creating the dataset");
    for e in 0..10 {
        let constants = if e == 5 { Constants::new() } else { scene(e) };
        writer.write_episode_with(&episode(e), &constants).expect("writing an episode");
    }
    writer.finish().expect("finishing the dataset");
    let reader = open(&path).expect("opening the dataset");
    check(&*reader, 0);
    for e in 0..10 {
        let expected = if e == 5 { Constants::new() } else { scene(e) };
        assert_eq!(reader.constants(e).expect("reading constants"), expected, "episode {e}");
    }
    assert!(reader.constants(10).is_err());
    // Constants are part of the content hash.
    let plain = folder.path().join("plain.lance");
    write(&plain, WriteMode::Create, 4, 0..10);
    let plain = open(&plain).expect("opening the dataset");
    assert_eq!(plain.constants(0).expect("reading constants"), Constants::new());
    assert_ne!(plain.content_hash().expect("hashing the content"), reader.content_hash().expect("hashing the content"));
}

#[test]
fn old_table_versions_are_removed() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    write(&path, WriteMode::Create, 1, 0..30);
    let versions = std::fs::read_dir(path.join("_versions")).expect("listing a folder").count();
    assert!(versions <= 10, "{versions} files");
    assert_eq!(open(&path).expect("opening the dataset").episodes().len(), 30);
}

#[test]
fn unwritable_locations_are_explained() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let file = folder.path().join("file");
    std::fs::write(&file, "not a folder").expect("writing a file");
    let error = failure(&file.join("d.lance"), &schema(), WriteMode::Create);
    assert!(error.contains("Not a directory"), "{error}");
    assert!(
        failure(&folder.path().join("name"), &schema(), WriteMode::Create).contains("use a name that ends in .lance")
    );
    // Not even root can create a folder in `/proc`.
    let error =
        create(Path::new("/proc/d.lance"), &schema(), options(WriteMode::Create)).err().expect("the call must fail");
    assert!(matches!(error, Error::Io { .. }), "{error}");
    // A folder with other files is left unchanged.
    let other = folder.path().join("other.lance");
    std::fs::create_dir(&other).expect("creating a folder");
    std::fs::write(other.join("notes.txt"), "notes").expect("writing a file");
    for mode in [WriteMode::Create, WriteMode::Append, WriteMode::Overwrite] {
        assert!(failure(&other, &schema(), mode).contains("notes.txt"));
    }
    assert!(
        open(&other)
            .err()
            .expect("opening a missing dataset must be an error")
            .to_string()
            .contains("not a Lance table")
    );
}

#[test]
fn statistics_ignore_missing_values() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    write(&path, WriteMode::Create, 3, 0..4);
    let reader = open(&path).expect("opening the dataset");
    let stats = column_stats(&*reader, "action", Some(&[1, 3])).expect("computing the statistics");
    let first: Vec<f64> = [1.0; 5].into_iter().chain([3.0; 7]).collect();
    let mean = first.iter().sum::<f64>() / 12.0;
    let std = (first.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 12.0).sqrt();
    assert_eq!((stats.count, stats.incomplete), (vec![12, 12], 0));
    assert!((stats.mean[0] - mean).abs() < 1e-12 && (stats.std[0] - std).abs() < 1e-12);
    assert_eq!((stats.min[1], stats.max[1]), (0.0, 1.5));
    assert!(column_stats(&*reader, "pixels", None).is_err());
}
