//! A baseline JPEG decoder for pictures of simulated worlds, to the last bit as libjpeg (and so Pillow, OpenCV and
//! torchvision) decodes them.
//!
//! Most of such a picture is flat, and flat squares are cheap here: one that repeats the square before is recognised
//! by its bits alone, one of a single colour amid its like is filled without transform, upsampling or conversion.
//! What is taken is what datasets hold: ITU-T T.81 baseline in YCbCr, colour at full (4:4:4) or half resolution
//! (4:2:0), no restart intervals. Everything else, and everything damaged, is left to a general decoder.

use super::{
    ZIGZAG,
    colour::{self, Samples},
    transform::{self, Block},
};
use std::cell::RefCell;

/// Bits that index the tables of codes. Longer codes are rare and searched for.
const INDEX: u32 = 10;

/// What the next bits of a scan mean, in one register. From the lowest bit: 5 bits, the length of the code, with its
/// coefficient's bits where those are among the ones looked up, and 0 for a code that is longer than [`INDEX`]; 4, how
/// many bits of the coefficient follow; 7, the zeros before it, [`END`] after the last one of a block; 16, the
/// coefficient.
#[derive(Clone, Copy, Default, PartialEq, Eq)]
struct Entry(u32);

/// More zeros than a block holds.
const END: u32 = 64;

impl Entry {
    const fn new(length: u32, more: u32, run: u32, value: i32) -> Self {
        Self((value as u32) << 16 | run << 9 | more << 5 | length)
    }

    #[inline(always)]
    const fn length(self) -> u32 {
        self.0 & 31
    }

    #[inline(always)]
    const fn more(self) -> u32 {
        self.0 >> 5 & 15
    }

    #[inline(always)]
    const fn run(self) -> u32 {
        self.0 >> 9 & 127
    }

    #[inline(always)]
    const fn value(self) -> i32 {
        self.0 as i32 >> 16
    }
}

/// A Huffman table, ready to be looked up.
struct Codes {
    entries: [Entry; 1 << INDEX],
    /// For every length, the first code of it (in the upper bits of 16) that is none, and what to add to a code for the
    /// place of its symbol.
    ends: [u32; 17],
    offsets: [i32; 17],
    symbols: [u8; 256],
}

impl Codes {
    /// From the body of a DHT segment: 16 counts and the symbols. `None` when it is no table.
    fn new(counts: &[u8; 16], symbols: &[u8], ac: bool) -> Option<Self> {
        let mut codes =
            Self { entries: [Entry::default(); 1 << INDEX], ends: [0; 17], offsets: [0; 17], symbols: [0; 256] };
        codes.symbols.get_mut(..symbols.len())?.copy_from_slice(symbols);
        let (mut code, mut place) = (0_u32, 0_usize);
        for length in 1..=16_u32 {
            let count = u32::from(counts[length as usize - 1]);
            codes.offsets[length as usize] = place as i32 - code as i32;
            for _ in 0..count {
                let symbol = *symbols.get(place)?;
                if length <= INDEX {
                    codes.enter(code, length, symbol, ac)?;
                } else if !ac && symbol > 11 {
                    return None;
                }
                code += 1;
                place += 1;
            }
            if code > 1 << length {
                return None;
            }
            codes.ends[length as usize] = code << (16 - length);
            code <<= 1;
        }
        Some(codes)
    }

    /// Enters a short code under every index that begins with it.
    fn enter(&mut self, code: u32, length: u32, symbol: u8, ac: bool) -> Option<()> {
        let free = INDEX - length;
        let first = (code << free) as usize;
        let (run, size) = meaning(symbol, ac)?;
        for (rest, entry) in (0..).zip(self.entries.get_mut(first..first + (1 << free))?) {
            *entry = if size <= free {
                Entry::new(length + size, 0, run, extended(rest >> (free - size), size))
            } else {
                Entry::new(length, size, run, 0)
            };
        }
        Some(())
    }

    /// What a code of more than [`INDEX`] bits means, that the 16 bits `next` begin with.
    #[cold]
    fn search(&self, next: u32, ac: bool) -> Option<Entry> {
        let length = (INDEX + 1..=16).find(|&length| next < self.ends[length as usize])?;
        let place = (next >> (16 - length)) as i32 + self.offsets[length as usize];
        let (run, size) = meaning(*self.symbols.get(usize::try_from(place).ok()?)?, ac)?;
        Some(Entry::new(length, size, run, 0))
    }
}

/// A symbol's zeros, and the bits of its coefficient, sections F.1.2.1 and F.1.2.2. `None` for those that baseline has
/// not.
fn meaning(symbol: u8, ac: bool) -> Option<(u32, u32)> {
    let (run, size) = (u32::from(symbol >> 4), u32::from(symbol & 15));
    match (ac, run, size) {
        (false, 0, 0..=11) | (true, _, 1..=10) | (true, 15, 0) => Some((run, size)),
        (true, 0, 0) => Some((END, 0)),
        _ => None,
    }
}

/// A coefficient of `size` bits, table F.1: those that begin with 0 are negative.
#[inline(always)]
fn extended(bits: u32, size: u32) -> i32 {
    let bits = bits as i32;
    if size > 0 && bits < 1 << (size - 1) { bits - (1 << size) + 1 } else { bits }
}

/// The entropy-coded bytes of a scan, as bits.
struct Bits<'a> {
    bytes: &'a [u8],
    at: usize,
    /// The next bits, from the top.
    held: u64,
    count: u32,
    /// How many of those held were made up beyond the end.
    beyond: u32,
}

impl Bits<'_> {
    /// Makes sure that at least 32 bits are held.
    #[inline(always)]
    fn refill(&mut self) {
        if self.count < 32 {
            self.read();
        }
    }

    #[inline(always)]
    fn read(&mut self) {
        if let Some(&next) = self.bytes.get(self.at..).and_then(<[u8]>::first_chunk::<8>) {
            let next = u64::from_be_bytes(next);
            // A byte of ones has its upper bit set, and carries into it when one is added to its other seven.
            let ones = (next & 0x7f7f_7f7f_7f7f_7f7f) + 0x0101_0101_0101_0101;
            if ones & next & 0x8080_8080_8080_8080 == 0 {
                self.held |= next >> self.count;
                let taken = (63 - self.count) / 8;
                self.at += taken as usize;
                self.count += taken * 8;
                // Bits of the byte that was not taken come again.
                self.held &= !0 << (64 - self.count);
                return;
            }
        }
        self.read_bytes();
    }

    /// Byte by byte, over those of ones and their zeros, and as far beyond the end as is asked for.
    fn read_bytes(&mut self) {
        while self.count <= 56 {
            let byte = match self.bytes.get(self.at..) {
                Some([0xff, 0, ..]) => {
                    self.at += 2;
                    0xff
                }
                Some([0xff, ..] | []) | None => {
                    self.beyond += 8;
                    0
                }
                Some([byte, ..]) => {
                    self.at += 1;
                    *byte
                }
            };
            self.held |= u64::from(byte) << (56 - self.count);
            self.count += 8;
        }
    }

    #[inline(always)]
    fn skip(&mut self, n: u32) {
        self.held <<= n;
        self.count -= n;
    }

    /// What the next code means.
    #[inline(always)]
    fn entry(&mut self, codes: &Codes, ac: bool) -> Option<Entry> {
        self.refill();
        let mut entry = codes.entries[(self.held >> (64 - INDEX)) as usize];
        if entry.length() == 0 {
            entry = codes.search((self.held >> 48) as u32, ac)?;
        }
        self.skip(entry.length());
        Some(entry)
    }

    /// The coefficient of an entry.
    #[inline(always)]
    fn value(&mut self, entry: Entry) -> i32 {
        let size = entry.more();
        if size == 0 {
            return entry.value();
        }
        let value = extended((self.held >> (64 - size)) as u32, size);
        self.skip(size);
        value
    }

    /// Reads the coefficients of a block after the first, times their steps. Whether there was one; `None` when there
    /// are too many.
    #[inline(always)]
    fn others(&mut self, codes: &Codes, order: &[Step; 64], to: &mut Block) -> Option<bool> {
        let mut place = 0;
        loop {
            let entry = self.entry(codes, true)?;
            let next = place + entry.run() as usize + 1;
            let Some(step) = order.get(next) else {
                return (entry.run() == END).then_some(place > 0);
            };
            place = next;
            to[usize::from(step.at) % 64] = (self.value(entry) * i32::from(step.size)) as i16;
            if place == 63 {
                return Some(true);
            }
        }
    }
}

/// A coefficient's place in a [`Block`] and its step.
#[derive(Clone, Copy, Default)]
struct Step {
    at: u8,
    size: u8,
}

/// Bodies of DHT segments, and what became of them: for brightness and colour, first and other coefficients.
type Tables = [[Option<(Vec<u8>, Box<Codes>)>; 2]; 2];

/// What is kept from one picture to the next: memory, and tables, which are mostly the same.
#[derive(Default)]
struct Scratch {
    tables: Tables,
    planes: [Vec<u8>; 3],
    squares: Vec<Square>,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}

/// A square of blocks that are coded together, where each plane is flat.
#[derive(Clone, Copy, PartialEq, Eq)]
struct Square {
    luma: Option<u8>,
    colour: Option<[u8; 2]>,
}

/// Decodes a picture of `height` by `width` into `out`, RGB.
///
/// Returns `false`, with `out` in any state, when the picture is of another size or kind, or damaged.
pub fn decode(bytes: &[u8], height: usize, width: usize, out: &mut [u8]) -> bool {
    if out.len() != height * width * 3 || out.is_empty() {
        return false;
    }
    SCRATCH.with_borrow_mut(|scratch| {
        let Some((header, scan)) = Header::read(bytes, scratch) else { return false };
        (header.height, header.width) == (height, width) && header.decode(scan, scratch, out).is_some()
    })
}

/// What is said before the scan.
#[derive(Default)]
struct Header {
    height: usize,
    width: usize,
    /// Pixels of brightness for one of colour, in both directions: 1 or 2; 0 until it was said.
    share: usize,
    /// Steps of the coefficients in the order of a scan, and which of them each plane uses.
    steps: [Option<[Step; 64]>; 4],
    uses: [usize; 3],
}

impl Header {
    /// Reads segments up to the scan's bytes; tables go to `scratch`.
    fn read<'a>(bytes: &'a [u8], scratch: &mut Scratch) -> Option<(Self, &'a [u8])> {
        let mut header = Self::default();
        let mut rest = bytes.strip_prefix(&[0xff, 0xd8])?;
        let mut given = [[false; 2]; 2];
        loop {
            let (&[0xff, marker, high, low], _) = rest.split_first_chunk::<4>()? else { return None };
            let length = usize::from(u16::from_be_bytes([high, low]));
            let body = rest.get(4..2 + length)?;
            rest = &rest[2 + length..];
            match marker {
                0xc0 => header.frame(body)?,
                0xc4 => huffman(body, &mut scratch.tables, &mut given)?,
                0xda if header.share > 0 && given == [[true; 2]; 2] => {
                    // Brightness by the first tables, both colours by the second.
                    return (body == [3, 1, 0x00, 2, 0x11, 3, 0x11, 0, 63, 0]).then_some((header, rest));
                }
                0xdb => header.quantisation(body)?,
                // JFIF and other programs' notes; a comment. Not Adobe's, which may change the meaning of the planes.
                0xe0..=0xed | 0xef | 0xfe => {}
                _ => return None,
            }
        }
    }

    fn frame(&mut self, body: &[u8]) -> Option<()> {
        let &[8, h1, h0, w1, w0, 3, 1, sampling, y, 2, 0x11, u, 3, 0x11, v] = body else { return None };
        self.share = match sampling {
            0x11 => 1,
            0x22 => 2,
            _ => return None,
        };
        self.height = u16::from_be_bytes([h1, h0]).into();
        self.width = u16::from_be_bytes([w1, w0]).into();
        self.uses = [y, u, v].map(usize::from);
        // libjpeg repeats colours of pictures this narrow instead of weighing them.
        (self.height > 0 && self.width > if self.share == 2 { 4 } else { 0 }).then_some(())
    }

    fn quantisation(&mut self, mut body: &[u8]) -> Option<()> {
        while let Some((&[id], rest)) = body.split_first_chunk() {
            let (values, rest) = rest.split_first_chunk::<64>()?;
            // The upper half is 0 for steps of one byte.
            let table = self.steps.get_mut(usize::from(id))?.insert([Step::default(); 64]);
            values.iter().zip(ZIGZAG).zip(table).for_each(|((&size, at), step)| *step = Step { at, size });
            body = rest;
        }
        Some(())
    }

    /// Decodes the scan; `None` when it is damaged.
    fn decode(&self, scan: &[u8], scratch: &mut Scratch, out: &mut [u8]) -> Option<()> {
        #[cfg(target_arch = "x86_64")]
        {
            /// The same code as elsewhere, compiled for AVX2.
            #[target_feature(enable = "avx2,bmi2")]
            fn wide(header: &Header, scan: &[u8], scratch: &mut Scratch, out: &mut [u8]) -> Option<()> {
                header.squares(scan, scratch, |block, to, stride| transform::avx2::transform(block, to, stride))?;
                header.paint(
                    scratch,
                    |y, u, v, out| colour::avx2::convert(y, u, v, out),
                    |y, us, vs, out| colour::avx2::convert_halved(y, us, vs, out),
                    out,
                )
            }
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("bmi2") {
                // SAFETY: the function is safe code; that the processor knows its instructions was just asked.
                #[allow(unsafe_code)]
                return unsafe { wide(self, scan, scratch, out) };
            }
        }
        self.squares(scan, scratch, transform::transform)?;
        self.paint(scratch, colour::convert, colour::convert_halved, out)
    }

    /// Squares down and across.
    fn grid(&self) -> (usize, usize) {
        (self.height.div_ceil(8 * self.share), self.width.div_ceil(8 * self.share))
    }

    /// Fills the planes.
    #[inline(always)]
    fn squares(&self, scan: &[u8], scratch: &mut Scratch, transform: impl Fn(&Block, &mut [u8], usize)) -> Option<()> {
        let (down, across) = self.grid();
        let blocks = self.share * self.share;
        let [Some(y), Some(u), Some(v)] = self.uses.map(|i| self.steps.get(i).and_then(Option::as_ref)) else {
            return None;
        };
        let steps = [y, u, v];
        let [[Some((_, dc0)), Some((_, ac0))], [Some((_, dc1)), Some((_, ac1))]] = &scratch.tables else { return None };
        let tables = [[&**dc0, &**ac0], [&**dc1, &**ac1], [&**dc1, &**ac1]];
        let side = 8 * self.share;
        let strides = [across * side + MARGIN, MARGIN + across * 8 + MARGIN, MARGIN + across * 8 + MARGIN];
        for ((plane, stride), side) in scratch.planes.iter_mut().zip(strides).zip([side, 8, 8]) {
            plane.resize(down * side * stride, 0);
        }
        scratch.squares.clear();
        let repeated = repeated(&tables, blocks);
        let mut bits = Bits { bytes: scan, at: 0, held: 0, count: 0, beyond: 0 };
        let mut previous = [0_i32; 3];
        let mut coefficients = [0; 64];
        // What the square before was, where it was flat throughout.
        let mut last = Square { luma: None, colour: None };
        for row in 0..down {
            for column in 0..across {
                bits.refill();
                let flat = matches!(last, Square { luma: Some(_), colour: Some(_) });
                if flat && repeated.is_some_and(|(code, length)| bits.held >> (64 - length) == code) {
                    bits.skip(repeated?.1);
                    let values = [last.luma?, last.colour?[0], last.colour?[1]];
                    let [y, u, v] = &mut scratch.planes;
                    let at = (row * strides[0] + column) * side;
                    if side == 16 {
                        fill::<16>(&mut y[at..], strides[0], values[0]);
                    } else {
                        fill::<8>(&mut y[at..], strides[0], values[0]);
                    }
                    let at = row * 8 * strides[1] + MARGIN + column * 8;
                    fill::<8>(&mut u[at..], strides[1], values[1]);
                    fill::<8>(&mut v[at..], strides[2], values[2]);
                    scratch.squares.push(last);
                    continue;
                }
                let mut flats = [None; 6];
                for (block, flat) in flats.iter_mut().enumerate().take(blocks + 2) {
                    let plane = block.saturating_sub(blocks - 1);
                    let [dc, ac] = tables[plane];
                    let entry = bits.entry(dc, false)?;
                    previous[plane] = i32::from((previous[plane] + bits.value(entry)) as i16);
                    let first = (previous[plane] * i32::from(steps[plane][0].size)) as i16;
                    let others = bits.others(ac, steps[plane], &mut coefficients)?;
                    let stride = strides[plane];
                    let at = match plane {
                        0 => {
                            (row * self.share + block / self.share) * 8 * stride
                                + (column * self.share + block % self.share) * 8
                        }
                        _ => row * 8 * stride + MARGIN + column * 8,
                    };
                    let to = &mut scratch.planes[plane][at..];
                    if !others {
                        let value = (((i32::from(first) + 4) >> 3) + 128).clamp(0, 255) as u8;
                        *flat = Some(value);
                        fill::<8>(to, stride, value);
                    } else {
                        coefficients[0] = first;
                        transform(&coefficients, to, stride);
                        coefficients = [0; 64];
                    }
                }
                let luma = flats[0].filter(|_| flats[..blocks].iter().all(|flat| *flat == flats[0]));
                let colour = flats[blocks].zip(flats[blocks + 1]).map(|(u, v)| [u, v]);
                last = Square { luma, colour };
                scratch.squares.push(last);
            }
            if bits.count < bits.beyond {
                return None;
            }
        }
        // The last byte is filled with ones; then the picture must end, for what follows is another scan or damage.
        let held = (bits.count - bits.beyond) / 8;
        let left = bits.bytes.get(bits.at..)?;
        (held == 0 && left.starts_with(&[0xff, 0xd9])).then_some(())
    }

    /// Planes to RGB, square by square.
    #[inline(always)]
    fn paint(
        &self,
        scratch: &mut Scratch,
        convert: impl Fn(&Samples, &Samples, &Samples, &mut [u8; 48]),
        convert_halved: impl Fn(&Samples, [&Samples; 2], [&Samples; 2], &mut [u8; 48]),
        out: &mut [u8],
    ) -> Option<()> {
        let (down, across) = self.grid();
        let (high, wide) = (self.height.div_ceil(self.share), self.width.div_ceil(self.share));
        let (side, stride) = (8 * self.share, MARGIN + across * 8 + MARGIN);
        for plane in &mut scratch.planes[1..] {
            for line in plane.chunks_exact_mut(stride) {
                line[MARGIN - 1] = line[MARGIN];
                line[MARGIN + wide] = line[MARGIN + wide - 1];
            }
        }
        let Scratch { planes: [y, u, v], squares, .. } = scratch;
        for row in 0..down {
            let lines = row * side..((row + 1) * side).min(self.height);
            for column in 0..across {
                let n = side.min(self.width - column * side) * 3;
                let mut pixels = [0; 48];
                let alone = self.alone(squares, row, column);
                if let Some([y, u, v]) = alone {
                    convert(&[y; 16], &[u; 16], &[v; 16], &mut pixels);
                }
                for line in lines.clone() {
                    let to = &mut out[(line * self.width + column * side) * 3..][..n];
                    if alone.is_none() {
                        let y = y[line * (across * side + MARGIN) + column * side..].first_chunk()?;
                        if self.share == 1 {
                            let at = line * stride + column * 8 + MARGIN;
                            convert(y, u[at..].first_chunk()?, v[at..].first_chunk()?, &mut pixels);
                        } else {
                            let near = line / 2;
                            let next = if line % 2 == 0 { near.saturating_sub(1) } else { (near + 1).min(high - 1) };
                            let near = near * stride + column * 8 + MARGIN - 1;
                            let next = next * stride + column * 8 + MARGIN - 1;
                            let us = [u[near..].first_chunk()?, u[next..].first_chunk()?];
                            let vs = [v[near..].first_chunk()?, v[next..].first_chunk()?];
                            if let Ok(to) = <&mut [u8; 48]>::try_from(&mut *to) {
                                convert_halved(y, us, vs, to);
                                continue;
                            }
                            convert_halved(y, us, vs, &mut pixels);
                        }
                    }
                    if let Ok(to) = <&mut [u8; 48]>::try_from(&mut *to) {
                        *to = pixels;
                    } else {
                        to.copy_from_slice(&pixels[..n]);
                    }
                }
            }
        }
        Some(())
    }

    /// The colour of a square that has only one.
    #[inline(always)]
    fn alone(&self, squares: &[Square], row: usize, column: usize) -> Option<[u8; 3]> {
        let (down, across) = self.grid();
        let square = squares[row * across + column];
        let (luma, colour) = (square.luma?, square.colour?);
        // Colour at half resolution is weighed with its neighbours'.
        if self.share == 2 {
            for row in row.saturating_sub(1)..(row + 2).min(down) {
                for column in column.saturating_sub(1)..(column + 2).min(across) {
                    if squares[row * across + column].colour != Some(colour) {
                        return None;
                    }
                }
            }
        }
        Some([luma, colour[0], colour[1]])
    }
}

/// Reads tables, unless they are those of the picture before.
fn huffman(mut body: &[u8], tables: &mut Tables, given: &mut [[bool; 2]; 2]) -> Option<()> {
    while let Some((&id, rest)) = body.split_first() {
        let (class, which) = (usize::from(id >> 4), usize::from(id & 15));
        let counts = rest.first_chunk::<16>()?;
        let total: usize = counts.iter().map(|&n| usize::from(n)).sum();
        let all = rest.get(..16 + total)?;
        let slot = tables.get_mut(which)?.get_mut(class)?;
        if slot.as_ref().is_none_or(|(known, _)| known != all) {
            *slot = Some((all.to_vec(), Box::new(Codes::new(counts, &all[16..], class == 1)?)));
        }
        given[which][class] = true;
        body = &rest[16 + total..];
    }
    Some(())
}

/// The bits of a square whose blocks are all as the blocks before them, and flat; and their number. `None` if they are
/// too many to be compared at once.
fn repeated(tables: &[[&Codes; 2]; 3], blocks: usize) -> Option<(u64, u32)> {
    let code = |codes: &Codes, run: u32| {
        let is = |entry: &Entry| (1..=INDEX).any(|length| *entry == Entry::new(length, 0, run, 0));
        let index = codes.entries.iter().position(is)?;
        let length = codes.entries[index].length();
        Some((index as u64 >> (INDEX - length), length))
    };
    let (mut all, mut bits) = (0_u64, 0);
    for plane in std::iter::repeat_n(0, blocks).chain([1, 2]) {
        for (codes, run) in tables[plane].iter().zip([0, END]) {
            let (code, length) = code(codes, run)?;
            all = all << length | code;
            bits += length;
            if bits > 32 {
                return None;
            }
        }
    }
    Some((all, bits))
}

#[inline(always)]
fn fill<const N: usize>(to: &mut [u8], stride: usize, value: u8) {
    for i in 0..N {
        to[i * stride..][..N].copy_from_slice(&[value; N]);
    }
}

/// Samples beside the planes: those of colour repeat their outermost ones there, so that every sample has neighbours.
const MARGIN: usize = 8;

#[cfg(test)]
mod tests {
    use super::super::encode;
    use super::{Header, Scratch, decode};
    use std::path::Path;

    /// A name, the file, height and width, and the pixels.
    type Picture = (String, Vec<u8>, [usize; 2], Vec<u8>);

    /// The pictures that Pillow wrote, and what it decodes them to (`tests/interop/jpeg_export.py`).
    fn pictures() -> Vec<Picture> {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/interop/jpeg");
        let mut paths: Vec<_> =
            std::fs::read_dir(folder).expect("pictures").map(|e| e.expect("entry").path()).collect();
        paths.retain(|path| path.extension().is_some_and(|extension| extension == "jpg"));
        paths.sort();
        let read = |path: &Path| {
            let png = std::fs::File::open(path.with_extension("png")).expect("a picture");
            let mut reader = png::Decoder::new(std::io::BufReader::new(png)).read_info().expect("PNG");
            let (height, width) = (reader.info().height as usize, reader.info().width as usize);
            let mut rgb = vec![0; height * width * 3];
            reader.next_frame(&mut rgb).expect("PNG");
            let name = path.file_stem().expect("a name").to_string_lossy().into_owned();
            (name, std::fs::read(path).expect("a picture"), [height, width], rgb)
        };
        paths.iter().map(|path| read(path)).collect()
    }

    /// As [`decode`], without AVX2.
    fn decode_plainly(bytes: &[u8], out: &mut [u8]) -> Option<()> {
        let mut scratch = Scratch::default();
        let (header, scan) = Header::read(bytes, &mut scratch)?;
        header.squares(scan, &mut scratch, super::transform::transform)?;
        header.paint(&mut scratch, super::colour::convert, super::colour::convert_halved, out)
    }

    #[test]
    fn every_bit_is_pillows() {
        let pictures = pictures();
        assert_eq!(pictures.len(), 11);
        for (name, bytes, [height, width], expected) in pictures {
            let mut out = vec![0; expected.len()];
            let taken = decode(&bytes, height, width, &mut out);
            assert_eq!(taken, !name.starts_with("other"), "{name}");
            if taken {
                assert!(out == expected, "{name}");
                out.fill(0);
                assert_eq!(decode_plainly(&bytes, &mut out), Some(()), "{name}");
                assert!(out == expected, "{name} without AVX2");
            }
            // The general decoder takes the others, and rounds elsewhere.
            crate::decode(&bytes, height, width, &mut out).expect("a picture");
            let off: u32 = out.iter().zip(&expected).map(|(a, b)| u32::from(a.abs_diff(*b))).sum();
            assert!(f64::from(off) / (expected.len() as f64) < 3.0, "{name}: {off}");
            assert!(!decode(&bytes, width, height, &mut out), "{name} has another size");
        }
    }

    /// Squares that are flat, alike and not, at every place of a picture of every size.
    #[test]
    fn patches_decode_alike_with_and_without_avx2() {
        let mut seed = 1_u32;
        let mut next = move |n: u32| {
            seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (seed >> 16) % n
        };
        for round in 0..60 {
            let (height, width) = (1 + next(70) as usize, 5 + next(70) as usize);
            let mut rgb = [200, 180, 160].repeat(height * width);
            for _ in 0..next(6) {
                let (y, x) = (next(height as u32) as usize, next(width as u32) as usize);
                let colour = [next(256), next(256), next(256)].map(|value| value as u8);
                for line in rgb.chunks_exact_mut(width * 3).skip(y).take(1 + next(30) as usize) {
                    line.as_chunks_mut::<3>().0.iter_mut().skip(x).take(17).for_each(|pixel| *pixel = colour);
                }
            }
            let mut bytes = vec![];
            encode(&rgb, height as u16, width as u16, 90, &mut bytes);
            let (mut fast, mut plain) = (vec![0; rgb.len()], vec![0; rgb.len()]);
            assert!(decode(&bytes, height, width, &mut fast), "round {round}");
            assert_eq!(decode_plainly(&bytes, &mut plain), Some(()), "round {round}");
            assert!(fast == plain, "round {round}: {height} x {width}");
        }
    }

    #[test]
    fn damage_is_refused_or_decoded_and_never_panics() {
        let pictures = pictures();
        let mut out = vec![0; 112 * 112 * 3];
        for (name, bytes, [height, width], _) in &pictures {
            let out = &mut out[..height * width * 3];
            for cut in (0..bytes.len()).step_by(3) {
                assert!(!decode(&bytes[..cut], *height, *width, out), "{name} cut at {cut}");
            }
            let mut damaged = bytes.clone();
            for at in (2..bytes.len()).step_by(5) {
                for change in [0xff, 0x01, 0x80] {
                    damaged[at] ^= change;
                    decode(&damaged, *height, *width, out);
                    damaged[at] = bytes[at];
                }
            }
            assert_eq!(
                decode(bytes, *height, *width, out),
                !name.starts_with("other"),
                "{name} after the damaged ones"
            );
        }
    }
}
