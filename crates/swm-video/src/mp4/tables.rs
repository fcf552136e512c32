//! The tables of a track: the codec of its samples, and where and when each sample is.

use super::boxes::{Boxes, Integers, find, versioned};
use super::{Codec, Colours, Result, Sample};
use std::sync::Arc;

/// How the samples of a track are encoded.
pub(super) struct Description {
    pub codec: Codec,
    /// Parameters of the decoder.
    pub extradata: Arc<[u8]>,
    pub colours: Option<Colours>,
    pub width: usize,
    pub height: usize,
}

/// Reads the description of a track's samples.
pub(super) fn description(stsd: &[u8]) -> Result<Description> {
    /// Size in bytes of a visual sample entry before its boxes.
    const ENTRY: usize = 78;
    /// Offset of the frame size in a visual sample entry.
    const SIZE: usize = 24;
    let (_, mut integers) = versioned(stsd)?;
    let (ways, entries) = (integers.u32()?, integers.0);
    if ways > 1 {
        return Err(format!("has {ways} descriptions of its codec, of which only one is read"));
    }
    let (kind, entry) = Boxes(entries).next().ok_or("has a track without a codec")??;
    let (codec, record) = match &kind {
        b"avc1" | b"avc3" => (Codec::H264, b"avcC"),
        b"hvc1" | b"hev1" => (Codec::Hevc, b"hvcC"),
        b"vp09" => (Codec::Vp9, b"vpcC"),
        b"av01" => (Codec::Av1, b"av1C"),
        b"FFV1" => (Codec::Ffv1, b"glbl"),
        other => {
            return Err(format!(
                "has the codec '{}', which is none of H.264, H.265, VP9, AV1, FFV1",
                other.escape_ascii()
            ));
        }
    };
    let (fixed, boxes) = entry.split_at_checked(ENTRY).ok_or("has a codec description that is cut short")?;
    let size = |at: usize| usize::from(u16::from_be_bytes([fixed[at], fixed[at + 1]]));
    // Ignores malformed boxes, because vendors add boxes in unknown forms.
    let boxed = |kind: &[u8; 4]| Boxes(boxes).flatten().find(|(found, _)| found == kind).map(|(_, body)| body);
    let record = boxed(record).unwrap_or_default();
    let colours = boxed(b"colr").and_then(colours);
    // A decoder needs no record for VP9.
    let extradata = if codec == Codec::Vp9 { &[] } else { record };
    let (width, height) = (size(SIZE), size(SIZE + 2));
    if width == 0 || height == 0 {
        return Err("has frames without a size".to_owned());
    }
    if width * height > swm_image::MAX_PIXELS {
        return Err(format!("has frames of {width} x {height} pixels, more than {}", swm_image::MAX_PIXELS));
    }
    Ok(Description { codec, extradata: extradata.into(), colours, width, height })
}

/// Reads a box of colours, which numbers primaries, transfer and matrix, and in its newer form states the range.
fn colours(colr: &[u8]) -> Option<Colours> {
    let (kind, [_, _, _, _, high, low, rest @ ..]) = colr.split_first_chunk::<4>()? else { return None };
    let full = match kind {
        b"nclx" => Some(rest.first()? & 128 != 0),
        b"nclc" => None,
        _ => return None,
    };
    Some(Colours { matrix: u16::from_be_bytes([*high, *low]), full })
}

/// The most encoded frames of a video: 38 hours at 60 frames per second. A few bytes of a file can state any number.
const MOST_SAMPLES: usize = 1 << 23;
/// The most bytes of an encoded frame: those of its pixels with four channels of 16 bits, twice, and room for headers.
const fn largest_sample(pixels: usize) -> usize {
    16 * pixels + (1 << 20)
}

/// Reads all samples, in decoding order, of a track whose frames have `pixels` pixels in a file of `length` bytes.
pub(super) fn samples(stbl: &[u8], pixels: usize, length: u64) -> Result<Vec<Sample>> {
    let mut samples = sizes(stbl, pixels, length)?;
    set_times(stbl, &mut samples)?;
    set_keys(stbl, &mut samples)?;
    set_offsets(stbl, &mut samples, length)?;
    Ok(samples)
}

/// Returns a table that every track has.
fn table<'a>(stbl: &'a [u8], kind: &[u8; 4]) -> Result<&'a [u8]> {
    find(stbl, kind)?.ok_or(format!("lacks its table '{}'", kind.escape_ascii()))
}

/// The bits of a size in a table, and the number of sizes that follow.
fn width_and_count(sizes: &mut Integers<'_>, is_compact: bool) -> Result<(u32, usize)> {
    if !is_compact {
        return Ok((32, sizes.count(4)?));
    }
    let (width, count) = (sizes.u32()? & 255, sizes.u32()? as usize);
    if !matches!(width, 4 | 8 | 16) {
        return Err(format!("has sizes of {width} bits, expected 4, 8 or 16"));
    }
    match (count as u64 * u64::from(width)).div_ceil(8) > sizes.0.len() as u64 {
        true => Err("has a table that is cut short".to_owned()),
        false => Ok((width, count)),
    }
}

/// Reads the sizes of the samples, from their table or its compact form.
fn sizes(stbl: &[u8], pixels: usize, length: u64) -> Result<Vec<Sample>> {
    let compact = find(stbl, b"stz2")?;
    let (_, mut sizes) = versioned(match compact {
        Some(compact) => compact,
        None => table(stbl, b"stsz")?,
    })?;
    let common_size = if compact.is_some() { 0 } else { sizes.u32()? };
    let (width, count) = match common_size {
        0 => width_and_count(&mut sizes, compact.is_some())?,
        _ => (0, sizes.u32()? as usize),
    };
    if count > MOST_SAMPLES {
        return Err(format!("states {count} frames, more than {MOST_SAMPLES}; cut it into shorter videos"));
    }
    if common_size != 0 && u64::from(common_size) * count as u64 > length {
        return Err("is shorter than its frames".to_owned());
    }
    let mut samples = vec![Sample { offset: 0, size: common_size, time: 0, key: false }; count];
    let list = sizes.0;
    for (i, sample) in samples.iter_mut().enumerate() {
        sample.size = match width {
            4 => u32::from(list[i / 2] >> (4 * (1 - i % 2)) & 15),
            8 => u32::from(list[i]),
            16 => u32::from(u16::from_be_bytes([list[2 * i], list[2 * i + 1]])),
            32 => sizes.u32()?,
            _ => common_size,
        };
        if sample.size as usize > largest_sample(pixels) {
            let (size, most) = (sample.size, largest_sample(pixels));
            return Err(format!("states an encoded frame of {size} bytes, more than {most} for {pixels} pixels"));
        }
    }
    Ok(samples)
}

/// Reads the decoding times, and the offsets from decoding times to presentation times.
fn set_times(stbl: &[u8], samples: &mut [Sample]) -> Result<()> {
    let (_, mut durations) = versioned(table(stbl, b"stts")?)?;
    let (mut at, mut time) = (0, 0_i64);
    for _ in 0..durations.count(8)? {
        let (n, duration) = (durations.u32()? as usize, durations.u32()?);
        for sample in samples.iter_mut().skip(at).take(n) {
            sample.time = time;
            time = time.saturating_add(duration.into());
        }
        at = at.saturating_add(n);
    }
    if at < samples.len() {
        return Err("has frames without a time".to_owned());
    }
    let Some(ctts) = find(stbl, b"ctts")? else { return Ok(()) };
    let (_, mut shifts) = versioned(ctts)?;
    let mut at = 0_usize;
    for _ in 0..shifts.count(8)? {
        // Version 0 is unsigned by the standard, but writers of negative offsets exist.
        let (n, shift) = (shifts.u32()? as usize, shifts.i32()?);
        let shifted = samples.iter_mut().skip(at).take(n);
        shifted.for_each(|sample| sample.time = sample.time.saturating_add(shift.into()));
        at = at.saturating_add(n);
    }
    Ok(())
}

/// Marks the key frames that a table lists. Without this table, every sample is a key frame.
fn set_keys(stbl: &[u8], samples: &mut [Sample]) -> Result<()> {
    let Some(stss) = find(stbl, b"stss")? else {
        samples.iter_mut().for_each(|sample| sample.key = true);
        return Ok(());
    };
    let (_, mut keys) = versioned(stss)?;
    for _ in 0..keys.count(4)? {
        let number = keys.u32()? as usize;
        let sample = number.checked_sub(1).and_then(|i| samples.get_mut(i));
        sample.ok_or("names a key frame that does not exist")?.key = true;
    }
    Ok(())
}

/// Reads the positions. Samples follow each other within a chunk; a table holds the offsets of the chunks.
fn set_offsets(stbl: &[u8], samples: &mut [Sample], length: u64) -> Result<()> {
    let (wide, chunks) = match find(stbl, b"stco")? {
        Some(stco) => (false, stco),
        None => (true, table(stbl, b"co64")?),
    };
    let (_, mut chunks) = versioned(chunks)?;
    let n = chunks.count(if wide { 8 } else { 4 })?;
    let (_, mut table) = versioned(table(stbl, b"stsc")?)?;
    // Runs of chunks: the first chunk (from 1), the number of samples per chunk, and the number of the description (from 1),
    // of which there is one.
    let mut runs = vec![];
    for _ in 0..table.count(12)? {
        runs.push((table.u32()? as usize, table.u32()? as usize));
        match table.u32()? {
            0 | 1 => {}
            other => {
                return Err(format!("has frames of its description {other} of the codec, and has one description"));
            }
        }
    }
    let (mut run, mut at) = (0, 0);
    for chunk in 1..=n {
        while runs.get(run + 1).is_some_and(|&(first, _)| first <= chunk) {
            run += 1;
        }
        let per_chunk = runs.get(run).map_or(0, |&(_, samples)| samples);
        let mut offset = if wide { chunks.u64()? } else { chunks.u32()?.into() };
        for sample in samples.iter_mut().skip(at).take(per_chunk) {
            sample.offset = offset;
            offset = offset.checked_add(sample.size.into()).ok_or("has a frame beyond its end")?;
            if offset > length {
                return Err("ends before its last frame".to_owned());
            }
        }
        at = at.saturating_add(per_chunk);
    }
    if at < samples.len() {
        return Err("has frames without a position".to_owned());
    }
    Ok(())
}
