//! Videos and contact sheets of datasets in any format.

use crate::sample::{options, schema};
use crate::{fuzz, sample};
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
        // Each of the eight frames in a row has two lines of text above two images, which are enlarged eightfold, and three
        // below them.
        let frame = (2 * 24 * 8 + 2, 16 * 8 + 5 * 7);
        assert_eq!((png.info().width, png.info().height), (8 * (frame.0 + 2) + 2, 3 * (frame.1 + 2) + 2));
        let one = PreviewOptions { columns: vec!["goal".to_owned()], ..options };
        assert_eq!(preview(&*reader, &out, &one, |_| ()).expect("writing the preview").len(), 4);
        let wrong = PreviewOptions { columns: vec!["state".to_owned()], ..PreviewOptions::default() };
        assert!(preview(&*reader, &out, &wrong, |_| ()).expect_err("a numeric column").to_string().contains("images"));
    }
}
