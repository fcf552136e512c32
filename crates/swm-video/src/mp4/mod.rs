//! The sample tables of MP4 files (ISO/IEC 14496-12), parsed without a library.
//!
//! Access to single frames needs the position, size, presentation time and key flag of every encoded frame. Reading
//! the tables takes microseconds, whereas demultiplexing reads the whole file, and safe code handles damaged tables.

mod boxes;
mod tables;

use boxes::{Boxes, find, versioned};
use std::ops::Range;
use std::sync::Arc;
use tables::{Description, description, samples};

/// Limit of the size of a file's tables in bytes. The tables of an hour of video take less than a megabyte.
const LARGEST_TABLES: u64 = 256 << 20;

/// Identifier of the box with checksums that [`seal`] appends.
const SEAL: [u8; 16] = *b"swm frame sums 2";

/// That of files that earlier programs wrote, whose checksums are [`weak_sum`]s.
const WEAK_SEAL: [u8; 16] = *b"swm frame sums 1";

type Result<T> = std::result::Result<T, String>;

/// The codec of a video.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Codec {
    H264,
    Hevc,
    Vp9,
    Av1,
    Ffv1,
}

/// An encoded frame, which MP4 calls a sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sample {
    pub offset: u64,
    pub size: u32,
    /// Presentation time, in the track's units.
    pub time: i64,
    /// Whether decoding can begin at this sample.
    pub key: bool,
}

/// What a file states of the colours of its frames, for streams that state nothing themselves (ISO/IEC 23091-2).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Colours {
    /// The number of the matrix from RGB.
    pub matrix: u16,
    /// Whether values have the full range, if that is stated.
    pub full: Option<bool>,
}

/// The video track of a file.
#[derive(Clone, Debug)]
pub struct Index {
    pub codec: Codec,
    /// Parameters of the decoder, from the file's sample entry.
    pub extradata: Arc<[u8]>,
    pub colours: Option<Colours>,
    pub width: usize,
    pub height: usize,
    /// The samples, in decoding order.
    pub samples: Vec<Sample>,
    /// Index of the sample of each frame, in presentation order. Samples that the edit list hides are left out.
    pub frames: Vec<u32>,
    /// Presentation time of each frame, in the track's units.
    pub times: Vec<i64>,
    /// Track units per second.
    pub timescale: u32,
    /// Checksums of the samples, in files that [`seal`] finished.
    pub sums: Option<Sums>,
}

/// Checksums of samples.
#[derive(Clone, Debug)]
pub struct Sums {
    pub values: Vec<u32>,
    /// Computes one.
    of: fn(&[u8]) -> u32,
}

impl Index {
    /// Reads the tables of a file of `length` bytes; `read(offset, bytes)` fills `bytes` from the file, starting at
    /// `offset`.
    pub fn read(length: u64, mut read: impl FnMut(u64, &mut [u8]) -> Result<()>) -> Result<Self> {
        let (mut moov, mut seal) = (None, None);
        let mut at = 0;
        while at + 8 <= length {
            let mut header = [0; 16];
            read(at, &mut header[..8])?;
            let kind = [header[4], header[5], header[6], header[7]];
            let (mut size, mut begin) =
                (u64::from(u32::from_be_bytes([header[0], header[1], header[2], header[3]])), 8);
            if size == 1 && at + 16 <= length {
                read(at + 8, &mut header[8..])?;
                size = u64::from_be_bytes(header[8..].try_into().unwrap_or_default());
                begin = 16;
            } else if size == 0 {
                size = length - at;
            }
            if at == 0 && !matches!(&kind, b"ftyp" | b"moov" | b"mdat" | b"free" | b"skip" | b"wide" | b"uuid") {
                return Err("is no MP4 file".to_owned());
            }
            if size < begin || size > length - at {
                return Err(format!("ends within its box '{}'", kind.escape_ascii()));
            }
            let mut body = |limit: u64| -> Result<Vec<u8>> {
                if size - begin > limit {
                    return Err(format!("has a box '{}' of more than {limit} bytes", kind.escape_ascii()));
                }
                let mut bytes = vec![0; usize::try_from(size - begin).map_err(|e| e.to_string())?];
                read(at + begin, &mut bytes)?;
                Ok(bytes)
            };
            match &kind {
                b"moov" => moov = Some(body(LARGEST_TABLES)?),
                b"uuid" => {
                    let bytes = body(LARGEST_TABLES)?;
                    let matching = bytes.iter().zip(&SEAL).filter(|(a, b)| a == b).count();
                    if let Some(sums) = bytes.strip_prefix(&SEAL) {
                        seal = Some((sums.to_vec(), sum as fn(&[u8]) -> u32));
                    } else if let Some(sums) = bytes.strip_prefix(&WEAK_SEAL) {
                        seal = Some((sums.to_vec(), weak_sum));
                    } else if matching > SEAL.len() / 2 {
                        return Err("has damaged checksums".to_owned());
                    }
                }
                b"moof" | b"styp" | b"sidx" => return Err("is cut into fragments".to_owned()),
                b"ftyp" | b"mdat" | b"free" | b"skip" | b"wide" | b"meta" | b"udta" | b"pdin" => {}
                // Ignoring unknown boxes would let a flipped bit hide the checksums.
                other => return Err(format!("has the unknown box '{}'", other.escape_ascii())),
            }
            at += size;
        }
        let moov = moov.ok_or("holds no sample tables (box 'moov')")?;
        let mut index = Self::of_moov(&moov, length)?;
        if let Some((seal, of)) = seal {
            let mut sums = seal.chunks_exact(4).map(|b| u32::from_be_bytes([b[0], b[1], b[2], b[3]]));
            if sums.next() != Some(of(&moov)) || seal.len() != 4 * (index.samples.len() + 1) {
                return Err("has sample tables that do not match their checksum".to_owned());
            }
            index.sums = Some(Sums { values: sums.collect(), of });
        }
        Ok(index)
    }

    fn of_moov(moov: &[u8], length: u64) -> Result<Self> {
        let movie_scale = timescale(find(moov, b"mvhd")?.ok_or("has no movie header")?)?;
        if find(moov, b"mvex")?.is_some() {
            return Err("is cut into fragments".to_owned());
        }
        for child in Boxes(moov) {
            let (kind, trak) = child?;
            if &kind != b"trak" {
                continue;
            }
            let Some(mdia) = find(trak, b"mdia")? else { continue };
            let handler = find(mdia, b"hdlr")?.and_then(|hdlr| hdlr.get(8..12));
            if handler == Some(b"vide".as_slice()) {
                return Self::of_track(trak, mdia, movie_scale, length);
            }
        }
        Err("holds no video".to_owned())
    }

    fn of_track(trak: &[u8], mdia: &[u8], movie_scale: u32, length: u64) -> Result<Self> {
        let timescale = timescale(find(mdia, b"mdhd")?.ok_or("has a track without a header")?)?;
        let minf = find(mdia, b"minf")?.ok_or("has a track without tables")?;
        let stbl = find(minf, b"stbl")?.ok_or("has a track without tables")?;
        let described = find(stbl, b"stsd")?.ok_or("has a track without a codec")?;
        let Description { codec, extradata, colours, width, height } = description(described)?;
        let samples = samples(stbl, width * height, length)?;
        let edit = edit(trak, movie_scale, timescale)?;
        let mut frames: Vec<u32> = (0..u32::try_from(samples.len()).map_err(|e| e.to_string())?).collect();
        frames.retain(|&i| edit.shown.contains(&samples[i as usize].time));
        frames.sort_by_key(|&i| samples[i as usize].time);
        let times = frames.iter().map(|&i| samples[i as usize].time.saturating_add(edit.shift)).collect();
        Ok(Self { codec, extradata, colours, width, height, samples, frames, times, timescale, sums: None })
    }

    /// Returns the key sample at which decoding of `sample` must begin: in decoding order, the last key sample up to
    /// `sample` that is not presented after `sample`.
    pub fn key_before(&self, sample: usize) -> usize {
        let shown = self.samples[sample].time;
        let begins = |i: &usize| self.samples[*i].key && self.samples[*i].time <= shown;
        (0..=sample).rev().find(begins).unwrap_or(0)
    }

    /// Returns the key sample that is `count` key samples before `sample`, or the first sample; `None` before the first one.
    pub fn earlier_key(&self, sample: usize, count: usize) -> Option<usize> {
        let keys = (0..sample).rev().filter(|&i| self.samples[i].key);
        (sample > 0).then(|| keys.take(count).last().unwrap_or(0))
    }

    /// Checks the bytes of a sample against the checksum, if the file has checksums.
    pub fn check(&self, sample: usize, bytes: &[u8]) -> Result<()> {
        if bytes.is_empty() {
            return Err(format!("is damaged: its encoded frame {sample} is empty"));
        }
        match &self.sums {
            Some(sums) if sums.values[sample] != (sums.of)(bytes) => {
                Err(format!("is damaged in encoded frame {sample}: its checksum differs"))
            }
            _ => Ok(()),
        }
    }

    /// Returns the presentation time of a frame in seconds.
    pub fn seconds(&self, frame: usize) -> f64 {
        self.times[frame] as f64 / f64::from(self.timescale)
    }

    /// Returns the frame whose presentation time is closest to a time in seconds.
    pub fn frame_at(&self, seconds: f64) -> Option<usize> {
        let after = self.times.partition_point(|&time| time as f64 / f64::from(self.timescale) < seconds);
        let candidates = [after.checked_sub(1), (after < self.times.len()).then_some(after)];
        let distance = |frame: &usize| (self.seconds(*frame) - seconds).abs();
        candidates.into_iter().flatten().min_by(|a, b| distance(a).total_cmp(&distance(b)))
    }
}

/// Appends checksums of the samples and the tables to a finished file, in a box that players skip.
pub fn seal(file: &mut Vec<u8>) -> Result<()> {
    let read = |file: &[u8], offset: u64, bytes: &mut [u8]| {
        let from = usize::try_from(offset).ok().and_then(|at| file.get(at..)?.get(..bytes.len()));
        bytes.copy_from_slice(from.ok_or("ends too early")?);
        Ok(())
    };
    let index = Index::read(file.len() as u64, |offset, bytes| read(file, offset, bytes))?;
    let moov = Boxes(file).flatten().find(|(kind, _)| kind == b"moov").ok_or("holds no sample tables")?.1;
    let mut content = SEAL.to_vec();
    content.extend(sum(moov).to_be_bytes());
    let mut bytes = vec![];
    for sample in &index.samples {
        bytes.resize(sample.size as usize, 0);
        read(file, sample.offset, &mut bytes)?;
        content.extend(sum(&bytes).to_be_bytes());
    }
    file.extend(u32::try_from(content.len() + 8).map_err(|e| e.to_string())?.to_be_bytes());
    file.extend(b"uuid");
    file.extend(content);
    Ok(())
}

/// Returns a checksum against accidental damage.
pub fn sum(bytes: &[u8]) -> u32 {
    // A step more than the words, because the last step alone does not spread the upper half of its word.
    step(state(bytes), 0) as u32
}

/// Returns the checksum of earlier programs. Its last step drops the upper half of the last word: up to 3 bytes at the end of 5 to 7 bytes
/// beyond a multiple of 8.
fn weak_sum(bytes: &[u8]) -> u32 {
    let state = state(bytes);
    (state >> 32) as u32 ^ state as u32
}

/// Every step is one-to-one, so the state differs whenever one word differs.
fn state(bytes: &[u8]) -> u64 {
    let (words, rest) = bytes.as_chunks::<8>();
    let mut last = [0; 8];
    last[..rest.len()].copy_from_slice(rest);
    let words = words.iter().chain([&last]).map(|word| u64::from_le_bytes(*word));
    words.fold(ODD ^ bytes.len() as u64, step)
}

fn step(state: u64, word: u64) -> u64 {
    let state = (state ^ word).wrapping_mul(ODD);
    state ^ state >> 32
}

/// The odd number that spreads the bits of a word.
const ODD: u64 = 0x9e37_79b9_7f4a_7c15;

/// Returns the units per second in the header of a movie or a track.
fn timescale(header: &[u8]) -> Result<u32> {
    let (version, mut integers) = versioned(header)?;
    // Skips the creation time and the modification time.
    if version == 1 { integers.bytes::<16>().map(drop) } else { integers.bytes::<8>().map(drop) }?;
    match integers.u32()? {
        0 => Err("has a time unit of 0".to_owned()),
        timescale => Ok(timescale),
    }
}

/// The part of a track that is presented.
struct Edit {
    /// Range of the track's times that are presented, in track units.
    shown: Range<i64>,
    /// The presentation time minus the track's time, in track units.
    shift: i64,
}

/// Reads the edit list. Encoders write one segment, possibly after an empty segment, to hide their delay. Several
/// segments are an error.
fn edit(trak: &[u8], movie_scale: u32, timescale: u32) -> Result<Edit> {
    let mut edit = Edit { shown: i64::MIN..i64::MAX, shift: 0 };
    let Some(edts) = find(trak, b"edts")? else { return Ok(edit) };
    let Some(elst) = find(edts, b"elst")? else { return Ok(edit) };
    let (version, mut integers) = versioned(elst)?;
    let (mut start, mut pieces) = (0_i64, 0);
    for _ in 0..integers.count(if version == 1 { 20 } else { 12 })? {
        let (duration, from) = if version == 1 {
            (integers.u64()?, integers.i64()?)
        } else {
            (integers.u32()?.into(), integers.i32()?.into())
        };
        integers.u32()?; // Skips the playback rate.
        let units = u128::from(duration) * u128::from(timescale) / u128::from(movie_scale);
        let units = i64::try_from(units).unwrap_or(i64::MAX);
        if from >= 0 {
            let end = if duration == 0 { i64::MAX } else { from.saturating_add(units) };
            edit = Edit { shown: from..end, shift: start.saturating_sub(from) };
            pieces += 1;
        }
        start = start.saturating_add(units);
    }
    if pieces > 1 { Err("is edited from several pieces".to_owned()) } else { Ok(edit) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checksums_depend_on_every_byte_and_those_of_earlier_programs_are_known() {
        for length in 1..40 {
            let bytes: Vec<u8> = (0..length).map(|i: u8| i.wrapping_mul(7).wrapping_add(3)).collect();
            for at in 0..bytes.len() {
                let mut changed = bytes.clone();
                changed[at] ^= 0x10;
                assert_ne!(sum(&changed), sum(&bytes), "byte {at} of {length}");
            }
        }
        // The value that earlier programs compute.
        assert_eq!(weak_sum(b"swm frame"), 0xe590b808);
    }
}
