//! Decoding of frames by index. The requested frames of a batch that depend on the same key frame form a run. Each run
//! is decoded once, and runs are decoded in parallel.

use crate::colour;
use crate::header;
use crate::link;
use crate::mp4::{Codec, Colours, Index};
use crate::parameters::brings_parameters;
use crate::reducer::Reducer;
use crate::video::{Video, damaged};
use ffmpeg_next::codec::{self, Compliance, Flags, threading};
use ffmpeg_next::decoder::{self, Check};
use ffmpeg_next::{Dictionary, Discard, Packet, ffi, frame};
use rayon::prelude::*;
use std::sync::{Arc, Mutex, PoisonError};
use swm_core::{Error, Result};

/// The maximum number of idle decoders in the pool. Each holds the memory of a few decoded frames.
const IDLE_DECODERS: usize = 32;

/// How many key frames earlier decoding begins where it fails from the nearest one, attempt by attempt.
const EARLIER: [usize; 3] = [1, 4, 16];

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
            let Some(Job { video, key, .. }) = run.first() else { return Ok(()) };
            let (video, key) = (*video, *key);
            let mut decoder = self.take(video)?;
            let mut outcome = decoder.run(video, key, run);
            // The nearest key frame may not be enough: with periodic refresh, frames are whole after a period only. Videos of this
            // program have closed groups. After a failure the state of the decoder is unknown, so the decoder is dropped.
            for earlier in EARLIER.into_iter().filter(|_| video.index.sums.is_none()) {
                let (Err(_), Some(from)) = (&outcome, video.index.earlier_key(key, earlier)) else { break };
                decoder = Decoder::new(video)?;
                outcome = decoder.run(video, from, run);
            }
            outcome.map_err(|problem| damaged(video.source.label(), &problem))?;
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

    /// Keeps a decoder for later, unless the stream gave it parameters that count for this stream only.
    fn give_back(&self, decoder: Decoder) {
        if decoder.has_own_parameters {
            return;
        }
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
    colours: Option<Colours>,
    size: (usize, usize),
    inner: decoder::Video,
    frame: frame::Video,
    coded: Vec<u8>,
    /// Whether frames brought parameters that the header of their file does not have.
    has_own_parameters: bool,
}

/// The requested frames of a run that is being decoded.
struct Run<'a, 'b> {
    video: &'a Video,
    jobs: &'a mut [Job<'b>],
    /// The number of requested frames that were not decoded yet.
    missing: usize,
    /// The time of the last frame that the decoder gave.
    time: i64,
    reducer: Reducer,
}

impl Decoder {
    fn new(video: &Video) -> Result<Self> {
        let index = &video.index;
        link::load()?;
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
            colours: index.colours,
            size: (index.width, index.height),
            inner,
            frame: frame::Video::empty(),
            coded: vec![],
            has_own_parameters: false,
        })
    }

    fn serves(&self, index: &Index) -> bool {
        self.codec == index.codec
            && self.colours == index.colours
            && self.size == (index.width, index.height)
            && (Arc::ptr_eq(&self.extradata, &index.extradata) || self.extradata == index.extradata)
    }

    /// Decodes the requested frames of one run, which are in decoding order, from the encoded frame `first` on.
    fn run(&mut self, video: &Video, first: usize, jobs: &mut [Job<'_>]) -> Result<(), String> {
        let Some(last) = jobs.last().map(|job| job.sample) else { return Ok(()) };
        let (mut open, _) = video.source.open().map_err(|e| e.to_string())?;
        let samples = &video.index.samples[first..=last];
        let missing = jobs.len();
        let mut run = Run { video, jobs, missing, time: i64::MIN, reducer: Reducer::default() };
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
                let wanted = run.jobs.binary_search_by_key(&at, |job| job.sample).is_ok();
                self.inner.skip_frame(if wanted { Discard::Default } else { Discard::NonReference });
                self.has_own_parameters |= brings_parameters(&video.index, bytes);
                let mut packet = Packet::copy(bytes);
                packet.set_pts(Some(at as i64));
                self.inner.send_packet(&packet).map_err(|e| format!("cannot be decoded in encoded frame {at}: {e}"))?;
                self.receive(&mut run)?;
                at += 1;
            }
            self.coded = coded;
        }
        if run.missing > 0 {
            self.inner.send_eof().map_err(|e| format!("cannot be decoded to its end: {e}"))?;
            self.receive(&mut run)?;
        }
        self.inner.flush();
        if run.missing > 0 {
            return Err(format!(
                "is damaged: of the frames from encoded frame {first} to {last}, {} are missing",
                run.missing
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
        self.has_own_parameters |= brings_parameters(&video.index, &self.coded);
        self.inner.skip_frame(Discard::Default);
        let sent = self.inner.send_packet(&Packet::copy(&self.coded)).and_then(|()| self.inner.send_eof());
        sent.and_then(|()| self.inner.receive_frame(&mut self.frame)).map_err(|e| format!("cannot be decoded: {e}"))?;
        self.inner.flush();
        Ok((self.frame.height() as usize, self.frame.width() as usize))
    }

    /// Receives the finished frames of the decoder and converts the requested frames.
    fn receive(&mut self, run: &mut Run<'_, '_>) -> Result<(), String> {
        loop {
            match self.inner.receive_frame(&mut self.frame) {
                Ok(()) => {}
                Err(ffmpeg_next::Error::Eof | ffmpeg_next::Error::Other { errno: ffi::EAGAIN }) => return Ok(()),
                Err(error) => return Err(format!("cannot be decoded: {error}")),
            }
            let Some(sample) = self.frame.pts().and_then(|pts| usize::try_from(pts).ok()) else { continue };
            let Run { video, jobs, missing, time, reducer } = &mut *run;
            // Decoders give frames in the order of their presentation, which the stream itself states.
            let shown = video.index.samples.get(sample).map_or(i64::MAX, |sample| sample.time);
            if shown < *time {
                return Err(format!(
                    "states a time for its encoded frame {sample} at which its stream shows another frame"
                ));
            }
            *time = shown;
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
    use crate::video::Source;
    use std::path::Path;

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
