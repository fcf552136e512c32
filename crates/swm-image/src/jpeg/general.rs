//! JPEG files of every kind, by `zune-jpeg`: progressive, grey, other subsampling, restart intervals.

use swm_core::guarded::guarded;
use swm_core::{Error, Result};
use zune_core::bytestream::ZCursor;
use zune_core::colorspace::ColorSpace;
use zune_core::options::DecoderOptions;
use zune_jpeg::JpegDecoder;

/// A JPEG file of any kind whose headers were read.
pub struct Decoder<'a> {
    inner: JpegDecoder<ZCursor<&'a [u8]>>,
    height: usize,
    width: usize,
}

impl<'a> Decoder<'a> {
    /// Reads the headers of a JPEG file in memory.
    ///
    /// # Errors
    /// When the headers are damaged.
    pub fn new(bytes: &'a [u8]) -> Result<Self> {
        // In strict mode, a truncated file is an error. Otherwise, the missing pixels would be grey.
        let options = DecoderOptions::default().jpeg_set_out_colorspace(ColorSpace::RGB).set_strict_mode(true);
        let mut inner = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
        checked("reading a JPEG header", || inner.decode_headers())?;
        let info = inner.info().ok_or_else(|| Error::external("reading a JPEG header", "it has no size"))?;
        Ok(Self { inner, height: info.height.into(), width: info.width.into() })
    }

    /// The height and width.
    pub const fn size(&self) -> (usize, usize) {
        (self.height, self.width)
    }

    /// Decodes into `out`, `[height, width, 3]` RGB bytes.
    ///
    /// # Errors
    /// When the file is damaged, or `out` has another length.
    pub fn decode(mut self, out: &mut [u8]) -> Result<()> {
        checked("decoding a JPEG image", || self.inner.decode_into(out))
    }
}

/// Calls the library, which panics at some damaged files.
fn checked<E: std::fmt::Display>(context: &str, call: impl FnOnce() -> Result<(), E>) -> Result<()> {
    match guarded(call) {
        Ok(decoded) => decoded.map_err(|error| Error::external(context, error)),
        Err(panic) => Err(Error::external(context, panic)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn panic_of_the_library_is_an_error() {
        let bytes = include_bytes!("../../tests/damaged/wide-chroma.jpg");
        let decoder = Decoder::new(bytes).expect("the headers are whole");
        let (height, width) = decoder.size();
        let error = decoder.decode(&mut vec![0; height * width * 3]).expect_err("a damaged file").to_string();
        assert!(error.contains("decoding a JPEG image") && error.contains("the library panicked"), "{error}");
    }
}
