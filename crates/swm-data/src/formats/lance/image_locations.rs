//! Where the encoded pictures of a column lie in a data file, so that any of them is one read away.
//!
//! Lance's own decoder plans every read anew: for a batch of single pictures that takes longer than decoding them. Its
//! "full zip" pages, which it writes for values of this size, are simple enough to be read directly: a buffer of
//! values, each after its length, and a buffer of where each row ends. Everything else is left to Lance.

use bytes::Bytes;
use lance_encoding::decoder::{ColumnInfo, PageEncoding, PageInfo};
use lance_encoding::format::metadata::compressive_encoding::Compression;
use lance_encoding::format::metadata::full_zip_layout::Details;
use lance_encoding::format::metadata::page_layout::Layout;
use std::ops::Range;

/// The places of all pictures of one column in one data file.
pub struct Places {
    pages: Vec<Page>,
}

struct Page {
    /// The first row, in the file.
    first: u64,
    rows: u64,
    /// Where the values are, in the file.
    values: Range<u64>,
    /// Where each row begins in `values`, and the last ends: little-endian numbers of `width` bytes.
    bounds: Bytes,
    width: usize,
    /// Bytes of the length before each value.
    prefix: usize,
}

impl Places {
    /// Reads the places, `None` where the column is not laid out so. `read` gives bytes of the file.
    ///
    /// # Errors
    /// What `read` fails with.
    pub fn read<E>(
        column: &ColumnInfo,
        file_size: u64,
        mut read: impl FnMut(&[Range<u64>]) -> Result<Vec<Bytes>, E>,
    ) -> Result<Option<Self>, E> {
        let Some(layouts) = column.page_infos.iter().map(|page| layout(page, file_size)).collect::<Option<Vec<_>>>()
        else {
            return Ok(None);
        };
        let wanted: Vec<Range<u64>> = layouts.iter().map(|layout| layout.bounds.clone()).collect();
        let mut first = 0;
        let mut pages = vec![];
        for (layout, bounds) in layouts.into_iter().zip(read(&wanted)?) {
            let Zip { values, rows, width, prefix, .. } = layout;
            pages.push(Page { first, rows, values, bounds, width, prefix });
            first += rows;
        }
        Ok(Some(Self { pages }))
    }

    /// Where the picture of a row of the file is, after [`Self::prefix`] bytes that state its length; `None` where the
    /// stored bounds contradict each other or the file is shorter.
    pub fn find(&self, row: u64) -> Option<Place> {
        let page = &self.pages[self.pages.partition_point(|page| page.first <= row).checked_sub(1)?];
        let row = row - page.first;
        if row >= page.rows {
            return None;
        }
        let (start, end) = (page.bound(row)?, page.bound(row + 1)?);
        let length = end.checked_sub(start)?.checked_sub(page.prefix as u64)?;
        let bytes = page.values.start + start..page.values.start + end;
        (bytes.end <= page.values.end).then_some(Place { bytes, prefix: page.prefix, length })
    }
}

impl Page {
    fn bound(&self, row: u64) -> Option<u64> {
        let at = usize::try_from(row).ok()?.checked_mul(self.width)?;
        let bytes = self.bounds.get(at..at + self.width)?;
        let mut number = [0; 8];
        number[..self.width].copy_from_slice(bytes);
        Some(u64::from_le_bytes(number))
    }
}

/// Where one picture is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Place {
    /// Its bytes in the file, the stated length before it included.
    pub bytes: Range<u64>,
    /// Bytes of the stated length.
    pub prefix: usize,
    /// The length that it must state.
    length: u64,
}

impl Place {
    /// The encoded picture in the bytes at this place; `None` when they state another length.
    pub fn picture<'a>(&self, bytes: &'a [u8]) -> Option<&'a [u8]> {
        let (stated, picture) = bytes.split_at_checked(self.prefix)?;
        let mut number = [0; 8];
        number[..self.prefix].copy_from_slice(stated);
        (u64::from_le_bytes(number) == self.length && picture.len() as u64 == self.length).then_some(picture)
    }
}

/// What a page of plain full-zip values says of itself.
struct Zip {
    rows: u64,
    values: Range<u64>,
    bounds: Range<u64>,
    width: usize,
    prefix: usize,
}

fn layout(page: &PageInfo, file_size: u64) -> Option<Zip> {
    let PageEncoding::Structural(structure) = &page.encoding else { return None };
    let Some(Layout::FullZipLayout(zip)) = &structure.layout else { return None };
    // No missing values, no lists: nothing stands between the rows.
    let items = u64::from(zip.num_items);
    if zip.bits_rep != 0 || zip.bits_def != 0 || items != page.num_rows || u64::from(zip.num_visible_items) != items {
        return None;
    }
    let Some(Details::BitsPerOffset(bits @ (32 | 64))) = zip.details else { return None };
    // Values as they came.
    let Some(Compression::Variable(variable)) = zip.value_compression.as_ref()?.compression.as_ref() else {
        return None;
    };
    let Some(Compression::Flat(_)) = variable.offsets.as_ref()?.compression.as_ref() else { return None };
    if variable.values.is_some() {
        return None;
    }
    let [values, bounds] = page.buffer_offsets_and_sizes[..] else { return None };
    let range = |(start, size): (u64, u64)| Some(start..start.checked_add(size).filter(|&end| end <= file_size)?);
    let (values, bounds) = (range(values)?, range(bounds)?);
    let (size, numbers) = (bounds.end - bounds.start, items.checked_add(1)?);
    let width = size / numbers;
    if size % numbers != 0 || !matches!(width, 1 | 2 | 4 | 8) {
        return None;
    }
    Some(Zip { rows: items, values, bounds, width: width as usize, prefix: bits as usize / 8 })
}
