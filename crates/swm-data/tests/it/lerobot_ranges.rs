//! LeRobot datasets whose list of episodes contradicts itself: ranges of rows and of times that are not those of the episodes.

use crate::fuzz;
use crate::hostile::copied;
use crate::lerobot::{DATA, EPISODES, change_values, rewrite};
use arrow_array::RecordBatch;
use arrow_array::types::{Float32Type, Float64Type, Int64Type};
use std::path::Path;
use swm_core::run::Control;
use swm_data::doctor::{Severity, examine};
use swm_data::open;

const NAME: &str = "lerobot-v30-h264";
/// The cameras whose frames are in videos.
const CAMERAS: [&str; 2] = ["observation.images.top", "observation.images.wrist"];
/// The times at which the episodes begin and end in both videos, and the frames per second.
const BEGIN: [f64; 3] = [0.0, 1.1, 2.5];
const END: [f64; 3] = [1.1, 2.5, 3.4];

/// A column, the episode, and the value that it states.
type Change<T> = (&'static str, usize, T);

fn set_rows(list: &Path, column: &str, row: usize, value: Option<i64>) {
    change_values::<Int64Type>(list, column, |rows| rows[row] = value);
}

fn set_time(list: &Path, camera: &str, field: &str, row: usize, time: Option<f64>) {
    change_values::<Float64Type>(list, &format!("videos/{camera}/{field}"), |times| times[row] = time);
}

/// The error of opening a dataset, which names its list of episodes.
fn refused(path: &Path) -> String {
    let error = open(path).map(|reader| reader.episodes().len()).expect_err("a contradiction").to_string();
    assert!(error.contains(EPISODES), "{error}");
    error
}

#[test]
fn ranges_of_rows_that_contradict_the_lengths_are_refused() {
    // The lengths are 11, 14 and 9.
    let cases: [(&[Change<i64>], &str); 9] = [
        (&[("dataset_to_index", 1, 24)], "episode 1 has the rows 11..24"),
        (&[("dataset_from_index", 1, 10)], "episode 1 has the rows 10..25"),
        (&[("dataset_from_index", 2, 0), ("dataset_to_index", 2, 9)], "episode 2 has the rows 0..9"),
        (&[("dataset_to_index", 2, 35)], "episode 2 has the rows 25..35"),
        (&[("dataset_from_index", 2, 26), ("dataset_to_index", 2, 35)], "episode 2 has the rows 26..35"),
        (&[("dataset_from_index", 0, -1)], "episode 0 has the rows -1..11"),
        (&[("dataset_to_index", 0, i64::MIN)], "episode 0 has the rows 0..-9223372036854775808"),
        (&[("dataset_to_index", 2, i64::MAX)], "episode 2 has the rows 25..9223372036854775807"),
        (&[("length", 1, 13)], "episode 1 has the rows 11..25"),
    ];
    for (changes, expected) in cases {
        let (_folder, path) = copied(NAME);
        changes.iter().for_each(|&(column, row, value)| set_rows(&path.join(EPISODES), column, row, Some(value)));
        let error = refused(&path);
        assert!(error.contains(expected) && error.contains("after"), "{changes:?}: {error}");
    }
    let (_folder, path) = copied(NAME);
    set_rows(&path.join(EPISODES), "dataset_from_index", 1, None);
    let error = refused(&path);
    assert!(error.contains("it lacks values of 'dataset_from_index'"), "{error}");
}

#[test]
fn ranges_of_times_that_contradict_the_lengths_or_each_other_are_refused() {
    let cases: [(&[Change<f64>], &str); 6] = [
        // A frame shorter than the rows.
        (&[("to_timestamp", 1, 2.4)], "episode 1"),
        (&[("to_timestamp", 2, 2.5)], "episode 2"),
        // Two frames of the episode before.
        (&[("from_timestamp", 1, 0.9)], "before the end of episode 0"),
        // In the frames of the first episode.
        (&[("from_timestamp", 2, 0.0), ("to_timestamp", 2, 0.9)], "before the end of episode 1"),
        (&[("from_timestamp", 0, -0.2), ("to_timestamp", 0, 0.9)], "before the video"),
        (&[("to_timestamp", 0, f64::NEG_INFINITY)], "end times"),
    ];
    for camera in CAMERAS {
        for (changes, expected) in cases {
            let (_folder, path) = copied(NAME);
            let list = path.join(EPISODES);
            changes.iter().for_each(|&(field, row, time)| set_time(&list, camera, field, row, Some(time)));
            let error = refused(&path);
            assert!(error.contains(expected) && error.contains(camera), "{changes:?}: {error}");
        }
        let (_folder, path) = copied(NAME);
        set_time(&path.join(EPISODES), camera, "to_timestamp", 1, None);
        let error = refused(&path);
        assert!(error.contains(&format!("it lacks end times of '{camera}'")), "{error}");
    }
}

#[test]
fn rounded_times_and_lists_without_ranges_are_read() {
    let (_folder, path) = copied(NAME);
    let list = path.join(EPISODES);
    let expected = fuzz::read_everything(&path).expect("the original");
    // A fifth of a frame more and less, of ten per second.
    for camera in CAMERAS {
        for row in 0..3 {
            let shift = if row == 1 { 0.02 } else { -0.02 };
            set_time(&list, camera, "from_timestamp", row, Some(BEGIN[row] + shift));
            set_time(&list, camera, "to_timestamp", row, Some(END[row] - shift));
        }
    }
    assert_eq!(fuzz::read_everything(&path).expect("rounded times"), expected);
    // Other programs leave out the columns that are not needed for reading.
    rewrite(&list, |batch| {
        let schema = batch.schema();
        let is_range = |name: &str| name.starts_with("dataset_") || name.ends_with("/to_timestamp");
        let left: Vec<usize> = (0..batch.num_columns()).filter(|&at| !is_range(schema.field(at).name())).collect();
        let batch: RecordBatch = batch.project(&left).expect("fewer columns");
        assert_eq!(left.len() + 4, schema.fields().len());
        batch
    });
    assert_eq!(fuzz::read_everything(&path).expect("no ranges"), expected);
}

#[test]
fn timestamps_outside_of_an_episode_are_refused_and_reported() {
    // The first episode, of ten frames per second, seems to begin three frames late, in the middle of its part of the video.
    for (rows, late, step, has_ends) in [(0..11, 0.3, 8, true), (0..11, 0.3, 8, false), (11..25, -0.2, 0, true)] {
        let (_folder, path) = copied(NAME);
        if !has_ends {
            rewrite(&path.join(EPISODES), |batch| {
                let schema = batch.schema();
                let is_end = |name: &str| name.ends_with("/to_timestamp");
                let left: Vec<usize> =
                    (0..batch.num_columns()).filter(|&at| !is_end(schema.field(at).name())).collect();
                batch.project(&left).expect("fewer columns")
            });
        }
        change_values::<Float32Type>(&path.join(DATA), "timestamp", |times| {
            times[rows.clone()].iter_mut().flatten().for_each(|time| *time += late);
        });
        let episode = usize::from(rows.start > 0);
        let expected = format!("step {step} of episode {episode} has the timestamp");
        let error = fuzz::read_everything(&path).expect_err("frames of another episode").to_string();
        assert!(error.contains(&expected), "{error}");
        let reader = open(&path).expect("opening reads no timestamps");
        let diagnosis = examine(&*reader, &[], &mut Control::new()).expect("an examination");
        assert!(diagnosis.findings.iter().any(|found| found.what.contains(&expected)), "{:?}", diagnosis.findings);
    }
}

#[test]
fn doctor_reports_episodes_with_more_frames_than_rows() {
    let (_folder, path) = copied(NAME);
    set_time(&path.join(EPISODES), CAMERAS[1], "to_timestamp", 2, Some(5.0));
    let reader = open(&path).expect("longer videos are read");
    let diagnosis = examine(&*reader, &[], &mut Control::new()).expect("an examination");
    let problems: Vec<_> = diagnosis.findings.iter().filter(|found| found.severity == Severity::Problem).collect();
    let [problem] = problems[..] else { panic!("{problems:?}") };
    assert_eq!(problem.episodes, [2]);
    let what = &problem.what;
    assert!(what.contains(CAMERAS[1]) && what.contains("2.500 s") && what.contains("9 rows"), "{what}");
    assert_eq!(diagnosis.intact, [0, 1]);
}
