//! Conversion of rare pixel formats with FFmpeg's scaler.

use ffmpeg_next::format::Pixel;
use ffmpeg_next::frame;
use ffmpeg_next::software::scaling;

/// Converts frames of rare formats (10 bits, packed) to a format that is converted directly.
#[derive(Default)]
pub struct Reducer {
    made: Option<(scaling::Context, frame::Video)>,
}

impl Reducer {
    /// Converts a frame to `YUV444P` of the same size.
    pub fn reduce(&mut self, frame: &frame::Video) -> Result<&frame::Video, String> {
        let (from, width, height) = (frame.format(), frame.width(), frame.height());
        let same = |made: &(scaling::Context, frame::Video)| {
            let input = made.0.input();
            (input.format, input.width, input.height) == (from, width, height)
        };
        if !self.made.as_ref().is_some_and(same) {
            let flags = scaling::Flags::BILINEAR | scaling::Flags::ACCURATE_RND;
            let scaler = scaling::Context::get(from, width, height, Pixel::YUV444P, width, height, flags);
            let scaler = scaler.map_err(|e| format!("has pixels that nothing converts: {e}"))?;
            self.made = Some((scaler, frame::Video::empty()));
        }
        let Some((scaler, reduced)) = &mut self.made else { return Err("has pixels that nothing converts".to_owned()) };
        scaler.run(frame, reduced).map_err(|e| format!("has pixels that cannot be converted: {e}"))?;
        reduced.set_color_space(frame.color_space());
        reduced.set_color_range(frame.color_range());
        Ok(reduced)
    }
}
