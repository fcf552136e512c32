//! The entropy-coded bytes of a scan, read as bits.

use super::huffman::{END_OF_BLOCK, Entry, HuffmanTable, INDEX_BITS, sign_extend};
use super::inverse_dct::Block;

/// The position of a coefficient in a [`Block`] and its quantisation step.
#[derive(Clone, Copy, Default)]
pub struct Step {
    pub position: u8,
    pub size: u8,
}

/// A reader of the bits of a scan, in order.
pub struct BitReader<'a> {
    bytes: &'a [u8],
    /// Index of the next byte to load.
    next: usize,
    /// Loaded bits; the highest bit is the next to read.
    buffer: u64,
    /// The number of loaded bits.
    count: u32,
    /// The number of loaded bits that stand for bytes beyond the end; these bits are 0.
    beyond: u32,
}

impl<'a> BitReader<'a> {
    pub const fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, next: 0, buffer: 0, count: 0, beyond: 0 }
    }

    /// Loads bits until at least 32 are loaded.
    #[inline(always)]
    pub fn refill(&mut self) {
        if self.count < 32 {
            self.load();
        }
    }

    #[inline(always)]
    fn load(&mut self) {
        if let Some(&next) = self.bytes.get(self.next..).and_then(<[u8]>::first_chunk::<8>) {
            let next = u64::from_be_bytes(next);
            // A byte 0xff has its highest bit set, and adding 1 to its seven lower bits carries into the highest bit.
            let ones = (next & 0x7f7f_7f7f_7f7f_7f7f) + 0x0101_0101_0101_0101;
            if ones & next & 0x8080_8080_8080_8080 == 0 {
                self.buffer |= next >> self.count;
                let taken = (63 - self.count) / 8;
                self.next += taken as usize;
                self.count += taken * 8;
                // Clears the bits of the partial byte at the end, which the next load reads again.
                self.buffer &= !0 << (64 - self.count);
                return;
            }
        }
        self.load_bytes();
    }

    /// Loads bits byte by byte. Skips the zero that follows a byte 0xff, and loads zeros beyond the end.
    fn load_bytes(&mut self) {
        while self.count <= 56 {
            let byte = match self.bytes.get(self.next..) {
                Some([0xff, 0, ..]) => {
                    self.next += 2;
                    0xff
                }
                Some([0xff, ..] | []) | None => {
                    self.beyond += 8;
                    0
                }
                Some([byte, ..]) => {
                    self.next += 1;
                    *byte
                }
            };
            self.buffer |= u64::from(byte) << (56 - self.count);
            self.count += 8;
        }
    }

    /// Skips `n` loaded bits.
    #[inline(always)]
    pub fn skip(&mut self, n: u32) {
        self.buffer <<= n;
        self.count -= n;
    }

    /// Returns whether the next `length` loaded bits are `code`.
    #[inline(always)]
    pub const fn starts_with(&self, (code, length): (u64, u32)) -> bool {
        self.buffer >> (64 - length) == code
    }

    /// Reads the next Huffman code. Returns `None` if the table does not contain it.
    #[inline(always)]
    pub fn entry(&mut self, table: &HuffmanTable, is_ac: bool) -> Option<Entry> {
        self.refill();
        let mut entry = table.entries[(self.buffer >> (64 - INDEX_BITS)) as usize];
        if entry.length() == 0 {
            entry = table.search((self.buffer >> 48) as u32, is_ac)?;
        }
        self.skip(entry.length());
        Some(entry)
    }

    /// Returns the coefficient of an entry. Reads the bits of the coefficient that the entry does not contain.
    #[inline(always)]
    pub fn value(&mut self, entry: Entry) -> i32 {
        let size = entry.extra_bits();
        if size == 0 {
            return entry.value();
        }
        let value = sign_extend((self.buffer >> (64 - size)) as u32, size);
        self.skip(size);
        value
    }

    /// Reads the AC coefficients of a block, times their quantisation steps, into `to`. Returns whether the block has
    /// AC coefficients, or `None` when it has more than 63 or a code is invalid.
    #[inline(always)]
    pub fn ac_coefficients(&mut self, table: &HuffmanTable, steps: &[Step; 64], to: &mut Block) -> Option<bool> {
        let mut k = 0;
        loop {
            let entry = self.entry(table, true)?;
            let next = k + entry.run() as usize + 1;
            let Some(step) = steps.get(next) else {
                return (entry.run() == END_OF_BLOCK).then_some(k > 0);
            };
            k = next;
            to[usize::from(step.position) % 64] = (self.value(entry) * i32::from(step.size)) as i16;
            if k == 63 {
                return Some(true);
            }
        }
    }

    /// Returns whether bits were read beyond the end of the scan.
    pub const fn is_past_end(&self) -> bool {
        self.count < self.beyond
    }

    /// Returns whether the end marker of the image follows the bits that were read. Padding may fill the last byte.
    pub fn is_at_end_of_image(&self) -> bool {
        let loaded_bytes = (self.count - self.beyond) / 8;
        loaded_bytes == 0 && self.bytes.get(self.next..).is_some_and(|left| left.starts_with(&[0xff, 0xd9]))
    }
}
