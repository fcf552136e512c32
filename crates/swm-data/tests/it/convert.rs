//! Conversions between all formats are verified, resumed after an interruption, and rejected if the target holds other
//! data.

use crate::sample::{check, episode, options, schema, write};
use rand::Rng as _;
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use swm_core::run::{Control, Event};
use swm_core::{Batch, ColumnSpec, DType, Error, Key, Result, Schema};
use swm_data::{
    CommitPolicy, ConvertMode, ConvertOptions, Converted, FORMATS, ImageCodec, Location, Reader, WriteMode,
    WriteOptions, checksum, convert, create, open,
};

fn run(source: &Path, target: &Path, options: &ConvertOptions) -> Result<Converted> {
    convert(&open(source)?, &Location::from(target), options, &mut Control::new())
}

fn lossless(mode: ConvertMode) -> ConvertOptions {
    ConvertOptions { mode, codec: ImageCodec::Png, ..ConvertOptions::default() }
}

/// Writes the episodes `0..9` with lossless images.
fn source(folder: &Path) -> PathBuf {
    let path = folder.join("source.lance");
    let mut writer = create(&path, &schema(), WriteOptions { codec: ImageCodec::Png, ..options(WriteMode::Create) })
        .expect("creating the dataset");
    (0..9).for_each(|e| writer.write_episode(&episode(e)).expect("writing an episode"));
    writer.finish().expect("finishing the dataset");
    path
}

/// A path that every format accepts.
fn target_path(folder: &Path, format: &str) -> PathBuf {
    folder.join(match format {
        "hdf5" => "to.h5".to_owned(),
        other => format!("to.{other}"),
    })
}

#[test]
fn every_format_preserves_the_content() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = source(folder.path());
    let from = open(&path).expect("opening the dataset");
    let sum = checksum(&*from).expect("computing the checksum");
    for format in FORMATS.rows.iter().filter(|format| format.is_available()) {
        let target = target_path(folder.path(), format.id);
        let convert_options = ConvertOptions { format: Some(format.id.to_owned()), ..lossless(ConvertMode::Create) };
        let report = run(&path, &target, &convert_options).unwrap_or_else(|error| panic!("{}: {error}", format.id));
        assert_eq!((report.episodes, report.existing, report.last_actions), (9, 0, 0), "{}", format.id);
        assert_eq!(report.checksum.as_deref(), Some(&sum[..]), "{}", format.id);
        let to = format.open(&Location::from(&target)).expect("opening the dataset");
        check(&*to, 0);
        assert_eq!(to.manifest().map(|manifest| manifest.seed), from.manifest().map(|manifest| manifest.seed));
        for column in &report.columns {
            let is_image = ["pixels", "goal"].contains(&&column.column[..]);
            let preserved = column.exact || column.psnr.is_some_and(|psnr| is_image && psnr > 25.0);
            assert!(preserved, "{}: {column:?}", format.id);
        }
        if report.columns.iter().all(|column| column.exact) {
            assert_eq!(checksum(&*to).expect("computing the checksum"), sum, "{}", format.id);
        }
        // Converts back to the source's format.
        let back = folder.path().join(format!("back-{}.lance", format.id));
        run(&target, &back, &lossless(ConvertMode::Create)).unwrap_or_else(|error| panic!("{}: {error}", format.id));
        check(&*open(&back).expect("opening the dataset"), 0);
    }
}

#[test]
fn lossy_images_must_reach_the_minimum_psnr() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = source(folder.path());
    let jpeg = ConvertOptions { codec: ImageCodec::Jpeg { quality: 95 }, ..ConvertOptions::default() };
    let report = run(&path, &folder.path().join("fine.lance"), &jpeg).expect("converting with a sufficient PSNR");
    let images = report.columns.iter().find(|column| column.column == "pixels").expect("images");
    assert!(!images.exact && images.max_error >= 1.0 && images.psnr.is_some_and(|psnr| psnr > 30.0), "{images:?}");
    assert!(report.columns.iter().filter(|column| column.column == "state").all(|column| column.exact));
    let strict = ConvertOptions { least_psnr: Some(90.0), ..jpeg };
    let error = run(&path, &folder.path().join("strict.lance"), &strict).expect_err("an insufficient PSNR").to_string();
    assert!(error.contains("dB") && error.contains("codec"), "{error}");
    let unverified = ConvertOptions { verify: false, least_psnr: None, ..strict };
    let report = run(&path, &folder.path().join("unverified.lance"), &unverified).expect("converting the dataset");
    assert!(report.checksum.is_none() && report.columns.is_empty());
}

#[test]
fn minimum_psnr_without_effect_is_refused() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let (path, target) = (source(folder.path()), folder.path().join("target.lance"));
    let jpeg = ImageCodec::Jpeg { quality: 95 };
    let given = ConvertOptions { least_psnr: Some(30.0), ..ConvertOptions::default() };
    let refused = |options: &ConvertOptions| run(&path, &target, options).expect_err("no effect").to_string();
    assert!(refused(&given).contains("without loss"), "{}", refused(&given));
    let unverified = ConvertOptions { codec: jpeg, verify: false, ..given.clone() };
    assert!(refused(&unverified).contains("nothing is verified"), "{}", refused(&unverified));
    assert!(refused(&ConvertOptions { least_psnr: Some(f64::NAN), ..given.clone() }).contains("NaN"));
    assert!(!target.exists());
    run(&path, &target, &ConvertOptions { codec: jpeg, ..given.clone() }).expect("converting with losses");
    run(&path, &target, &given).expect("continuing a target with losses");
}

#[test]
fn interrupted_conversion_resumes_and_targets_with_other_data_are_rejected() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = source(folder.path());
    let target = folder.path().join("target.lance");
    for stop in [1, 4, 9] {
        let mut stages = vec![];
        let flag = Arc::new(AtomicBool::new(false));
        let mut control = Control::new().with_interrupt(Arc::clone(&flag)).with_events(|event| {
            if let Event::Progress(at) = event {
                stages.push(at.stage);
                flag.store(at.stage == "convert" && at.done >= stop, Ordering::Relaxed);
            }
        });
        let reader = open(&path).expect("opening the dataset");
        let options = lossless(ConvertMode::Resume);
        let stopped = convert(&reader, &Location::from(&target), &options, &mut control);
        drop(control);
        assert!(matches!(stopped, Err(Error::Interrupted)), "{stopped:?}");
        assert_eq!(open(&target).expect("opening the dataset").episodes().len(), stop, "the written episodes remain");
        assert_eq!(stages.contains(&"compare"), stop > 1);
    }
    let report = run(&path, &target, &lossless(ConvertMode::Resume)).expect("comparing the datasets");
    assert_eq!((report.episodes, report.existing, report.rows), (9, 9, 0));
    assert_eq!(
        report.checksum,
        run(&path, &folder.path().join("whole.lance"), &lossless(ConvertMode::Create))
            .expect("converting the dataset")
            .checksum
    );
    check(&*open(&target).expect("opening the dataset"), 0);

    let other = folder.path().join("other.lance");
    write(&other, WriteMode::Create, 2, 1..3);
    let error = run(&path, &other, &lossless(ConvertMode::Resume)).expect_err("a target with other data");
    assert!(error.is_usage() && error.to_string().contains("not the beginning of the source"), "{error}");
    assert!(run(&path, &other, &lossless(ConvertMode::Create)).is_err());
    let longer = folder.path().join("longer.lance");
    write(&longer, WriteMode::Create, 20, 0..12);
    let error = run(&path, &longer, &lossless(ConvertMode::Resume)).expect_err("a longer target").to_string();
    assert!(error.contains("12 episodes, more than the source's 9"), "{error}");
    let report = run(&path, &other, &lossless(ConvertMode::Append)).expect("appending to the target");
    assert_eq!((report.episodes, open(&other).expect("opening the dataset").episodes().len()), (11, 11));
    assert_eq!(run(&path, &other, &lossless(ConvertMode::Overwrite)).expect("overwriting the target").episodes, 9);
    check(&*open(&other).expect("opening the dataset"), 0);
}

/// Environment variable of the child process: the target of the conversion. The source is in the same folder.
const TARGET: &str = "SWM_TEST_CONVERT_TARGET";

/// The child process that `resumes_a_killed_conversion` kills. Prints a line per episode. Does nothing unless the
/// variable is set.
#[test]
fn child_that_converts() {
    let Some(target) = std::env::var_os(TARGET).map(PathBuf::from) else { return };
    let commit = CommitPolicy { episodes: 2, ..CommitPolicy::default() };
    let source = open(target.with_file_name("source.lance")).expect("opening the dataset");
    let options = ConvertOptions { commit, ..lossless(ConvertMode::Resume) };
    let mut control = Control::new().with_events(|event| {
        if let Event::Progress(at) = event {
            println!("{} {}", at.stage, at.done);
        }
    });
    let report = convert(&source, &Location::from(&target), &options, &mut control).expect("converting the dataset");
    println!("done {}", report.checksum.expect("the report has a checksum"));
}

#[test]
fn resumes_a_killed_conversion() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("source.lance");
    write(&path, WriteMode::Create, 40, 0..40);
    let expected = checksum(&*open(&path).expect("opening the dataset")).expect("computing the checksum");
    let target = folder.path().join("target.lance");
    let mut rng = Key::new(7).rng();
    let (mut kills, mut finished, mut continued) = (0, 0, false);
    while kills < 50 || finished == 0 {
        let mut command = Command::new(std::env::current_exe().expect("finding the test executable"));
        command.args(["--exact", "convert::child_that_converts", "--nocapture"]).env(TARGET, &target);
        let mut child =
            command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().expect("starting the child process");
        let mut lines = BufReader::new(child.stdout.take().expect("the output of the child process")).lines();
        // The child is killed after this many lines, unless it finishes earlier.
        let kill_after = if kills < 50 { rng.random_range(0..60) } else { usize::MAX };
        let mut done = None;
        for line in lines.by_ref().map(|line| line.expect("a line of text")).take(kill_after) {
            continued |= line.contains("compare");
            done = line.split_once("done ").map(|(_, checksum)| checksum.trim().to_owned()).or(done);
        }
        let _ = child.kill();
        child.wait().expect("waiting for the child process");
        kills += usize::from(done.is_none());
        if target.exists() {
            // The target always holds complete episodes, in order.
            check(&*open(&target).expect("opening the dataset"), 0);
        }
        if let Some(checksum) = done {
            assert_eq!(checksum, expected);
            assert_eq!(open(&target).expect("opening the dataset").episodes().len(), 40);
            std::fs::remove_dir_all(&target).expect("removing a folder");
            finished += 1;
        }
    }
    assert!(continued, "at least one killed conversion was resumed");
}

/// A third-party dataset whose last rows have actions.
struct ThirdParty(Schema);

impl Reader for ThirdParty {
    fn schema(&self) -> &Schema {
        &self.0
    }

    fn episodes(&self) -> &[swm_data::Episode] {
        &[swm_data::Episode { index: 4, length: 3 }, swm_data::Episode { index: 7, length: 2 }]
    }

    fn read_column(&self, _: &str, ranges: &[swm_data::StepRange], out: &mut [u8]) -> Result<()> {
        let mut at = 0;
        for range in ranges {
            for row in range.start..range.start + range.length {
                out[at..at + 4].copy_from_slice(&(row as f32 + 0.5).to_ne_bytes());
                at += 4;
            }
        }
        Ok(())
    }

    fn manifest(&self) -> Option<swm_core::Manifest> {
        None
    }

    fn footprint(&self) -> Result<Vec<(String, u64)>> {
        Ok(vec![])
    }

    fn content_hash(&self) -> Result<String> {
        Ok(String::new())
    }
}

#[test]
fn conversion_omits_and_counts_actions_in_last_rows() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let target = folder.path().join("target.lance");
    let schema = Schema::new([ColumnSpec::new("action", DType::Float32, [1])]).expect("creating the schema");
    let reader: Arc<dyn Reader> = Arc::new(ThirdParty(schema));
    let report = convert(&reader, &Location::from(&target), &ConvertOptions::default(), &mut Control::new())
        .expect("converting the dataset");
    assert_eq!((report.episodes, report.last_actions), (2, 2));
    let read = open(&target).expect("opening the dataset");
    let batch: Batch = read.read(&["action"], &[swm_data::StepRange::new(0, 0, 3)]).expect("reading rows");
    let actions = batch.get::<f32>("action").expect("reading the actions");
    assert!(actions[..2] == [0.5, 1.5] && actions[2].is_nan());
}

#[test]
fn conversion_preserves_doubles_or_reports_the_rounding_error() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("fine.lance");
    let schema = Schema::new([ColumnSpec::new("state", DType::Float64, [1])]).expect("creating the schema");
    let mut batch = Batch::zeros(&schema, 4);
    batch.get_mut::<f64>("state").expect("accessing the states").copy_from_slice(&[0.1, -1.0 / 3.0, 1e-9, 7.0]);
    let buffer = swm_data::ReplayBuffer::new(&schema, 10).expect("creating the replay buffer");
    buffer.add(&batch, &swm_data::Constants::new()).expect("adding an episode");
    let report = convert(&buffer.snapshot(), &Location::from(&path), &ConvertOptions::default(), &mut Control::new())
        .expect("converting the dataset");
    let state = &report.columns[0];
    assert!(state.exact || (state.max_error > 0.0 && state.max_error < 1e-7), "{state:?}");
}

#[test]
fn failed_conversion_leaves_no_empty_dataset() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let source = folder.path().join("source.h5");
    let schema = Schema::new([ColumnSpec::new("id", DType::Int64, [])]).expect("a schema");
    let mut episode = Batch::zeros(&schema, 2);
    episode.row_mut(1).set(0, &[(1_i64 << 24) + 1]);
    let mut writer = create(&source, &schema, WriteOptions::default()).expect("creating");
    writer.write_episode(&episode).expect("writing");
    writer.finish().expect("finishing");
    let reader = open(&source).expect("opening");
    let target = Location::from(folder.path().join("target.lance"));
    let error =
        convert(&reader, &target, &ConvertOptions::default(), &mut Control::new()).expect_err("a large integer");
    assert!(error.to_string().contains("another format"), "{error}");
    assert_eq!(folder.path().read_dir().expect("listing").count(), 1, "only the source remains");
}

#[test]
fn refused_conversion_does_not_replace_a_dataset() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let source = folder.path().join("source.lance");
    write(&source, WriteMode::Create, 1, 0..2);
    let reader = open(&source).expect("opening");
    for format in ["lance", "lance-video", "folder", "video", "lerobot"] {
        let path = folder.path().join(format!("old.{format}"));
        write(&path, WriteMode::Create, 2, 0..3);
        let content = || checksum(&*open(&path).expect("opening the old dataset")).expect("its hash");
        let before = content();
        let quality = ImageCodec::Jpeg { quality: 1 };
        let options = ConvertOptions {
            mode: ConvertMode::Overwrite,
            codec: quality,
            least_psnr: Some(90.0),
            ..ConvertOptions::default()
        };
        let error = convert(&reader, &Location::from(&path), &options, &mut Control::new()).expect_err("lossy images");
        assert!(error.to_string().contains("signal-to-noise"), "{format}: {error}");
        assert_eq!(content(), before, "{format}");
        let options = ConvertOptions { least_psnr: Some(0.0), ..options };
        convert(&reader, &Location::from(&path), &options, &mut Control::new()).expect(format);
        assert_eq!(open(&path).expect("opening").episodes().len(), 2, "{format}");
    }
    let left: Vec<_> =
        folder.path().read_dir().expect("listing").map(|entry| entry.expect("an entry").path()).collect();
    assert_eq!(left.len(), 6, "{left:?}");
    // What a kill leaves of a trial does not stay.
    for format in ["lance", "video"] {
        let (path, trial) =
            (folder.path().join(format!("old.{format}")), folder.path().join(format!(".old.trial.{format}")));
        write(&trial, WriteMode::Create, 3, 0..1);
        let options = ConvertOptions {
            mode: ConvertMode::Overwrite,
            codec: ImageCodec::Jpeg { quality: 90 },
            least_psnr: Some(0.0),
            ..ConvertOptions::default()
        };
        convert(&reader, &Location::from(&path), &options, &mut Control::new()).expect(format);
        assert!(!trial.exists(), "{format}");
    }
}

#[test]
fn conversions_continue_datasets_without_episodes() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let from = folder.path().join("source.lance");
    write(&from, WriteMode::Create, 1, 0..2);
    for format in ["lance", "lance-video", "folder", "video", "lerobot", "h5"] {
        let path = folder.path().join(format!("to.{format}"));
        // A conversion that is killed before its first commit leaves the empty dataset of its writer.
        create(&path, &schema(), options(WriteMode::Create)).expect("creating the dataset").finish().expect("an end");
        for mode in [ConvertMode::Resume, ConvertMode::Append] {
            let options = ConvertOptions { mode, least_psnr: None, ..ConvertOptions::default() };
            run(&from, &path, &options).unwrap_or_else(|error| panic!("{format}: {error}"));
        }
        assert_eq!(open(&path).expect("opening").episodes().len(), 4, "{format}");
    }
}

#[test]
fn dataset_is_not_written_over_itself() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for format in ["lance", "lance-video", "folder", "video", "lerobot", "h5"] {
        let path = folder.path().join(format!("{format}/data.{format}"));
        std::fs::create_dir_all(path.parent().expect("a folder")).expect("creating a folder");
        write(&path, WriteMode::Create, 1, 0..2);
        let link = folder.path().join(format!("link.{format}"));
        std::os::unix::fs::symlink(&path, &link).expect("making a link");
        let reader = open(&path).expect("opening");
        let views = [
            swm_data::views::subset(Arc::clone(&reader), vec![1]).expect("a view"),
            swm_data::views::concat(vec![Arc::clone(&reader)]).expect("a view"),
        ];
        for reader in views.iter().chain([&reader]) {
            // The folder that holds a single table or file is a name of this dataset.
            for target in [&*path, &link, path.parent().expect("a folder")] {
                let options = ConvertOptions { mode: ConvertMode::Overwrite, ..ConvertOptions::default() };
                let error = convert(reader, &target.into(), &options, &mut Control::new()).expect_err("the source");
                assert!(error.is_usage() && error.to_string().contains("is the dataset that is read"), "{error}");
            }
        }
        assert_eq!(open(&path).expect("opening").episodes().len(), 2);
    }
}

/// The format refuses the name of a column only when it creates the table, below folders that exist then.
#[test]
fn a_conversion_that_is_refused_leaves_no_folder() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let schema = Schema::new([ColumnSpec::new("a`b", DType::Float32, [])]).expect("a schema");
    let path = folder.path().join("from.h5");
    let mut writer = create(&path, &schema, options(WriteMode::Create)).expect("creating the dataset");
    writer.write_episode(&Batch::zeros(&schema, 3)).expect("writing an episode");
    writer.finish().expect("finishing the dataset");
    for name in ["to.lance", "to.lance-video"] {
        run(&path, &folder.path().join(name), &lossless(ConvertMode::Create)).expect_err("a column with this name");
        assert!(!folder.path().join(name).exists(), "{name} stays");
    }
}
