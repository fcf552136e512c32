//! JPEG files of every kind, by `zune-jpeg`: progressive, grey, other subsampling, restart intervals.

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
        inner.decode_headers().map_err(|error| Error::external("reading a JPEG header", error))?;
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
        self.inner.decode_into(out).map_err(|error| Error::external("decoding a JPEG image", error))
    }
}
