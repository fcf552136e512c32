//! Encoding of frames as an MP4 file with H.264.

use crate::colour;
use crate::mp4;
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

    /// Returns the name of the encoder, its pixel format and its options.
    fn settings(self, even: bool) -> (&'static str, Pixel, Vec<(&'static str, String)>) {
        let pixels = if even { Pixel::YUV420P } else { Pixel::YUV444P };
        match self.quality {
            // Encodes RGB without conversion to YUV.
            Quality::Lossless => {
                ("libx264rgb", Pixel::RGB24, vec![("qp", "0".to_owned()), ("preset", "veryfast".to_owned())])
            }
            Quality::Crf(crf) => {
                let mut options = vec![("crf", crf.to_string()), ("preset", "medium".to_owned())];
                if let Some(instructions) = instruction_set() {
                    options.push(("x264-params", format!("asm={instructions}")));
                }
                if !self.small {
                    options.push(("tune", "fastdecode".to_owned()));
                }
                ("libx264", pixels, options)
            }
        }
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
    packet: Packet,
    /// Time units of the encoder and of the file.
    units: [Rational; 2],
}

impl Encoder {
    /// Begins a video of `width` × `height` pixels.
    pub fn new(width: usize, height: usize, fps: u32, encoding: Encoding) -> Result<Self> {
        crate::prepare();
        let even = width.is_multiple_of(2) && height.is_multiple_of(2);
        let (name, pixels, settings) = encoding.settings(even);
        let Some(codec) = encoder::find_by_name(name) else {
            let problem = format!("this machine's FFmpeg has no encoder {name}; install an FFmpeg that has it");
            return Err(Error::external("encoding a video", problem));
        };
        let side = |n: usize| {
            u32::try_from(n).map_err(|_| Error::config("video", format!("a side of {n} pixels"), "use smaller frames"))
        };
        let (wide, high) = (side(width)?, side(height)?);
        let file = Memory::default();
        let stream = format::context::StreamIo::from_write_seek(file.clone()).map_err(failed)?;
        let mut output = format::output_to_stream(stream, None, Some("mp4")).map_err(failed)?;
        let mut context = codec::Context::new_with_codec(codec).encoder().video().map_err(failed)?;
        context.set_width(wide);
        context.set_height(high);
        context.set_format(pixels);
        // Players guess the colour space from the frame size unless the file states it.
        if pixels != Pixel::RGB24 {
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
        settings.iter().for_each(|(key, value)| options.set(key, value));
        let encoder = context.open_as_with(codec, options).map_err(failed)?;
        let mut stream = output.add_stream_with(&encoder).map_err(failed)?;
        stream.set_time_base(rate.invert());
        stream.set_avg_frame_rate(rate);
        let mut options = Dictionary::new();
        options.set("fflags", "+bitexact");
        drop(output.write_header_with(options).map_err(failed)?);
        let unit = output.stream(0).map_or(rate.invert(), |stream| stream.time_base());
        let frame = frame::Video::new(pixels, wide, high);
        Ok(Self { encoder, output, file, frame, packet: Packet::empty(), units: [rate.invert(), unit] })
    }

    /// Adds the next frame, `[height, width, 3]` bytes. `index` counts frames from 0.
    pub fn add_frame(&mut self, rgb: &[u8], index: i64) -> Result<()> {
        // The encoder may still use the last frame's memory.
        let mut frame = frame::Video::new(self.frame.format(), self.frame.width(), self.frame.height());
        colour::from_rgb(rgb, &mut frame);
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
