//! [`ImageCodec`]: the codecs of stored frames. The decoder recognises the format by the first bytes, so a dataset may
//! mix codecs.

use crate::{jpeg, png_file, qoi};
use serde::{Deserialize, Serialize};
use swm_core::{Error, Result};

/// The format that frames are stored in.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum ImageCodec {
    /// JPEG with chrominance at half resolution (4:2:0), as datasets of the reference implementation store frames (with
    /// quality 95).
    Jpeg {
        /// The quality, from 1 (smallest files) to 100 (best quality).
        quality: u8,
    },
    /// PNG tuned for speed: lossless, and the lossless format that Python decodes fastest.
    Png,
    /// QOI: lossless, and nearly as fast as copying memory for frames with large areas of one colour. The default, so
    /// that a model trains on exactly the pixels that it observes when it acts. Pillow, and therefore the reference,
    /// reads QOI as well (5 to 60 ms per image).
    ///
    /// Each cell holds the bytes per image of 224 × 224 × 3, then the megabytes of pixels per second that one core
    /// encodes and decodes:
    ///
    /// | environment | QOI | PNG |
    /// | --- | --- | --- |
    /// | Push-T | 5,300: 8,300, 6,000 | 12,700: 4,900, 2,600 |
    /// | Two-Room | 10,600: 3,900, 3,300 | 11,700: 4,100, 2,200 |
    /// | OGBench Cube (3-D, textured) | 20,900: 1,900, 2,000 | 23,900: 2,500, 1,800 |
    /// | DMC Humanoid, Quadruped | 36,800: 1,200, 1,500 | 53,200: 1,400, 900 |
    #[default]
    Qoi,
}

impl ImageCodec {
    /// Encodes one RGB image, `[height, width, 3]`, and appends it to `out`. Equal images give equal bytes.
    ///
    /// # Errors
    /// When a side is 0 or above 65535, there are more than [`MAX_PIXELS`], or `rgb` has another length.
    pub fn encode(self, rgb: &[u8], height: usize, width: usize, out: &mut Vec<u8>) -> Result<()> {
        let (Ok(h), Ok(w)) = (u16::try_from(height), u16::try_from(width)) else {
            return Err(Error::mismatch(
                "encoding an image",
                format!("{height} x {width} pixels"),
                "sides below 65536",
            ));
        };
        check_pixels(height, width)?;
        if rgb.len() != height * width * 3 || rgb.is_empty() {
            return Err(Error::mismatch(
                "encoding an image",
                format!("{} bytes", rgb.len()),
                format!("{height} x {width} x 3 bytes"),
            ));
        }
        match self {
            Self::Jpeg { quality } => jpeg::encode(rgb, h, w, quality, out),
            Self::Png => png_file::encode(rgb, h, w, out)?,
            Self::Qoi => qoi::encode(rgb, h, w, out),
        }
        Ok(())
    }

    /// Checks the settings.
    ///
    /// # Errors
    /// When the JPEG quality is not 1 ..= 100.
    pub fn check(self) -> Result<()> {
        match self {
            Self::Jpeg { quality } if !(1..=100).contains(&quality) => Err(Error::OutOfSpace {
                what: "JPEG quality".to_owned(),
                given: quality.to_string(),
                expected: "1 ..= 100".to_owned(),
            }),
            _ => Ok(()),
        }
    }
}

/// The format of an encoded image.
enum FileFormat {
    Jpeg,
    Png,
    Qoi,
}

impl FileFormat {
    fn of(bytes: &[u8]) -> Result<Self> {
        match bytes {
            [0xff, 0xd8, ..] => Ok(Self::Jpeg),
            [0x89, b'P', b'N', b'G', ..] => Ok(Self::Png),
            [b'q', b'o', b'i', b'f', ..] => Ok(Self::Qoi),
            _ => Err(Error::mismatch(
                "decoding an image",
                format!("{} bytes that begin with {:02x?}", bytes.len(), &bytes[..bytes.len().min(4)]),
                "a JPEG, PNG or QOI file",
            )),
        }
    }
}

/// The pixel budget: the most pixels of an image in a file, whatever its format. Headers can state any size.
pub const MAX_PIXELS: usize = 1 << 26;

/// Checks a size from a header against [`MAX_PIXELS`].
pub(crate) fn check_pixels(height: usize, width: usize) -> Result<()> {
    match height.checked_mul(width) {
        Some(pixels) if pixels <= MAX_PIXELS => Ok(()),
        _ => Err(Error::mismatch(
            "reading the header of an image",
            format!("{height} x {width} pixels"),
            format!("at most {MAX_PIXELS} pixels"),
        )),
    }
}

/// Returns the height and width of an encoded image, from its header.
///
/// # Errors
/// When the bytes are neither JPEG, PNG nor QOI, the header is damaged, or it states more than [`MAX_PIXELS`].
pub fn image_size(bytes: &[u8]) -> Result<(usize, usize)> {
    let (height, width) = match FileFormat::of(bytes)? {
        FileFormat::Jpeg => jpeg::Decoder::new(bytes)?.size(),
        FileFormat::Png => png_file::Decoder::new(bytes)?.size(),
        FileFormat::Qoi => qoi::size(bytes)?,
    };
    check_pixels(height, width)?;
    Ok((height, width))
}

/// Returns whether bytes begin as a JPEG, PNG or QOI file does.
pub fn is_image(bytes: &[u8]) -> bool {
    FileFormat::of(bytes).is_ok()
}

/// Decodes an image into `out`, `[height, width, 3]` RGB bytes.
///
/// # Errors
/// When the bytes are neither JPEG, PNG nor QOI, are damaged, or hold an image of another size.
pub fn decode(bytes: &[u8], height: usize, width: usize, out: &mut [u8]) -> Result<()> {
    check_pixels(height, width)?;
    let length = out.len();
    let check = |given: (usize, usize)| {
        if given == (height, width) && length == height * width * 3 {
            return Ok(());
        }
        Err(Error::mismatch(
            "decoding an image",
            format!("an image of {} x {}", given.0, given.1),
            format!("{height} x {width}"),
        ))
    };
    match FileFormat::of(bytes)? {
        FileFormat::Jpeg => {
            if jpeg::decode(bytes, height, width, out) {
                return Ok(());
            }
            // The fast decoder returns false for unsupported kinds of JPEG, other sizes and damaged files. The general
            // decoder decodes unsupported kinds, and returns an error for other sizes and damaged files.
            let decoder = jpeg::Decoder::new(bytes)?;
            check(decoder.size())?;
            decoder.decode(out)
        }
        FileFormat::Png => {
            let decoder = png_file::Decoder::new(bytes)?;
            check(decoder.size())?;
            decoder.decode(out)
        }
        FileFormat::Qoi => {
            check(qoi::size(bytes)?)?;
            qoi::decode(bytes, out)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a gradient that contains a square of one colour.
    fn test_image(height: usize, width: usize) -> Vec<u8> {
        let mut rgb = vec![];
        for y in 0..height {
            for x in 0..width {
                let inside = (height / 4..height / 2).contains(&y) && (width / 4..width / 2).contains(&x);
                rgb.extend(if inside { [200, 30, 60] } else { [(y * 2) as u8, (x * 2) as u8, 90] });
            }
        }
        rgb
    }

    /// Returns the test image, and the pixels after encoding and decoding it.
    fn round_trip(codec: ImageCodec, height: usize, width: usize) -> (Vec<u8>, Vec<u8>) {
        let rgb = test_image(height, width);
        let mut bytes = vec![];
        codec.encode(&rgb, height, width, &mut bytes).expect("encoding the image");
        assert_eq!(image_size(&bytes).expect("an image size"), (height, width));
        let mut decoded = vec![0; rgb.len()];
        decode(&bytes, height, width, &mut decoded).expect("decoding the image");
        (rgb, decoded)
    }

    #[test]
    fn png_and_qoi_are_lossless_and_jpeg_is_close() {
        for (height, width) in [(1, 1), (17, 9), (64, 64), (30, 101)] {
            for codec in [ImageCodec::Png, ImageCodec::Qoi] {
                let (rgb, decoded) = round_trip(codec, height, width);
                assert_eq!(rgb, decoded);
            }
            let (rgb, decoded) = round_trip(ImageCodec::Jpeg { quality: 95 }, height, width);
            let error: f64 = rgb.iter().zip(&decoded).map(|(&a, &b)| f64::from(a.abs_diff(b))).sum();
            assert!(error / rgb.len() as f64 <= 6.0, "{height} x {width}: {}", error / rgb.len() as f64);
        }
    }

    #[test]
    fn headers_with_absurd_sizes_are_errors() {
        let mut png = vec![];
        png_file::encode(&test_image(4, 4), 4, 4, &mut png).expect("an encoded image");
        let crc = |bytes: &[u8]| {
            let step = |crc: u32, byte: &u8| {
                (0..8).fold(crc ^ u32::from(*byte), |crc, _| crc >> 1 ^ if crc & 1 == 1 { 0xedb8_8320 } else { 0 })
            };
            !bytes.iter().fold(!0, step)
        };
        for side in [65535_u32, u32::MAX / 2, u32::MAX] {
            png[16..20].copy_from_slice(&side.to_be_bytes());
            png[20..24].copy_from_slice(&side.to_be_bytes());
            let sum = crc(&png[12..29]);
            png[29..33].copy_from_slice(&sum.to_be_bytes());
            let qoi =
                [b"qoif".as_slice(), &side.to_be_bytes(), &side.to_be_bytes(), &[3, 0], &[0xc0, 0, 0, 0]].concat();
            for bytes in [&png, &qoi] {
                assert!(image_size(bytes).is_err() && is_image(bytes), "{side}");
                assert!(decode(bytes, side as usize, side as usize, &mut [0; 48]).is_err(), "{side}");
                assert!(decode(bytes, 4, 4, &mut [0; 48]).is_err(), "{side}");
            }
        }
    }

    #[test]
    fn truncated_images_and_wrong_sizes_are_errors() {
        let rgb = test_image(40, 40);
        let mut out = vec![0; rgb.len()];
        for codec in [ImageCodec::Jpeg { quality: 95 }, ImageCodec::Png, ImageCodec::Qoi] {
            let mut bytes = vec![];
            codec.encode(&rgb, 40, 40, &mut bytes).expect("encoding the image");
            for cut in (0..bytes.len() * 9 / 10).step_by(7) {
                assert!(decode(&bytes[..cut], 40, 40, &mut out).is_err(), "{codec:?} cut at {cut}");
            }
            let other = decode(&bytes, 20, 80, &mut out).expect_err("decoding with another size").to_string();
            assert!(other.contains("40 x 40") && other.contains("20 x 80"), "{other}");
        }
        assert!(decode(b"GIF89a", 40, 40, &mut out).expect_err("GIF bytes").to_string().contains("JPEG, PNG or QOI"));
    }
}
