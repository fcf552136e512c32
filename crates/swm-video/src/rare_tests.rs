//! Rare encodings that FFmpeg reads: `tests/interop/rare_videos_export.py` wrote the videos and their frames.

use crate::{DecoderPool, FrameRequest, Source, Video};
use std::path::{Path, PathBuf};
use std::sync::Arc;

const FRAME: usize = 48 * 64 * 3;

fn path(name: &str, end: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/interop/rare-{name}.{end}"))
}

fn bytes(name: &str) -> Vec<u8> {
    std::fs::read(path(name, "mp4")).expect("reading the file")
}

fn opened(bytes: Vec<u8>) -> swm_core::Result<Video> {
    Video::open(Source::Memory("a blob".into(), bytes.into()))
}

fn decode(decoders: &DecoderPool, video: &Video, frames: &[usize]) -> swm_core::Result<Vec<u8>> {
    let mut out = vec![7; frames.len() * FRAME];
    let wanted = frames.iter().zip(out.chunks_exact_mut(FRAME));
    decoders.read(wanted.map(|(&frame, out)| FrameRequest { video, frame, out }).collect())?;
    Ok(out)
}

/// Checks the frames of a video, one at a time and in reverse order, against those of FFmpeg.
fn check(decoders: &DecoderPool, name: &str) {
    let video = opened(bytes(name)).expect("opening");
    let expected = swm_image::read_png(&path(name, "png")).expect("reading the PNG file").rgb;
    assert_eq!((video.frames() * FRAME, video.size()), (expected.len(), (48, 64)), "{name}");
    let one_by_one: Vec<usize> = (0..video.frames()).rev().collect();
    for frames in one_by_one.chunks(1).chain([&one_by_one[..]]) {
        let found = decode(decoders, &video, frames).unwrap_or_else(|error| panic!("{name}, {frames:?}: {error}"));
        for (&frame, found) in frames.iter().zip(found.chunks_exact(FRAME)) {
            let expected = &expected[frame * FRAME..][..FRAME];
            let off: usize = found.iter().zip(expected).map(|(a, b)| usize::from(a.abs_diff(*b))).sum();
            assert!(off < 3 * FRAME, "{name}, frame {frame}: off by {} on average", off / FRAME);
        }
    }
}

#[test]
fn colours_ranges_and_open_groups_are_read() {
    ["rgb", "grey", "open", "box", "ffv1"].into_iter().for_each(|name| check(&DecoderPool::default(), name));
}

/// The parameters that a stream brings among its frames do not count for the next file, nor for its own first frames.
#[test]
fn parameters_of_one_stream_do_not_count_for_another() {
    let decoders = DecoderPool::default();
    ["joined", "first", "joined", "first"].into_iter().for_each(|name| check(&decoders, name));
}

/// Writes the sizes of the samples as integers of 16 bits, in place of 32.
fn with_compact_sizes(mut bytes: Vec<u8>) -> Vec<u8> {
    let at = bytes.windows(4).position(|kind| kind == b"stsz").expect("the table of sizes");
    bytes[at..at + 4].copy_from_slice(b"stz2");
    assert_eq!(bytes[at + 8..at + 12], [0; 4], "each sample has a size");
    bytes[at + 11] = 16;
    let count = bytes[at + 15] as usize;
    for i in 0..count {
        let from = at + 16 + 4 * i;
        assert_eq!(bytes[from..from + 2], [0; 2], "a size of 16 bits");
        bytes.copy_within(from + 2..from + 4, at + 16 + 2 * i);
    }
    bytes
}

#[test]
fn compact_tables_of_sizes_are_read() {
    let (plain, compact) = (bytes("open"), with_compact_sizes(bytes("open")));
    assert_ne!(plain, compact);
    let frames: Vec<usize> = (0..opened(plain.clone()).expect("opening").frames()).collect();
    let [plain, compact_frames] = [plain, compact.clone()].map(|file| {
        let video = opened(file).expect("opening");
        decode(&DecoderPool::default(), &video, &frames).expect("the frames")
    });
    assert!(plain == compact_frames);
    let at = compact.windows(4).position(|kind| kind == b"stz2").expect("the table");
    for (place, value, words) in [(11, 12, "sizes of 12 bits"), (13, 255, "cut short")] {
        let mut damaged = compact.clone();
        damaged[at + place] = value;
        let error = opened(damaged).err().map(|error| error.to_string()).unwrap_or_default();
        assert!(error.contains(words), "{error}");
    }
}

/// Replaces the only place where `from` stands.
fn changed(mut bytes: Vec<u8>, from: &[u8], to: &[u8]) -> Vec<u8> {
    let places: Vec<usize> = (0..=bytes.len() - from.len()).filter(|&i| bytes[i..].starts_with(from)).collect();
    assert_eq!(places.len(), 1, "{from:?}");
    bytes[places[0]..][..to.len()].copy_from_slice(to);
    bytes
}

/// The bytes of a box from its type on, of which `length` are given after it.
fn after<'a>(bytes: &'a [u8], kind: &[u8; 4], length: usize) -> &'a [u8] {
    let at = bytes.windows(4).position(|window| window == kind).expect("a box");
    &bytes[at..][..4 + length]
}

#[test]
fn tables_that_contradict_the_stream_are_refused() {
    let whole = bytes("open");
    // Without the offsets from decoding to presentation, times are in decoding order.
    let video = opened(changed(whole.clone(), b"ctts", b"free")).expect("opening");
    let all: Vec<usize> = (0..video.frames()).collect();
    let error = decode(&DecoderPool::default(), &video, &all).expect_err("frames at wrong times").to_string();
    assert!(error.contains("shows another frame"), "{error}");
    // A second description of the codec, and samples of it.
    let descriptions = after(&whole, b"stsd", 8);
    let two = [&descriptions[..11], &[2]].concat();
    let error = opened(changed(whole.clone(), descriptions, &two)).expect_err("two descriptions").to_string();
    assert!(error.contains("2 descriptions"), "{error}");
    let runs = after(&whole, b"stsc", 20);
    let error = opened(changed(whole.clone(), runs, &[&runs[..23], &[2]].concat())).expect_err("another description");
    assert!(error.to_string().contains("description 2"), "{error}");
    // More frames, and a larger frame, than any file has.
    let sizes = after(&whole, b"stsz", 16);
    let many = [&sizes[..8], &1_u32.to_be_bytes(), &200_000_000_u32.to_be_bytes()].concat();
    let error = opened(changed(whole.clone(), sizes, &many)).expect_err("many frames").to_string();
    assert!(error.contains("200000000 frames"), "{error}");
    let large = [&sizes[..16], &u32::MAX.to_be_bytes()].concat();
    let error = opened(changed(whole.clone(), sizes, &large)).expect_err("a large frame").to_string();
    assert!(error.contains("4294967295 bytes"), "{error}");
    let unchanged: Arc<[u8]> = whole.into();
    assert!(Video::open(Source::Memory("a blob".into(), unchanged)).is_ok());
}
