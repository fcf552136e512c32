//! Replacing a dataset deletes the dataset's own files only, and no writer writes through symbolic links.

use crate::fuzz::{copy_all, files};
use crate::kill;
use crate::sample::{check, episode, options, schema, write};
use crate::video::interop;
use std::collections::BTreeMap;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use swm_core::columns::{self, ACTION};
use swm_core::files::Lock;
use swm_core::{Batch, ColumnSpec, DType, Schema};
use swm_data::{
    FORMATS, Location, PreviewOptions, StepRange, WriteMode, WriteOptions, create, has_no_dataset, open, preview,
};

/// The formats whose datasets are folders.
const FOLDER_FORMATS: [&str; 5] = ["lance", "lance-video", "folder", "video", "lerobot"];

/// Names of files of a user that resemble those of a dataset of some format.
const USER_FILES: [&str; 19] = [
    "thesis.txt",
    "thesis.npz",
    "notes/deep/a.txt",
    "holiday/ep_1.mp4",
    "holiday/ep_0_step_0.jpeg",
    "pixels/ep_notes.txt",
    "pixels/ep_x_step_y.png",
    "pixels/ep_0_step_y.jpeg",
    "pixels/ep_00.mp4",
    "pixels/ep_99.mp4",
    "pixels/ep_99_step_0.jpeg",
    "data/thesis.lance",
    "data/chunk-000/thesis.parquet",
    "data/chunk-000/file-099.parquet",
    "meta/notes.json.tmp",
    "meta/episodes/chunk-000/thesis.parquet",
    "videos/holiday/chunk-000/file-000.mp4",
    "videos/chunk-000/holiday/episode_0.mp4",
    "_versions/notes.manifest",
];

/// Writes the files of the user into a folder.
pub fn add_user_files(folder: &Path) {
    for file in USER_FILES.map(|name| folder.join(name)) {
        std::fs::create_dir_all(file.parent().expect("a folder")).expect("creating a folder");
        std::fs::write(file, "thesis").expect("writing a file");
    }
}

/// Checks that the files of the user are unchanged.
pub fn check_user_files(folder: &Path) {
    for file in USER_FILES.map(|name| folder.join(name)) {
        assert_eq!(std::fs::read_to_string(&file).unwrap_or_default(), "thesis", "{}", file.display());
    }
}

/// The content of every file in a folder.
fn contents(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    files(folder).into_iter().map(|file| (file.clone(), std::fs::read(file).expect("reading a file"))).collect()
}

/// The relative paths of all files in a folder.
pub fn names(folder: &Path) -> Vec<PathBuf> {
    files(folder).iter().map(|file| file.strip_prefix(folder).expect("a file of the folder").to_owned()).collect()
}

/// Expects that replacing a dataset fails with this message and changes no file.
fn refused(path: &Path, message: &str) {
    let before = contents(path);
    let error = overwrite(path).expect("a refusal").to_string();
    assert!(error.contains(message), "{error}");
    assert_eq!(contents(path), before, "{}", path.display());
}

fn overwrite(path: &Path) -> Option<swm_core::Error> {
    create(path, &schema(), WriteOptions { exclusive: true, ..options(WriteMode::Overwrite) }).err()
}

#[test]
fn datasets_that_would_not_be_recognised_are_refused() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for format in FORMATS.rows {
        let path = folder.path().join(format!("data-{}", format.id));
        match format.create(&Location::from(&path), &schema(), options(WriteMode::Create)) {
            Ok(mut writer) => {
                writer.write_episode(&episode(0)).expect("writing an episode");
                writer.finish().expect("finishing the dataset");
                assert_eq!(open(&path).expect("opening").episodes().len(), 1, "{}", format.id);
            }
            Err(error) => {
                let expected = format!("use {}.{}", path.display(), format.suffixes[0]);
                assert!(error.to_string().contains(&expected) && !path.exists(), "{error}");
            }
        }
    }
}

#[test]
fn links_to_nothing_are_refused() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let target = folder.path().join("target");
    for format in FORMATS.rows.iter().filter(|format| format.is_available()) {
        let path = folder.path().join(format!("data.{}", format.suffixes.first().unwrap_or(&"folder")));
        symlink(&target, &path).expect("creating a link");
        let error = format.create(&Location::from(&path), &schema(), options(WriteMode::Create)).err();
        let error = error.expect("a link to nothing").to_string();
        assert!(error.contains(&path.display().to_string()) && !target.exists(), "{}: {error}", format.id);
        std::fs::remove_file(&path).expect("removing the link");
    }
}

#[test]
fn names_of_columns_are_refused_or_read_back() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let names = ["", "`", "a`b", ".", "..", "a.b", "a\"b", "a'b", "a b", "a\nb"];
    for format in FORMATS.rows.iter().filter(|format| format.is_available()) {
        for (index, name) in names.into_iter().enumerate() {
            let columns = [ColumnSpec::new(name, DType::Float32, [1]), ColumnSpec::new(ACTION, DType::Float32, [1])];
            let Ok(schema) = Schema::new(columns) else { continue };
            let suffix = format.suffixes.first().unwrap_or(&"folder");
            let location = Location::from(folder.path().join(format!("{}-{index}.{suffix}", format.id)));
            let Ok(mut writer) = format.create(&location, &schema, options(WriteMode::Create)) else { continue };
            let mut rows = Batch::zeros(&schema, 2);
            rows.get_mut::<f32>(name).expect("the column").copy_from_slice(&[1.0, 2.0]);
            rows.get_mut::<f32>(ACTION).expect("the actions").copy_from_slice(&[0.0, f32::NAN]);
            writer.write_episode(&rows).and_then(|()| writer.finish()).expect("writing an episode");
            let range = StepRange { episode: 0, start: 0, length: 2 };
            let reader = format.open(&location);
            let stored = reader.and_then(|reader| {
                // A reader may return the name with `_` for `.`.
                let same = |stored: &str| stored == name || stored == columns::flat(name);
                let found = reader.schema().columns().iter().find(|column| same(&column.name));
                reader.read(&[&found.expect("the column is listed").name], &[range])
            });
            let stored = stored.unwrap_or_else(|error| panic!("{}: {name:?}: {error}", format.id));
            let column = stored.schema().columns()[0].name.clone();
            assert_eq!(stored.get::<f32>(&column).expect("the column"), [1.0, 2.0], "{}: {name:?}", format.id);
        }
    }
}

#[test]
fn files_of_another_kind_are_not_replaced() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let text = b"a thesis, not a dataset";
    // The second file begins like an HDF5 file whose creation was killed.
    for (name, content) in
        [("thesis.h5", &text[..]), ("zeros.h5", &[0; 100]), ("thesis.lance", text), ("a.folder", text)]
    {
        let path = folder.path().join(name);
        std::fs::write(&path, content).expect("writing a file");
        for mode in [WriteMode::Overwrite, WriteMode::Append, WriteMode::Create] {
            assert!(create(&path, &schema(), options(mode)).is_err(), "{name}");
            assert_eq!(std::fs::read(&path).expect("the file"), content, "{name}");
        }
    }
    for format in FOLDER_FORMATS {
        let path = folder.path().join(format!("a.{format}"));
        std::fs::write(&path, text).expect("writing a file");
        let error = overwrite(&path).expect("a refusal").to_string();
        assert!(error.contains(&path.display().to_string()) && error.contains("is not a folder"), "{error}");
        std::fs::remove_file(&path).expect("removing the file");
    }
    for name in ["a.lance", "b.folder", "c.video", "d.lerobot"] {
        let file = folder.path().join(name).join("meta/info.json");
        std::fs::create_dir_all(file.parent().expect("a folder")).expect("creating a folder");
        std::fs::write(&file, text).expect("writing a file");
        assert!(overwrite(file.parent().and_then(Path::parent).expect("a folder")).is_some(), "{name}");
        assert_eq!(std::fs::read(&file).expect("the file"), text, "{name}");
    }
}

#[test]
fn other_files_in_the_folder_of_a_dataset_stay() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for format in FOLDER_FORMATS {
        let path = folder.path().join(format!("data.{format}"));
        write(&path, WriteMode::Create, 1, 0..3);
        add_user_files(&path);
        let read = |episodes| {
            check_user_files(&path);
            let reader = open(&path).expect("opening");
            assert_eq!(reader.episodes().len(), episodes, "{format}");
            check(&*reader, 0);
        };
        read(3);
        write(&path, WriteMode::Overwrite, 1, 0..1);
        read(1);
        write(&path, WriteMode::Append, 1, 1..2);
        read(2);
    }
    assert_eq!(folder.path().read_dir().expect("listing").count(), 5, "nothing is beside the datasets");
}

#[test]
fn replacement_leaves_no_file_of_the_old_dataset() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for format in ["folder", "video", "lerobot"] {
        let [path, new] = ["old", "new"].map(|name| folder.path().join(format!("{name}.{format}")));
        write(&path, WriteMode::Create, 1, 0..4);
        write(&path, WriteMode::Overwrite, 1, 0..1);
        write(&new, WriteMode::Create, 1, 0..1);
        assert_eq!(names(&path), names(&new));
    }
}

#[test]
fn replacement_completes_one_that_was_killed() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for (format, last) in [("folder", "ep_len.npz"), ("video", "ep_len.npz"), ("lerobot", "meta/info.json")] {
        let path = folder.path().join(format!("data.{format}"));
        write(&path, WriteMode::Create, 1, 0..3);
        let expected = names(&path);
        let own = files(&path);
        // The metadata is deleted last.
        for file in own.iter().filter(|file| **file != path.join(last)) {
            std::fs::remove_file(file).expect("removing a file");
        }
        add_user_files(&path);
        assert!(open(&path).is_err(), "{format}: missing files are reported");
        write(&path, WriteMode::Overwrite, 1, 0..3);
        check(&*open(&path).expect("opening"), 0);
        check_user_files(&path);
        assert!(expected.iter().all(|name| path.join(name).is_file()), "{format}");
    }
}

#[test]
fn what_a_writer_leaves_before_its_first_commit_is_continued_and_replaced() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for (format, left) in [("folder", &b"PK\x03\x04"[..]), ("video", b"")] {
        for mode in [WriteMode::Append, WriteMode::Overwrite] {
            let path = folder.path().join(format!("{mode:?}.{format}"));
            std::fs::create_dir(&path).expect("creating a folder");
            std::fs::write(path.join("ep_len.tmp"), left).expect("writing a file");
            write(&path, mode, 1, 0..2);
            check(&*open(&path).expect("opening"), 0);
            assert!(!path.join("ep_len.tmp").exists(), "{format}");
        }
        let path = folder.path().join(format!("thesis.{format}"));
        std::fs::create_dir(&path).expect("creating a folder");
        std::fs::write(path.join("ep_len.tmp"), "thesis").expect("writing a file");
        assert!(overwrite(&path).expect("a refusal").to_string().contains("holds other files"), "{format}");
        assert_eq!(std::fs::read(path.join("ep_len.tmp")).expect("the file"), b"thesis");
    }
    for format in ["folder", "video", "lerobot", "lance", "lance-video"] {
        let path = folder.path().join(format!("empty.{format}"));
        std::fs::create_dir(&path).expect("creating a folder");
        write(&path, WriteMode::Append, 1, 0..2);
        check(&*open(&path).expect("opening"), 0);
    }
    let path = folder.path().join("d.lance");
    std::fs::create_dir_all(path.join("data")).expect("creating a folder");
    assert!(has_no_dataset(&path));
    std::fs::create_dir(path.join("_versions")).expect("creating a folder");
    for name in [&format!("data/{}.lance", "0".repeat(64)), "_versions/18446744073709551614.manifest#1"] {
        std::fs::write(path.join(name), "killed").expect("writing a file");
        assert!(has_no_dataset(&path));
    }
    std::fs::write(path.join("data/thesis.lance"), "thesis").expect("writing a file");
    assert!(!has_no_dataset(&path));
}

#[test]
fn killed_replacements_keep_files_of_the_user() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for format in ["folder", "video", "lerobot", "lance"] {
        let path = folder.path().join(format!("data.{format}"));
        write(&path, WriteMode::Create, 1, 0..2);
        let own = names(&path);
        add_user_files(&path);
        kill::replacements(&path, 6, |path| {
            check_user_files(path);
            if let Err(error) = open(path) {
                assert!(error.to_string().contains("its old files are in"), "{format}: {error}");
                // The next writer brings the old dataset back.
                create(path, &schema(), options(WriteMode::Append))
                    .and_then(|writer| writer.finish())
                    .expect("appending");
            }
            let reader = open(path).expect("opening the old or the new dataset");
            assert!(!reader.episodes().is_empty(), "{format}: {:?}", names(path));
            check(&*reader, 0);
            check_user_files(path);
        });
        write(&path, WriteMode::Overwrite, 1, 0..2);
        check(&*open(&path).expect("opening"), 0);
        check_user_files(&path);
        let left: Vec<PathBuf> = names(&path);
        let left =
            left.iter().filter(|name| !own.contains(name) && !USER_FILES.iter().any(|user| Path::new(user) == **name));
        assert!(format == "lance" || left.clone().count() == 0, "{format}: {:?}", left.collect::<Vec<_>>());
    }
    assert_eq!(folder.path().read_dir().expect("listing").count(), 4, "nothing is beside the datasets");
}

#[test]
fn datasets_whose_files_are_unknown_are_not_replaced() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let third_party = [
        ("folder-reference", "folder"),
        ("reference-video", "video"),
        ("lerobot-v21", "lerobot"),
        ("lerobot-v30-h264", "lerobot"),
    ];
    for (name, format) in third_party {
        let path = folder.path().join(format!("{name}.{format}"));
        copy_all(&interop().join(name), &path);
        refused(&path, "another program wrote it");
    }
    for (format, metadata) in [("folder", "ep_len.npz"), ("video", "ep_len.npz"), ("lerobot", "meta/info.json")] {
        let path = folder.path().join(format!("damaged.{format}"));
        write(&path, WriteMode::Create, 1, 0..2);
        std::fs::write(path.join(metadata), "thesis").expect("writing a file");
        refused(&path, "the names of its files are unknown");
    }
}

#[test]
fn dataset_of_another_format_is_not_replaced() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for (old, new) in [("video", "folder"), ("folder", "video")] {
        let path = folder.path().join(format!("a-{old}"));
        let create = |format, mode| {
            let format = FORMATS.get(format).expect("a format");
            format.create(&Location::from(&path), &schema(), options(mode))
        };
        let mut writer = create(old, WriteMode::Create).expect("creating");
        writer.write_episode(&episode(0)).expect("writing");
        writer.finish().expect("finishing");
        let before = contents(&path);
        let error = create(new, WriteMode::Overwrite).err().expect("another format").to_string();
        assert!(error.contains(&format!("is a dataset of the format {old}")), "{error}");
        assert_eq!(contents(&path), before);
    }
}

#[test]
fn new_columns_do_not_replace_files_of_the_user() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let path = folder.path().join("data.folder");
    write(&path, WriteMode::Create, 1, 0..2);
    add_user_files(&path);
    let schema = Schema::new([ColumnSpec::new("thesis", DType::Float32, [])]).expect("a schema");
    let before = contents(&path);
    let error = create(&path, &schema, options(WriteMode::Overwrite)).err().expect("an existing file").to_string();
    assert!(error.contains("thesis.npz") && error.contains("is not replaced"), "{error}");
    assert_eq!(contents(&path), before);
}

#[test]
fn new_episodes_do_not_replace_files_of_the_user() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let cases = [
        ("folder", "pixels/ep_1_step_0.jpeg"),
        ("video", "pixels/ep_1.mp4"),
        ("lerobot", "data/chunk-000/file-001.parquet"),
        ("lerobot", "videos/observation.images.pixels/chunk-000/file-001.mp4"),
    ];
    for (i, (format, name)) in cases.into_iter().enumerate() {
        let path = folder.path().join(format!("{i}.{format}"));
        write(&path, WriteMode::Create, 1, 0..1);
        std::fs::write(path.join(name), "thesis").expect("writing a file");
        let mut writer = create(&path, &schema(), options(WriteMode::Append)).expect("continuing");
        let error = writer.write_episode(&episode(1)).and_then(|()| writer.finish()).expect_err("an existing file");
        assert!(error.to_string().contains("is not replaced"), "{format}: {error}");
        assert_eq!(std::fs::read_to_string(path.join(name)).expect("the file"), "thesis", "{name}");
        assert_eq!(open(&path).expect("opening").episodes().len(), 1);
    }
}

#[test]
fn linked_datasets_are_not_replaced() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for format in ["lance", "lance-video", "folder", "video", "lerobot", "h5"] {
        let path = folder.path().join(format!("data.{format}"));
        write(&path, WriteMode::Create, 1, 0..2);
        let before = contents(&path);
        let link = folder.path().join(format!("link.{format}"));
        symlink(&path, &link).expect("making a link");
        let with_slash = PathBuf::from(format!("{}/", link.display()));
        for link in [&link, &with_slash] {
            let error = overwrite(link).expect("a refusal").to_string();
            assert!(error.contains("is a symbolic link"), "{format}: {error}");
        }
        assert_eq!(contents(&path), before, "{format}");
        check(&*open(&link).expect("a link is read"), 0);
    }
}

#[test]
fn linked_parts_of_a_dataset_are_not_replaced() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let cases = [
        ("folder", "pixels"),
        ("folder", "action.npz"),
        ("video", "pixels"),
        ("video", "ep_len.journal"),
        ("lerobot", "videos"),
        ("lerobot", "data/chunk-000"),
        ("lance", "data"),
        ("lance", "_versions"),
    ];
    for (i, (format, name)) in cases.into_iter().enumerate() {
        let (path, outside) = (folder.path().join(format!("{i}.{format}")), folder.path().join(format!("{i}-outside")));
        write(&path, WriteMode::Create, 1, 0..2);
        match path.join(name).exists() {
            true => std::fs::rename(path.join(name), &outside).expect("moving"),
            false => std::fs::write(&outside, "").expect("writing a file"),
        }
        symlink(&outside, path.join(name)).expect("making a link");
        let before = [contents(&path), contents(&outside)];
        let error = overwrite(&path).expect("a refusal").to_string();
        assert!(error.contains(name), "{format} {name}: {error}");
        if format == "lance" {
            assert!(create(&path, &schema(), options(WriteMode::Append)).is_err(), "new files would go elsewhere");
        }
        assert_eq!([contents(&path), contents(&outside)], before, "{format} {name}");
    }
}

#[test]
fn temporary_files_are_not_written_through_links() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let cases = [
        ("folder", "ep_len.tmp"),
        ("folder", "ep_len.journal"),
        ("folder", "pixels/ep_1_step_0.jpeg"),
        ("video", "pixels/ep_1.mp4.tmp"),
        ("video", "pixels/ep_1.mp4"),
        ("lerobot", "data/chunk-000/file-001.parquet.tmp"),
        ("lerobot", "videos/observation.images.pixels/chunk-000/file-001.mp4.tmp"),
        ("lerobot", "meta/info.json.tmp"),
    ];
    for (i, (format, name)) in cases.into_iter().enumerate() {
        let (path, thesis) = (folder.path().join(format!("{i}.{format}")), folder.path().join(format!("{i}-thesis")));
        write(&path, WriteMode::Create, 1, 0..1);
        std::fs::write(&thesis, "thesis").expect("writing a file");
        symlink(&thesis, path.join(name)).expect("making a link");
        let written = create(&path, &schema(), options(WriteMode::Append)).and_then(|mut writer| {
            writer.write_episode(&episode(1))?;
            writer.finish()
        });
        assert!(written.is_err(), "{format} {name}");
        assert_eq!(std::fs::read_to_string(&thesis).expect("the file"), "thesis", "{format} {name}");
    }
}

#[test]
fn preview_replaces_only_its_own_files() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let path = folder.path().join("data.lance");
    write(&path, WriteMode::Create, 1, 0..2);
    let reader = open(&path).expect("opening");
    let thesis = folder.path().join("thesis");
    std::fs::write(&thesis, "thesis").expect("writing a file");
    for name in ["contact_sheet.png", "episode_1.mp4"] {
        for linked in [false, true] {
            let out = tempfile::tempdir().expect("creating a folder");
            match linked {
                true => symlink(&thesis, out.path().join(name)).expect("making a link"),
                false => drop(std::fs::copy(&thesis, out.path().join(name)).expect("copying a file")),
            }
            let error =
                preview(&*reader, out.path(), &PreviewOptions::default(), |_| ()).expect_err("a file of the user");
            assert!(error.to_string().contains("was not written by this program"), "{name}: {error}");
            assert_eq!(names(out.path()), [Path::new(name)]);
            assert_eq!(std::fs::read_to_string(out.path().join(name)).expect("the file"), "thesis");
        }
    }
    let out = folder.path().join("preview");
    let other = Lock::folder(&out).expect("another preview");
    let error = preview(&*reader, &out, &PreviewOptions::default(), |_| ()).expect_err("a folder of another preview");
    assert!(error.to_string().contains("another process writes to it"), "{error}");
    drop(other);
    for _ in 0..2 {
        // As a kill leaves them; the last two are the user's.
        for name in [".episode_1.mp4.77.tmp", ".contact_sheet.png.77.tmp", ".episode_9.mp4.77.tmp", ".notes.77.tmp"] {
            std::fs::write(out.join(name), "cut off").expect("writing a file");
        }
        preview(&*reader, &out, &PreviewOptions::default(), |_| ()).expect("a preview replaces its own files");
        let written = ["contact_sheet.png", "episode_0.mp4", "episode_1.mp4"];
        let left: Vec<&str> = [".episode_9.mp4.77.tmp", ".notes.77.tmp"].into_iter().chain(written).collect();
        assert_eq!(names(&out), left.iter().map(Path::new).collect::<Vec<_>>());
    }
}
