//! Tests that every lossless format must pass: write modes, the time convention (only the last row of an episode has no
//! action), constants, exclusive writers, and recovery after a writer is killed.

use crate::sample::{self, episode, manifest, schema};
use rand::Rng as _;
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use swm_core::{Batch, ColumnSpec, DType, Key, Result, Schema};
use swm_data::{
    CommitPolicy, Constants, ImageCodec, Location, Reader, StepRange, WriteMode, WriteOptions, Writer, create, open,
};

/// Episodes per commit.
const GROUP: usize = 2;

pub fn writer(location: impl Into<Location>, mode: WriteMode) -> Result<Box<dyn Writer>> {
    let commit = CommitPolicy { episodes: GROUP, ..CommitPolicy::default() };
    let options = WriteOptions {
        mode,
        codec: ImageCodec::Png,
        manifest: Some(manifest(3)),
        commit,
        exclusive: false,
        continues: None,
    };
    create(location, &schema(), options)
}

/// The constants of episode `e`: a scene that every third episode shares, and a unique note.
fn constants(e: usize) -> Constants {
    let scene = format!("<mujoco model='{}'/>", e % 3);
    Constants::from([("scene.xml".to_owned(), scene.into_bytes()), ("note".to_owned(), vec![e as u8; e])])
}

pub fn write(path: &Path, mode: WriteMode, episodes: std::ops::Range<usize>) {
    let mut writer = writer(path, mode).expect("creating the dataset");
    for e in episodes {
        writer.write_episode_with(&episode(e), &constants(e)).expect("writing an episode");
    }
    writer.finish().expect("finishing the dataset");
}

/// Checks that the dataset holds exactly the episodes `first..`, bit for bit.
pub fn check(reader: &dyn Reader, first: usize) {
    let names: Vec<&str> = schema().columns().iter().map(|column| column.name.clone().leak() as &str).collect();
    for (position, stored) in reader.episodes().iter().enumerate() {
        let expected = episode(first + position);
        assert_eq!((stored.index, stored.length), (position as i64, expected.rows()));
        let read = reader.read(&names, &[StepRange::new(position, 0, stored.length)]).expect("reading rows");
        for (column, name) in names.iter().enumerate() {
            assert!(read.bytes(column) == expected.bytes(column), "{name} of episode {position}");
        }
    }
}

fn check_constants(reader: &dyn Reader, first: usize) {
    for position in 0..reader.episodes().len() {
        assert_eq!(reader.constants(position).expect("reading constants"), constants(first + position));
    }
}

/// Runs all tests except the tests that kill processes.
pub fn all(name: &str) {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join(name);
    check_write_modes(&path);
    reads_rows_in_any_order(&path);
    rejects_invalid_episodes(&path);
    let other = |prefix: &str| folder.path().join(format!("{prefix}{name}"));
    rejects_a_second_writer(&other("busy-"));
    reads_committed_episodes_during_writing(&other("growing-"));
    numeric_types_round_trip(&other("types-"));
    assert!(open(folder.path().join(format!("none-{name}"))).is_err(), "opening a missing dataset must fail");
}

fn check_write_modes(path: &Path) {
    write(path, WriteMode::Create, 0..5);
    let reader = open(path).expect("opening the dataset");
    assert_eq!(reader.episodes().len(), 5);
    assert_eq!(reader.schema().columns()[0], ColumnSpec::new("episode_idx", DType::Int32, []));
    assert_eq!(
        reader.schema().column("step_idx").expect("finding the column").dtype,
        DType::Int64,
        "`step_idx` has the declared type"
    );
    let data_columns = |columns: &[ColumnSpec]| -> Vec<ColumnSpec> {
        columns.iter().filter(|column| !column.name.ends_with("_idx")).cloned().collect()
    };
    assert_eq!(data_columns(reader.schema().columns()), data_columns(schema().columns()));
    check(&*reader, 0);
    check_constants(&*reader, 0);
    assert_eq!(reader.manifest(), Some(manifest(3)));
    let parts = reader.footprint().expect("listing the files");
    assert!(parts.iter().any(|(part, size)| part == "pixels" && *size > 0), "{parts:?}");
    let hash = reader.content_hash().expect("hashing the content");

    let error =
        writer(path, WriteMode::Create).err().expect("creating an existing dataset must be an error").to_string();
    assert!(error.contains("exists already") && error.contains("append"), "{error}");
    write(path, WriteMode::Append, 5..9);
    let reader = open(path).expect("opening the dataset");
    assert_eq!(reader.episodes().len(), 9);
    check(&*reader, 0);
    check_constants(&*reader, 0);
    assert_ne!(reader.content_hash().expect("hashing the content"), hash);

    let few = Schema::new(schema().columns()[..3].to_vec()).expect("creating the schema");
    let options = WriteOptions { mode: WriteMode::Append, ..WriteOptions::default() };
    let error = create(path, &few, options).err().expect("a schema with other columns must be an error").to_string();
    assert!(error.contains("variation.agent.color") && error.contains("the columns it has"), "{error}");

    write(path, WriteMode::Overwrite, 3..5);
    let reader = open(path).expect("opening the dataset");
    assert_eq!(reader.episodes().len(), 2);
    check(&*reader, 3);
    check_constants(&*reader, 3);
    write(path, WriteMode::Overwrite, 0..5);
    assert_eq!(
        open(path).expect("opening the dataset").content_hash().expect("hashing the content"),
        hash,
        "equal content has equal hashes"
    );
}

fn reads_rows_in_any_order(path: &Path) {
    let reader = open(path).expect("opening the dataset");
    let ranges = [
        StepRange::new(3, 2, 4),
        StepRange::new(0, 4, 1),
        StepRange::new(3, 3, 2),
        StepRange::new(1, 0, 6),
        StepRange::new(0, 0, 0),
    ];
    let names = ["pixels", "state", "episode_idx", "step_idx", "success"];
    let read = reader.read(&names, &ranges).expect("reading rows");
    let rows: Vec<(usize, usize)> =
        ranges.iter().flat_map(|range| (range.start..range.start + range.length).map(|t| (range.episode, t))).collect();
    assert_eq!(read.rows(), rows.len());
    for (row, &(e, t)) in rows.iter().enumerate() {
        let expected = episode(e);
        for name in ["pixels", "success"] {
            let (a, b) = (read.row(row).get::<u8>(name), expected.row(t).get::<u8>(name));
            assert!(a.expect("bytes") == b.expect("bytes"), "{name} of row {row}");
        }
        assert_eq!(read.row(row).get::<f64>("state").expect("reading the values"), [e as f64, t as f64, -0.5]);
        assert_eq!(read.row(row).get::<i32>("episode_idx").expect("reading the value"), [e as i32]);
        assert_eq!(read.row(row).get::<i64>("step_idx").expect("reading the value"), [t as i64]);
    }
    let error = |name: &str, range| reader.read(&[name], &[range]).expect_err("a missing column or row").to_string();
    assert!(error("pixels", StepRange::new(1, 4, 3)).contains("rows below 6"));
    assert!(error("state", StepRange::new(5, 0, 1)).contains("positions below 5"));
    assert!(error("stat", StepRange::new(0, 0, 1)).contains("state"));
}

fn rejects_invalid_episodes(path: &Path) {
    let mut writer = writer(path, WriteMode::Append).expect("continuing the dataset");
    let mut missing = episode(0);
    let last = missing.rows() - 1;
    missing.row_mut(last).set(1, &[0.5_f32, 0.5]);
    assert!(
        writer
            .write_episode(&missing)
            .expect_err("an action in the last row")
            .to_string()
            .contains("final observation")
    );
    let empty = Batch::zeros(&schema(), 0);
    assert!(writer.write_episode(&empty).expect_err("an episode without rows").to_string().contains("without rows"));
    let few = Batch::zeros(&Schema::new(schema().columns()[1..].to_vec()).expect("creating the schema"), 3);
    assert!(writer.write_episode(&few).expect_err("an episode without pixels").to_string().contains("pixels"));
    assert_eq!(writer.episodes(), 5, "the writer stores no invalid episode");
    writer.finish().expect("finishing the dataset");
    assert_eq!(open(path).expect("opening the dataset").episodes().len(), 5);
}

fn rejects_a_second_writer(path: &Path) {
    let first = writer(path, WriteMode::Create).expect("creating the dataset");
    for mode in [WriteMode::Append, WriteMode::Overwrite] {
        let error = writer(path, mode).err().expect("a second writer must be an error").to_string();
        assert!(error.contains("another process writes"), "{error}");
    }
    drop(first);
    write(path, WriteMode::Append, 0..1);
}

fn reads_committed_episodes_during_writing(path: &Path) {
    let mut writer = writer(path, WriteMode::Create).expect("creating the dataset");
    assert_eq!(open(path).expect("opening the dataset").episodes().len(), 0);
    for e in 0..7 {
        writer.write_episode_with(&episode(e), &constants(e)).expect("writing an episode");
        let reader = open(path).expect("opening the dataset");
        let committed = (e + 1) / GROUP * GROUP;
        assert_eq!(reader.episodes().len(), committed);
        check(&*reader, 0);
        check_constants(&*reader, 0);
    }
    drop(writer);
    let reader = open(path).expect("opening the dataset");
    assert_eq!(reader.episodes().len(), 7, "dropping the writer commits the remaining episodes");
    check(&*reader, 0);
}

fn numeric_types_round_trip(path: &Path) {
    let types = [DType::Bool, DType::U8, DType::Int32, DType::Int64, DType::Float32, DType::Float64];
    let shapes: [&[usize]; 3] = [&[], &[1], &[2, 3]];
    let specs: Vec<ColumnSpec> = types
        .iter()
        .flat_map(|dtype| {
            shapes.map(|shape| ColumnSpec::new(format!("{}{}", dtype.name(), shape.len()), *dtype, shape))
        })
        .collect();
    let schema = Schema::new(specs).expect("creating the schema");
    let mut batch = Batch::zeros(&schema, 300);
    for (index, column) in schema.columns().iter().enumerate() {
        let limit = if column.dtype == DType::Bool { 2 } else { 251 };
        batch.bytes_mut(index).iter_mut().enumerate().for_each(|(i, byte)| *byte = ((i * 7 + index) % limit) as u8);
    }
    let mut writer = create(path, &schema, WriteOptions::default()).expect("creating the dataset");
    writer.write_episode(&batch).expect("writing an episode");
    writer.write_episode(&batch).expect("writing an episode");
    writer.finish().expect("finishing the dataset");
    let reader = open(path).expect("opening the dataset");
    assert_eq!(reader.schema().columns()[2..], *schema.columns());
    let names: Vec<&str> = schema.columns().iter().map(|column| &*column.name).collect();
    let read = reader.read(&names, &[StepRange::new(1, 0, 300)]).expect("reading rows");
    (0..names.len()).for_each(|column| assert!(read.bytes(column) == batch.bytes(column), "{}", names[column]));
}

/// Kills `kills` writers at random times, drawn with a fixed key. All committed episodes must be readable, and the next
/// writer continues.
pub fn killed(name: &str, kills: u64) {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join(name);
    let mut stored = 0;
    for kill in 0..kills {
        let mut rng = Key::new(5).with(name).at(kill).rng();
        let mut child = child(&path).spawn().expect("starting the child process");
        let mut lines = BufReader::new(child.stdout.take().expect("the output of the child process")).lines();
        let mut last = None;
        for _ in 0..rng.random_range(0..12) {
            let line = lines.next().expect("another line").expect("a line of text");
            last = line.rsplit_once("episode ").map(|(_, e)| e.parse::<usize>().expect("a number")).or(last);
        }
        // Waits for a random time.
        let until = Instant::now() + Duration::from_micros(rng.random_range(0..8000));
        while Instant::now() < until {
            std::hint::spin_loop();
        }
        child.kill().expect("killing the child process");
        child.wait().expect("waiting for the child process");
        let now = match open(&path) {
            Ok(reader) => {
                // Compares with a tolerance, because the child stores JPEG in formats that encode images.
                sample::check(&*reader, 0);
                reader.episodes().len()
            }
            Err(error) => {
                assert!(stored == 0 && last.is_none(), "kill {kill}: {error}");
                0
            }
        };
        // The child commits groups of three episodes.
        let reported = last.map_or(0, |last| last + 1);
        assert!(
            now >= stored && now + 3 > reported,
            "kill {kill}: {now} episodes after {stored}; {reported} were written"
        );
        stored = now;
    }
    assert!(stored > 0, "no episode was committed");
    let mut writer = writer(&path, WriteMode::Append).expect("continuing the dataset");
    writer.write_episode(&episode(stored)).expect("writing an episode");
    writer.finish().expect("finishing the dataset");
    let reader = open(&path).expect("opening the dataset");
    assert_eq!(reader.episodes().len(), stored + 1);
    sample::check(&*reader, 0);
}

/// The command of a child process that writes episodes until it is killed.
fn child(path: &Path) -> Command {
    let program: PathBuf = std::env::current_exe().expect("finding the test executable");
    let mut command = Command::new(program);
    command.args(["--exact", "interruption::child_that_writes", "--nocapture"]);
    command.env("SWM_TEST_CHILD_TARGET", path).stdout(Stdio::piped()).stderr(Stdio::null());
    command
}
