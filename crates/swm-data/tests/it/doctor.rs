//! An examination reports deliberate defects, and a repair omits defective episodes from the repaired dataset.

use crate::hostile::copied;
use crate::lerobot::{DATA, change_values};
use crate::sample::{episode, rows, schema, write};
use crate::video::THIRD_PARTY_LENGTHS;
use arrow_array::types::Int64Type;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use swm_core::requirements::{DatasetRequirements, RequiredObservations};
use swm_core::run::Control;
use swm_core::{Batch, ColumnSpec, DType, Error, Manifest, Result, Schema};
use swm_data::doctor::{Diagnosis, Finding, Severity, examine, open_damaged, repair};
use swm_data::{Constants, ConvertOptions, Episode, Irregularity, Location, Reader, StepRange, WriteMode, open};

/// A reader of the sample episodes with deliberate defects.
#[derive(Default)]
struct Broken {
    schema: Option<Schema>,
    episodes: Vec<Episode>,
    rows: Vec<Batch>,
    /// Positions of episodes whose images cannot be read.
    damaged: Vec<usize>,
    irregular: Vec<Irregularity>,
}

impl Broken {
    fn new(count: usize, breaking: impl Fn(usize, &mut Batch)) -> Self {
        let mut broken = Self { schema: Some(schema()), ..Self::default() };
        for e in 0..count {
            let mut batch = episode(e);
            breaking(e, &mut batch);
            broken.episodes.push(Episode { index: e as i64, length: batch.rows() });
            broken.rows.push(batch);
        }
        broken
    }
}

impl Reader for Broken {
    fn schema(&self) -> &Schema {
        self.schema.as_ref().expect("a schema")
    }

    fn episodes(&self) -> &[Episode] {
        &self.episodes
    }

    fn read_column(&self, column: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        let index = self.schema().index(column)?;
        let n = self.schema().columns()[index].row_bytes();
        let mut at = 0;
        for range in ranges {
            if column == "pixels" && self.damaged.contains(&range.episode) {
                return Err(Error::external("decoding an image", "it is truncated"));
            }
            let bytes = &self.rows[range.episode].bytes(index)[range.start * n..(range.start + range.length) * n];
            out[at..at + bytes.len()].copy_from_slice(bytes);
            at += bytes.len();
        }
        Ok(())
    }

    fn constants(&self, episode: usize) -> Result<Constants> {
        Ok(Constants::from([("scene".to_owned(), vec![episode as u8])]))
    }

    fn irregularities(&self) -> Result<Vec<Irregularity>> {
        Ok(self.irregular.clone())
    }

    fn manifest(&self) -> Option<Manifest> {
        None
    }

    fn footprint(&self) -> Result<Vec<(String, u64)>> {
        Ok(vec![])
    }

    fn content_hash(&self) -> Result<String> {
        Ok("none".to_owned())
    }
}

/// Requirements of a world model, and of an agent that learns from states and rewards.
const MODELS: [DatasetRequirements; 2] = [
    DatasetRequirements {
        model: "world model",
        observations: RequiredObservations::Images,
        reward: false,
        clip_rows: 20,
    },
    DatasetRequirements {
        model: "agent",
        observations: RequiredObservations::ImagesOrState,
        reward: true,
        clip_rows: 4,
    },
];

fn diagnose(reader: &dyn Reader) -> Diagnosis {
    examine(reader, &MODELS, &mut Control::new()).expect("examining the dataset")
}

/// Returns the description and the episodes of the only problem.
fn problem(diagnosis: &Diagnosis) -> (String, Vec<usize>) {
    let problems: Vec<_> = diagnosis.findings.iter().filter(|found| found.severity == Severity::Problem).collect();
    assert_eq!(problems.len(), 1, "{problems:?}");
    (problems[0].what.clone(), problems[0].episodes.clone())
}

/// An episode of many rows, which no read may hold together.
struct Long {
    schema: Schema,
    episodes: [Episode; 1],
    /// The most rows of a read, and the rows of all reads.
    most: AtomicUsize,
    all: AtomicUsize,
}

/// The rows of [`Long`].
const LONG: usize = (3 << 20) + 5;

impl Reader for Long {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn episodes(&self) -> &[Episode] {
        &self.episodes
    }

    fn read_column(&self, column: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        let count = ranges.iter().map(|range| range.length).sum();
        self.most.fetch_max(count, Ordering::Relaxed);
        self.all.fetch_add(count, Ordering::Relaxed);
        let rows = ranges.iter().flat_map(|range| range.start..range.start + range.length);
        match column {
            "step_idx" => out.as_chunks_mut::<8>().0.iter_mut().zip(rows).for_each(|(out, row)| {
                *out = (row as i64).to_ne_bytes();
            }),
            "action" => out.as_chunks_mut::<4>().0.iter_mut().zip(rows).for_each(|(out, row)| {
                let is_missing = [7, LONG - 9, LONG - 1].contains(&row);
                *out = (if is_missing { f32::NAN } else { 0.5 }).to_ne_bytes();
            }),
            _ => {
                out.iter_mut().zip(rows).for_each(|(out, row)| *out = u8::from([9, LONG - 3, LONG - 1].contains(&row)))
            }
        }
        Ok(())
    }

    fn manifest(&self) -> Option<Manifest> {
        None
    }

    fn footprint(&self) -> Result<Vec<(String, u64)>> {
        Ok(vec![])
    }

    fn content_hash(&self) -> Result<String> {
        Ok("none".to_owned())
    }
}

#[test]
fn a_long_episode_is_examined_in_pieces() {
    let schema = Schema::new([
        ColumnSpec::new("step_idx", DType::Int64, []),
        ColumnSpec::new("action", DType::Float32, []),
        ColumnSpec::new("terminated", DType::Bool, []),
    ])
    .expect("a schema");
    let reader = Long { schema, episodes: [Episode { index: 0, length: LONG }], most: 0.into(), all: 0.into() };
    let diagnosis = diagnose(&reader);
    assert_eq!(reader.most.load(Ordering::Relaxed), 1 << 20, "rows at a time");
    // Each finding has the episode once, although it is found in two pieces.
    assert_eq!(problem(&diagnosis), ("there is no action in a row that is not the last".to_owned(), vec![0]));
    let notes: Vec<_> = diagnosis.findings.iter().filter(|found| !found.episodes.is_empty()).skip(1).collect();
    assert_eq!(notes.len(), 1, "{notes:?}");
    assert_eq!((&*notes[0].what, &notes[0].episodes[..]), ("it continues after it terminated", &[0][..]));
    // A run that is stopped ends before the next piece.
    reader.all.store(0, Ordering::Relaxed);
    let stopped = examine(&reader, &MODELS, &mut Control::new().with_interrupt(Arc::new(AtomicBool::new(true))));
    assert!(matches!(stopped, Err(Error::Interrupted)));
    assert_eq!(reader.all.load(Ordering::Relaxed), 1 << 20);
}

#[test]
fn collected_dataset_has_no_findings() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    write(&path, WriteMode::Create, 2, 0..8);
    let diagnosis = diagnose(&*open(&path).expect("opening the dataset"));
    assert_eq!((diagnosis.problems(), diagnosis.findings.len(), diagnosis.intact.len()), (0, 0, 8), "{diagnosis:?}");
    assert_eq!(diagnosis.rows, (0..8).map(rows).sum::<usize>());
    // The longest episode, with eleven rows, is shorter than a clip of the world model.
    let fits: Vec<&str> = diagnosis.models.iter().filter(|fit| fit.fits()).map(|fit| fit.model).collect();
    assert_eq!(fits, ["agent"]);
    assert!(diagnosis.models[0].missing[0].contains("the longest has 11"), "{:?}", diagnosis.models[0]);
}

#[test]
fn finds_columns_with_more_rows_than_the_episodes() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    for format in ["folder", "video"] {
        let [path, longer] = ["d", "longer"].map(|name| folder.path().join(format!("{name}.{format}")));
        write(&path, WriteMode::Create, 2, 0..4);
        write(&longer, WriteMode::Create, 2, 0..5);
        assert_eq!(diagnose(&*open(&path).expect("opening the dataset")).problems(), 0);
        std::fs::copy(longer.join("state.npz"), path.join("state.npz")).expect("copying a file");
        let diagnosis = diagnose(&*open(&path).expect("opening the dataset"));
        let [all, more] = [4, 5].map(|episodes| (0..episodes).map(rows).sum::<usize>());
        let expected = format!("'state' has {more} rows, and the episodes have {all}");
        assert_eq!(problem(&diagnosis), (expected, vec![]));
        assert_eq!(diagnosis.intact.len(), 4);
    }
}

#[test]
fn finds_a_repeated_episode_index_in_a_table() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/interop/broken.lance");
    let reader = open(&path).expect("opening the dataset");
    let diagnosis = diagnose(&*reader);
    let problems: Vec<_> = diagnosis.findings.iter().filter(|found| found.severity == Severity::Problem).collect();
    assert!(problems.iter().all(|found| found.episodes == [1]), "{problems:?}");
    assert!(problems.iter().any(|found| found.what.contains("row 2 holds 0")), "{problems:?}");
    assert!(problems.iter().any(|found| found.what.contains("no action in a row that is not the last")));
    assert_eq!(diagnosis.intact, [0, 2]);
}

#[test]
#[cfg(feature = "hdf5")]
fn finds_restarting_steps_and_shared_rows_in_an_hdf5_file() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/interop/broken.h5");
    let diagnosis = diagnose(&*open(&path).expect("opening the dataset"));
    let problems_of = |episode: usize| {
        let here = |found: &&Finding| found.severity == Severity::Problem && found.episodes.contains(&episode);
        diagnosis.findings.iter().filter(here).map(|found| found.what.clone()).collect::<Vec<_>>()
    };
    assert_eq!(problems_of(1), ["the stored steps do not count up from 0: row 2 holds 0"]);
    assert!(problems_of(3).contains(&"some of its rows also belong to episode 2".to_owned()), "{:?}", problems_of(3));
    assert_eq!(diagnosis.intact, [0, 2]);
}

#[test]
fn finds_misplaced_rows_in_a_lerobot_dataset() {
    let (_folder, path) = copied("lerobot-v30-h264");
    let examined = |change: &dyn Fn(&mut [Option<i64>])| {
        change_values::<Int64Type>(&path.join(DATA), "frame_index", change);
        diagnose(&*open(&path).expect("opening the dataset"))
    };
    let diagnosis = examined(&|_| {});
    assert_eq!((diagnosis.problems(), &diagnosis.intact[..]), (0, &[0, 1, 2][..]), "{diagnosis:?}");
    // The rows of the episodes follow each other in one file.
    let first = THIRD_PARTY_LENGTHS[0];
    let diagnosis = examined(&|steps| steps.swap(first + 2, first + 3));
    assert_eq!(problem(&diagnosis), ("the stored steps do not count up from 0: row 2 holds 3".to_owned(), vec![1]));
    assert_eq!(diagnosis.intact, [0, 2]);
    // Steps that count up from 1.
    let shifted = |steps: &mut [Option<i64>]| {
        steps.swap(first + 2, first + 3);
        steps[..first].iter_mut().for_each(|step| *step = step.map(|step| step + 1));
    };
    let diagnosis = examined(&shifted);
    assert_eq!(problem(&diagnosis), ("the stored steps do not count up from 0: row 0 holds 1".to_owned(), vec![0]));
    assert_eq!(diagnosis.intact, [1, 2]);
}

#[test]
fn repairs_the_readable_part_of_a_table() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    write(&path, WriteMode::Create, 2, 0..8);
    // One of the four data files is truncated, so the table does not open.
    let data = std::fs::read_dir(path.join("data")).expect("listing a folder").flatten();
    let mut files: Vec<_> = data.map(|entry| entry.path()).collect();
    files.sort();
    let bytes = std::fs::read(&files[1]).expect("reading a file");
    std::fs::write(&files[1], &bytes[..bytes.len() / 2]).expect("writing a file");
    let location = Location::from(&path);
    assert!(open(&location).is_err());
    let (reader, lost) = open_damaged(&location).expect("opening the readable part");
    assert!(lost.len() == 1 && lost[0].contains("are lost"), "{lost:?}");
    let mut diagnosis = diagnose(&*reader);
    assert_eq!((diagnosis.episodes, diagnosis.problems()), (6, 0));
    diagnosis.add_losses(lost);
    assert_eq!(diagnosis.problems(), 1);
    let target = Location::from(folder.path().join("repaired.lance"));
    repair(&reader, &diagnosis, &target, &ConvertOptions::default(), &mut Control::new())
        .expect("repairing the dataset");
    let repaired = open(&target).expect("opening the dataset");
    assert_eq!((diagnose(&*repaired).problems(), repaired.episodes().len()), (0, 6));
    // If no part can be opened, `open_damaged` returns the error of `open`.
    files.iter().for_each(|file| std::fs::write(file, b"").expect("writing a file"));
    assert!(open_damaged(&location).map(|(reader, _)| reader.episodes().len()).unwrap_or(0) == 0);
    assert!(open_damaged(&Location::from(folder.path().join("nothing.lance"))).is_err());
}

#[test]
#[allow(clippy::too_many_lines, reason = "a table of defects")]
fn reports_the_episodes_of_each_defect() {
    type Breaking = fn(usize, &mut Batch);
    let breaks: [(&str, Breaking); 7] = [
        ("'reward' has a value that is not finite", |e, rows| {
            if e == 2 {
                rows.get_mut::<f32>("reward").expect("accessing the rewards")[1] = f32::NAN;
            }
        }),
        ("'state' has a value that is not finite", |e, rows| {
            if e == 2 {
                rows.get_mut::<f64>("state").expect("accessing the states")[4] = f64::INFINITY;
            }
        }),
        ("no action in a row that is not the last", |e, rows| {
            if e == 2 {
                rows.get_mut::<f32>("action").expect("accessing the actions")[2..4].fill(f32::NAN);
            }
        }),
        ("an action is not finite", |e, rows| {
            if e == 2 {
                rows.get_mut::<f32>("action").expect("accessing the actions")[3] = f32::NAN;
            }
        }),
        ("row 2 holds step 1", |e, rows| {
            if e == 2 {
                rows.get_mut::<i64>("step_idx").expect("accessing the steps")[2] = 1;
            }
        }),
        ("row 0 holds step 3", |e, rows| {
            if e == 2 {
                rows.get_mut::<i64>("step_idx").expect("accessing the steps").iter_mut().for_each(|step| *step += 3);
            }
        }),
        ("it has no rows", |e, rows| {
            if e == 2 {
                rows.resize(0);
            }
        }),
    ];
    for (expected, breaking) in breaks {
        let (what, episodes) = problem(&diagnose(&Broken::new(4, breaking)));
        assert!(what.contains(expected), "{what} instead of {expected}");
        assert_eq!(episodes, [2], "{expected}");
    }
    let mut broken = Broken::new(4, |_, _| {});
    broken.damaged = vec![1, 3];
    let diagnosis = diagnose(&broken);
    let (what, episodes) = problem(&diagnosis);
    assert!(what.contains("'pixels' cannot be read") && what.contains("truncated"), "{what}");
    assert_eq!((episodes, diagnosis.intact), (vec![1, 3], vec![0, 2]));
    let mut broken = Broken::new(4, |_, _| {});
    broken.episodes[3].index = 1;
    let (what, episodes) = problem(&diagnose(&broken));
    assert!(what.contains("the index 1 is also the index of another episode") && episodes == [3], "{what}");
    let mut broken = Broken::new(4, |_, _| {});
    broken.irregular = vec![Irregularity { episode: None, what: "3 rows belong to no episode".to_owned() }];
    let diagnosis = diagnose(&broken);
    assert_eq!(problem(&diagnosis), ("3 rows belong to no episode".to_owned(), vec![]));
    assert_eq!(diagnosis.intact.len(), 4, "all episodes are intact");
    let mut broken = Broken::new(4, |_, _| {});
    broken.irregular = vec![Irregularity { episode: Some(1), what: "its stored steps restart".to_owned() }];
    assert_eq!(diagnose(&broken).intact, [0, 2, 3], "episode 1 is not intact");
    assert!(problem(&diagnose(&Broken::new(0, |_, _| {}))).0.contains("no episode"));
}

#[test]
fn unusual_but_intact_data_gives_notes_and_no_problems() {
    let notes = |broken: Broken| -> Vec<String> {
        let diagnosis = diagnose(&broken);
        assert_eq!(diagnosis.problems(), 0, "{diagnosis:?}");
        diagnosis.findings.into_iter().map(|found| found.what).collect()
    };
    let acting = Broken::new(3, |_, rows| rows.get_mut::<f32>("action").expect("accessing the actions").fill(0.5));
    assert!(notes(acting)[0].contains("the last row has an action"));
    let single = Broken::new(3, |e, rows| {
        if e == 1 {
            *rows = Batch::zeros(&schema(), 1);
            rows.get_mut::<f32>("action").expect("accessing the actions").fill(f32::NAN);
        }
    });
    assert!(notes(single)[0].contains("no step"));
    let mut without = Broken::new(3, |_, _| {});
    let columns: Vec<ColumnSpec> = schema().columns().iter().filter(|c| c.name != "reward").cloned().collect();
    let schema = Schema::new(columns).expect("creating the schema");
    without.rows = without.rows.iter().map(|rows| without_reward(&schema, rows)).collect();
    without.schema = Some(schema);
    let diagnosis = diagnose(&without);
    assert_eq!(diagnosis.findings[0].what, "there is no reward");
    let agent = diagnosis.models.iter().find(|fit| fit.model == "agent").expect("the fit of the agent");
    assert_eq!(agent.missing, ["there is no 'reward'"]);
}

fn without_reward(schema: &Schema, rows: &Batch) -> Batch {
    let mut batch = Batch::zeros(schema, rows.rows());
    for (i, column) in schema.columns().iter().enumerate() {
        let from = rows.schema().index(&column.name).expect("finding the column");
        batch.bytes_mut(i).copy_from_slice(rows.bytes(from));
    }
    batch
}

#[test]
fn repair_writes_the_intact_episodes() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let target = folder.path().join("repaired.lance");
    let broken = Broken::new(6, |e, rows| {
        if e == 1 {
            rows.get_mut::<f32>("reward").expect("accessing the rewards").fill(f32::NAN);
        }
        if e == 4 {
            // Repeated step indices, as if two writers had used the same episode index.
            rows.get_mut::<i64>("step_idx").expect("accessing the steps").fill(0);
        }
    });
    let mut broken = Plain(broken);
    broken.0.damaged = vec![2];
    let reader: Arc<dyn Reader> = Arc::new(broken);
    let diagnosis = diagnose(&*reader);
    assert_eq!((diagnosis.problems(), &diagnosis.intact[..]), (3, &[0, 3, 5][..]));
    let to = Location::from(&target);
    let report = repair(&reader, &diagnosis, &to, &ConvertOptions::default(), &mut Control::new())
        .expect("repairing the dataset");
    assert_eq!(report.episodes, 3);
    let repaired = open(&target).expect("opening the dataset");
    assert_eq!(diagnose(&*repaired).problems(), 0);
    for (position, e) in [0, 3, 5].into_iter().enumerate() {
        let read = repaired.read(&["state"], &[StepRange::new(position, 0, rows(e))]).expect("reading rows");
        assert_eq!(read.bytes(0), episode(e).bytes(2));
    }
    let unrepairable: Arc<dyn Reader> = Arc::new(Broken::new(2, |_, rows| rows.resize(0)));
    let diagnosis = diagnose(&*unrepairable);
    let refused = repair(&unrepairable, &diagnosis, &to, &ConvertOptions::default(), &mut Control::new());
    let refused = refused.expect_err("repairing without an intact episode").to_string();
    assert!(refused.contains("none of the dataset's 2 episodes is intact"), "{refused}");
    let mut control = Control::new().with_interrupt(Arc::new(AtomicBool::new(true)));
    let stopped = examine(&*repaired, &MODELS, &mut control);
    assert!(matches!(stopped, Err(Error::Interrupted)));
}

/// Hides the constants of the inner reader.
struct Plain(Broken);

impl Reader for Plain {
    fn schema(&self) -> &Schema {
        self.0.schema()
    }

    fn episodes(&self) -> &[Episode] {
        self.0.episodes()
    }

    fn read_column(&self, column: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        self.0.read_column(column, ranges, out)
    }

    fn manifest(&self) -> Option<Manifest> {
        None
    }

    fn footprint(&self) -> Result<Vec<(String, u64)>> {
        Ok(vec![])
    }

    fn content_hash(&self) -> Result<String> {
        self.0.content_hash()
    }
}
