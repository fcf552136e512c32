//! Datasets that a stranger made: headers with absurd sizes, and files that are no regular files. Opening and reading
//! gives an error; a panic, an abort or a hang fails the test.

use crate::fuzz;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use swm_data::{WriteMode, open};

fn interop(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/interop").join(name)
}

/// A copy of a dataset of `tests/interop` in a new folder.
pub fn copied(name: &str) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join(name);
    fuzz::copy_all(&interop(name), &path);
    (folder, path)
}

fn error(path: &Path) -> String {
    fuzz::read_everything(path).expect_err("an error").to_string()
}

/// The header of a PNG file of `side` x `side` pixels.
fn png(side: u32) -> Vec<u8> {
    let body = [b"IHDR".as_slice(), &side.to_be_bytes(), &side.to_be_bytes(), &[8, 2, 0, 0, 0]].concat();
    let step = |crc: u32, byte: &u8| {
        (0..8).fold(crc ^ u32::from(*byte), |crc, _| crc >> 1 ^ if crc & 1 == 1 { 0xedb8_8320 } else { 0 })
    };
    let crc = !body.iter().fold(!0, step);
    [b"\x89PNG\r\n\x1a\n\0\0\0\r".as_slice(), &body, &crc.to_be_bytes(), b"\0\0\0\0IDAT"].concat()
}

#[test]
fn foreign_images_of_absurd_sizes_are_refused() {
    let qoi = |side: u32| [b"qoif".as_slice(), &side.to_be_bytes(), &side.to_be_bytes(), &[3, 0]].concat();
    for header in [png(65535), png(1 << 30), qoi(65535), qoi(u32::MAX)] {
        let (_folder, path) = copied("reference.lance");
        let mut changed = 0;
        for file in fuzz::files(&path).iter().filter(|file| file.extension().is_some_and(|end| end == "lance")) {
            let mut bytes = std::fs::read(file).expect("a data file");
            let starts: Vec<usize> = (0..bytes.len().saturating_sub(header.len()))
                .filter(|&at| bytes[at..].starts_with(&[0xff, 0xd8, 0xff]) || bytes[at..].starts_with(b"\x89PNG"))
                .collect();
            for at in starts {
                bytes[at..at + header.len()].copy_from_slice(&header);
                changed += 1;
            }
            std::fs::write(file, bytes).expect("a data file");
        }
        assert!(changed > 0, "the dataset has images");
        let error = error(&path);
        // The PNG library has a limit of its own.
        assert!(["at most 67108864 pixels", "limits are exceeded"].iter().any(|text| error.contains(text)), "{error}");
    }
}

#[test]
fn hostile_descriptions_of_lerobot_datasets_are_refused() {
    let (_folder, path) = copied("lerobot-v21");
    let file = path.join("meta/info.json");
    let original: Value = serde_json::from_slice(&std::fs::read(&file).expect("a file")).expect("JSON");
    // Parsed objects are sorted by key, and the order of features is that of the columns.
    std::fs::write(&file, original.to_string()).expect("a written file");
    let expected = fuzz::read_everything(&path).expect("the original");
    let features = original["features"].as_object().expect("features");
    let shapes = features.keys().map(|name| format!("/features/{name}/shape"));
    let counts = ["total_episodes", "total_frames", "chunks_size", "fps"].map(|name| format!("/{name}"));
    for pointer in shapes.chain(counts) {
        let is_shape = pointer.ends_with("shape");
        let sizes = [json!(-1), json!(0), json!(1_u64 << 31), json!(1_u64 << 60), json!(u64::MAX), json!(1e308)];
        for size in sizes {
            let mut changed = original.clone();
            let new = if is_shape { json!([size, size, 3]) } else { size };
            *changed.pointer_mut(&pointer).expect("the value") = new.clone();
            std::fs::write(&file, changed.to_string()).expect("a written file");
            // Columns without elements are skipped, so a shape of 0 can be valid, as a frame rate can be.
            match fuzz::read_everything(&path) {
                Ok(hash) => assert!(new == json!([0, 0, 3]) || hash == expected, "{pointer} = {new}"),
                Err(error) => assert!(!error.to_string().is_empty()),
            }
        }
    }
}

#[test]
fn lengths_of_lerobot_episodes_do_not_allocate_memory() {
    let (_folder, path) = copied("lerobot-v21");
    let (list, info) = (path.join("meta/episodes.jsonl"), path.join("meta/info.json"));
    let text = std::fs::read_to_string(&list).expect("the list of episodes");
    let total: Value = serde_json::from_slice(&std::fs::read(&info).expect("a file")).expect("JSON");
    for length in [1_u64 << 31, 1 << 39, 1 << 60] {
        let lines: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
        let mut lines = lines;
        let (mut rows, first) = (0, lines[0]["length"].as_u64().expect("a length"));
        lines[0]["length"] = json!(length);
        rows += total["total_frames"].as_u64().expect("a count") - first + length;
        let lines: Vec<String> = lines.iter().map(Value::to_string).collect();
        std::fs::write(&list, lines.join("\n")).expect("a written file");
        let mut changed = total.clone();
        changed["total_frames"] = json!(rows);
        std::fs::write(&info, changed.to_string()).expect("a written file");
        assert!(!error(&path).is_empty());
    }
}

/// Writes the footer of a Parquet file again, with this number of rows in the file and in its row groups.
fn set_parquet_rows(path: &Path, rows: i64) {
    use parquet::file::metadata::{FileMetaData, ParquetMetaDataBuilder, ParquetMetaDataReader, ParquetMetaDataWriter};
    let mut bytes = std::fs::read(path).expect("a file");
    let old = ParquetMetaDataReader::new().parse_and_finish(&bytes::Bytes::from(bytes.clone())).expect("a footer");
    let file = old.file_metadata();
    let schema = file.schema_descr_ptr();
    let file = FileMetaData::new(file.version(), rows, None, None, schema, None);
    let groups = old
        .row_groups()
        .iter()
        .map(|group| group.clone().into_builder().set_num_rows(rows).build().expect("a row group"));
    let new = ParquetMetaDataBuilder::new(file).set_row_groups(groups.collect()).build();
    ParquetMetaDataWriter::new(&mut bytes, &new).finish().expect("a written footer");
    std::fs::write(path, bytes).expect("a written file");
}

#[test]
fn row_counts_of_parquet_files_allocate_no_memory() {
    for rows in [1 << 31, 1 << 60, i64::MAX, -1] {
        for part in ["data", "meta/episodes"] {
            let (_folder, path) = copied("lerobot-v30-h264");
            let files = fuzz::files(&path);
            let of_part = |file: &&PathBuf| file.strip_prefix(&path).is_ok_and(|inside| inside.starts_with(part));
            let file = files.iter().filter(of_part).find(|file| file.extension().is_some_and(|end| end == "parquet"));
            set_parquet_rows(file.expect("a Parquet file"), rows);
            assert!(!error(&path).is_empty(), "{part}: {rows} rows");
        }
    }
}

#[test]
fn sparse_files_of_a_lance_table_reserve_no_memory() {
    let read = |suffix: &str| {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("e.lance");
        crate::format_suite::write(&path, WriteMode::Create, 0..2);
        let versions = path.join("_versions");
        let hint = versions.join("latest_version_hint.json");
        for file in
            fuzz::files(&versions).into_iter().chain([hint]).filter(|file| file.to_string_lossy().ends_with(suffix))
        {
            let file = std::fs::File::create(file).expect("creating a file");
            file.set_len(1 << 42).expect("a file of 4 TiB without content");
        }
        fuzz::read_everything(&path)
    };
    let error = read("manifest").expect_err("a manifest of 4 TiB").to_string();
    assert!(error.contains("has 4398046511104 bytes, of at most"), "{error}");
    assert!(read("json").is_ok(), "the hint is not read");
}

#[test]
fn paths_of_lerobot_episodes_allocate_no_memory() {
    let (_folder, path) = copied("lerobot-v21");
    let file = path.join("meta/info.json");
    let original: Value = serde_json::from_slice(&std::fs::read(&file).expect("a file")).expect("JSON");
    let mut long = original.clone();
    long["data_path"] = json!(format!("{}/{{episode_index}}.parquet", "a".repeat(1_000_000)));
    std::fs::write(&file, long.to_string()).expect("a written file");
    assert!(error(&path).contains("the path of a file has more than 4096 bytes"), "{}", error(&path));
    let mut many = original;
    for camera in 0..3000 {
        many["features"][format!("v{camera}")] = json!({"dtype": "video", "shape": [8, 8, 3], "names": null});
    }
    std::fs::write(&file, many.to_string()).expect("a written file");
    let lines: String = (0..20_000).map(|i| format!("{{\"episode_index\":{i},\"length\":1}}\n")).collect();
    std::fs::write(path.join("meta/episodes.jsonl"), lines).expect("a written file");
    assert!(error(&path).contains("20000 episodes with 300"), "{}", error(&path));
}

#[test]
fn pipes_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let pipe = |path: &Path| {
        if path.exists() {
            std::fs::remove_file(path).expect("a removed file");
        }
        assert!(std::process::Command::new("mkfifo").arg(path).status().expect("mkfifo").success());
    };
    let refused = |path: &Path| {
        let error = error(path);
        // A pipe in the place of the file that identifies a format is no dataset of the format.
        assert!(["not a regular file", "not a dataset"].iter().any(|text| error.contains(text)), "{error}");
    };
    pipe(&folder.path().join("d.h5"));
    refused(&folder.path().join("d.h5"));
    for (name, suffix) in [
        ("folder-reference", "ep_len.npz"),
        ("lerobot-v21", "parquet"),
        ("reference.lance", "lance"),
        ("reference.lance", "manifest"),
    ] {
        let (_folder, path) = copied(name);
        let files = fuzz::files(&path);
        let file = files.iter().find(|file| file.to_string_lossy().ends_with(suffix)).expect("a file");
        pipe(file);
        refused(&path);
    }
    let path = folder.path().join("e.folder");
    crate::format_suite::write(&path, WriteMode::Create, 0..2);
    assert!(open(&path).is_ok());
    let image = fuzz::files(&path).into_iter().find(|file| file.extension().is_some_and(|end| end != "npz"));
    pipe(&image.expect("an image"));
    refused(&path);
    // Data files that are named by their hash are read to compare it.
    for name in ["e.lance", "e.lance-video"] {
        let path = folder.path().join(name);
        crate::format_suite::write(&path, WriteMode::Create, 0..2);
        let file =
            fuzz::files(&path).into_iter().find(|file| file.parent().is_some_and(|parent| parent.ends_with("data")));
        pipe(&file.expect("a data file"));
        refused(&path);
    }
}

#[test]
fn hostile_compact_data_of_hdf5_files_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("d.h5");
    let intact = std::fs::read(interop("hdf5-compact.h5")).expect("the file");
    std::fs::write(&path, &intact).expect("a written file");
    let expected = fuzz::read_everything(&path).expect("the original");
    let (mut refused, mut changed) = (0, 0);
    // Sizes, versions and addresses are in the headers: each becomes the largest, zero, and a power of two.
    for at in 0..intact.len() - 8 {
        for new in [&[0xff][..], &[0], &[0xff; 2], &[0xff; 8], &[0, 0, 0, 0, 0, 0, 0, 0x10]] {
            if intact[at..].starts_with(new) || (new.len() == 8 && !at.is_multiple_of(4)) {
                continue;
            }
            let mut bytes = intact.clone();
            bytes[at..at + new.len()].copy_from_slice(new);
            std::fs::write(&path, &bytes).expect("a written file");
            match fuzz::read_everything(&path) {
                Ok(hash) => changed += usize::from(hash != expected),
                Err(error) => refused += usize::from(!error.to_string().is_empty()),
            }
        }
    }
    // Data in a header have no checksum: a changed value is a changed value.
    assert!(refused > 500 && changed > 50, "{refused} refused, {changed} changed");
}

/// A sequence parameter set of H.264 for frames of this many macroblocks.
fn parameter_set(width: u32, height: u32) -> Vec<u8> {
    let mut bits = String::new();
    let number = |value: u32| {
        let digits = format!("{:b}", value + 1);
        "0".repeat(digits.len() - 1) + &digits
    };
    // The id, the length of frame numbers, the kind of order, the number of references.
    bits.extend([number(0), number(0), number(2), number(1), "0".to_owned()]);
    bits.extend([
        number(width - 1),
        number(height - 1),
        "1".to_owned(),
        "1".to_owned(),
        "00".to_owned(),
        "1".to_owned(),
    ]);
    let padded = bits.len().next_multiple_of(8);
    bits += &"0".repeat(padded - bits.len());
    let byte = |at: usize| u8::from_str_radix(&bits[at..at + 8], 2).expect("eight bits");
    [vec![0x67, 66, 0, 62], (0..padded).step_by(8).map(byte).collect()].concat()
}

#[test]
fn frame_sizes_of_hostile_videos_reserve_no_memory() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("d.video");
    crate::format_suite::write(&path, WriteMode::Create, 0..2);
    let video = fuzz::files(&path).into_iter().find(|file| file.extension().is_some_and(|end| end == "mp4"));
    let video = video.expect("a video");
    let intact = std::fs::read(&video).expect("the video");
    let expected = fuzz::read_everything(&path).expect("the original");
    let find = |name: &[u8]| intact.windows(name.len()).position(|bytes| bytes == name).expect("a box");
    // The size in the description of the track.
    for size in [[0xff; 4], [0; 4], [0x40, 0, 0x40, 0], [0x10, 0, 0x10, 0]] {
        let mut bytes = intact.clone();
        let at = find(b"avc1") + 28;
        bytes[at..at + 4].copy_from_slice(&size);
        std::fs::write(&video, bytes).expect("a written video");
        assert!(!error(&path).is_empty(), "{size:?}");
    }
    // The size in the parameters of the decoder, up to 1,048,576 x 1,048,576 pixels.
    let at = find(b"avcC") + 4;
    let length = usize::from(u16::from_be_bytes([intact[at + 6], intact[at + 7]]));
    for [width, height] in [[1 << 16, 1 << 16], [4096, 4096], [1024, 1024], [512, 512], [1, 1 << 16]] {
        let mut bytes = intact.clone();
        let set = parameter_set(width, height);
        assert!(set.len() <= length, "{} bytes", set.len());
        bytes[at + 8..at + 8 + length].fill(0);
        bytes[at + 8..at + 8 + set.len()].copy_from_slice(&set);
        std::fs::write(&video, bytes).expect("a written video");
        match fuzz::read_everything(&path) {
            Ok(hash) => assert_eq!(hash, expected, "{width} x {height} macroblocks"),
            Err(error) => assert!(!error.to_string().is_empty()),
        }
    }
}
