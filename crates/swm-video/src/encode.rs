//! Encoding of frames as an MP4 file: H.264 by x264, or by OpenH264 where FFmpeg was built without parts under the GPL; lossless
//! frames then as FFV1.

use crate::{colour, link, mp4};
use ffmpeg_next::codec::{self, Flags, threading};
use ffmpeg_next::color::{Range, Space};
use ffmpeg_next::format::{self, Pixel};
use ffmpeg_next::{Dictionary, Packet, Rational, encoder, frame};
use std::io::{Cursor, Seek, SeekFrom, Write};
use std::sync::{Arc, Mutex, PoisonError};
use swm_core::{Error, Result};
use swm_image::ImageCodec;
use swm_simd::CpuLevel;

/// Settings of the encoder.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Encoding {
    /// The quality of the decoded frames.
    pub quality: Quality,
    /// The number of frames from one key frame to the next. Decoding one random frame decodes half of these frames on
    /// average.
    pub gop: u32,
    /// Whether the encoder uses methods that make files smaller and decoding slower, such as frames that depend on
    /// later frames.
    pub small: bool,
}

/// The quality of encoded frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quality {
    /// Decoded frames equal the originals.
    Lossless,
    /// Constant rate factor: higher values give smaller files of lower quality.
    Crf(u8),
}

impl Encoding {
    /// Settings for training data: a key frame every few frames, and fast decoding. The quality follows from the
    /// codec of single images.
    pub fn training(codec: ImageCodec) -> Self {
        let quality = match codec {
            // JPEG quality 95 becomes a rate factor of 18, which looks like the original.
            ImageCodec::Jpeg { quality } => Quality::Crf((8 + 2 * 100_u8.saturating_sub(quality.max(50))).min(51)),
            _ => Quality::Lossless,
        };
        Self { quality, gop: TRAINING_GOP, small: false }
    }

    /// Settings for videos that people watch: small files that browsers play.
    pub const fn viewing() -> Self {
        Self { quality: Quality::Crf(18), gop: 250, small: true }
    }

    /// Returns the settings of the encoders that can be used, the preferred one first.
    fn candidates(self, width: usize, height: usize) -> Vec<Settings> {
        match self.quality {
            Quality::Lossless => vec![Settings::x264_lossless(width, height), Settings::ffv1(width, height)],
            Quality::Crf(crf) => {
                let open = Settings::open_h264(crf, width, height);
                // Training data keep their size, and people's players know no FFV1.
                let open =
                    if self.small || open.size == (width, height) { open } else { Settings::ffv1(width, height) };
                vec![Settings::x264(crf, self.small, width, height), open]
            }
        }
    }
}

/// An encoder with its settings.
#[derive(Clone, Debug)]
struct Settings {
    encoder: &'static str,
    pixels: Pixel,
    /// FFmpeg's writer of the file. That of `mp4` knows no FFV1; `mov` differs in the names of brands.
    container: &'static str,
    /// Width and height of the encoded frames, whose last rows and columns are repeated where frames are smaller.
    size: (usize, usize),
    options: Vec<(&'static str, String)>,
}

impl Settings {
    /// Encodes RGB without conversion to YUV.
    fn x264_lossless(width: usize, height: usize) -> Self {
        let options = vec![("qp", "0".to_owned()), ("preset", "veryfast".to_owned())];
        Self { encoder: "libx264rgb", pixels: Pixel::RGB24, container: "mp4", size: (width, height), options }
    }

    fn x264(crf: u8, small: bool, width: usize, height: usize) -> Self {
        let even = width.is_multiple_of(2) && height.is_multiple_of(2);
        let mut options = vec![("crf", crf.to_string()), ("preset", "medium".to_owned())];
        if let Some(instructions) = instruction_set() {
            options.push(("x264-params", format!("asm={instructions}")));
        }
        if !small {
            options.push(("tune", "fastdecode".to_owned()));
        }
        let pixels = if even { Pixel::YUV420P } else { Pixel::YUV444P };
        Self { encoder: "libx264", pixels, container: "mp4", size: (width, height), options }
    }

    /// A constant quantiser, which is what a constant rate factor is on average. OpenH264 takes even sides of at least 16 pixels.
    fn open_h264(crf: u8, width: usize, height: usize) -> Self {
        let quantiser = crf.clamp(1, 51).to_string();
        let options = vec![("rc_mode", "quality".to_owned()), ("qmin", quantiser.clone()), ("qmax", quantiser)];
        let side = |pixels: usize| pixels.max(16).next_multiple_of(2);
        let size = (side(width), side(height));
        Self { encoder: "libopenh264", pixels: Pixel::YUV420P, container: "mp4", size, options }
    }

    /// Version 3 with checksums. Small frames are one slice, which makes them smaller; FFmpeg divides larger ones.
    fn ffv1(width: usize, height: usize) -> Self {
        let mut options = vec![("level", "3".to_owned()), ("slicecrc", "1".to_owned())];
        if width <= 352 && height <= 288 {
            options.push(("slices", "1".to_owned()));
        }
        Self { encoder: "ffv1", pixels: Pixel::BGRZ, container: "mov", size: (width, height), options }
    }
}

/// Returns the instruction set that x264 is limited to, if the set that x264 would choose gives wrong results. With
/// AVX-512 the rate control (`mbtree`) of x264 164 reads uninitialised memory when a frame is at most a few macroblocks
/// wide (seen at 32, 48 and 64 pixels), so equal frames gave different files.
fn instruction_set() -> Option<&'static str> {
    (swm_simd::cpu_level() == CpuLevel::Avx512).then_some("AVX2")
}

/// Number of frames from one key frame to the next in training data.
const TRAINING_GOP: u32 = 8;

/// Encodes frames, `[height, width, 3]` RGB bytes each, as an MP4 file in memory with checksums. Equal frames give
/// equal bytes with the same libraries.
///
/// # Errors
/// When there is no frame, a frame has a wrong size, a setting is 0, or FFmpeg lacks the encoder.
pub fn encode<I>(width: usize, height: usize, fps: u32, encoding: Encoding, frames: I) -> Result<Vec<u8>>
where
    I: IntoIterator,
    I::Item: AsRef<[u8]>,
{
    if width == 0 || height == 0 || fps == 0 || encoding.gop == 0 {
        let problem = format!("{width} x {height} pixels at {fps} frames a second, a key frame every {}", encoding.gop);
        return Err(Error::config("video", problem, "make each value at least 1"));
    }
    let mut encoder = Encoder::new(width, height, fps, encoding)?;
    let mut count = 0;
    for rgb in frames {
        let rgb = rgb.as_ref();
        if rgb.len() != width * height * 3 {
            let expected = format!("{}, for {width} x {height} RGB pixels", width * height * 3);
            return Err(Error::mismatch(format!("frame {count} of a video"), format!("{} bytes", rgb.len()), expected));
        }
        encoder.add_frame(rgb, count)?;
        count += 1;
    }
    if count == 0 {
        return Err(Error::config("video", "there is no frame to write", "record at least one step"));
    }
    encoder.finish()
}

fn failed(error: ffmpeg_next::Error) -> Error {
    Error::external("encoding a video with FFmpeg", error)
}

/// Encodes a video frame by frame.
pub struct Encoder {
    encoder: encoder::video::Encoder,
    output: format::context::Output,
    file: Memory,
    frame: frame::Video,
    /// Width and height of the given frames.
    given: (usize, usize),
    packet: Packet,
    /// Time units of the encoder and of the file.
    units: [Rational; 2],
}

impl Encoder {
    /// Begins a video of `width` × `height` pixels.
    ///
    /// # Errors
    /// When FFmpeg lacks an encoder of this quality, or the encoder refuses the settings.
    pub fn new(width: usize, height: usize, fps: u32, encoding: Encoding) -> Result<Self> {
        link::load()?;
        let candidates = encoding.candidates(width, height);
        let Some(settings) = candidates.iter().find(|settings| encoder::find_by_name(settings.encoder).is_some())
        else {
            let names: Vec<&str> = candidates.iter().map(|settings| settings.encoder).collect();
            let names = names.join(" or ");
            let problem = format!("this machine's FFmpeg has no encoder {names}; install an FFmpeg that has one");
            return Err(Error::external("encoding a video", problem));
        };
        Self::with(settings, width, height, fps, encoding)
    }

    /// Begins a video with an encoder.
    fn with(settings: &Settings, width: usize, height: usize, fps: u32, encoding: Encoding) -> Result<Self> {
        let name = settings.encoder;
        if name == "ffv1" && width.min(height) < 2 {
            // FFmpeg writes black frames, without an error.
            let problem = format!("{width} x {height} pixels, and FFV1 stores no side of a single pixel");
            return Err(Error::config("video", problem, "use larger frames, or a format without videos"));
        }
        let codec = encoder::find_by_name(name);
        let codec =
            codec.ok_or_else(|| Error::external("encoding a video", format!("FFmpeg has no encoder {name}")))?;
        let side = |n: usize| {
            u32::try_from(n).map_err(|_| Error::config("video", format!("a side of {n} pixels"), "use smaller frames"))
        };
        let (wide, high) = (side(settings.size.0)?, side(settings.size.1)?);
        let file = Memory::default();
        let stream = format::context::StreamIo::from_write_seek(file.clone()).map_err(failed)?;
        let mut output = format::output_to_stream(stream, None, Some(settings.container)).map_err(failed)?;
        let mut context = codec::Context::new_with_codec(codec).encoder().video().map_err(failed)?;
        context.set_width(wide);
        context.set_height(high);
        context.set_format(settings.pixels);
        // Players guess the colour space from the frame size unless the file states it.
        if ![Pixel::RGB24, Pixel::BGRZ].contains(&settings.pixels) {
            context.set_colorspace(Space::SMPTE170M);
            context.set_color_range(Range::MPEG);
        }
        let rate = Rational::new(i32::try_from(fps).unwrap_or(i32::MAX), 1);
        context.set_time_base(rate.invert());
        context.set_frame_rate(Some(rate));
        context.set_gop(encoding.gop);
        if !encoding.small {
            context.set_max_b_frames(0);
        }
        // One thread and no dates, so that equal frames give equal bytes.
        context.set_threading(threading::Config::count(1));
        context.set_flags(Flags::BITEXACT | Flags::GLOBAL_HEADER);
        let mut options = Dictionary::new();
        settings.options.iter().for_each(|(key, value)| options.set(key, value));
        let encoder = context.open_as_with(codec, options).map_err(failed)?;
        let mut stream = output.add_stream_with(&encoder).map_err(failed)?;
        stream.set_time_base(rate.invert());
        stream.set_avg_frame_rate(rate);
        let mut options = Dictionary::new();
        options.set("fflags", "+bitexact");
        drop(output.write_header_with(options).map_err(failed)?);
        let unit = output.stream(0).map_or(rate.invert(), |stream| stream.time_base());
        let frame = frame::Video::new(settings.pixels, wide, high);
        let units = [rate.invert(), unit];
        Ok(Self { encoder, output, file, frame, given: (width, height), packet: Packet::empty(), units })
    }

    /// Adds the next frame, `[height, width, 3]` bytes. `index` counts frames from 0.
    pub fn add_frame(&mut self, rgb: &[u8], index: i64) -> Result<()> {
        // The encoder may still use the last frame's memory.
        let mut frame = frame::Video::new(self.frame.format(), self.frame.width(), self.frame.height());
        let size = (frame.width() as usize, frame.height() as usize);
        if size == self.given {
            colour::from_rgb(rgb, &mut frame);
        } else {
            colour::from_rgb(&enlarged(rgb, self.given, size), &mut frame);
        }
        frame.set_pts(Some(index));
        self.frame = frame;
        self.encoder.send_frame(&self.frame).map_err(failed)?;
        self.receive()
    }

    /// Writes the finished packets of the encoder to the file.
    fn receive(&mut self) -> Result<()> {
        loop {
            match self.encoder.receive_packet(&mut self.packet) {
                Ok(()) => {}
                Err(ffmpeg_next::Error::Eof | ffmpeg_next::Error::Other { errno: ffmpeg_next::ffi::EAGAIN }) => {
                    return Ok(());
                }
                Err(error) => return Err(failed(error)),
            }
            self.packet.set_stream(0);
            self.packet.set_duration(1);
            self.packet.rescale_ts(self.units[0], self.units[1]);
            self.packet.write_interleaved(&mut self.output).map_err(failed)?;
        }
    }

    /// Finishes the file and returns its bytes.
    pub fn finish(mut self) -> Result<Vec<u8>> {
        self.encoder.send_eof().map_err(failed)?;
        self.receive()?;
        self.output.write_trailer().map_err(failed)?;
        drop(self.output);
        let mut file = std::mem::take(&mut *self.file.lock()).into_inner();
        mp4::seal(&mut file)
            .map_err(|problem| Error::external("encoding a video", format!("FFmpeg's file {problem}")))?;
        Ok(file)
    }
}

/// Returns frames of a larger size, `[height, width, 3]`, whose last rows and columns are repeated.
fn enlarged(rgb: &[u8], (width, height): (usize, usize), (wide, high): (usize, usize)) -> Vec<u8> {
    let pixel = |x: usize, y: usize| &rgb[(y.min(height - 1) * width + x.min(width - 1)) * 3..][..3];
    (0..wide * high).flat_map(|at| pixel(at % wide, at / wide)).copied().collect()
}

/// A file in memory that FFmpeg writes to.
#[derive(Clone, Default)]
struct Memory(Arc<Mutex<Cursor<Vec<u8>>>>);

impl Memory {
    fn lock(&self) -> std::sync::MutexGuard<'_, Cursor<Vec<u8>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Write for Memory {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.lock().write(bytes)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

impl Seek for Memory {
    fn seek(&mut self, to: SeekFrom) -> std::io::Result<u64> {
        self.lock().seek(to)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{DecoderPool, FrameRequest, Source, Video};

    fn test_frames(width: usize, height: usize) -> Vec<Vec<u8>> {
        let at = |frame: usize, i: usize| [i % width * 4 + frame, i / width * 4, (i * i + frame * 7) % 251];
        (0..11).map(|frame| (0..width * height).flat_map(|i| at(frame, i).map(|value| value as u8)).collect()).collect()
    }

    /// Encodes frames with an encoder, and returns the size of the video and its decoded frames in an order that seeks.
    fn decoded(settings: &Settings, width: usize, height: usize, encoding: Encoding) -> ((usize, usize), Vec<Vec<u8>>) {
        let mut encoder = Encoder::with(settings, width, height, 25, encoding).expect("the encoder");
        for (index, frame) in (0..).zip(test_frames(width, height)) {
            encoder.add_frame(&frame, index).expect("a frame");
        }
        let file = encoder.finish().expect("the file");
        let video = Video::open(Source::Memory("a.mp4".into(), file.into())).expect("the video");
        let size = video.size();
        let mut frames = vec![vec![0; size.0 * size.1 * 3]; video.frames()];
        let requests = frames.iter_mut().enumerate().rev();
        let requests = requests.map(|(frame, out)| FrameRequest { video: &video, frame, out }).collect();
        DecoderPool::default().read(requests).expect("the frames");
        (size, frames)
    }

    #[test]
    fn ffv1_is_lossless_at_every_size() {
        for (width, height) in [(64, 64), (63, 33), (2, 3), (17, 2), (400, 300)] {
            let encoding = Encoding::training(ImageCodec::Qoi);
            let (size, frames) = decoded(&Settings::ffv1(width, height), width, height, encoding);
            assert_eq!(size, (height, width));
            assert!(frames == test_frames(width, height), "{width} x {height}");
        }
        link::load().expect("FFmpeg");
        let encoding = Encoding::training(ImageCodec::Qoi);
        let refused = Encoder::with(&Settings::ffv1(1, 5), 1, 5, 25, encoding).err().map(|error| error.to_string());
        assert!(refused.is_some_and(|error| error.contains("1 x 5 pixels")));
    }

    #[test]
    fn open_h264_is_close_and_enlarges_odd_sizes() {
        link::load().expect("FFmpeg");
        if encoder::find_by_name("libopenh264").is_none() {
            return;
        }
        for (width, height, encoded) in [(64, 48, (48, 64)), (63, 9, (16, 64))] {
            let (size, frames) = decoded(
                &Settings::open_h264(18, width, height),
                width,
                height,
                Encoding { quality: Quality::Crf(18), ..Encoding::viewing() },
            );
            assert_eq!((size, frames.len()), (encoded, 11));
            // The slow part of the test frames is red and green; blue is noise.
            let given = &test_frames(width, height)[5];
            let error = |i: usize| {
                let (x, y) = (i % width, i / width);
                given[i * 3 + 1].abs_diff(frames[5][(y * size.1 + x) * 3 + 1])
            };
            let worst = (0..width * height).map(error).max();
            assert!(worst < Some(60), "{worst:?}");
        }
    }

    #[test]
    fn training_data_keep_odd_sizes_without_x264() {
        let odd = Encoding::training(ImageCodec::Jpeg { quality: 95 }).candidates(63, 64);
        assert_eq!(odd[1].encoder, "ffv1");
        let even = Encoding::training(ImageCodec::Jpeg { quality: 95 }).candidates(64, 64);
        assert_eq!((even[1].encoder, even[1].size), ("libopenh264", (64, 64)));
        assert_eq!(Encoding::viewing().candidates(63, 64)[1].size, (64, 64));
    }
}
