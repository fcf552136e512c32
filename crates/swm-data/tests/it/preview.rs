//! Videos and contact sheets of datasets in any format.

use crate::sample::{options, schema};
use crate::{fuzz, sample};
use swm_core::{Batch, ColumnSpec, DType, Schema};
use swm_data::{PreviewOptions, WriteMode, create, open, preview};

#[test]
fn previews_show_every_camera() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    for name in ["d.lance", "d.video", "d.lance-video"] {
        let path = folder.path().join(name);
        let mut writer = create(&path, &schema(), options(WriteMode::Create)).expect("creating the dataset");
        (0..6).for_each(|e| writer.write_episode(&sample::episode(e)).expect("writing an episode"));
        writer.finish().expect("finishing the dataset");
        let reader = open(&path).expect("opening the dataset");
        let out = folder.path().join(format!("{name}-preview"));
        let mut progress = vec![];
        let options = PreviewOptions { episodes: 3, ..PreviewOptions::default() };
        let written = preview(&*reader, &out, &options, |done| progress.push(done)).expect("writing the preview");
        let names: Vec<&str> = written.iter().filter_map(|path| path.file_name()?.to_str()).collect();
        assert_eq!(names, ["episode_0.mp4", "episode_2.mp4", "episode_4.mp4", "contact_sheet.png"]);
        assert_eq!(progress, [1, 2, 3]);
        assert_eq!(fuzz::files(&out).len(), 4, "no other file remains");
        let png = std::io::BufReader::new(std::fs::File::open(&written[3]).expect("opening a file"));
        let png = png::Decoder::new(png).read_info().expect("reading the PNG header");
        // Each of the frames, eight of an episode in two rows, has two lines of text above two images, which are enlarged eightfold, and three
        // below them.
        let frame = (2 * 24 * 8 + 2, 16 * 8 + 5 * 7);
        assert_eq!((png.info().width, png.info().height), (4 * (frame.0 + 2) + 2, 6 * (frame.1 + 2) + 2));
        let one = PreviewOptions { columns: vec!["goal".to_owned()], ..options };
        assert_eq!(preview(&*reader, &out, &one, |_| ()).expect("writing the preview").len(), 4);
        let wrong = PreviewOptions { columns: vec!["state".to_owned()], ..PreviewOptions::default() };
        assert!(preview(&*reader, &out, &wrong, |_| ()).expect_err("a numeric column").to_string().contains("images"));
    }
}

#[test]
fn three_cameras_are_a_grid() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let cameras = ["pixels", "front", "wrist"];
    let columns = cameras.iter().map(|name| ColumnSpec::image(*name, 192, 192));
    let columns = columns.chain([ColumnSpec::new("action", DType::Float32, [1])]).collect::<Vec<_>>();
    let schema = Schema::new(columns).expect("creating the schema");
    let path = folder.path().join("d.lance");
    let mut writer = create(&path, &schema, options(WriteMode::Create)).expect("creating the dataset");
    let mut episode = Batch::zeros(&schema, 3);
    for (camera, level) in [60, 120, 180].into_iter().enumerate() {
        episode.bytes_mut(camera).fill(level);
    }
    episode.get_mut::<f32>("action").expect("the action").copy_from_slice(&[0.0, 1.0, f32::NAN]);
    writer.write_episode(&episode).expect("writing an episode");
    writer.finish().expect("finishing the dataset");
    let reader = open(&path).expect("opening the dataset");
    let written = preview(&*reader, &folder.path().join("out"), &PreviewOptions::default(), |_| ()).expect("a preview");
    let png = std::io::BufReader::new(std::fs::File::open(&written[1]).expect("opening a file"));
    let mut png = png::Decoder::new(png).read_info().expect("reading the PNG header");
    let mut pixels = vec![0; png.output_buffer_size().expect("a size")];
    let info = png.next_frame(&mut pixels).expect("reading the image");
    assert!(info.width < 2000 && info.height < 2000, "{} x {}", info.width, info.height);
    // The first frame has two cameras side by side, and the third below.
    let (wide, line) = (info.width as usize, 7);
    let level = |x: usize, y: usize| pixels[(y * wide + x) * 3];
    let (first, second) = (2 * line + 100, 3 * line + 192 + 100);
    assert_eq!([level(100, first), level(300, first), level(100, second), level(300, second)], [60, 120, 180, 0]);
}
