//! Eight wrappers compared with the Python reference on one image, `tests/golden/wrappers.npz`. The random draws of the
//! reference are part of the file.

use super::chroma_key::ChromaKey;
use super::color_jitter::ColorJitter;
use super::media::Media;
use super::moving_patch::Moving;
use super::patch::{Patch, Rect};
use super::random_conv::RandomConv;
use super::{EpisodeFrame, VisualWrapper, WRAPPERS};
use npyz::npz::NpzArchive;
use serde_json::{Map, Value};
use std::fs::File;
use std::io::BufReader;
use swm_core::FrameMut;
use swm_image::RgbImage;

struct Golden(NpzArchive<BufReader<File>>);

impl Golden {
    fn image(&mut self, name: &str) -> RgbImage {
        let array = self.0.by_name(name).expect("reading the archive").expect("an array of this name");
        let [height, width] = [0, 1].map(|axis| usize::try_from(array.shape()[axis]).expect("a valid size"));
        RgbImage { width, height, rgb: array.into_vec().expect("reading the bytes") }
    }

    fn cases(&mut self) -> Vec<Map<String, Value>> {
        let text: Vec<String> = self
            .0
            .by_name("cases")
            .expect("reading the archive")
            .expect("the array `cases`")
            .into_vec()
            .expect("reading strings");
        serde_json::from_str(&text.concat()).expect("parsing the cases")
    }
}

fn floats(value: &Value) -> Vec<f64> {
    match value {
        Value::Array(values) => values.iter().flat_map(floats).collect(),
        number => vec![number.as_f64().expect("reading a number")],
    }
}

/// The tolerated mean and maximal difference of a wrapper from the reference, of 255.
fn tolerance(id: &str) -> (f64, u8) {
    match id {
        // Means whose fraction is one half are rounded differently.
        "resolution" | "chroma-key" => (0.03, 1),
        // The order of multiplication decides if a product is an integer or just below it.
        "color-jitter" => (0.001, 1),
        _ => (0.0, 0),
    }
}

#[test]
#[allow(clippy::too_many_lines, reason = "one match over the wrappers of the golden file")]
fn wrapped_frames_equal_those_of_the_reference() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden/wrappers.npz");
    let mut golden = Golden(NpzArchive::open(path).expect("opening the golden file"));
    let original = golden.image("frame");
    let (mut compared, mut wrong) = (std::collections::BTreeSet::new(), vec![]);
    for (i, mut case) in golden.cases().into_iter().enumerate() {
        let expected = golden.image(&format!("out_{i}"));
        let case_name = format!("case {i}, {case:?}");
        let id = case.remove("wrapper").expect("the entry `wrapper`").as_str().expect("the id of a wrapper").to_owned();
        let drawn = case.remove("drawn").filter(|drawn| !drawn.is_null()).map(|drawn| floats(&drawn));
        let step = case.remove("step").and_then(|step| step.as_u64()).expect("the entry `step`");
        let RgbImage { width, height, mut rgb } = RgbImage { rgb: original.rgb.clone(), ..original };
        let mut frame = FrameMut::new(width, height, &mut rgb);
        match (id.as_str(), drawn) {
            ("chroma-key", _) => {
                let media =
                    golden.image(&format!("background_{}", case["media"].as_str().expect("the name of a background")));
                let key: Vec<u8> = serde_json::from_value(case["key_color"].clone()).expect("reading a colour");
                let tolerance = case["tolerance"].as_f64().expect("reading a number");
                ChromaKey::new(&key, Media::new(vec![media]), tolerance).apply(&mut frame, EpisodeFrame::Step(step));
            }
            ("color-jitter", Some(drawn)) => {
                let fixed: Vec<[f64; 2]> = drawn.iter().map(|&value| [value; 2]).collect();
                let ranges = fixed.try_into().expect("four factors");
                ColorJitter::new(ranges).apply(&mut frame, EpisodeFrame::Step(step));
            }
            ("random-conv", Some(weights)) => {
                let side =
                    usize::try_from(case["kernel_size"].as_u64().expect("reading a size")).expect("a valid size");
                let mut conv = RandomConv::new(side);
                conv.set(weights.iter().map(|&weight| weight as f32));
                conv.apply(&mut frame, EpisodeFrame::Step(step));
            }
            ("occlusion", Some(patches)) => {
                let color: [u8; 3] = serde_json::from_value(case["color"].clone()).expect("reading a colour");
                for patch in patches.as_chunks::<4>().0 {
                    let [y, x, height, width] = patch.map(|v| v as usize);
                    Rect { x, y, width, height }.fill(color, &mut frame);
                }
            }
            ("moving-patch", Some(patches)) => {
                for &[y, x, h, w, down, right] in patches.as_chunks::<6>().0 {
                    let shares = [h / height as f64, w / width as f64];
                    let position = [y / (height as f64 - h), x / (width as f64 - w)];
                    let moving = Moving { patch: Patch { size: shares, position }, velocity: [down, right] };
                    moving.rect(&frame, step).fill([255; 3], &mut frame);
                }
            }
            (id, _) => {
                let mut wrapper =
                    WRAPPERS.get(id).expect("finding the wrapper").make(&case).expect("making the wrapper");
                wrapper.apply(&mut frame, EpisodeFrame::Step(step));
            }
        }
        let differences: Vec<u8> = rgb.iter().zip(&expected.rgb).map(|(a, b)| a.abs_diff(*b)).collect();
        let (mean, most) = (
            differences.iter().map(|&d| f64::from(d)).sum::<f64>() / differences.len() as f64,
            differences.iter().max(),
        );
        let (mean_allowed, most_allowed) = tolerance(&id);
        if mean > mean_allowed || most > Some(&most_allowed) {
            wrong.push(format!("{case_name}: mean {mean:.4}, most {most:?} of 255"));
        }
        compared.insert(id);
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
    assert_eq!(compared.len(), 8, "all but noise, cutout and random-shift are compared: {compared:?}");
}
