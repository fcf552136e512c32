//! Huffman tables of the JPEG decoder, as lookups by the next bits of a scan.

/// Bits that index the lookup table. Longer codes are rare and found by a search.
pub const INDEX_BITS: u32 = 10;

/// Zero run that marks the end of a block: more zeros than a block holds.
pub const END_OF_BLOCK: u32 = 64;

/// The meaning of the next bits of a scan, packed into one register.
///
/// Fields from the lowest bit:
/// - 5 bits: the length of the code, plus the length of the coefficient if both fit into the index; 0 for a code that
///   is longer than [`INDEX_BITS`].
/// - 4 bits: the number of bits of the coefficient that follow the code.
/// - 7 bits: the number of zeros before the coefficient, or [`END_OF_BLOCK`].
/// - 16 bits: the coefficient.
#[derive(Clone, Copy, Default, PartialEq, Eq)]
pub struct Entry(u32);

impl Entry {
    pub const fn new(length: u32, extra_bits: u32, run: u32, value: i32) -> Self {
        Self((value as u32) << 16 | run << 9 | extra_bits << 5 | length)
    }

    #[inline(always)]
    pub const fn length(self) -> u32 {
        self.0 & 31
    }

    #[inline(always)]
    pub const fn extra_bits(self) -> u32 {
        self.0 >> 5 & 15
    }

    #[inline(always)]
    pub const fn run(self) -> u32 {
        self.0 >> 9 & 127
    }

    #[inline(always)]
    pub const fn value(self) -> i32 {
        self.0 as i32 >> 16
    }
}

/// A Huffman table prepared for lookup.
pub struct HuffmanTable {
    pub entries: [Entry; 1 << INDEX_BITS],
    /// For every length, the first 16-bit prefix beyond the codes of that length.
    ends: [u32; 17],
    /// For every length, the offset from a code of that length to the index of its symbol.
    offsets: [i32; 17],
    symbols: [u8; 256],
}

impl HuffmanTable {
    /// Builds a table from the body of a DHT segment: 16 counts and the symbols. Returns `None` when the body is
    /// invalid.
    pub fn new(counts: &[u8; 16], symbols: &[u8], is_ac: bool) -> Option<Self> {
        let mut table =
            Self { entries: [Entry::default(); 1 << INDEX_BITS], ends: [0; 17], offsets: [0; 17], symbols: [0; 256] };
        table.symbols.get_mut(..symbols.len())?.copy_from_slice(symbols);
        let (mut code, mut index) = (0_u32, 0_usize);
        for length in 1..=16_u32 {
            let count = u32::from(counts[length as usize - 1]);
            table.offsets[length as usize] = index as i32 - code as i32;
            for _ in 0..count {
                let symbol = *symbols.get(index)?;
                if length <= INDEX_BITS {
                    table.insert(code, length, symbol, is_ac)?;
                } else if !is_ac && symbol > 11 {
                    return None;
                }
                code += 1;
                index += 1;
            }
            if code > 1 << length {
                return None;
            }
            table.ends[length as usize] = code << (16 - length);
            code <<= 1;
        }
        Some(table)
    }

    /// Inserts a short code under every index that begins with it.
    fn insert(&mut self, code: u32, length: u32, symbol: u8, is_ac: bool) -> Option<()> {
        let free = INDEX_BITS - length;
        let first = (code << free) as usize;
        let (run, size) = run_and_size(symbol, is_ac)?;
        for (rest, entry) in (0..).zip(self.entries.get_mut(first..first + (1 << free))?) {
            *entry = if size <= free {
                Entry::new(length + size, 0, run, sign_extend(rest >> (free - size), size))
            } else {
                Entry::new(length, size, run, 0)
            };
        }
        Some(())
    }

    /// Finds the code of more than [`INDEX_BITS`] bits that the 16 bits `next` begin with.
    #[cold]
    pub fn search(&self, next: u32, is_ac: bool) -> Option<Entry> {
        let length = (INDEX_BITS + 1..=16).find(|&length| next < self.ends[length as usize])?;
        let index = (next >> (16 - length)) as i32 + self.offsets[length as usize];
        let (run, size) = run_and_size(*self.symbols.get(usize::try_from(index).ok()?)?, is_ac)?;
        Some(Entry::new(length, size, run, 0))
    }
}

/// Returns the zero run and the coefficient size of a symbol, sections F.1.2.1 and F.1.2.2. Returns `None` for symbols
/// that baseline JPEG does not have.
fn run_and_size(symbol: u8, is_ac: bool) -> Option<(u32, u32)> {
    let (run, size) = (u32::from(symbol >> 4), u32::from(symbol & 15));
    match (is_ac, run, size) {
        (false, 0, 0..=11) | (true, _, 1..=10) | (true, 15, 0) => Some((run, size)),
        (true, 0, 0) => Some((END_OF_BLOCK, 0)),
        _ => None,
    }
}

/// Returns the coefficient that `size` bits encode, table F.1. Bits that begin with 0 encode a negative coefficient.
#[inline(always)]
pub fn sign_extend(bits: u32, size: u32) -> i32 {
    let bits = bits as i32;
    if size > 0 && bits < 1 << (size - 1) { bits - (1 << size) + 1 } else { bits }
}
