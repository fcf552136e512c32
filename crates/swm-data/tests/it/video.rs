//! The format `video`. Run the long tests with:
//!
//! ```text
//! cargo test --release --workspace --test it -- --ignored video::
//! ```

use crate::{format_suite, fuzz};
use std::path::{Path, PathBuf};
use std::process::Command;
use swm_data::{ImageCodec, Reader, StepRange, WriteMode, WriteOptions, create, open};

#[test]
fn passes_the_format_suite() {
    format_suite::all("d.video");
}

#[test]
fn killed_writer_keeps_committed_episodes() {
    format_suite::killed("d.video", 4);
}

#[test]
#[ignore = "takes a minute"]
fn writer_killed_50_times_keeps_committed_episodes() {
    format_suite::killed("d.video", 50);
}

fn damaged(cases: u64) {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.video");
    format_suite::write(&path, WriteMode::Create, 0..3);
    let report = fuzz::dataset("video", &path, cases, fuzz::read_everything);
    // The format does not detect exchanged videos.
    let changed: Vec<&String> = report.changed.iter().filter(|change| !change.contains("replaced by")).collect();
    assert!(changed.is_empty(), "{changed:?}");
    assert!(report.refused as u64 > cases / 2, "{report:?}");
}

#[test]
fn rejects_damaged_folders() {
    damaged(400);
}

#[test]
#[ignore = "takes minutes"]
fn rejects_folders_damaged_in_10000_ways() {
    damaged(10_000);
}

/// Damages videos without this format's checksums, so that the damage reaches the decoder.
fn damaged_third_party(cases: u64) {
    let report = fuzz::dataset("reference-video", &interop().join("reference-video"), cases, fuzz::read_everything);
    assert!(report.refused as u64 > cases / 2, "{report:?}");
}

#[test]
fn reads_or_rejects_damaged_third_party_videos() {
    damaged_third_party(400);
}

#[test]
#[ignore = "takes minutes"]
fn reads_or_rejects_third_party_videos_damaged_in_10000_ways() {
    damaged_third_party(10_000);
}

#[test]
fn reports_videos_with_wrong_frame_counts() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.video");
    format_suite::write(&path, WriteMode::Create, 0..4);
    let found =
        |path: &Path| open(path).expect("opening the dataset").irregularities().expect("finding the irregularities");
    assert_eq!(found(&path), []);
    std::fs::copy(path.join("pixels/ep_3.mp4"), path.join("pixels/ep_1.mp4")).expect("copying a file");
    std::fs::remove_file(path.join("goal/ep_2.mp4")).expect("removing a file");
    let found = found(&path);
    assert_eq!(found.iter().map(|found| found.episode).collect::<Vec<_>>(), [Some(1), Some(2)]);
    assert!(found[0].what.contains("8 frames for 6 rows"), "{found:?}");
    let message = open(&path)
        .expect("opening the dataset")
        .read(&["goal"], &[StepRange::new(2, 0, 1)])
        .expect_err("a missing video")
        .to_string();
    assert!(message.contains("ep_2.mp4"), "{message}");
}

#[test]
fn videos_that_are_moved_away_are_missing_until_they_are_back() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    for (format, video) in
        [("video", "pixels/ep_1.mp4"), ("lerobot", "videos/observation.images.pixels/chunk-000/file-000.mp4")]
    {
        let path = folder.path().join(format!("d.{format}"));
        format_suite::write(&path, WriteMode::Create, 0..3);
        let reader = open(&path).expect("opening the dataset");
        let read = || reader.read(&["pixels"], &[StepRange::new(1, 0, 2)]).map(|read| read.bytes(0).to_vec());
        let expected = read().expect("the frames");
        let (video, away) = (path.join(video), folder.path().join("away.mp4"));
        std::fs::rename(&video, &away).expect("moving the video away");
        let error = read().expect_err("no video").to_string();
        let name = video.file_name().and_then(|name| name.to_str()).expect("a name");
        assert!(error.contains(&format!("{name}: the video is missing; move it back")), "{format}: {error}");
        std::fs::rename(&away, &video).expect("moving the video back");
        assert_eq!(read().expect("the video is back"), expected, "{format}");
    }
}

pub fn interop() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/interop")
}

/// Lengths of the episodes in the datasets of other programs.
pub const THIRD_PARTY_LENGTHS: [usize; 3] = [11, 14, 9];

/// Compares the first, third and last frame of every episode with the frames that another program decoded. The PNG file
/// holds these frames one below the other.
pub fn check_frames(reader: &dyn Reader, column: &str, png: &str, tolerance: u8) {
    let file = std::io::BufReader::new(std::fs::File::open(interop().join(png)).expect("opening a file"));
    let mut decoder = png::Decoder::new(file).read_info().expect("reading the PNG header");
    let mut expected = vec![0; decoder.output_buffer_size().expect("a size")];
    decoder.next_frame(&mut expected).expect("reading the PNG image");
    let ranges: Vec<StepRange> = THIRD_PARTY_LENGTHS
        .iter()
        .enumerate()
        .flat_map(|(e, length)| [0, 2, length - 1].map(|t| StepRange::new(e, t, 1)))
        .collect();
    let read = reader.read(&[column], &ranges).expect("reading rows");
    assert_eq!(read.bytes(0).len(), expected.len());
    let worst = read.bytes(0).iter().zip(&expected).map(|(a, b)| a.abs_diff(*b)).max().expect("pixels");
    assert!(worst <= tolerance, "{column}: off by {worst}");
    // Reads the frames backwards, and two frames twice, so that the decoder must seek.
    let back: Vec<StepRange> = ranges.iter().rev().chain(&ranges[..2]).copied().collect();
    let again = reader.read(&[column], &back).expect("reading rows");
    let size = read.bytes(0).len() / ranges.len();
    for (i, frame) in again.bytes(0).chunks_exact(size).enumerate() {
        let same = ranges.iter().position(|range| *range == back[i]).expect("a requested frame");
        assert!(frame == &read.bytes(0)[same * size..][..size], "{column}: frame {:?}", back[i]);
    }
}

#[test]
fn reads_videos_of_the_reference() {
    let reader = open(interop().join("reference-video")).expect("opening the dataset");
    assert_eq!(reader.episodes().iter().map(|e| e.length).collect::<Vec<_>>(), THIRD_PARTY_LENGTHS);
    check_frames(&*reader, "pixels", "reference-video-pixels.png", 0);
    for (e, &length) in THIRD_PARTY_LENGTHS.iter().enumerate() {
        let read = reader.read(&["state", "action", "success"], &[StepRange::new(e, 0, length)]).expect("reading rows");
        for t in 0..length {
            assert_eq!(read.row(t).get::<f64>("state").expect("reading the values"), [e as f64, t as f64, -0.5]);
            let action = read.row(t).get::<f32>("action").expect("reading the values").to_vec();
            assert!(if t + 1 == length { action[0].is_nan() } else { action == [e as f32, t as f32 / 4.0] });
            assert_eq!(read.row(t).get::<u8>("success").expect("reading the flag"), [u8::from(t % 3 == 0)]);
        }
    }
}

#[test]
fn appends_to_a_dataset_of_the_reference() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("reference-video");
    fuzz::copy_all(&interop().join("reference-video"), &path);
    let theirs = open(&path).expect("opening the dataset");
    let schema = swm_core::Schema::new(theirs.schema().columns()[2..].to_vec()).expect("creating the schema");
    let names: Vec<&str> = schema.columns().iter().map(|column| &*column.name).collect();
    let episode = theirs.read(&names, &[StepRange::new(1, 0, THIRD_PARTY_LENGTHS[1])]).expect("reading rows");
    let options = WriteOptions { mode: WriteMode::Append, codec: ImageCodec::Png, ..WriteOptions::default() };
    let mut writer = create(&path, &schema, options).expect("continuing the dataset");
    writer.write_episode(&episode).expect("writing an episode");
    writer.finish().expect("finishing the dataset");
    let reader = open(&path).expect("opening the dataset");
    assert_eq!(reader.episodes().len(), 4);
    check_frames(&*reader, "pixels", "reference-video-pixels.png", 0);
    let again = reader.read(&names, &[StepRange::new(3, 0, THIRD_PARTY_LENGTHS[1])]).expect("reading rows");
    (0..names.len()).for_each(|column| assert!(again.bytes(column) == episode.bytes(column), "{}", names[column]));
}

#[test]
fn reference_reads_videos_written_here() {
    let Some(python) = std::env::var_os("SWM_VIDEO_PYTHON") else {
        println!("SKIPPED: set SWM_VIDEO_PYTHON to a Python with stable-worldmodel and decord");
        return;
    };
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let theirs = open(interop().join("reference-video")).expect("opening the dataset");
    let schema = swm_core::Schema::new(theirs.schema().columns()[2..].to_vec()).expect("creating the schema");
    let names: Vec<&str> = schema.columns().iter().map(|column| &*column.name).collect();
    for (name, codec, tolerance) in
        [("lossless.video", ImageCodec::Png, 0.0), ("lossy.video", ImageCodec::Jpeg { quality: 95 }, 3.0)]
    {
        let path = folder.path().join(name);
        let mut writer =
            create(&path, &schema, WriteOptions { codec, ..WriteOptions::default() }).expect("creating the dataset");
        let episodes: Vec<_> = (0..3)
            .map(|e| theirs.read(&names, &[StepRange::new(e, 0, THIRD_PARTY_LENGTHS[e])]).expect("reading rows"))
            .collect();
        episodes.iter().for_each(|episode| writer.write_episode(episode).expect("writing an episode"));
        writer.finish().expect("finishing the dataset");
        let ours = open(&path).expect("opening the dataset");
        let output = Command::new(&python).arg("-B").arg(interop().join("video_check.py")).arg(&path).output();
        let output = output.expect("running Python");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let seen: serde_json::Value = serde_json::from_slice(&output.stdout).expect("parsing the JSON");
        for (e, episode) in episodes.iter().enumerate() {
            let bytes = episode.bytes(episode.schema().index("pixels").expect("finding the column"));
            let here = ours.read(&["pixels"], &[StepRange::new(e, 0, episode.rows())]).expect("reading rows");
            let there: Vec<u8> = seen[e]["pixels"]
                .as_array()
                .expect("bytes")
                .iter()
                .map(|v| v.as_u64().and_then(|v| u8::try_from(v).ok()).expect("a byte"))
                .collect();
            assert!(there == here.bytes(0), "{name}: both readers decode the same frames");
            let off: f64 = there.iter().zip(bytes).map(|(a, &b)| f64::from(a.abs_diff(b))).sum();
            assert!(off / bytes.len() as f64 <= tolerance, "{name}: {}", off / bytes.len() as f64);
            let state: Vec<f64> = (0..episode.rows()).flat_map(|t| [e as f64, t as f64, -0.5]).collect();
            assert_eq!(seen[e]["state"], serde_json::json!(state));
        }
    }
}
