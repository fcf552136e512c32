//! PNG: encoding and decoding of stored frames in memory, and reading and writing of image files.

use crate::RgbImage;
use crate::codec::check_pixels;
use png::{Compression, EncodingError, Filter, Transformations};
use std::io::{BufReader, Cursor, Read as _};
use std::path::Path;
use swm_core::{Error, Result, files};

/// Appends an RGB image, `[height, width, 3]`, as a PNG file tuned for fast decoding.
///
/// # Errors
/// When the PNG encoder fails.
pub fn encode(rgb: &[u8], height: u16, width: u16, out: &mut Vec<u8>) -> Result<()> {
    let failed = |error: EncodingError| Error::external("encoding a PNG image", error);
    let mut encoder = png::Encoder::new(out, width.into(), height.into());
    encoder.set_color(png::ColorType::Rgb);
    // The compression level sets a filter, so the filter is set after it. Rows stored as differences to the row above
    // are the fastest to decode.
    encoder.set_compression(Compression::Fast);
    encoder.set_filter(Filter::Up);
    encoder.add_text_chunk(SOFTWARE[0].to_owned(), SOFTWARE[1].to_owned()).map_err(failed)?;
    let mut writer = encoder.write_header().map_err(failed)?;
    writer.write_image_data(rgb).map_err(failed)
}

/// A PNG file whose header was read.
pub struct Decoder<'a>(png::Reader<Cursor<&'a [u8]>>);

impl<'a> Decoder<'a> {
    /// Reads the header of a PNG file in memory.
    ///
    /// # Errors
    /// When the header is damaged.
    pub fn new(bytes: &'a [u8]) -> Result<Self> {
        let mut decoder = png::Decoder::new(Cursor::new(bytes));
        decoder.set_transformations(Transformations::normalize_to_color8());
        decoder.read_info().map(Self).map_err(|error| Error::external("reading a PNG header", error))
    }

    /// The height and width.
    pub fn size(&self) -> (usize, usize) {
        (self.0.info().height as usize, self.0.info().width as usize)
    }

    /// Decodes into `out`, `[height, width, 3]`. Grey is repeated in all three channels, opacity is dropped.
    ///
    /// # Errors
    /// When the file is damaged.
    pub fn decode(mut self, out: &mut [u8]) -> Result<()> {
        let failed = |error| Error::external("decoding a PNG image", error);
        let channels = self.0.output_color_type().0.samples();
        if channels == 3 {
            return self.0.next_frame(out).map(drop).map_err(failed);
        }
        let mut raw = vec![0; out.len() / 3 * channels];
        self.0.next_frame(&mut raw).map_err(failed)?;
        for (rgb, pixel) in out.as_chunks_mut::<3>().0.iter_mut().zip(raw.chunks_exact(channels)) {
            *rgb = rgb_of(pixel);
        }
        Ok(())
    }
}

/// The red, green and blue of a pixel with 1 (grey), 2 (grey, opacity), 3 or 4 (RGB, opacity) channels.
fn rgb_of(pixel: &[u8]) -> [u8; 3] {
    match *pixel {
        [r, g, b, ..] => [r, g, b],
        [grey, ..] => [grey; 3],
        [] => [0; 3],
    }
}

/// Reads a PNG file of any kind: grey is repeated in all three channels, 16 bits become 8, opacity is dropped.
///
/// # Errors
/// When the file cannot be opened, is damaged, or has more than [`crate::MAX_PIXELS`].
pub fn read_png(path: &Path) -> Result<RgbImage> {
    let damaged = |problem: String| Error::corrupt(path, problem, "give a readable PNG file");
    let file = files::open(path)?;
    let mut decoder = png::Decoder::new(BufReader::new(file));
    decoder.set_transformations(Transformations::EXPAND | Transformations::STRIP_16);
    let mut reader = decoder.read_info().map_err(|error| damaged(error.to_string()))?;
    let (width, height) = (reader.info().width as usize, reader.info().height as usize);
    check_pixels(height, width).map_err(|error| damaged(error.to_string()))?;
    let bytes = reader.output_buffer_size().ok_or_else(|| damaged("its pixels do not fit into memory".to_owned()))?;
    let mut raw = vec![0; bytes];
    reader.next_frame(&mut raw).map_err(|error| damaged(error.to_string()))?;
    let channels = reader.output_color_type().0.samples();
    let rgb = raw.chunks_exact(channels).flat_map(rgb_of).collect();
    Ok(RgbImage { width, height, rgb })
}

/// The text chunk of PNG files that this program writes: keyword and value.
const SOFTWARE: [&str; 2] = ["Software", "stable-worldmodel"];

/// Checks that a PNG file may be written: nothing exists at its path, or an image that [`write_png`] wrote.
///
/// # Errors
/// When another file exists there.
pub fn check_png(path: &Path) -> Result<()> {
    files::check_own(path, |path| {
        // Text chunks precede the pixels.
        let mut start = vec![];
        let read = files::open(path).is_ok_and(|file| file.take(1 << 10).read_to_end(&mut start).is_ok());
        let chunk = format!("tEXt{}\0{}", SOFTWARE[0], SOFTWARE[1]);
        read && start.windows(chunk.len()).any(|part| part == chunk.as_bytes())
    })
}

/// Writes an RGB image, `[height, width, 3]` bytes, as a PNG file. An image of this program is replaced.
///
/// # Errors
/// When `rgb` has another length, a side is 0, [`check_png`] fails, or the file cannot be written.
pub fn write_png(path: &Path, width: usize, height: usize, rgb: &[u8]) -> Result<()> {
    if width == 0 || height == 0 || rgb.len() != width * height * 3 {
        return Err(Error::mismatch(
            format!("writing {}", path.display()),
            format!("{} bytes", rgb.len()),
            format!("{}, for {width} x {height} RGB pixels", width * height * 3),
        ));
    }
    let side = |pixels: usize| {
        u32::try_from(pixels).map_err(|_| {
            let problem = format!("{pixels} pixels wide or high");
            Error::config(format!("image {}", path.display()), problem, "make it smaller")
        })
    };
    let (wide, high) = (side(width)?, side(height)?);
    check_png(path)?;
    let mut bytes = vec![];
    let mut encoder = png::Encoder::new(&mut bytes, wide, high);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let failed = |error: EncodingError| match error {
        EncodingError::IoError(source) => Error::io(path, "writing an image", source),
        other => Error::external(format!("encoding {}", path.display()), other),
    };
    encoder.add_text_chunk(SOFTWARE[0].to_owned(), SOFTWARE[1].to_owned()).map_err(failed)?;
    let mut writer = encoder.write_header().map_err(failed)?;
    writer.write_image_data(rgb).map_err(failed)?;
    writer.finish().map_err(failed)?;
    // As a whole: half of a file has no mark of this program, and would not be replaced.
    files::write(path, &bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn written_png_files_are_read_back() {
        let folder = tempfile::tempdir().expect("creating a temporary folder");
        let path = folder.path().join("a.png");
        let rgb: Vec<u8> = (0..5 * 4 * 3).collect();
        write_png(&path, 5, 4, &rgb).expect("writing the PNG file");
        assert_eq!(read_png(&path).expect("reading the PNG file"), RgbImage { width: 5, height: 4, rgb: rgb.clone() });
        assert!(write_png(&path, 4, 4, &rgb).is_err());
        let missing =
            write_png(&folder.path().join("missing/a.png"), 5, 4, &rgb).expect_err("a missing folder").to_string();
        assert!(missing.contains("writing the file"), "{missing}");
    }
}
