//! Conversion of rare pixel formats with FFmpeg's scaler.

use ffmpeg_next::format::Pixel;
use ffmpeg_next::frame;
use ffmpeg_next::software::scaling;

/// Converts frames of rare formats (10 bits, packed) to a format of 8 bits that `colour::to_rgb` supports.
#[derive(Default)]
pub struct Reducer {
    scaler_and_output: Option<(scaling::Context, frame::Video)>,
}

impl Reducer {
    /// Converts a frame to a frame of the same size and range of values: `GBRP`, `GRAY8` or `YUV444P`.
    pub fn reduce(&mut self, frame: &frame::Video) -> Result<&frame::Video, String> {
        let (from, width, height) = (frame.format(), frame.width(), frame.height());
        let same = |scaler_and_output: &(scaling::Context, frame::Video)| {
            let input = scaler_and_output.0.input();
            (input.format, input.width, input.height) == (from, width, height)
        };
        if !self.scaler_and_output.as_ref().is_some_and(same) {
            let flags = scaling::Flags::BILINEAR | scaling::Flags::ACCURATE_RND;
            let scaler = scaling::Context::get(from, width, height, reduced_format(from), width, height, flags);
            let scaler = scaler.map_err(|e| format!("has a pixel format that FFmpeg cannot convert: {e}"))?;
            self.scaler_and_output = Some((scaler, frame::Video::empty()));
        }
        let Some((scaler, reduced)) = &mut self.scaler_and_output else {
            return Err("has a pixel format that FFmpeg cannot convert".to_owned());
        };
        scaler.run(frame, reduced).map_err(|e| format!("has pixels that cannot be converted: {e}"))?;
        reduced.set_color_space(frame.color_space());
        reduced.set_color_range(frame.color_range());
        Ok(reduced)
    }
}

/// Returns the format of 8 bits with the channels of a format. Between other channels, the scaler would change the range of values.
fn reduced_format(from: Pixel) -> Pixel {
    let Some(descriptor) = from.descriptor() else { return Pixel::YUV444P };
    let is_rgb = ["gbr", "rgb", "bgr"].iter().any(|name| descriptor.name().contains(name));
    match descriptor.nb_components() {
        1 | 2 => Pixel::GRAY8,
        _ if is_rgb => Pixel::GBRP,
        _ => Pixel::YUV444P,
    }
}
