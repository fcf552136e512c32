//! NumPy's `.npz` files: zip archives of `.npy` arrays.
//!
//! Reading verifies the archive's checksums and supports stored and deflated members, as `numpy.savez` and
//! `numpy.savez_compressed` write them. Writing stores members uncompressed.

use crate::formats::stored_scalar::{Class, StoredScalar};
use std::fs::File;
use std::io::{BufReader, BufWriter, Read as _, Write};
use std::path::{Path, PathBuf};
use swm_core::{ColumnSpec, DType, Error, Result, files};
use zip::write::SimpleFileOptions;
use zip::{ZipArchive, ZipWriter};

/// The member that holds the array passed to `numpy.savez(file, array)`.
const ARRAY: &str = "arr_0.npy";
/// The first bytes of a `.npy` array.
const MAGIC: &[u8] = b"\x93NUMPY";
/// Maximum compression ratio of deflate. An archive that declares a higher ratio is damaged.
const MAX_COMPRESSION: u64 = 1032;
/// The compression ratio up to which a member of any size is read.
const USUAL_COMPRESSION: u64 = 128;
/// The size in bytes up to which a member of any ratio is read, such as a column of zeros.
const ALWAYS_READ: u64 = 1 << 30;

/// The header of a `.npy` array.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Header {
    /// Type of the elements; `None` for text and objects.
    pub stored: Option<StoredScalar>,
    /// Shape of the array; the first axis counts rows.
    pub shape: Vec<usize>,
    /// Whether the first axis changes fastest in the file (Fortran order), as NumPy stores a transposed array.
    pub column_major: bool,
}

impl Header {
    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.shape.first().copied().unwrap_or(1)
    }

    /// The description of the array as a column, or `None` if the elements are not numeric.
    pub fn spec(&self, name: &str) -> Option<ColumnSpec> {
        let dtype = self.stored?.dtype()?;
        Some(ColumnSpec::new(name, dtype, self.shape.get(1..).unwrap_or_default()))
    }
}

/// An open archive.
pub(crate) struct Npz {
    path: PathBuf,
    archive: ZipArchive<BufReader<File>>,
    /// The size of the file, in bytes.
    bytes: u64,
}

impl Npz {
    /// Opens an archive.
    ///
    /// # Errors
    /// If the file does not exist or is damaged.
    pub fn open(path: &Path) -> Result<Self> {
        let file = files::open(path)?;
        let bytes = file.metadata().map_err(|error| Error::io(path, "reading the size", error))?.len();
        let archive = ZipArchive::new(BufReader::new(file)).map_err(|e| damaged(path, e))?;
        Ok(Self { path: path.to_owned(), archive, bytes })
    }

    /// Returns whether the archive has a member of this name.
    pub fn has(&self, member: &str) -> bool {
        self.archive.index_for_name(member).is_some()
    }

    /// Returns whether the archive has only one member.
    pub fn is_plain(&self) -> bool {
        self.archive.len() == 1
    }

    /// The bytes of a member.
    ///
    /// # Errors
    /// If the member does not exist or is damaged.
    pub fn member(&mut self, member: &str) -> Result<Vec<u8>> {
        let path = self.path.clone();
        let mut file = self.archive.by_name(member).map_err(|e| damaged(&path, format!("{member}: {e}")))?;
        let (size, compressed) = (file.size(), file.compressed_size());
        if compressed > self.bytes {
            let problem = format!("{member} takes {compressed} bytes, more than the {} of the file", self.bytes);
            return Err(damaged(&path, problem));
        }
        if size / MAX_COMPRESSION > compressed || size > ALWAYS_READ.saturating_add(USUAL_COMPRESSION * compressed) {
            return Err(damaged(
                &path,
                format!("{member} takes {compressed} bytes, and would be {size} bytes in memory"),
            ));
        }
        let mut bytes = vec![];
        let fits = usize::try_from(size).is_ok_and(|size| bytes.try_reserve_exact(size).is_ok());
        if !fits {
            return Err(damaged(&path, format!("{member} has {size} bytes, more than the free memory")));
        }
        // The archive's checksum is compared at the end of the member, so the byte after the last one is read as well.
        file.by_ref().take(size + 1).read_to_end(&mut bytes).map_err(|e| damaged(&path, format!("{member}: {e}")))?;
        if bytes.len() as u64 != size {
            return Err(damaged(&path, format!("{member} is not {size} bytes long")));
        }
        Ok(bytes)
    }

    /// Returns the size of a member as the archive states it, in bytes.
    fn size(&mut self, member: &str) -> Option<u64> {
        Some(self.archive.by_name(member).ok()?.size())
    }

    /// Reads the header of the array.
    ///
    /// # Errors
    /// If there is no array, or the array is damaged.
    pub fn header(&mut self) -> Result<Header> {
        Ok(self.parsed()?.0)
    }

    /// Reads the first `most` bytes of the elements, as the file stores them, or all if there are fewer.
    ///
    /// # Errors
    /// As [`Npz::header`].
    pub fn first_bytes(&mut self, most: usize) -> Result<Vec<u8>> {
        let (_, begin) = self.parsed()?;
        let path = self.path.clone();
        let file = self.archive.by_name(ARRAY).map_err(|e| damaged(&path, format!("{ARRAY}: {e}")))?;
        let mut start = vec![];
        let end = begin.saturating_add(most) as u64;
        file.take(end).read_to_end(&mut start).map_err(|e| damaged(&path, format!("{ARRAY}: {e}")))?;
        Ok(start.split_off(begin.min(start.len())))
    }

    /// Reads the header of the array, and the offset of the elements.
    fn parsed(&mut self) -> Result<(Header, usize)> {
        let path = self.path.clone();
        let file = self.archive.by_name(ARRAY).map_err(|e| damaged(&path, format!("{ARRAY}: {e}")))?;
        let mut start = vec![];
        file.take(1 << 16).read_to_end(&mut start).map_err(|e| damaged(&path, format!("{ARRAY}: {e}")))?;
        parse(&start).map_err(|problem| damaged(&path, problem))
    }

    /// Reads the header of the array, and the elements, converted to the type [`StoredScalar::dtype`].
    ///
    /// # Errors
    /// If there is no array, its elements are not numeric, or the array is damaged.
    pub fn array(&mut self) -> Result<(Header, Vec<u8>)> {
        let (header, mut start) = self.parsed()?;
        let Some((stored, dtype)) = header.stored.and_then(|stored| Some((stored, stored.dtype()?))) else {
            return Err(damaged(&self.path, "its elements are not numeric"));
        };
        let stated = self.size(ARRAY).unwrap_or(0).saturating_sub(start as u64);
        let count = header.shape.iter().try_fold(1_usize, |n, &side| n.checked_mul(side));
        let Some(count) = count.filter(|n| n.checked_mul(stored.size).map(|bytes| bytes as u64) == Some(stated)) else {
            return Err(damaged(&self.path, format!("{stated} bytes do not fit an array of shape {:?}", header.shape)));
        };
        let mut bytes = self.member(ARRAY)?;
        if header.column_major {
            bytes = row_major(&bytes[start..], &header.shape, stored.size);
            start = 0;
        }
        if stored.is_plain() {
            bytes.drain(..start);
            return Ok((header, bytes));
        }
        let mut converted = vec![0; count * dtype.size()];
        stored.convert(&bytes[start..], &mut converted).map_err(|problem| damaged(&self.path, problem))?;
        Ok((header, converted))
    }
}

fn damaged(path: &Path, problem: impl std::fmt::Display) -> Error {
    Error::corrupt(path, problem.to_string(), "restore the file from a copy, or rebuild the dataset")
}

/// Parses a header. Returns the header and the offset of the elements.
fn parse(bytes: &[u8]) -> Result<(Header, usize), String> {
    let truncated = || "the array's header is truncated".to_owned();
    let (start, length) = match bytes.get(..12).ok_or_else(truncated)? {
        [0x93, b'N', b'U', b'M', b'P', b'Y', 1, _, a, b, ..] => (10, u32::from(u16::from_le_bytes([*a, *b]))),
        [0x93, b'N', b'U', b'M', b'P', b'Y', 2 | 3, _, a, b, c, d] => (12, u32::from_le_bytes([*a, *b, *c, *d])),
        _ => return Err("it is not a NumPy array".to_owned()),
    };
    let end = usize::try_from(length).ok().and_then(|length| length.checked_add(start)).ok_or_else(truncated)?;
    let text = std::str::from_utf8(bytes.get(start..end).ok_or_else(truncated)?).map_err(|e| e.to_string())?;
    let field = |name: &str| {
        let (_, rest) = text.split_once(&format!("'{name}':"))?;
        Some(rest.trim_start())
    };
    let start: String = text.trim_end().chars().take(200).collect();
    let invalid = || format!("the array's header is invalid: {start}");
    let column_major = match field("fortran_order").ok_or_else(invalid)? {
        order if order.starts_with("False") => false,
        order if order.starts_with("True") => true,
        _ => return Err(invalid()),
    };
    let shape = field("shape").and_then(|rest| rest.strip_prefix('(')?.split_once(')')).ok_or_else(invalid)?.0;
    let shape: Result<Vec<usize>, _> =
        shape.split(',').map(str::trim).filter(|side| !side.is_empty()).map(str::parse).collect();
    // A structured type is a list; any other type is a quoted string.
    let descr = field("descr").and_then(|rest| rest.strip_prefix('\'')?.split_once('\'')).map(|(descr, _)| descr);
    Ok((Header { stored: descr.and_then(scalar_type), shape: shape.map_err(|_| invalid())?, column_major }, end))
}

/// Returns the elements of an array in row-major order, given those in column-major order.
///
/// # Shapes
/// `bytes` are the elements of `size` bytes of an array of shape `shape`.
fn row_major(bytes: &[u8], shape: &[usize], size: usize) -> Vec<u8> {
    let mut out = Vec::with_capacity(bytes.len());
    // The number of elements between two neighbours along each axis.
    let strides: Vec<usize> = (0..shape.len()).map(|axis| shape[..axis].iter().product()).collect();
    let mut index = vec![0; shape.len()];
    let mut from = 0;
    while out.len() < bytes.len() {
        out.extend_from_slice(&bytes[from * size..(from + 1) * size]);
        for axis in (0..shape.len()).rev() {
            index[axis] += 1;
            from += strides[axis];
            if index[axis] < shape[axis] {
                break;
            }
            from -= strides[axis] * shape[axis];
            index[axis] = 0;
        }
    }
    out
}

/// Parses a numeric NumPy type, such as `<f4`.
fn scalar_type(descr: &str) -> Option<StoredScalar> {
    let (order, rest) = descr.split_at_checked(1)?;
    let (class, size) = rest.split_at_checked(1)?;
    let class = match class {
        "b" => Class::Bool,
        "i" => Class::Signed,
        "u" => Class::Unsigned,
        "f" => Class::Float,
        _ => return None,
    };
    let stored = StoredScalar { class, size: size.parse().ok()?, big_endian: order == ">" };
    stored.dtype().map(|_| stored)
}

/// Writes an archive of an array and other members.
pub(crate) struct NpzWriter {
    path: PathBuf,
    zip: ZipWriter<BufWriter<File>>,
}

impl NpzWriter {
    /// Creates an archive, replacing an existing file.
    ///
    /// # Errors
    /// If writing fails.
    pub fn create(path: &Path) -> Result<Self> {
        let file = files::open_to_write(path, false)?;
        Ok(Self { path: path.to_owned(), zip: ZipWriter::new(BufWriter::with_capacity(1 << 20, file)) })
    }

    /// Adds the array with shape `[rows, shape…]`, whose bytes are the concatenation of `parts`.
    ///
    /// # Errors
    /// If writing fails.
    pub fn array(&mut self, dtype: DType, rows: usize, shape: &[usize], parts: &[&[u8]]) -> Result<()> {
        let header = npy_header(dtype, rows, shape);
        let all: Vec<&[u8]> = std::iter::once(&*header).chain(parts.iter().copied()).collect();
        self.add_member(ARRAY, &all)
    }

    /// Adds a member.
    ///
    /// # Errors
    /// If writing fails.
    pub fn member(&mut self, name: &str, bytes: &[u8]) -> Result<()> {
        self.add_member(name, &[bytes])
    }

    fn add_member(&mut self, name: &str, parts: &[&[u8]]) -> Result<()> {
        let options = SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored).large_file(true);
        self.zip.start_file(name, options).map_err(|e| Error::io(&self.path, "writing a column file", e.into()))?;
        for part in parts {
            self.zip.write_all(part).map_err(|e| Error::io(&self.path, "writing a column file", e))?;
        }
        Ok(())
    }

    /// Completes the archive and syncs it to disk.
    ///
    /// # Errors
    /// If writing fails.
    pub fn finish(self) -> Result<()> {
        let fail = |e| Error::io(&self.path, "completing a column file", e);
        let buffered = self.zip.finish().map_err(|e| fail(e.into()))?;
        buffered.into_inner().map_err(|e| fail(e.into_error()))?.sync_all().map_err(fail)
    }
}

fn npy_header(dtype: DType, rows: usize, shape: &[usize]) -> Vec<u8> {
    let descr = match dtype {
        DType::Bool => "|b1",
        DType::U8 => "|u1",
        DType::Int32 => "<i4",
        DType::Int64 => "<i8",
        DType::Float32 => "<f4",
        DType::Float64 => "<f8",
    };
    let sides: String = std::iter::once(rows).chain(shape.iter().copied()).map(|side| format!("{side},")).collect();
    let mut text = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({sides}), }}");
    // The elements start at a multiple of 64 bytes.
    let length = (10 + text.len() + 1).next_multiple_of(64) - 10;
    text.extend(std::iter::repeat_n(' ', length - 1 - text.len()));
    text.push('\n');
    let mut header = MAGIC.to_vec();
    header.extend([1, 0]);
    header.extend((length as u16).to_le_bytes());
    header.extend(text.as_bytes());
    header
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn npz_arrays_and_members_round_trip() {
        let folder = tempfile::tempdir().expect("creating a temporary folder");
        let path = folder.path().join("a.npz");
        let mut writer = NpzWriter::create(&path).expect("creating the archive");
        writer.array(DType::Int32, 3, &[2], &[&[1; 8], &[2; 16]]).expect("writing to the archive");
        writer.member("note", b"hello").expect("writing to the archive");
        writer.finish().expect("completing the archive");
        let mut npz = Npz::open(&path).expect("opening the archive");
        let (header, bytes) = npz.array().expect("reading the array");
        assert_eq!((header.rows(), header.spec("a")), (3, Some(ColumnSpec::new("a", DType::Int32, [2]))));
        assert_eq!(header.stored, Some(StoredScalar::of(DType::Int32)));
        assert_eq!((&bytes[..8], &bytes[8..]), (&[1; 8][..], &[2; 16][..]));
        assert_eq!(npz.header().expect("reading the header"), header);
        assert_eq!(npz.member("note").expect("reading the member"), b"hello");
        assert!(npz.has("note") && !npz.has("other") && npz.member("other").is_err());
    }

    #[test]
    fn members_are_no_larger_than_the_file() {
        let folder = tempfile::tempdir().expect("creating a temporary folder");
        let path = folder.path().join("a.npz");
        let mut writer = NpzWriter::create(&path).expect("creating the archive");
        writer.member("note", b"hello").expect("writing to the archive");
        writer.finish().expect("completing the archive");
        let mut bytes = std::fs::read(&path).expect("reading the archive");
        let entry = bytes.windows(4).position(|window| window == b"PK\x01\x02").expect("a central directory");
        // Both sizes of the member, compressed and not.
        for at in [entry + 20, entry + 24] {
            bytes[at..at + 4].copy_from_slice(&0x7fff_ffff_u32.to_le_bytes());
        }
        std::fs::write(&path, bytes).expect("writing the archive");
        let error = Npz::open(&path).and_then(|mut npz| npz.member("note")).expect_err("a damaged archive").to_string();
        assert!(error.contains("takes 2147483647 bytes, more than the"), "{error}");
    }

    /// Writes an archive of one deflated array with the given header and elements.
    fn deflated(path: &Path, header: &str, elements: &mut dyn std::io::Read) {
        let mut zip = ZipWriter::new(File::create(path).expect("a file"));
        let options =
            SimpleFileOptions::default().compression_method(zip::CompressionMethod::Deflated).large_file(true);
        zip.start_file(ARRAY, options).expect("a member");
        let start = [b"\x93NUMPY\x01\x00", &(header.len() as u16).to_le_bytes()[..], header.as_bytes()].concat();
        zip.write_all(&start).expect("a header");
        std::io::copy(elements, &mut zip).expect("elements");
        zip.finish().expect("an archive");
    }

    #[test]
    fn arrays_of_zeros_are_read_up_to_a_limit() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.npz");
        let header = |rows: u64| format!("{{'descr': '|u1', 'fortran_order': False, 'shape': ({rows},), }}");
        deflated(&path, &header(1 << 40), &mut std::io::repeat(0).take(1 << 20));
        let error = Npz::open(&path).and_then(|mut npz| npz.array()).expect_err("a shape without elements").to_string();
        assert!(error.contains("do not fit an array"), "{error}");
        deflated(&path, &header(1 << 20), &mut std::io::repeat(0).take(1 << 20));
        assert_eq!(Npz::open(&path).and_then(|mut npz| npz.array()).expect("zeros").1.len(), 1 << 20);
        // A member of 3 GiB of zeros would take long to write, so its stated sizes are replaced in both headers.
        let mut bytes = std::fs::read(&path).expect("an archive");
        let (large, small) = ((3_u64 << 30) + 60, (1_u64 << 20) + header(1 << 20).len() as u64 + 10);
        let at: Vec<usize> =
            bytes.windows(8).enumerate().filter(|(_, w)| *w == small.to_le_bytes()).map(|(i, _)| i).collect();
        for at in at {
            bytes[at..at + 8].copy_from_slice(&large.to_le_bytes());
        }
        std::fs::write(&path, bytes).expect("an archive");
        assert!(Npz::open(&path).and_then(|mut npz| npz.array()).is_err());
    }

    #[test]
    fn column_major_arrays_are_transposed() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.npz");
        // numpy.asfortranarray(numpy.arange(24).reshape(2, 3, 4)), whose first axis changes fastest in the file.
        let value = |i: usize, j: usize, k: usize| (12 * i + 4 * j + k) as u16;
        let stored: Vec<u8> = (0..24).flat_map(|n| value(n % 2, n / 2 % 3, n / 6).to_le_bytes()).collect();
        deflated(&path, "{'descr': '<u2', 'fortran_order': True, 'shape': (2, 3, 4), }", &mut &stored[..]);
        let (header, bytes) = Npz::open(&path).and_then(|mut npz| npz.array()).expect("an array");
        let values: Vec<i32> = bytes.as_chunks().0.iter().map(|&b| i32::from_ne_bytes(b)).collect();
        assert_eq!((header.rows(), values), (2, (0..24).collect()));
    }

    #[test]
    fn array_headers_are_parsed_or_rejected() {
        let array = |text: &str| {
            let mut bytes = b"\x93NUMPY\x02\x00".to_vec();
            bytes.extend((text.len() as u32).to_le_bytes());
            bytes.extend(text.as_bytes());
            parse(&bytes).map(|(header, _)| header)
        };
        let text = array("{'descr': '<U5', 'fortran_order': False, 'shape': (4,), }")
            .expect("parsing the header of a text array");
        assert_eq!((text.stored, text.rows()), (None, 4));
        let scalar = array("{'descr': '>f8', 'fortran_order': False, 'shape': (), }").expect("reading the array");
        assert_eq!((scalar.stored.expect("a numeric type").big_endian, scalar.rows()), (true, 1));
        let fortran = array("{'descr': '<f8', 'fortran_order': True, 'shape': (2, 3), }").expect("an array");
        assert!(fortran.column_major && !text.column_major);
        assert!(array("{'descr': '<f8', 'fortran_order': 2, 'shape': (2, 3), }").is_err());
        assert!(array("{'descr': '<f8', 'fortran_order': False, 'shape': (-2, 3), }").is_err());
        assert!(
            parse(b"PK\x03\x04 is something else").expect_err("bytes that are no array").contains("not a NumPy array")
        );
    }
}
