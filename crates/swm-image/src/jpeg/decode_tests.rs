//! Tests of the fast decoder, with and without AVX2, on files that Pillow wrote and decoded and on random images.

use super::decode::decode;
use super::encode;
use std::path::Path;
use std::sync::{Mutex, PoisonError};
use swm_simd::{CpuLevel, limit_cpu_level};

/// A name, the bytes of the file, height and width, and the pixels that Pillow decodes.
type PillowImage = (String, Vec<u8>, [usize; 2], Vec<u8>);

/// Returns the images that Pillow wrote, and the pixels that Pillow decodes from them (`tests/interop/jpeg_export.py`).
fn pillow_images() -> Vec<PillowImage> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/interop/jpeg");
    let mut paths: Vec<_> = std::fs::read_dir(folder)
        .expect("listing the folder of images")
        .map(|e| e.expect("reading the folder entry").path())
        .collect();
    paths.retain(|path| path.extension().is_some_and(|extension| extension == "jpg"));
    paths.sort();
    let read = |path: &Path| {
        let decoded = crate::read_png(&path.with_extension("png")).expect("reading the PNG file");
        let name = path.file_stem().expect("a name").to_string_lossy().into_owned();
        (name, std::fs::read(path).expect("reading the image file"), [decoded.height, decoded.width], decoded.rgb)
    };
    paths.iter().map(|path| read(path)).collect()
}

/// Calls [`decode`] without AVX2.
fn decode_at_baseline(bytes: &[u8], height: usize, width: usize, out: &mut [u8]) -> bool {
    static LIMITED: Mutex<()> = Mutex::new(());
    let _limited = LIMITED.lock().unwrap_or_else(PoisonError::into_inner);
    limit_cpu_level(CpuLevel::Baseline);
    let decoded = decode(bytes, height, width, out);
    limit_cpu_level(CpuLevel::Avx512);
    decoded
}

#[test]
fn decodes_bit_for_bit_as_pillow() {
    let images = pillow_images();
    assert_eq!(images.len(), 11);
    for (name, bytes, [height, width], expected) in images {
        let mut out = vec![0; expected.len()];
        let supported = decode(&bytes, height, width, &mut out);
        assert_eq!(supported, !name.starts_with("other"), "{name}");
        if supported {
            assert!(out == expected, "{name}");
            out.fill(0);
            assert!(decode_at_baseline(&bytes, height, width, &mut out), "{name}");
            assert!(out == expected, "{name} without AVX2");
        }
        // The general decoder also reads the kinds that the fast decoder does not support, and rounds differently.
        crate::decode(&bytes, height, width, &mut out).expect("decoding the image");
        let off: u32 = out.iter().zip(&expected).map(|(a, b)| u32::from(a.abs_diff(*b))).sum();
        assert!(f64::from(off) / (expected.len() as f64) < 3.0, "{name}: {off}");
        assert!(!decode(&bytes, width, height, &mut out), "{name} has another size");
    }
}

#[test]
fn random_rectangles_decode_equally_with_and_without_avx2() {
    let mut seed = 1_u32;
    let mut next = move |n: u32| {
        seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (seed >> 16) % n
    };
    for round in 0..60 {
        let (height, width) = (1 + next(70) as usize, 5 + next(70) as usize);
        let mut rgb = [200, 180, 160].repeat(height * width);
        for _ in 0..next(6) {
            let (y, x) = (next(height as u32) as usize, next(width as u32) as usize);
            let colour = [next(256), next(256), next(256)].map(|value| value as u8);
            for line in rgb.chunks_exact_mut(width * 3).skip(y).take(1 + next(30) as usize) {
                line.as_chunks_mut::<3>().0.iter_mut().skip(x).take(17).for_each(|pixel| *pixel = colour);
            }
        }
        let mut bytes = vec![];
        encode(&rgb, height as u16, width as u16, 90, &mut bytes);
        let (mut fast, mut baseline) = (vec![0; rgb.len()], vec![0; rgb.len()]);
        assert!(decode(&bytes, height, width, &mut fast), "round {round}");
        assert!(decode_at_baseline(&bytes, height, width, &mut baseline), "round {round}");
        assert!(fast == baseline, "round {round}: {height} x {width}");
    }
}

#[test]
fn damaged_files_fail_or_decode_without_panic() {
    let images = pillow_images();
    let mut out = vec![0; 112 * 112 * 3];
    for (name, bytes, [height, width], _) in &images {
        let out = &mut out[..height * width * 3];
        for cut in (0..bytes.len()).step_by(3) {
            assert!(!decode(&bytes[..cut], *height, *width, out), "{name} cut at {cut}");
        }
        let mut damaged = bytes.clone();
        for at in (2..bytes.len()).step_by(5) {
            for change in [0xff, 0x01, 0x80] {
                damaged[at] ^= change;
                decode(&damaged, *height, *width, out);
                damaged[at] = bytes[at];
            }
        }
        assert_eq!(decode(bytes, *height, *width, out), !name.starts_with("other"), "{name} after damaged files");
    }
}
