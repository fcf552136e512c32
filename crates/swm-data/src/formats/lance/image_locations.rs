//! Locations of the encoded images of a column within a data file, so that each image can be read directly.
//!
//! Lance's decoder plans every read anew; for a batch of single images, planning takes longer than decoding. Lance
//! stores values as large as images in "full zip" pages, which have a simple layout: a buffer of values, each with a
//! length prefix, and a buffer of row bounds. Columns with pages of any other layout are read with Lance's decoder.

use bytes::Bytes;
use lance_encoding::decoder::{ColumnInfo, PageEncoding, PageInfo};
use lance_encoding::format::metadata::compressive_encoding::Compression;
use lance_encoding::format::metadata::full_zip_layout::Details;
use lance_encoding::format::metadata::page_layout::Layout;
use std::ops::Range;

/// Locations of all images of one column in one data file.
pub struct ImageLocations {
    pages: Vec<Page>,
}

struct Page {
    /// First row of the page, counted within the file.
    first: u64,
    rows: u64,
    /// Byte range of the values within the file.
    values: Range<u64>,
    /// Start of each row within `values`, then the end of the last row: little-endian integers of `width` bytes.
    bounds: Bytes,
    width: usize,
    /// Size of the length prefix of each value, in bytes.
    prefix: usize,
}

impl ImageLocations {
    /// Reads the locations; `None` if a page of the column is not a full-zip page. `read` returns byte ranges of the
    /// file.
    ///
    /// # Errors
    /// If `read` fails.
    pub fn read<E>(
        column: &ColumnInfo,
        file_size: u64,
        mut read: impl FnMut(&[Range<u64>]) -> Result<Vec<Bytes>, E>,
    ) -> Result<Option<Self>, E> {
        let Some(layouts) = column.page_infos.iter().map(|page| layout(page, file_size)).collect::<Option<Vec<_>>>()
        else {
            return Ok(None);
        };
        let bound_ranges: Vec<Range<u64>> = layouts.iter().map(|layout| layout.bounds.clone()).collect();
        let mut first = 0;
        let mut pages = vec![];
        for (layout, bounds) in layouts.into_iter().zip(read(&bound_ranges)?) {
            let FullZipPage { values, rows, width, prefix, .. } = layout;
            pages.push(Page { first, rows, values, bounds, width, prefix });
            first += rows;
        }
        Ok(Some(Self { pages }))
    }

    /// The location of the image in a row of the file; `None` if the stored bounds are inconsistent or exceed the file.
    pub fn find(&self, row: u64) -> Option<ImageLocation> {
        let page = &self.pages[self.pages.partition_point(|page| page.first <= row).checked_sub(1)?];
        let row = row - page.first;
        if row >= page.rows {
            return None;
        }
        let (start, end) = (page.bound(row)?, page.bound(row + 1)?);
        let length = end.checked_sub(start)?.checked_sub(page.prefix as u64)?;
        let bytes = page.values.start + start..page.values.start + end;
        (bytes.end <= page.values.end).then_some(ImageLocation { bytes, prefix: page.prefix, length })
    }
}

impl Page {
    fn bound(&self, row: u64) -> Option<u64> {
        let at = usize::try_from(row).ok()?.checked_mul(self.width)?;
        let bytes = self.bounds.get(at..at + self.width)?;
        let mut padded = [0; 8];
        padded[..self.width].copy_from_slice(bytes);
        Some(u64::from_le_bytes(padded))
    }
}

/// Location of one image.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ImageLocation {
    /// Byte range within the file, including the length prefix.
    pub bytes: Range<u64>,
    /// Size of the length prefix in bytes.
    pub prefix: usize,
    /// Expected value of the length prefix.
    length: u64,
}

impl ImageLocation {
    /// Extracts the encoded image from the bytes of this location; `None` if the length prefix differs from the bounds.
    pub fn image<'a>(&self, bytes: &'a [u8]) -> Option<&'a [u8]> {
        let (stored_length, image) = bytes.split_at_checked(self.prefix)?;
        let mut padded = [0; 8];
        padded[..self.prefix].copy_from_slice(stored_length);
        (u64::from_le_bytes(padded) == self.length && image.len() as u64 == self.length).then_some(image)
    }
}

/// Layout of a page of plain full-zip values.
struct FullZipPage {
    rows: u64,
    values: Range<u64>,
    bounds: Range<u64>,
    width: usize,
    prefix: usize,
}

fn layout(page: &PageInfo, file_size: u64) -> Option<FullZipPage> {
    let PageEncoding::Structural(structure) = &page.encoding else { return None };
    let Some(Layout::FullZipLayout(zip)) = &structure.layout else { return None };
    // Requires a page without nulls and lists.
    let items = u64::from(zip.num_items);
    if zip.bits_rep != 0 || zip.bits_def != 0 || items != page.num_rows || u64::from(zip.num_visible_items) != items {
        return None;
    }
    let Some(Details::BitsPerOffset(bits @ (32 | 64))) = zip.details else { return None };
    // Requires uncompressed values.
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
    let (size, bounds_count) = (bounds.end - bounds.start, items.checked_add(1)?);
    let width = size / bounds_count;
    if size % bounds_count != 0 || !matches!(width, 1 | 2 | 4 | 8) {
        return None;
    }
    Some(FullZipPage { rows: items, values, bounds, width: width as usize, prefix: bits as usize / 8 })
}
