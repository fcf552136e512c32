//! Decoding of frames by index. The requested frames of a batch that depend on the same key frame form a run. Each run
//! is decoded once, and runs are decoded in parallel.

use crate::colour;
use crate::header;
use crate::mp4::{self, Codec, Index};
use crate::reducer::Reducer;
use ffmpeg_next::codec::{self, Compliance, Flags, threading};
use ffmpeg_next::decoder::{self, Check};
use ffmpeg_next::{Dictionary, Discard, Packet, ffi, frame};
use rayon::prelude::*;
use std::fs::File;
use std::io::{Read as _, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use swm_core::{Error, Result, files};

/// The maximum number of idle decoders in the pool. Each holds the memory of a few decoded frames.
const IDLE_DECODERS: usize = 32;

/// The source of a video's bytes.
#[derive(Clone, Debug)]
pub enum Source {
    /// A file.
    File(PathBuf),
    /// Bytes in memory, with the path that error messages contain.
    Memory(PathBuf, Arc<[u8]>),
}

/// An opened source.
enum Open<'a> {
    File(File),
    Memory(&'a [u8]),
}

impl Source {
    fn label(&self) -> &Path {
        let (Self::File(path) | Self::Memory(path, _)) = self;
        path
    }

    fn open(&self) -> Result<(Open<'_>, u64)> {
        Ok(match self {
            Self::File(path) => {
                let io = |e| Error::io(path, "opening a video", e);
                let file = files::open(path)?;
                let length = file.metadata().map_err(io)?.len();
                (Open::File(file), length)
            }
            Self::Memory(_, bytes) => (Open::Memory(bytes), bytes.len() as u64),
        })
    }
}

impl Open<'_> {
    /// Fills `bytes` from `offset` on.
    fn read(&mut self, offset: u64, bytes: &mut [u8]) -> std::result::Result<(), String> {
        match self {
            Self::File(file) => {
                let read = file.seek(SeekFrom::Start(offset)).and_then(|_| file.read_exact(bytes));
                read.map_err(|e| format!("cannot be read: {e}"))
            }
            Self::Memory(all) => {
                let from = usize::try_from(offset).ok().and_then(|at| all.get(at..)?.get(..bytes.len()));
                bytes.copy_from_slice(from.ok_or("ends too early")?);
                Ok(())
            }
        }
    }
}

/// An MP4 file whose tables were read. The file is not kept open.
#[derive(Debug)]
pub struct Video {
    source: Source,
    pub(crate) index: Index,
}

impl Video {
    /// Reads the tables of a video.
    ///
    /// # Errors
    /// When the file cannot be read, is not a plain MP4 file, or has an unsupported codec.
    pub fn open(source: Source) -> Result<Self> {
        let (mut open, length) = source.open()?;
        let index = Index::read(length, |offset, bytes| open.read(offset, bytes));
        let index = index.map_err(|problem| damaged(source.label(), &problem))?;
        Ok(Self { source, index })
    }

    /// Returns the number of frames.
    pub fn frames(&self) -> usize {
        self.index.frames.len()
    }

    /// Returns the height and width.
    pub fn size(&self) -> (usize, usize) {
        (self.index.height, self.index.width)
    }

    /// Returns the bytes of memory that the opened video takes.
    pub fn memory(&self) -> usize {
        let index = &self.index;
        let tables = index.samples.len() * size_of::<mp4::Sample>() + index.frames.len() * 12;
        let sums = index.sums.as_ref().map_or(0, |sums| 4 * sums.len());
        let bytes = if let Source::Memory(_, bytes) = &self.source { bytes.len() } else { 0 };
        size_of::<Self>() + tables + sums + bytes
    }

    /// Calls `each` with the encoded bytes of every frame of `frames`.
    ///
    /// # Errors
    /// When the file is damaged.
    pub fn coded(&self, frames: impl IntoIterator<Item = usize>, mut each: impl FnMut(&[u8])) -> Result<()> {
        let (mut open, _) = self.source.open()?;
        let mut bytes = vec![];
        for frame in frames {
            let sample = self.index.frames.get(frame).map(|&i| i as usize);
            let sample = sample.ok_or_else(|| self.lacks(frame))?;
            let entry = self.index.samples[sample];
            bytes.resize(entry.size as usize, 0);
            let read = open.read(entry.offset, &mut bytes).and_then(|()| self.index.check(sample, &bytes));
            read.map_err(|problem| damaged(self.source.label(), &problem))?;
            each(&bytes);
        }
        Ok(())
    }

    /// Returns the error for a defect of this video.
    pub fn damaged(&self, problem: &str) -> Error {
        damaged(self.source.label(), problem)
    }

    fn lacks(&self, frame: usize) -> Error {
        self.damaged(&format!("has {} frames, but frame {frame} was requested", self.frames()))
    }

    /// Returns the index of the frame closest to a time in seconds, and the frame's distance from the time in seconds.
    /// Returns `None` if the video has no frames.
    pub fn frame_at(&self, seconds: f64) -> Option<(usize, f64)> {
        let frame = self.index.frame_at(seconds)?;
        Some((frame, (self.index.seconds(frame) - seconds).abs()))
    }
}

/// Returns the error for a damaged video.
fn damaged(path: &Path, problem: &str) -> Error {
    let fix = "restore it from a copy, or encode it again with `ffmpeg -i IN -c:v libx264 OUT.mp4`";
    Error::corrupt(path, format!("the video {problem}"), fix)
}

/// A request to decode a frame into memory.
pub struct FrameRequest<'a> {
    /// The video.
    pub video: &'a Video,
    /// Index of the frame in presentation order.
    pub frame: usize,
    /// The memory for the decoded frame, `[height, width, 3]`.
    pub out: &'a mut [u8],
}

/// A requested frame of a run.
struct Job<'a> {
    video: &'a Video,
    /// The sample at which decoding begins.
    key: usize,
    sample: usize,
    out: &'a mut [u8],
}

/// Decoders that are reused between batches. Files of one dataset have the same parameters, so one decoder serves
/// many files.
#[derive(Default)]
pub struct DecoderPool {
    /// Idle decoders, sorted by the time of last use.
    idle: Mutex<Vec<Decoder>>,
}

impl DecoderPool {
    /// Decodes frames of any videos, on the threads of the current rayon pool.
    ///
    /// # Errors
    /// When a frame does not exist, an `out` has another size, or a video is damaged.
    pub fn read(&self, wanted: Vec<FrameRequest<'_>>) -> Result<()> {
        let mut jobs = Vec::with_capacity(wanted.len());
        for FrameRequest { video, frame, out } in wanted {
            let index = &video.index;
            let Some(&sample) = index.frames.get(frame) else {
                return Err(video.lacks(frame));
            };
            if out.len() != index.width * index.height * 3 {
                let problem = format!(
                    "has {} x {} pixels, but a frame of its dataset has {} bytes",
                    index.width,
                    index.height,
                    out.len()
                );
                return Err(damaged(video.source.label(), &problem));
            }
            let sample = sample as usize;
            jobs.push(Job { video, key: index.key_before(sample), sample, out });
        }
        let order = |job: &Job<'_>| (std::ptr::from_ref(job.video) as usize, job.key, job.sample);
        jobs.sort_unstable_by_key(order);
        let runs: Vec<&mut [Job<'_>]> =
            jobs.chunk_by_mut(|a, b| (order(a).0, order(a).1) == (order(b).0, order(b).1)).collect();
        runs.into_par_iter().with_max_len(1).try_for_each(|run| {
            let Some(Job { video, .. }) = run.first() else { return Ok(()) };
            let video = *video;
            let mut decoder = self.take(video)?;
            // After a failure the state of the decoder is unknown, so the decoder is dropped.
            decoder.run(video, run).map_err(|problem| damaged(video.source.label(), &problem))?;
            self.give_back(decoder);
            Ok(())
        })
    }

    /// Checks that the first frame has the size that the header states. Callers check this before they allocate memory
    /// for frames of an unknown file.
    ///
    /// # Errors
    /// When the sizes differ, or the frame cannot be decoded.
    pub fn check_size(&self, video: &Video) -> Result<()> {
        let mut decoder = self.take(video)?;
        let found = decoder.first_size(video).map_err(|problem| video.damaged(&problem))?;
        if found != video.size() {
            return Err(
                video.damaged(&format!("has frames of {found:?} pixels, but its header states {:?}", video.size()))
            );
        }
        self.give_back(decoder);
        Ok(())
    }

    fn take(&self, video: &Video) -> Result<Decoder> {
        let mut idle = self.idle.lock().unwrap_or_else(PoisonError::into_inner);
        match idle.iter().rposition(|decoder| decoder.serves(&video.index)) {
            Some(i) => Ok(idle.remove(i)),
            None => {
                drop(idle);
                Decoder::new(video)
            }
        }
    }

    fn give_back(&self, decoder: Decoder) {
        let mut idle = self.idle.lock().unwrap_or_else(PoisonError::into_inner);
        if idle.len() == IDLE_DECODERS {
            idle.remove(0);
        }
        idle.push(decoder);
    }
}

/// An FFmpeg decoder and its memory.
struct Decoder {
    codec: Codec,
    extradata: Arc<[u8]>,
    size: (usize, usize),
    inner: decoder::Video,
    frame: frame::Video,
    coded: Vec<u8>,
}

impl Decoder {
    fn new(video: &Video) -> Result<Self> {
        let index = &video.index;
        crate::prepare();
        let id = match index.codec {
            Codec::H264 => codec::Id::H264,
            Codec::Hevc => codec::Id::HEVC,
            Codec::Vp9 => codec::Id::VP9,
            Codec::Av1 => codec::Id::AV1,
            Codec::Ffv1 => codec::Id::FFV1,
        };
        // FFmpeg's own AV1 decoder needs special hardware.
        let named = (index.codec == Codec::Av1).then(|| decoder::find_by_name("libdav1d")).flatten();
        let Some(found) = named.or_else(|| decoder::find(id)) else {
            return Err(Error::external(
                "opening a video decoder",
                format!("this machine's FFmpeg has no decoder for {:?}; install an FFmpeg that has one", index.codec),
            ));
        };
        let mut context = codec::Context::new_with_codec(found);
        header::set(&mut context, index);
        // One thread, because runs are decoded in parallel. Strict compliance, because otherwise FFmpeg assumes that
        // frames are not reordered when a stream does not state the reordering depth. Damaged frames are errors and are
        // not concealed.
        context.set_threading(threading::Config::count(1));
        context.compliance(Compliance::Strict);
        // Without this flag the decoder withholds frames after the key frame of an open GOP. `Index::key_before`
        // chooses a key frame from which the requested frame can be decoded.
        context.set_flags(Flags::OUTPUT_CORRUPT);
        let mut decoder = context.decoder();
        decoder.check(Check::CRC | Check::BITSTREAM | Check::BUFFER | Check::EXPLODE);
        // Damaged headers may state any size. The limit exceeds that of frames, which are padded to whole blocks.
        let mut options = Dictionary::new();
        options.set("max_pixels", &((index.width + 256) * (index.height + 256)).to_string());
        let inner = decoder.open_as_with(found, options).and_then(|opened| opened.video());
        let inner = inner.map_err(|e| video.damaged(&format!("has a header that the decoder refuses: {e}")))?;
        Ok(Self {
            codec: index.codec,
            extradata: Arc::clone(&index.extradata),
            size: (index.width, index.height),
            inner,
            frame: frame::Video::empty(),
            coded: vec![],
        })
    }

    fn serves(&self, index: &Index) -> bool {
        self.codec == index.codec
            && self.size == (index.width, index.height)
            && (Arc::ptr_eq(&self.extradata, &index.extradata) || self.extradata == index.extradata)
    }

    /// Decodes the requested frames of one run, which are in decoding order.
    fn run(&mut self, video: &Video, jobs: &mut [Job<'_>]) -> Result<(), String> {
        let (Some(first), Some(last)) = (jobs.first().map(|job| job.key), jobs.last().map(|job| job.sample)) else {
            return Ok(());
        };
        let (mut open, _) = video.source.open().map_err(|e| e.to_string())?;
        let samples = &video.index.samples[first..=last];
        let mut missing = jobs.len();
        let mut reducer = Reducer::default();
        // Samples that are adjacent in the file are read together.
        let mut at = first;
        for group in samples.chunk_by(|a, b| a.offset + u64::from(a.size) == b.offset) {
            let mut coded = std::mem::take(&mut self.coded);
            coded.resize(group.iter().map(|sample| sample.size as usize).sum(), 0);
            open.read(group[0].offset, &mut coded)?;
            let mut rest = &coded[..];
            for sample in group {
                let (bytes, following) = rest.split_at(sample.size as usize);
                rest = following;
                video.index.check(at, bytes)?;
                // A frame that is not requested and that no other frame refers to is not decoded.
                let wanted = jobs.binary_search_by_key(&at, |job| job.sample).is_ok();
                self.inner.skip_frame(if wanted { Discard::Default } else { Discard::NonReference });
                let mut packet = Packet::copy(bytes);
                packet.set_pts(Some(at as i64));
                self.inner.send_packet(&packet).map_err(|e| format!("cannot be decoded in encoded frame {at}: {e}"))?;
                self.receive(video, jobs, &mut missing, &mut reducer)?;
                at += 1;
            }
            self.coded = coded;
        }
        if missing > 0 {
            self.inner.send_eof().map_err(|e| format!("cannot be decoded to its end: {e}"))?;
            self.receive(video, jobs, &mut missing, &mut reducer)?;
        }
        self.inner.flush();
        if missing > 0 {
            return Err(format!(
                "is damaged: of the frames from encoded frame {first} to {last}, {missing} are missing"
            ));
        }
        Ok(())
    }

    /// Decodes the first frame and returns its height and width.
    fn first_size(&mut self, video: &Video) -> Result<(usize, usize), String> {
        let (mut open, _) = video.source.open().map_err(|e| e.to_string())?;
        let Some(sample) = video.index.samples.first() else { return Err("has no frame".to_owned()) };
        self.coded.resize(sample.size as usize, 0);
        open.read(sample.offset, &mut self.coded)?;
        video.index.check(0, &self.coded)?;
        self.inner.skip_frame(Discard::Default);
        let sent = self.inner.send_packet(&Packet::copy(&self.coded)).and_then(|()| self.inner.send_eof());
        sent.and_then(|()| self.inner.receive_frame(&mut self.frame)).map_err(|e| format!("cannot be decoded: {e}"))?;
        self.inner.flush();
        Ok((self.frame.height() as usize, self.frame.width() as usize))
    }

    /// Receives the finished frames of the decoder and converts the requested frames.
    fn receive(
        &mut self,
        video: &Video,
        jobs: &mut [Job<'_>],
        missing: &mut usize,
        reducer: &mut Reducer,
    ) -> Result<(), String> {
        loop {
            match self.inner.receive_frame(&mut self.frame) {
                Ok(()) => {}
                Err(ffmpeg_next::Error::Eof | ffmpeg_next::Error::Other { errno: ffi::EAGAIN }) => return Ok(()),
                Err(error) => return Err(format!("cannot be decoded: {error}")),
            }
            let Some(sample) = self.frame.pts().and_then(|pts| usize::try_from(pts).ok()) else { continue };
            let begin = jobs.partition_point(|job| job.sample < sample);
            let end = jobs.partition_point(|job| job.sample <= sample);
            let Some((Job { out, .. }, duplicates)) = jobs[begin..end].split_first_mut() else { continue };
            if self.frame.is_corrupt() || self.frame.has_decode_errors() {
                return Err(format!("is damaged in encoded frame {sample}"));
            }
            let (height, width) = video.size();
            let frame =
                if colour::is_native(self.frame.format()) { &self.frame } else { reducer.reduce(&self.frame)? };
            if !colour::to_rgb(frame, width, height, out) {
                let found = format!("{} x {}", frame.width(), frame.height());
                return Err(format!("has a frame of {found} pixels, but its header states {width} x {height}"));
            }
            duplicates.iter_mut().for_each(|job| job.out.copy_from_slice(out));
            *missing = missing.saturating_sub(end - begin);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the frames of `tests/interop/odd-NAME.mp4`, as PyAV decoded them, and the video.
    fn odd(name: &str) -> (Vec<u8>, Video) {
        let stem = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/interop").join(format!("odd-{name}"));
        let expected = swm_image::read_png(&stem.with_extension("png")).expect("reading the PNG file").rgb;
        (expected, Video::open(Source::File(stem.with_extension("mp4"))).expect("opening the video"))
    }

    #[test]
    fn decoded_frames_equal_the_frames_of_pyav() {
        let decoders = DecoderPool::default();
        // PyAV interpolates the chroma of 10-bit frames, so only the mean difference is small.
        for (name, tolerance) in [("times", 0), ("hevc", 0), ("deep", 4)] {
            let (expected, video) = odd(name);
            assert_eq!((video.frames(), video.size()), (14, (32, 48)), "{name}");
            let size = 32 * 48 * 3;
            let bytes: Arc<[u8]> = std::fs::read(video.source.label()).expect("reading the file").into();
            let in_memory = Video::open(Source::Memory("a blob".into(), bytes)).expect("opening the video");
            // Frames one by one from the file, then all frames in reverse order from memory, then frames with
            // repetitions.
            let orders: [Vec<usize>; 3] = [(0..14).collect(), (0..14).rev().collect(), vec![9, 3, 9, 13, 0, 3]];
            for (i, order) in orders.into_iter().enumerate() {
                let mut out = vec![7; order.len() * size];
                let video = if i == 1 { &in_memory } else { &video };
                let frames = order.iter().zip(out.chunks_exact_mut(size));
                let wanted: Vec<FrameRequest<'_>> =
                    frames.map(|(&frame, out)| FrameRequest { video, frame, out }).collect();
                if i == 0 {
                    wanted.into_iter().for_each(|wanted| decoders.read(vec![wanted]).expect("decoding the frames"));
                } else {
                    decoders.read(wanted).expect("decoding the frames");
                }
                for (&frame, found) in order.iter().zip(out.chunks_exact(size)) {
                    let off: usize =
                        found.iter().zip(&expected[frame * size..]).map(|(a, b)| usize::from(a.abs_diff(*b))).sum();
                    assert!(off <= tolerance * size, "{name}, frame {frame}: the differences sum to {off}");
                }
            }
        }
    }

    #[test]
    fn frames_are_found_by_time() {
        let (_, video) = odd("times");
        for t in 0..14 {
            let time = f64::from(350 + 40 * t + 11 * t * t) / 1000.0;
            let (frame, distance) = video.frame_at(time + 0.004).expect("finding the frame");
            assert_eq!(frame, t as usize);
            assert!((distance - 0.004).abs() < 1e-3, "{distance}");
        }
        assert_eq!(video.frame_at(-5.0).map(|(frame, _)| frame), Some(0));
        assert_eq!(video.frame_at(99.0).map(|(frame, _)| frame), Some(13));
    }

    #[test]
    fn missing_frames_and_wrong_files_are_errors() {
        let (_, video) = odd("times");
        let mut out = vec![0; 32 * 48 * 3];
        let error = |frame, out: &mut [u8]| {
            let wanted = vec![FrameRequest { video: &video, frame, out }];
            DecoderPool::default().read(wanted).expect_err("the call must fail").to_string()
        };
        assert!(error(14, &mut out).contains("14 frames"));
        assert!(error(0, &mut out[1..]).contains("48 x 32"));
        let png = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/interop/odd-times.png");
        assert!(Video::open(Source::File(png)).expect_err("a PNG file").to_string().contains("no MP4"));
    }
}
