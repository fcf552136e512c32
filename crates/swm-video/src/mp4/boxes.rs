//! The boxes of MP4 files, and the integers in them.

use super::Result;

/// Iterates over the boxes within a box.
pub(super) struct Boxes<'a>(pub(super) &'a [u8]);

impl<'a> Iterator for Boxes<'a> {
    type Item = Result<([u8; 4], &'a [u8])>;

    fn next(&mut self) -> Option<Self::Item> {
        let (&[a, b, c, d, k, i, n, e], rest) = self.0.split_first_chunk::<8>()?;
        let kind = [k, i, n, e];
        let (size, body) = match u32::from_be_bytes([a, b, c, d]) {
            0 => (rest.len(), rest),
            1 => {
                let Some((large, body)) = rest.split_first_chunk::<8>() else { return self.cut(kind) };
                (usize::try_from(u64::from_be_bytes(*large).saturating_sub(16)).unwrap_or(usize::MAX), body)
            }
            size => ((size as usize).saturating_sub(8), rest),
        };
        match body.split_at_checked(size) {
            Some((body, rest)) => {
                self.0 = rest;
                Some(Ok((kind, body)))
            }
            None => self.cut(kind),
        }
    }
}

impl<'a> Boxes<'a> {
    fn cut(&mut self, kind: [u8; 4]) -> Option<Result<([u8; 4], &'a [u8])>> {
        self.0 = &[];
        Some(Err(format!("has a box '{}' that is cut short", kind.escape_ascii())))
    }
}

/// Returns the first box of a kind.
pub(super) fn find<'a>(parent: &'a [u8], kind: &[u8; 4]) -> Result<Option<&'a [u8]>> {
    for child in Boxes(parent) {
        let (found, body) = child?;
        if found == *kind {
            return Ok(Some(body));
        }
    }
    Ok(None)
}

/// Reads big-endian integers in sequence.
pub(super) struct Integers<'a>(pub(super) &'a [u8]);

impl Integers<'_> {
    pub(super) fn bytes<const N: usize>(&mut self) -> Result<[u8; N]> {
        let (first, rest) = self.0.split_first_chunk::<N>().ok_or("has a table that is cut short")?;
        self.0 = rest;
        Ok(*first)
    }

    pub(super) fn u32(&mut self) -> Result<u32> {
        Ok(u32::from_be_bytes(self.bytes()?))
    }

    pub(super) fn u64(&mut self) -> Result<u64> {
        Ok(u64::from_be_bytes(self.bytes()?))
    }

    pub(super) fn i32(&mut self) -> Result<i32> {
        Ok(i32::from_be_bytes(self.bytes()?))
    }

    pub(super) fn i64(&mut self) -> Result<i64> {
        Ok(i64::from_be_bytes(self.bytes()?))
    }

    /// Returns the number of entries that follow, each of `size` bytes.
    pub(super) fn count(&mut self, size: usize) -> Result<usize> {
        let count = self.u32()? as usize;
        if count.checked_mul(size).is_none_or(|bytes| bytes > self.0.len()) {
            return Err("has a table that is cut short".to_owned());
        }
        Ok(count)
    }
}

/// Reads the version and the flags at the start of a box. Returns the version, and the integers after the flags.
pub(super) fn versioned(body: &[u8]) -> Result<(u8, Integers<'_>)> {
    let mut integers = Integers(body);
    let [version, ..] = integers.bytes::<4>()?;
    Ok((version, integers))
}
