//! [`Buffer`]: bytes at a 64-byte aligned address, as SIMD code and array views require.

/// 64 bytes at an address that is a multiple of 64.
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C, align(64))]
struct Line([u8; 64]);

/// Bytes at a 64-byte aligned address.
#[derive(Clone, Default)]
pub(super) struct Buffer {
    lines: Vec<Line>,
    len: usize,
}

impl Buffer {
    /// The number of bytes.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Changes the number of bytes; new bytes are zero. Memory stays allocated.
    pub fn resize(&mut self, len: usize) {
        if len < self.len {
            // The removed bytes must be zero after a later call that grows the buffer again.
            self.bytes_mut()[len..].fill(0);
        }
        self.lines.resize(len.div_ceil(64), Line([0; 64]));
        self.len = len;
    }

    /// Allocates memory for `len` bytes; returns whether there is enough.
    pub fn reserve(&mut self, len: usize) -> bool {
        let missing = len.div_ceil(64).saturating_sub(self.lines.len());
        self.lines.try_reserve_exact(missing).is_ok()
    }

    /// The bytes.
    pub fn bytes(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.lines)[..self.len]
    }

    /// The bytes, for writing.
    pub fn bytes_mut(&mut self) -> &mut [u8] {
        &mut bytemuck::cast_slice_mut(&mut self.lines)[..self.len]
    }
}
