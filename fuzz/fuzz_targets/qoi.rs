//! QOI images.

#![no_main]

use swm_image::ImageCodec;

libfuzzer_sys::fuzz_target!(
    init: {
        for side in [1_usize, 9, 48] {
            // A gradient, noise and an area of one colour use every operation of the format.
            let pixel = |i: usize| ((i * i) >> (i / 800 % 9)) as u8 * u8::from(i % 4096 < 3000);
            let rgb: Vec<u8> = (0..side * side * 3).map(pixel).collect();
            let mut bytes = vec![];
            ImageCodec::Qoi.encode(&rgb, side, side, &mut bytes).expect("an encoded image");
            swm_fuzz::seed(&side.to_string(), &bytes);
        }
    },
    |bytes: &[u8]| {
        if bytes.starts_with(b"qoif") {
            swm_fuzz::decode_image(bytes);
        }
    }
);
