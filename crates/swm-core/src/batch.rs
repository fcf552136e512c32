//! [`Batch`]: named, typed, row-major arrays with a common number of rows.
//!
//! It is the only thing that flows: environments write their observations into one in place, writers
//! store them, loaders yield them, models read them. A [`Schema`] says which columns there are; column data
//! is contiguous and aligned to 64 bytes, so a tensor or an array view needs no copy.

use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The type of one number.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DType {
    /// True or false, one byte (0 or 1).
    Bool,
    /// Bytes; an RGB picture is `U8` with shape `[height, width, 3]`.
    U8,
    /// 32-bit signed integers.
    Int32,
    /// 64-bit signed integers.
    Int64,
    /// Single precision.
    Float32,
    /// Double precision.
    Float64,
}

impl DType {
    /// Bytes of one number.
    pub const fn size(self) -> usize {
        match self {
            Self::Bool | Self::U8 => 1,
            Self::Int32 | Self::Float32 => 4,
            Self::Int64 | Self::Float64 => 8,
        }
    }

    /// The name numpy gives this type.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Bool => "bool",
            Self::U8 => "uint8",
            Self::Int32 => "int32",
            Self::Int64 => "int64",
            Self::Float32 => "float32",
            Self::Float64 => "float64",
        }
    }
}

/// A Rust type that a column can hold.
pub trait Element: bytemuck::Pod + PartialEq + std::fmt::Debug {
    /// Whether columns of `dtype` hold this type.
    fn is(dtype: DType) -> bool;
}

macro_rules! element {
    ($($t:ty => $pat:pat),* $(,)?) => {
        $(impl Element for $t {
            fn is(dtype: DType) -> bool {
                matches!(dtype, $pat)
            }
        })*
    };
}
element! { u8 => DType::U8 | DType::Bool, i32 => DType::Int32, i64 => DType::Int64, f32 => DType::Float32, f64 => DType::Float64 }

/// One column: its name, number type, and the shape of one row (empty for a scalar).
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ColumnSpec {
    /// The column's name.
    pub name: String,
    /// The type of its numbers.
    pub dtype: DType,
    /// The shape of one row.
    pub shape: Vec<usize>,
}

impl ColumnSpec {
    /// A column.
    pub fn new(name: impl Into<String>, dtype: DType, shape: impl Into<Vec<usize>>) -> Self {
        Self { name: name.into(), dtype, shape: shape.into() }
    }

    /// A column of RGB pictures, `[height, width, 3]` bytes.
    pub fn image(name: impl Into<String>, height: usize, width: usize) -> Self {
        Self::new(name, DType::U8, [height, width, 3])
    }

    /// Numbers in one row.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Whether a row holds no number.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Bytes of one row.
    pub fn row_bytes(&self) -> usize {
        self.len() * self.dtype.size()
    }

    /// Whether rows are RGB pictures.
    pub fn is_image(&self) -> bool {
        self.dtype == DType::U8 && matches!(self.shape[..], [_, _, 3])
    }
}

/// The columns of a [`Batch`], in order. Cheap to clone.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(into = "Vec<ColumnSpec>", try_from = "Vec<ColumnSpec>")]
pub struct Schema(Arc<[ColumnSpec]>);

impl From<Schema> for Vec<ColumnSpec> {
    fn from(schema: Schema) -> Self {
        schema.0.to_vec()
    }
}

impl TryFrom<Vec<ColumnSpec>> for Schema {
    type Error = Error;

    fn try_from(columns: Vec<ColumnSpec>) -> Result<Self> {
        Self::new(columns)
    }
}

impl Schema {
    /// A schema of these columns.
    ///
    /// # Errors
    /// When two columns share a name.
    pub fn new(columns: impl Into<Vec<ColumnSpec>>) -> Result<Self> {
        let columns = columns.into();
        for (i, column) in columns.iter().enumerate() {
            if columns[..i].iter().any(|other| other.name == column.name) {
                return Err(Error::config(
                    "schema",
                    format!("two columns are named '{}'", column.name),
                    "give every column its own name",
                ));
            }
        }
        Ok(Self(columns.into()))
    }

    /// The columns.
    pub fn columns(&self) -> &[ColumnSpec] {
        &self.0
    }

    /// The place of a column, if it is there.
    pub fn find(&self, name: &str) -> Option<usize> {
        self.0.iter().position(|column| column.name == name)
    }

    /// The place of a column.
    ///
    /// # Errors
    /// When there is none of that name; names the nearest.
    pub fn index(&self, name: &str) -> Result<usize> {
        self.find(name).ok_or_else(|| {
            Error::unknown(
                "column",
                name,
                self.0.iter().map(|c| c.name.as_str()),
                format!("the columns are {}", self.0.iter().map(|c| c.name.as_str()).collect::<Vec<_>>().join(", ")),
            )
        })
    }

    /// The column of that name.
    ///
    /// # Errors
    /// As [`Schema::index`].
    pub fn column(&self, name: &str) -> Result<&ColumnSpec> {
        Ok(&self.0[self.index(name)?])
    }
}

/// 64 bytes at an address that is a multiple of 64.
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C, align(64))]
struct Line([u8; 64]);

/// Bytes at a 64-byte aligned address.
#[derive(Clone, Default)]
struct Buffer {
    lines: Vec<Line>,
    len: usize,
}

impl Buffer {
    fn resize(&mut self, len: usize) {
        if len < self.len {
            // What is grown again later must read as zero.
            self.bytes_mut()[len..].fill(0);
        }
        self.lines.resize(len.div_ceil(64), Line([0; 64]));
        self.len = len;
    }

    fn bytes(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.lines)[..self.len]
    }

    fn bytes_mut(&mut self) -> &mut [u8] {
        &mut bytemuck::cast_slice_mut(&mut self.lines)[..self.len]
    }
}

/// Named, typed, row-major arrays with a common number of rows.
#[derive(Clone)]
pub struct Batch {
    schema: Schema,
    rows: usize,
    data: Vec<Buffer>,
    /// Where each column begins; refreshed whenever rows are handed out, so that this needs no allocation.
    starts: Vec<shared::Start>,
}

impl Batch {
    /// A batch of `rows` rows, all zero.
    pub fn zeros(schema: &Schema, rows: usize) -> Self {
        let mut batch = Self {
            schema: schema.clone(),
            rows: 0,
            data: schema.columns().iter().map(|_| Buffer::default()).collect(),
            starts: vec![shared::Start::default(); schema.columns().len()],
        };
        batch.resize(rows);
        batch
    }

    /// The columns.
    pub fn schema(&self) -> &Schema {
        &self.schema
    }

    /// The number of rows.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Bytes held.
    pub fn byte_len(&self) -> usize {
        self.data.iter().map(|buffer| buffer.len).sum()
    }

    /// Changes the number of rows; new rows are zero. Memory is kept, so growing again costs nothing.
    pub fn resize(&mut self, rows: usize) {
        for (buffer, column) in self.data.iter_mut().zip(self.schema.columns()) {
            buffer.resize(rows * column.row_bytes());
        }
        self.rows = rows;
    }

    /// The raw bytes of a column, row after row.
    pub fn bytes(&self, column: usize) -> &[u8] {
        self.data[column].bytes()
    }

    /// The raw bytes of a column, row after row.
    pub fn bytes_mut(&mut self, column: usize) -> &mut [u8] {
        self.data[column].bytes_mut()
    }

    /// All numbers of a column, `[rows, shape…]`.
    ///
    /// # Errors
    /// When there is no such column, or it holds another type.
    pub fn get<T: Element>(&self, name: &str) -> Result<&[T]> {
        let index = self.schema.index(name)?;
        self.check::<T>(index)?;
        Ok(bytemuck::cast_slice(self.bytes(index)))
    }

    /// All numbers of a column, `[rows, shape…]`, to write.
    ///
    /// # Errors
    /// As [`Batch::get`].
    pub fn get_mut<T: Element>(&mut self, name: &str) -> Result<&mut [T]> {
        let index = self.schema.index(name)?;
        self.check::<T>(index)?;
        Ok(bytemuck::cast_slice_mut(self.bytes_mut(index)))
    }

    /// A column converted to `f32`, whatever its type: `[rows, shape…]`.
    ///
    /// # Errors
    /// When there is no such column.
    pub fn to_f32(&self, name: &str) -> Result<Vec<f32>> {
        let index = self.schema.index(name)?;
        let bytes = self.bytes(index);
        #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
        Ok(match self.schema.columns()[index].dtype {
            DType::Bool | DType::U8 => bytes.iter().map(|&v| f32::from(v)).collect(),
            DType::Int32 => bytemuck::cast_slice::<u8, i32>(bytes).iter().map(|&v| v as f32).collect(),
            DType::Int64 => bytemuck::cast_slice::<u8, i64>(bytes).iter().map(|&v| v as f32).collect(),
            DType::Float32 => bytemuck::cast_slice(bytes).to_vec(),
            DType::Float64 => bytemuck::cast_slice::<u8, f64>(bytes).iter().map(|&v| v as f32).collect(),
        })
    }

    /// One row.
    pub fn row(&self, row: usize) -> RowRef<'_> {
        assert!(row < self.rows, "row {row} of a batch of {} rows", self.rows);
        RowRef { batch: self, row }
    }

    /// One row, to write.
    pub fn row_mut(&mut self, row: usize) -> RowMut<'_> {
        self.rows_mut().row(row)
    }

    /// Calls `f(row index, row)` for every row on the threads of the current rayon pool.
    pub fn par_rows_mut(&mut self, f: impl Fn(usize, RowMut<'_>) + Sync) {
        use rayon::prelude::*;
        let rows = self.rows;
        let shared = self.rows_mut();
        (0..rows).into_par_iter().with_max_len(1).for_each(|row| f(row, shared.row(row)));
    }

    /// Calls `f(row index, row, item)` for every row and the item of the same place, on the threads of the
    /// current rayon pool.
    ///
    /// # Panics
    /// When there is not one item a row.
    pub fn par_zip_mut<T: Send>(&mut self, items: &mut [T], f: impl Fn(usize, RowMut<'_>, &mut T) + Sync) {
        use rayon::prelude::*;
        assert_eq!(items.len(), self.rows, "one item a row");
        let shared = self.rows_mut();
        items.par_iter_mut().with_max_len(1).enumerate().for_each(|(row, item)| f(row, shared.row(row), item));
    }

    /// Copies a row of another batch of the same schema.
    ///
    /// # Errors
    /// When the schemas differ.
    pub fn copy_row(&mut self, to: usize, from: &Batch, row: usize) -> Result<()> {
        if self.schema != from.schema {
            return Err(Error::mismatch("copying a row", describe(&from.schema), describe(&self.schema)));
        }
        for (index, column) in self.schema.0.iter().enumerate() {
            let n = column.row_bytes();
            self.data[index].bytes_mut()[to * n..(to + 1) * n]
                .copy_from_slice(&from.bytes(index)[row * n..(row + 1) * n]);
        }
        Ok(())
    }

    /// Appends a row of another batch of the same schema.
    ///
    /// # Errors
    /// When the schemas differ.
    pub fn push_row(&mut self, from: &Batch, row: usize) -> Result<()> {
        let to = self.rows;
        self.resize(to + 1);
        self.copy_row(to, from, row)
    }

    fn check<T: Element>(&self, index: usize) -> Result<()> {
        let column = &self.schema.columns()[index];
        if T::is(column.dtype) {
            return Ok(());
        }
        Err(Error::mismatch(
            format!("reading column '{}'", column.name),
            std::any::type_name::<T>(),
            column.dtype.name(),
        ))
    }

    fn rows_mut(&mut self) -> RowsMut<'_> {
        for (start, buffer) in self.starts.iter_mut().zip(&mut self.data) {
            start.0 = buffer.bytes_mut().as_mut_ptr();
        }
        RowsMut { schema: &self.schema, rows: self.rows, starts: &self.starts }
    }
}

impl std::fmt::Debug for Batch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Batch({} rows: {})", self.rows, describe(&self.schema))
    }
}

fn describe(schema: &Schema) -> String {
    let columns: Vec<String> =
        schema.columns().iter().map(|c| format!("{} {}{:?}", c.name, c.dtype.name(), c.shape)).collect();
    columns.join(", ")
}

/// One row of a [`Batch`].
#[derive(Clone, Copy)]
pub struct RowRef<'a> {
    batch: &'a Batch,
    row: usize,
}

impl<'a> RowRef<'a> {
    /// The numbers of column `index`.
    ///
    /// # Panics
    /// When the column holds another type: places come from a schema, so that is a bug of the caller.
    pub fn at<T: Element>(self, index: usize) -> &'a [T] {
        let column = &self.batch.schema.columns()[index];
        assert!(T::is(column.dtype), "column '{}' holds {}", column.name, column.dtype.name());
        let n = column.row_bytes();
        bytemuck::cast_slice(&self.batch.bytes(index)[self.row * n..(self.row + 1) * n])
    }

    /// The numbers of a column.
    ///
    /// # Errors
    /// When there is no such column, or it holds another type.
    pub fn get<T: Element>(self, name: &str) -> Result<&'a [T]> {
        let index = self.batch.schema.index(name)?;
        self.batch.check::<T>(index)?;
        Ok(self.at(index))
    }

    /// The numbers of a column as `f64`, whatever its type.
    ///
    /// # Errors
    /// When there is no such column.
    pub fn to_f64(self, name: &str) -> Result<Vec<f64>> {
        let index = self.batch.schema.index(name)?;
        #[allow(clippy::cast_precision_loss)]
        Ok(match self.batch.schema.columns()[index].dtype {
            DType::Bool | DType::U8 => self.at::<u8>(index).iter().map(|&v| f64::from(v)).collect(),
            DType::Int32 => self.at::<i32>(index).iter().map(|&v| f64::from(v)).collect(),
            DType::Int64 => self.at::<i64>(index).iter().map(|&v| v as f64).collect(),
            DType::Float32 => self.at::<f32>(index).iter().map(|&v| f64::from(v)).collect(),
            DType::Float64 => self.at::<f64>(index).to_vec(),
        })
    }

    /// The bytes of column `index`, whatever its type.
    pub fn bytes(self, index: usize) -> &'a [u8] {
        let n = self.batch.schema.columns()[index].row_bytes();
        &self.batch.bytes(index)[self.row * n..][..n]
    }

    /// The columns of the row.
    pub fn schema(self) -> &'a Schema {
        &self.batch.schema
    }
}

pub use shared::RowMut;
use shared::RowsMut;

/// Disjoint rows of one batch, written by several threads at once.
#[allow(unsafe_code)]
mod shared {
    use super::{Element, Schema};

    /// Where the bytes of a column begin.
    #[derive(Clone, Copy)]
    pub(super) struct Start(pub *mut u8);

    impl Default for Start {
        fn default() -> Self {
            Self(std::ptr::null_mut())
        }
    }

    // SAFETY: a `Start` is only read through `RowsMut`, which borrows the batch mutably and refreshes it.
    unsafe impl Send for Start {}
    // SAFETY: as above.
    unsafe impl Sync for Start {}

    /// All rows of a mutably borrowed batch; this module's parent hands each row out at most once at a time.
    pub(super) struct RowsMut<'a> {
        pub schema: &'a Schema,
        pub rows: usize,
        pub starts: &'a [Start],
    }

    impl<'a> RowsMut<'a> {
        pub fn row(&self, row: usize) -> RowMut<'a> {
            assert!(row < self.rows, "row {row} of a batch of {} rows", self.rows);
            RowMut { schema: self.schema, starts: self.starts, row }
        }
    }

    /// One row of a batch, to write.
    pub struct RowMut<'a> {
        schema: &'a Schema,
        starts: &'a [Start],
        row: usize,
    }

    impl RowMut<'_> {
        /// The columns of the row.
        pub fn schema(&self) -> &Schema {
            self.schema
        }

        /// The numbers of column `index`, to write.
        ///
        /// # Panics
        /// When the column holds another type: places come from a schema, so that is a bug of the caller.
        pub fn at<T: Element>(&mut self, index: usize) -> &mut [T] {
            let column = &self.schema.columns()[index];
            assert!(T::is(column.dtype), "column '{}' holds {}", column.name, column.dtype.name());
            bytemuck::cast_slice_mut(self.bytes(index))
        }

        /// The bytes of column `index`, to write.
        pub fn bytes(&mut self, index: usize) -> &mut [u8] {
            let n = self.schema.columns()[index].row_bytes();
            // SAFETY: the batch is mutably borrowed while rows exist, so its buffers neither move nor are
            // reached otherwise; each holds `rows * n` bytes, and rows are disjoint ranges of them.
            unsafe { std::slice::from_raw_parts_mut(self.starts[index].0.add(self.row * n), n) }
        }

        /// Writes the numbers of column `index`.
        ///
        /// # Panics
        /// When the column holds another type or number of numbers.
        pub fn set<T: Element>(&mut self, index: usize, values: &[T]) {
            self.at::<T>(index).copy_from_slice(values);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn schema() -> Schema {
        Schema::new([ColumnSpec::new("state", DType::Float64, [3]), ColumnSpec::image("pixels", 2, 2)]).expect("schema")
    }

    #[test]
    fn rows_are_written_in_place_by_many_threads() {
        let mut batch = Batch::zeros(&schema(), 100);
        batch.par_rows_mut(|i, mut row| {
            row.set(0, &[i as f64, 0.5, -1.0]);
            row.at::<u8>(1).fill(i as u8);
        });
        assert_eq!(batch.row(7).at::<f64>(0), [7.0, 0.5, -1.0]);
        assert_eq!(batch.row(99).get::<u8>("pixels").expect("pixels"), [99; 12]);
        assert_eq!(batch.get::<f64>("state").expect("state").len(), 300);
        assert_eq!(batch.bytes(1).as_ptr() as usize % 64, 0);
    }

    #[test]
    fn shrinking_and_growing_reads_zero() {
        let mut batch = Batch::zeros(&schema(), 2);
        batch.get_mut::<f64>("state").expect("state").fill(1.0);
        batch.resize(1);
        batch.resize(2);
        assert_eq!(batch.get::<f64>("state").expect("state"), [1.0, 1.0, 1.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn wrong_column_and_wrong_type_say_so() {
        let batch = Batch::zeros(&schema(), 1);
        let missing = batch.get::<f64>("stat").expect_err("no such column").to_string();
        assert!(missing.contains("did you mean state?"), "{missing}");
        let wrong = batch.get::<f32>("state").expect_err("wrong type").to_string();
        assert!(wrong.contains("f32") && wrong.contains("float64"), "{wrong}");
    }
}
