//! [`Batch`]: named, typed, row-major arrays with a common number of rows.
//!
//! Environments, writers, loaders, policies and models exchange data as batches only: environments write their
//! observations into a batch in place, writers store batches, loaders return them, models read them. A [`Schema`] lists
//! the columns. Column data is contiguous and aligned to 64 bytes, so a tensor or an array view needs no copy.

mod buffer;
mod rows;
mod schema;

pub use rows::{RowMut, RowRef};
pub use schema::{ColumnSpec, DType, Element, LARGEST_SCHEMA, Schema, check_column_count};

use crate::{Error, Result};
use buffer::Buffer;
use rows::{ColumnStart, ItemsMut, RowsMut};

/// Named, typed, row-major arrays with a common number of rows.
///
/// # Shapes
/// A column of rows of shape `[shape…]` is one array `[rows, shape…]`.
#[derive(Clone)]
pub struct Batch {
    schema: Schema,
    rows: usize,
    data: Vec<Buffer>,
    /// The address of each column. Every mutable access to rows updates these addresses in place, without allocation.
    starts: Vec<ColumnStart>,
}

impl Batch {
    /// A batch of `rows` rows, all zero.
    pub fn zeros(schema: &Schema, rows: usize) -> Self {
        let mut batch = Self {
            schema: schema.clone(),
            rows: 0,
            data: schema.columns().iter().map(|_| Buffer::default()).collect(),
            starts: vec![ColumnStart::default(); schema.columns().len()],
        };
        batch.resize(rows);
        batch
    }

    /// A batch of `rows` rows, all zero, where a file determines the number or the size of the rows.
    ///
    /// # Errors
    /// When the rows do not fit into memory.
    pub fn try_zeros(schema: &Schema, rows: usize) -> Result<Self> {
        let mut batch = Self::zeros(schema, 0);
        batch.try_resize(rows)?;
        Ok(batch)
    }

    /// Changes the number of rows as [`Batch::resize`] does, where a file determines the number or the size of the rows.
    ///
    /// # Errors
    /// When the rows do not fit into memory.
    pub fn try_resize(&mut self, rows: usize) -> Result<()> {
        self.schema.check_memory(rows)?;
        for (buffer, column) in self.data.iter_mut().zip(self.schema.columns()) {
            let reserved = rows.checked_mul(column.row_bytes()).is_some_and(|bytes| buffer.reserve(bytes));
            if !reserved {
                return Err(Error::mismatch(
                    format!("reading column '{}'", column.name),
                    format!("{rows} rows of {} bytes, more than the free memory", column.row_bytes()),
                    "fewer rows at once; `swm doctor` checks the dataset",
                ));
            }
        }
        self.resize(rows);
        Ok(())
    }

    /// The columns.
    pub fn schema(&self) -> &Schema {
        &self.schema
    }

    /// The number of rows.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// The size of all columns in bytes.
    pub fn byte_len(&self) -> usize {
        self.data.iter().map(Buffer::len).sum()
    }

    /// Changes the number of rows; new rows are zero. Memory stays allocated, so growing again allocates nothing.
    pub fn resize(&mut self, rows: usize) {
        for (buffer, column) in self.data.iter_mut().zip(self.schema.columns()) {
            buffer.resize(rows * column.row_bytes());
        }
        self.rows = rows;
    }

    /// The bytes of a column, `[rows, row_bytes]`.
    pub fn bytes(&self, column: usize) -> &[u8] {
        self.data[column].bytes()
    }

    /// The bytes of a column, `[rows, row_bytes]`, for writing.
    pub fn bytes_mut(&mut self, column: usize) -> &mut [u8] {
        self.data[column].bytes_mut()
    }

    /// All elements of a column, `[rows, shape…]`.
    ///
    /// # Errors
    /// When there is no such column, or it holds another type.
    pub fn get<T: Element>(&self, name: &str) -> Result<&[T]> {
        let index = self.schema.index(name)?;
        self.check::<T>(index)?;
        Ok(bytemuck::cast_slice(self.bytes(index)))
    }

    /// All elements of a column, `[rows, shape…]`, for writing.
    ///
    /// # Errors
    /// As [`Batch::get`].
    pub fn get_mut<T: Element>(&mut self, name: &str) -> Result<&mut [T]> {
        let index = self.schema.index(name)?;
        self.check::<T>(index)?;
        Ok(bytemuck::cast_slice_mut(self.bytes_mut(index)))
    }

    /// The elements of a column of any type, converted to `f32`: `[rows, shape…]`.
    ///
    /// # Errors
    /// When there is no such column.
    pub fn to_f32(&self, name: &str) -> Result<Vec<f32>> {
        let index = self.schema.index(name)?;
        Ok(to_f32(self.schema.columns()[index].dtype, self.bytes(index)))
    }

    /// One row.
    ///
    /// # Panics
    /// When there is no such row.
    pub fn row(&self, row: usize) -> RowRef<'_> {
        assert!(row < self.rows, "row {row} is outside a batch of {} rows", self.rows);
        RowRef::new(self, row)
    }

    /// One row, for writing.
    ///
    /// # Panics
    /// When there is no such row.
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

    /// Calls `f(row index, row, item)` for every row and the item of the same index, on the threads of the
    /// current rayon pool.
    ///
    /// # Panics
    /// When the number of items differs from the number of rows.
    pub fn par_zip_mut<T: Send>(&mut self, items: &mut [T], f: impl Fn(usize, RowMut<'_>, &mut T) + Sync) {
        use rayon::prelude::*;
        assert_eq!(items.len(), self.rows, "the number of items must equal the number of rows");
        let shared = self.rows_mut();
        items.par_iter_mut().with_max_len(1).enumerate().for_each(|(row, item)| f(row, shared.row(row), item));
    }

    /// Calls `f(row index, row, item)` for every row and the item of the same index, on this thread.
    ///
    /// # Panics
    /// When the number of items differs from the number of rows.
    pub fn zip_mut<T>(&mut self, items: &mut [T], mut f: impl FnMut(usize, RowMut<'_>, &mut T)) {
        assert_eq!(items.len(), self.rows, "the number of items must equal the number of rows");
        let rows = self.rows_mut();
        items.iter_mut().enumerate().for_each(|(index, item)| f(index, rows.row(index), item));
    }

    /// Returns a function that calls `f(row index, row, item)` for the next row and its item until no row is left.
    /// Several threads call the function at once, and each row goes to one of them.
    ///
    /// # Panics
    /// When the number of items differs from the number of rows.
    pub(crate) fn divided_zip_mut<'a, T: Send>(
        &'a mut self,
        items: &'a mut [T],
        f: impl Fn(usize, RowMut<'_>, &mut T) + Sync + 'a,
    ) -> impl Fn() + Sync + 'a {
        assert_eq!(items.len(), self.rows, "the number of items must equal the number of rows");
        let (rows, items) = (self.rows_mut(), ItemsMut::new(items));
        move || {
            while let Some((index, item)) = items.take() {
                f(index, rows.row(index), item);
            }
        }
    }

    /// Copies row `row` of `from`, a batch of the same schema, to row `to`.
    ///
    /// # Errors
    /// When the schemas differ.
    pub fn copy_row(&mut self, to: usize, from: &Batch, row: usize) -> Result<()> {
        if self.schema != from.schema {
            return Err(Error::mismatch("copying a row", from.schema.describe(), self.schema.describe()));
        }
        for (index, column) in self.schema.columns().iter().enumerate() {
            let n = column.row_bytes();
            self.data[index].bytes_mut()[to * n..(to + 1) * n]
                .copy_from_slice(&from.bytes(index)[row * n..(row + 1) * n]);
        }
        Ok(())
    }

    /// Appends row `row` of `from`, a batch of the same schema.
    ///
    /// # Errors
    /// When the schemas differ.
    pub fn push_row(&mut self, from: &Batch, row: usize) -> Result<()> {
        let to = self.rows;
        self.resize(to + 1);
        self.copy_row(to, from, row)
    }

    /// Checks that a column holds elements of type `T`.
    fn check<T: Element>(&self, index: usize) -> Result<()> {
        let column = &self.schema.columns()[index];
        if T::is(column.dtype) {
            return Ok(());
        }
        Err(Error::mismatch(
            format!("reading column '{}'", column.name),
            format!("a request for {}", std::any::type_name::<T>()),
            format!("{}, the type of the column", column.dtype.name()),
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
        write!(f, "Batch({} rows: {})", self.rows, self.schema.describe())
    }
}

impl Schema {
    /// Checks that rows fit into memory, where a file determines their number or their size.
    ///
    /// # Errors
    /// When they take more than half of the free memory.
    pub fn check_memory(&self, rows: usize) -> Result<()> {
        let bytes = rows.saturating_mul(self.row_bytes());
        // The system promises more memory than there is, and ends a process that uses it. What is read is copied once at least.
        if bytes > MANY_BYTES && free_memory().is_some_and(|free| bytes as u64 > free / 2) {
            return Err(Error::mismatch(
                "reading rows",
                format!("{rows} rows of {} bytes, more than half of the free memory", self.row_bytes()),
                "fewer rows at once; `swm doctor` checks the dataset",
            ));
        }
        Ok(())
    }
}

/// Converts elements of any type to `f32`.
fn to_f32(dtype: DType, bytes: &[u8]) -> Vec<f32> {
    match dtype {
        DType::Bool | DType::U8 => bytes.iter().map(|&v| f32::from(v)).collect(),
        DType::Int32 => bytemuck::cast_slice::<u8, i32>(bytes).iter().map(|&v| v as f32).collect(),
        DType::Int64 => bytemuck::cast_slice::<u8, i64>(bytes).iter().map(|&v| v as f32).collect(),
        DType::Float32 => bytemuck::cast_slice(bytes).to_vec(),
        DType::Float64 => bytemuck::cast_slice::<u8, f64>(bytes).iter().map(|&v| v as f32).collect(),
    }
}

/// The bytes above which the free memory is asked for: a small compressed file can describe more.
const MANY_BYTES: usize = 1 << 30;

/// The memory that the system could give to a program, in bytes; `None` where it does not say.
fn free_memory() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    Some(1024 * line.trim().trim_end_matches(" kB").parse::<u64>().ok()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn schema() -> Schema {
        Schema::new([ColumnSpec::new("state", DType::Float64, [3]), ColumnSpec::image("pixels", 2, 2)])
            .expect("creating the schema")
    }

    #[test]
    fn schemas_of_too_many_columns_or_equal_names_are_refused() {
        let columns = |count: usize| -> Vec<ColumnSpec> {
            (0..count).map(|i| ColumnSpec::new(format!("c{i}"), DType::Float32, [2])).collect()
        };
        assert!(Schema::new(columns(LARGEST_SCHEMA)).is_ok());
        let error = Schema::new(columns(300_000)).expect_err("too many columns").to_string();
        assert!(error.contains("300000 columns, of at most 4096"), "{error}");
        let twice = [columns(2), columns(1)].concat();
        let error = Schema::new(twice).expect_err("a name twice").to_string();
        assert!(error.contains("two columns are named 'c0'"), "{error}");
    }

    #[test]
    fn rows_beyond_the_free_memory_are_refused() {
        let rows = (1 << 40) / schema().row_bytes();
        let error = Batch::zeros(&schema(), 0).try_resize(rows).expect_err("a TiB").to_string();
        assert!(error.contains("the free memory") && error.contains("fewer rows at once"), "{error}");
    }

    #[test]
    fn par_rows_mut_writes_rows_into_aligned_columns() {
        let mut batch = Batch::zeros(&schema(), 100);
        batch.par_rows_mut(|i, mut row| {
            row.set(0, &[i as f64, 0.5, -1.0]);
            row.at::<u8>(1).fill(i as u8);
        });
        assert_eq!(batch.row(7).at::<f64>(0), [7.0, 0.5, -1.0]);
        assert_eq!(batch.row(99).get::<u8>("pixels").expect("reading the column `pixels`"), [99; 12]);
        assert_eq!(batch.get::<f64>("state").expect("reading the column `state`").len(), 300);
        assert_eq!(batch.bytes(1).as_ptr() as usize % 64, 0);
    }

    #[test]
    fn resizing_fills_new_rows_with_zeros() {
        let mut batch = Batch::zeros(&schema(), 2);
        batch.get_mut::<f64>("state").expect("accessing the column `state`").fill(1.0);
        batch.resize(1);
        batch.resize(2);
        assert_eq!(batch.get::<f64>("state").expect("reading the column `state`"), [1.0, 1.0, 1.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn unknown_columns_and_wrong_element_types_are_errors() {
        let batch = Batch::zeros(&schema(), 1);
        let missing = batch.get::<f64>("stat").expect_err("no such column").to_string();
        assert!(missing.contains("did you mean state?"), "{missing}");
        let wrong = batch.get::<f32>("state").expect_err("reading with a wrong element type").to_string();
        assert!(wrong.contains("f32") && wrong.contains("float64"), "{wrong}");
    }
}
