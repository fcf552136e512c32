//! Single rows of a batch: [`RowRef`] reads a row, [`RowMut`] writes a row. Several threads write disjoint rows at
//! once.

use super::{Batch, ColumnSpec, DType, Element, Schema};
use crate::Result;

/// Panics if a column holds another type than `T`.
fn assert_type<T: Element>(column: &ColumnSpec) {
    assert!(
        T::is(column.dtype),
        "column '{}' holds {}, which was read as {}",
        column.name,
        column.dtype.name(),
        std::any::type_name::<T>()
    );
}

/// One row of a [`Batch`].
#[derive(Clone, Copy)]
pub struct RowRef<'a> {
    batch: &'a Batch,
    row: usize,
}

impl<'a> RowRef<'a> {
    /// Creates a reference to row `row`, which must exist.
    pub(super) fn new(batch: &'a Batch, row: usize) -> Self {
        Self { batch, row }
    }

    /// The elements of column `index`, `[shape…]`.
    ///
    /// # Panics
    /// When the column holds another type: indices come from a schema, so another type is a bug of the caller.
    pub fn at<T: Element>(self, index: usize) -> &'a [T] {
        let column = &self.schema().columns()[index];
        assert_type::<T>(column);
        let n = column.row_bytes();
        bytemuck::cast_slice(&self.batch.bytes(index)[self.row * n..(self.row + 1) * n])
    }

    /// The elements of a column, `[shape…]`.
    ///
    /// # Errors
    /// When the batch has no such column, or the column holds another type.
    pub fn get<T: Element>(self, name: &str) -> Result<&'a [T]> {
        let index = self.schema().index(name)?;
        self.batch.check::<T>(index)?;
        Ok(self.at(index))
    }

    /// The elements of a column of any type, converted to `f64`: `[shape…]`.
    ///
    /// # Errors
    /// When the batch has no such column.
    pub fn to_f64(self, name: &str) -> Result<Vec<f64>> {
        let index = self.schema().index(name)?;
        Ok(match self.schema().columns()[index].dtype {
            DType::Bool | DType::U8 => self.at::<u8>(index).iter().map(|&v| f64::from(v)).collect(),
            DType::Int32 => self.at::<i32>(index).iter().map(|&v| f64::from(v)).collect(),
            DType::Int64 => self.at::<i64>(index).iter().map(|&v| v as f64).collect(),
            DType::Float32 => self.at::<f32>(index).iter().map(|&v| f64::from(v)).collect(),
            DType::Float64 => self.at::<f64>(index).to_vec(),
        })
    }

    /// The elements of a column of any type, converted to `f32` as by [`Batch::to_f32`]: `[shape…]`.
    ///
    /// # Errors
    /// When the batch has no such column.
    pub fn to_f32(self, name: &str) -> Result<Vec<f32>> {
        let index = self.schema().index(name)?;
        Ok(super::to_f32(self.schema().columns()[index].dtype, self.bytes(index)))
    }

    /// The bytes of column `index`, of any type.
    pub fn bytes(self, index: usize) -> &'a [u8] {
        let n = self.schema().columns()[index].row_bytes();
        &self.batch.bytes(index)[self.row * n..][..n]
    }

    /// The columns of the row.
    pub fn schema(self) -> &'a Schema {
        self.batch.schema()
    }
}

pub use shared::RowMut;
pub(super) use shared::{ColumnStart, ItemsMut, RowsMut};

/// Disjoint rows of one batch, written by several threads at once.
#[allow(unsafe_code, reason = "threads write disjoint rows of one buffer, which safe slices cannot express by column")]
mod shared {
    use super::{Element, Schema, assert_type};
    use std::marker::PhantomData;
    use std::sync::atomic::{AtomicUsize, Ordering};

    /// The address of a column's first byte.
    #[derive(Clone, Copy)]
    pub(in crate::batch) struct ColumnStart(pub *mut u8);

    impl Default for ColumnStart {
        fn default() -> Self {
            Self(std::ptr::null_mut())
        }
    }

    // SAFETY: a `ColumnStart` is read only through `RowsMut`. `Batch::rows_mut` makes a `RowsMut`, borrows the batch
    // mutably and updates every address.
    unsafe impl Send for ColumnStart {}
    // SAFETY: as for `Send`.
    unsafe impl Sync for ColumnStart {}

    /// All rows of a mutably borrowed batch. At most one [`RowMut`] of each row exists at a time.
    pub(in crate::batch) struct RowsMut<'a> {
        pub schema: &'a Schema,
        pub rows: usize,
        pub starts: &'a [ColumnStart],
    }

    impl<'a> RowsMut<'a> {
        /// Returns row `row` for writing. Callers, all in `batch`, request a row again only after its last use.
        ///
        /// # Panics
        /// When the row does not exist.
        pub fn row(&self, row: usize) -> RowMut<'a> {
            assert!(row < self.rows, "row {row} is outside a batch of {} rows", self.rows);
            RowMut { schema: self.schema, starts: self.starts, row }
        }
    }

    /// The items of a slice, which several threads take one by one. Every item is taken once.
    pub(in crate::batch) struct ItemsMut<'a, T> {
        start: *mut T,
        len: usize,
        taken: AtomicUsize,
        items: PhantomData<&'a mut [T]>,
    }

    // SAFETY: threads share an `ItemsMut` to take items, and an item goes to one thread, which `T: Send` allows.
    unsafe impl<T: Send> Sync for ItemsMut<'_, T> {}

    impl<'a, T> ItemsMut<'a, T> {
        pub fn new(items: &'a mut [T]) -> Self {
            Self { start: items.as_mut_ptr(), len: items.len(), taken: AtomicUsize::new(0), items: PhantomData }
        }

        /// Takes the next item, with its index; `None` if all are taken.
        pub fn take(&self) -> Option<(usize, &'a mut T)> {
            if self.taken.load(Ordering::Relaxed) >= self.len {
                // Without this, many calls at the end could wrap the counter.
                return None;
            }
            let index = self.taken.fetch_add(1, Ordering::Relaxed);
            // SAFETY: the index is inside the slice, which is mutably borrowed for `'a`; the counter returns every index
            // once, so no other reference to this item exists.
            (index < self.len).then(|| (index, unsafe { &mut *self.start.add(index) }))
        }
    }

    /// One row of a batch, for writing.
    pub struct RowMut<'a> {
        schema: &'a Schema,
        starts: &'a [ColumnStart],
        row: usize,
    }

    impl RowMut<'_> {
        /// The columns of the row.
        pub fn schema(&self) -> &Schema {
            self.schema
        }

        /// The elements of column `index`, `[shape…]`, for writing.
        ///
        /// # Panics
        /// When the column holds another type: indices come from a schema, so another type is a bug of the caller.
        pub fn at<T: Element>(&mut self, index: usize) -> &mut [T] {
            let column = &self.schema.columns()[index];
            assert_type::<T>(column);
            bytemuck::cast_slice_mut(self.bytes(index))
        }

        /// The bytes of column `index`, for writing.
        pub fn bytes(&mut self, index: usize) -> &mut [u8] {
            let n = self.schema.columns()[index].row_bytes();
            // SAFETY: the batch is mutably borrowed while rows exist, so its buffers neither move nor are accessed in any
            // other way. Each buffer holds `rows * n` bytes, `RowsMut::row` checks that the row exists, rows are disjoint
            // ranges, and only one `RowMut` of a row is in use.
            unsafe { std::slice::from_raw_parts_mut(self.starts[index].0.add(self.row * n), n) }
        }

        /// Writes the elements of column `index`, `[shape…]`.
        ///
        /// # Panics
        /// When the column holds another type or number of elements.
        pub fn set<T: Element>(&mut self, index: usize, values: &[T]) {
            self.at::<T>(index).copy_from_slice(values);
        }
    }
}
