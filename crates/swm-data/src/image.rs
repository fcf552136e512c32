//! Pictures as they are stored: encoding RGB frames, and decoding what others encoded.
//!
//! The stored bytes say themselves what they are, so decoding looks at their first bytes and a dataset may mix
//! codecs.

use crate::{jpeg, qoi};
use serde::{Deserialize, Serialize};
use swm_core::{Error, Result};
use zune_core::bytestream::ZCursor;
use zune_core::colorspace::ColorSpace;
use zune_core::options::DecoderOptions;

/// How pictures are encoded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum ImageCodec {
    /// JPEG with colour at half resolution (4:2:0), what the reference's datasets hold (it uses quality 95).
    Jpeg {
        /// 1 (small) to 100 (faithful).
        quality: u8,
    },
    /// PNG tuned for speed: lossless. What Python decodes fastest of the lossless ones.
    Png,
    /// QOI: lossless. The default, so that a model is trained on the very pictures it will see when it acts, and as
    /// fast as memory on drawn ones. Pillow, and with it the reference, opens it as well (in 5 to 60 ms a picture).
    ///
    /// Pictures of 224 × 224 × 3 on one core, bytes and MB/s of pixels encoded and decoded:
    ///
    /// | pictures | QOI | PNG |
    /// | --- | --- | --- |
    /// | Push-T | 5,300: 8,300, 6,000 | 12,700: 4,900, 2,600 |
    /// | Two-Room | 10,600: 3,900, 3,300 | 11,700: 4,100, 2,200 |
    /// | OGBench Cube (3-D, textured) | 20,900: 1,900, 2,000 | 23,900: 2,500, 1,800 |
    /// | DMC Humanoid, Quadruped | 36,800: 1,200, 1,500 | 53,200: 1,400, 900 |
    #[default]
    Qoi,
}

impl ImageCodec {
    /// Encodes one RGB picture, `[height, width, 3]`, appending to `out`. Equal pictures give equal bytes.
    ///
    /// # Errors
    /// When a side is 0 or above 65535, or `rgb` is not of that size.
    pub fn encode(self, rgb: &[u8], height: usize, width: usize, out: &mut Vec<u8>) -> Result<()> {
        let (Ok(h), Ok(w)) = (u16::try_from(height), u16::try_from(width)) else {
            return Err(Error::mismatch("encoding a picture", format!("{height} x {width}"), "sides below 65536"));
        };
        if rgb.len() != height * width * 3 || rgb.is_empty() {
            return Err(Error::mismatch(
                "encoding a picture",
                format!("{} bytes", rgb.len()),
                format!("{height} x {width} x 3"),
            ));
        }
        match self {
            Self::Jpeg { quality } => {
                jpeg::encode(rgb, h, w, quality, out);
                Ok(())
            }
            Self::Png => {
                let fail = |e: png::EncodingError| Error::external("encoding a PNG picture", e);
                let mut encoder = png::Encoder::new(out, w.into(), h.into());
                encoder.set_color(png::ColorType::Rgb);
                // The compression level brings a filter of its own, so ours is set after it: rows as differences
                // to the one above are the fastest to undo.
                encoder.set_compression(png::Compression::Fast);
                encoder.set_filter(png::Filter::Up);
                let mut writer = encoder.write_header().map_err(fail)?;
                writer.write_image_data(rgb).map_err(fail)
            }
            Self::Qoi => {
                qoi::encode(rgb, h, w, out);
                Ok(())
            }
        }
    }

    /// Checks the settings.
    ///
    /// # Errors
    /// When the quality is not 1 ..= 100.
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

/// What stored bytes turn out to be.
enum Stored {
    Jpeg,
    Png,
    Qoi,
}

fn recognise(bytes: &[u8]) -> Result<Stored> {
    match bytes {
        [0xff, 0xd8, ..] => Ok(Stored::Jpeg),
        [0x89, b'P', b'N', b'G', ..] => Ok(Stored::Png),
        [b'q', b'o', b'i', b'f', ..] => Ok(Stored::Qoi),
        _ => Err(Error::mismatch(
            "decoding a picture",
            format!("{} bytes that begin with {:02x?}", bytes.len(), &bytes[..bytes.len().min(4)]),
            "a JPEG, PNG or QOI file",
        )),
    }
}

/// The height and width of an encoded picture, from its header.
///
/// # Errors
/// When the bytes are neither JPEG, PNG nor QOI, or the header is damaged.
pub fn size(bytes: &[u8]) -> Result<(usize, usize)> {
    match recognise(bytes)? {
        Stored::Jpeg => {
            let mut decoder = jpeg_reader(bytes);
            decoder.decode_headers().map_err(|e| Error::external("reading a JPEG header", e))?;
            let info = decoder.info().ok_or_else(|| Error::external("reading a JPEG header", "it has no size"))?;
            Ok((info.height.into(), info.width.into()))
        }
        Stored::Png => {
            let reader = png_reader(bytes)?;
            Ok((reader.info().height as usize, reader.info().width as usize))
        }
        Stored::Qoi => qoi::size(bytes),
    }
}

/// Decodes a picture into `out`, `[height, width, 3]` RGB bytes.
///
/// # Errors
/// When the bytes are neither JPEG, PNG nor QOI, are damaged, or show a picture of another size.
pub fn decode(bytes: &[u8], height: usize, width: usize, out: &mut [u8]) -> Result<()> {
    let length = out.len();
    let check = |given: (usize, usize)| {
        if given == (height, width) && length == height * width * 3 {
            return Ok(());
        }
        Err(Error::mismatch(
            "decoding a picture",
            format!("{} x {}", given.0, given.1),
            format!("{height} x {width} like the first one"),
        ))
    };
    match recognise(bytes)? {
        Stored::Jpeg => {
            if jpeg::decode(bytes, height, width, out) {
                return Ok(());
            }
            // Of another kind or size, or damaged: the general decoder knows.
            let fail = |e| Error::external("decoding a JPEG picture", e);
            let mut decoder = jpeg_reader(bytes);
            decoder.decode_headers().map_err(fail)?;
            let info = decoder.info().ok_or_else(|| Error::external("decoding a JPEG picture", "it has no size"))?;
            check((info.height.into(), info.width.into()))?;
            decoder.decode_into(out).map_err(fail)
        }
        Stored::Png => {
            let fail = |e| Error::external("decoding a PNG picture", e);
            let mut reader = png_reader(bytes)?;
            check((reader.info().height as usize, reader.info().width as usize))?;
            let channels = reader.output_color_type().0.samples();
            if channels == 3 {
                return reader.next_frame(out).map(|_| ()).map_err(fail);
            }
            // Grey and transparent pictures of foreign datasets: repeat the grey, drop the transparency.
            let mut raw = vec![0; height * width * channels];
            reader.next_frame(&mut raw).map_err(fail)?;
            for (rgb, pixel) in out.chunks_exact_mut(3).zip(raw.chunks_exact(channels)) {
                match *pixel {
                    [r, g, b, _] => rgb.copy_from_slice(&[r, g, b]),
                    _ => rgb.fill(pixel[0]),
                }
            }
            Ok(())
        }
        Stored::Qoi => {
            check(qoi::size(bytes)?)?;
            qoi::decode(bytes, out)
        }
    }
}

fn jpeg_reader(bytes: &[u8]) -> zune_jpeg::JpegDecoder<ZCursor<&[u8]>> {
    // Strict: a truncated picture is an error, not a grey area.
    let options = DecoderOptions::default().jpeg_set_out_colorspace(ColorSpace::RGB).set_strict_mode(true);
    zune_jpeg::JpegDecoder::new_with_options(ZCursor::new(bytes), options)
}

fn png_reader(bytes: &[u8]) -> Result<png::Reader<std::io::Cursor<&[u8]>>> {
    let mut decoder = png::Decoder::new(std::io::Cursor::new(bytes));
    decoder.set_transformations(png::Transformations::normalize_to_color8());
    decoder.read_info().map_err(|e| Error::external("reading a PNG header", e))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A smooth picture with a square in it.
    fn picture(height: usize, width: usize) -> Vec<u8> {
        let mut rgb = vec![];
        for y in 0..height {
            for x in 0..width {
                let inside = (height / 4..height / 2).contains(&y) && (width / 4..width / 2).contains(&x);
                rgb.extend(if inside { [200, 30, 60] } else { [(y * 2) as u8, (x * 2) as u8, 90] });
            }
        }
        rgb
    }

    fn round(codec: ImageCodec, height: usize, width: usize) -> (Vec<u8>, Vec<u8>) {
        let rgb = picture(height, width);
        let mut bytes = vec![];
        codec.encode(&rgb, height, width, &mut bytes).expect("encodes");
        assert_eq!(size(&bytes).expect("has a size"), (height, width));
        let mut back = vec![0; rgb.len()];
        decode(&bytes, height, width, &mut back).expect("decodes");
        (rgb, back)
    }

    #[test]
    fn png_and_qoi_are_lossless_and_jpeg_is_close() {
        for (height, width) in [(1, 1), (17, 9), (64, 64), (30, 101)] {
            for codec in [ImageCodec::Png, ImageCodec::Qoi] {
                let (rgb, back) = round(codec, height, width);
                assert_eq!(rgb, back);
            }
            let (rgb, back) = round(ImageCodec::Jpeg { quality: 95 }, height, width);
            let error: f64 = rgb.iter().zip(&back).map(|(&a, &b)| f64::from(a.abs_diff(b))).sum();
            assert!(error / rgb.len() as f64 <= 6.0, "{height} x {width}: {}", error / rgb.len() as f64);
        }
    }

    #[test]
    fn damaged_pictures_are_errors() {
        let rgb = picture(40, 40);
        let mut out = vec![0; rgb.len()];
        for codec in [ImageCodec::Jpeg { quality: 95 }, ImageCodec::Png, ImageCodec::Qoi] {
            let mut bytes = vec![];
            codec.encode(&rgb, 40, 40, &mut bytes).expect("encodes");
            for cut in (0..bytes.len() * 9 / 10).step_by(7) {
                assert!(decode(&bytes[..cut], 40, 40, &mut out).is_err(), "{codec:?} cut at {cut}");
            }
            let other = decode(&bytes, 20, 80, &mut out).expect_err("another size").to_string();
            assert!(other.contains("40 x 40") && other.contains("20 x 80"), "{other}");
        }
        assert!(decode(b"GIF89a", 40, 40, &mut out).expect_err("no picture").to_string().contains("JPEG, PNG or QOI"));
    }
}
