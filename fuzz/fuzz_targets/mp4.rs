//! The tables of MP4 files. The parser is compiled alone, because the rest of its crate needs FFmpeg's libraries.

#![no_main]

#[path = "../../crates/swm-video/src/mp4/mod.rs"]
#[allow(dead_code, reason = "a part of a crate")]
mod mp4;

use mp4::Index;

libfuzzer_sys::fuzz_target!(
    init: swm_fuzz::seed_files("crates/swm-data/tests/interop", ".mp4"),
    |bytes: &[u8]| {
        let read = |offset: u64, out: &mut [u8]| {
            let from = usize::try_from(offset).ok().and_then(|at| bytes.get(at..)?.get(..out.len()));
            out.copy_from_slice(from.ok_or("ends too early")?);
            Ok(())
        };
        let _ = mp4::seal(&mut bytes.to_vec());
        let Ok(index) = Index::read(bytes.len() as u64, read) else { return };
        for &sample in index.frames.iter().take(100) {
            let key = index.key_before(sample as usize);
            assert!(key <= sample as usize);
            let encoded = &index.samples[sample as usize];
            let at = encoded.offset as usize;
            let _ = index.check(sample as usize, &bytes[at..at + encoded.size as usize]);
        }
        for time in [f64::NEG_INFINITY, 0.0, 1.0, f64::NAN] {
            if let Some(frame) = index.frame_at(time) {
                let _ = index.seconds(frame);
            }
        }
    }
);
