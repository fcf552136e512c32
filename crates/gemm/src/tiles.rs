//! Products of single precision in tiles, on x86.
//!
//! The left matrix is laid out in panels: as many rows as a kernel computes at once, column by column, in lines of the cache. `gemm-common`
//! does so as well, but element by element and on one thread where rows are contiguous, as the weights of a linear layer are. Here
//! squares are transposed in registers, and each thread lays out the panels that it multiplies. The kernels are those of `gemm-f32`, and so
//! are all bits of a product.

use crate::{Factors, Matrix, Product};
use gemm_common::microkernel::MicroKernelFn;
use std::arch::x86_64::{
    __m256, _mm_loadu_ps, _mm256_castps128_ps256, _mm256_insertf128_ps, _mm256_shuffle_ps, _mm256_storeu_ps,
    _mm256_unpackhi_ps, _mm256_unpacklo_ps,
};
use std::cell::Cell;
use std::ops::Range;

/// The bytes of panels that a thread lays out before it uses them. They stay in its second cache.
const LAID_OUT: usize = 1 << 19;
/// The most tiles beside each other for which a left matrix with contiguous columns is read where it lies.
const FEW: usize = 8;
/// The number of tiles beside each other whose right matrix is copied at once, if it is.
const COPIED: usize = 8;
/// The distance between rows of the right matrix, in bytes, whose multiples share a few lines of the first cache.
const CONFLICT: usize = 1 << 12;
/// The number of multiplications from which a product is computed by several threads.
const PARALLEL: usize = 1 << 19;
/// The time in which a panel is laid out, in tiles.
const LAYING_OUT: usize = 2;

/// The number of elements in a line of the cache.
const LINE: usize = 16;

/// A line of the cache.
#[derive(Clone, Copy)]
#[repr(align(64))]
struct Line(#[expect(dead_code, reason = "lines are read as slices of elements")] [f32; LINE]);

thread_local! {
    /// Memory for panels, which is reused.
    static MEMORY: Cell<Vec<Line>> = const { Cell::new(Vec::new()) };
}

/// The kernels of `gemm-f32` for one instruction set, by vectors of `LANES` rows and by columns of a tile.
pub struct Tiles<const LANES: usize, const VECTORS: usize, const COLUMNS: usize>(
    pub [[MicroKernelFn<f32>; COLUMNS]; VECTORS],
);

/// A product that several threads compute.
struct Shared<'a>(&'a Product<f32>);

// SAFETY: threads read two of the matrices, and write different elements of the third.
unsafe impl Sync for Shared<'_> {}

/// Whether [`Tiles`] compute a product, of which no matrix has a side of 0. The kernels of `gemm-common` have other ways for vectors and
/// for sums of two terms, and cut those of small products elsewhere.
pub fn can_multiply(product: &Product<f32>) -> bool {
    let [m, n, k] = product.sides;
    let has_neighbours = product.lhs.to_next_row == 1 || product.lhs.to_next_column == 1;
    m.min(n) > 1 && m.max(n) > crate::SMALL && k > 2 && has_neighbours && !product.has_sums_over_lanes()
}

impl<const LANES: usize, const VECTORS: usize, const COLUMNS: usize> Tiles<LANES, VECTORS, COLUMNS> {
    /// The number of rows of a panel.
    const ROWS: usize = LANES * VECTORS;

    /// Computes `dst = alpha * dst + beta * lhs * rhs`, without the first term if there is no `alpha`.
    ///
    /// # Safety
    /// As for [`crate::gemm()`]. The processor must have the instructions of the kernels, and AVX. The product is one that
    /// [`can_multiply`] names.
    pub unsafe fn multiply(&self, product: &Product<f32>, factors: Factors<f32>, threads: usize) {
        let [m, n, k] = product.sides;
        let (panels, tiles) = (m.div_ceil(Self::ROWS), n.div_ceil(COLUMNS));
        let threads = if m * n * k < PARALLEL { 1 } else { threads };
        if threads == 1 {
            // SAFETY: as for this function.
            return unsafe { self.multiply_part(product, factors, 0..panels, 0..tiles) };
        }
        // Threads that share panels each lay them out.
        let time_of_panels = panels.div_ceil(threads) * (tiles + LAYING_OUT);
        let time_of_tiles = panels * (tiles.div_ceil(threads) + LAYING_OUT);
        let shared = Shared(product);
        for_each(threads, |thread| {
            let part = |whole: usize| whole * thread / threads..whole * (thread + 1) / threads;
            let (panels, tiles) =
                if time_of_panels <= time_of_tiles { (part(panels), 0..tiles) } else { (0..panels, part(tiles)) };
            let Shared(product) = &shared;
            // SAFETY: as for this function; the parts are different.
            unsafe { self.multiply_part(product, factors, panels, tiles) };
        });
    }

    /// Computes some rows and columns of a product: those of `panels` and, of each, of `tiles`.
    ///
    /// # Safety
    /// As for [`Self::multiply`].
    unsafe fn multiply_part(
        &self,
        product: &Product<f32>,
        factors: Factors<f32>,
        panels: Range<usize>,
        tiles: Range<usize>,
    ) {
        if panels.is_empty() || tiles.is_empty() {
            return;
        }
        let Product { sides: [m, n, k], dst, lhs, rhs } = product;
        let (m, n, k) = (*m, *n, *k);
        let size = Self::ROWS * k;
        // Copied tiles are a line apart, so that their rows are in different lines of the first cache.
        let size_of_copy = COLUMNS * k + LINE;
        let at_once = (LAID_OUT / size_of::<f32>() / size).clamp(1, panels.len());
        let is_copied =
            rhs.to_next_row != 1 && (rhs.to_next_row.unsigned_abs() * size_of::<f32>()).is_multiple_of(CONFLICT);
        let mut memory = MEMORY.take();
        let (laid_out, copies) =
            grown(&mut memory, [at_once * size, if is_copied { COPIED * size_of_copy } else { 0 }]);
        let rows_of = |panel: usize| panel * Self::ROWS..m.min((panel + 1) * Self::ROWS);
        let lies_right = lhs.to_next_row == 1 && tiles.len() <= FEW;
        let is_in_place = |panel: usize| lies_right && rows_of(panel).len().is_multiple_of(LANES);
        for first in panels.clone().step_by(at_once) {
            let panels = first..(first + at_once).min(panels.end);
            for (panel, to) in panels.clone().zip(laid_out.chunks_exact_mut(size)) {
                if !is_in_place(panel) {
                    // SAFETY: the rows are those of the left matrix; as for this function.
                    unsafe { lay_out::<LANES>(lhs, rows_of(panel), Self::ROWS, to) };
                }
            }
            for tile in tiles.clone() {
                let column = tile * COLUMNS;
                let width = COLUMNS.min(n - column);
                let copy = (tile - tiles.start) % COPIED;
                if is_copied && copy == 0 {
                    let columns = column..n.min((tile + COPIED).min(tiles.end) * COLUMNS);
                    // SAFETY: the columns are those of the right matrix; as for this function.
                    unsafe { copy_tiles::<COLUMNS>(rhs, columns, (copies, size_of_copy)) };
                }
                let rhs = if is_copied {
                    Matrix::new(copies[copy * size_of_copy..].as_ptr(), 1, COLUMNS as isize)
                } else {
                    rhs.at(0, column)
                };
                for (panel, laid_out) in panels.clone().zip(laid_out.chunks_exact(size)) {
                    let rows = rows_of(panel);
                    let dst = dst.at(rows.start, column);
                    let lhs = if is_in_place(panel) {
                        lhs.at(rows.start, 0)
                    } else {
                        Matrix::new(laid_out.as_ptr(), Self::ROWS as isize, 1)
                    };
                    let tile = Product { sides: [rows.len(), width, k], dst, lhs, rhs };
                    // SAFETY: the elements are those of the matrices and of panels, which have as many rows as the kernel reads.
                    unsafe { self.multiply_tile(&tile, factors) };
                }
            }
        }
        MEMORY.set(memory);
    }

    /// Computes a tile, with its left matrix column by column.
    ///
    /// # Safety
    /// As for [`Self::multiply`]. The left matrix has as many rows as whole vectors hold.
    unsafe fn multiply_tile(&self, tile: &Product<f32>, (alpha, beta): Factors<f32>) {
        let Product { sides: [rows, columns, k], dst, lhs, rhs } = tile;
        let kernel = self.0[rows.div_ceil(LANES) - 1][columns - 1];
        let alpha_kind = match alpha {
            None | Some(0.0) => 0,
            Some(1.0) => 1,
            Some(_) => 2,
        };
        // SAFETY: as for this function.
        unsafe {
            kernel(
                *rows,
                *columns,
                *k,
                dst.first,
                lhs.first,
                rhs.first,
                dst.to_next_column,
                dst.to_next_row,
                lhs.to_next_column,
                rhs.to_next_row,
                rhs.to_next_column,
                alpha.unwrap_or(0.0),
                beta,
                alpha_kind,
                false,
                false,
                false,
                core::ptr::null(),
            );
        }
    }
}

/// Calls a function for each thread.
#[cfg(feature = "rayon")]
fn for_each(threads: usize, work: impl Fn(usize) + Sync + Send) {
    use rayon::iter::{IndexedParallelIterator as _, IntoParallelIterator as _, ParallelIterator as _};
    (0..threads).into_par_iter().with_max_len(1).for_each(work);
}

/// Calls a function for each thread, one after the other.
#[cfg(not(feature = "rayon"))]
fn for_each(threads: usize, work: impl Fn(usize)) {
    (0..threads).for_each(work);
}

/// Returns two parts of memory, which grows if it is too short, with these numbers of elements.
fn grown(memory: &mut Vec<Line>, [first, second]: [usize; 2]) -> (&mut [f32], &mut [f32]) {
    let lines = (first + second).div_ceil(LINE);
    if memory.len() < lines {
        memory.resize(lines, Line([0.0; LINE]));
    }
    // SAFETY: a line has as many elements, and nothing else.
    let elements = unsafe { core::slice::from_raw_parts_mut(memory.as_mut_ptr().cast::<f32>(), lines * LINE) };
    elements[..first + second].split_at_mut(first)
}

/// Copies columns so that those of a tile are neighbours. `to` is the memory and the distance between copied tiles.
///
/// # Safety
/// The columns must be valid.
unsafe fn copy_tiles<const COLUMNS: usize>(
    from: &Matrix<*const f32>,
    columns: Range<usize>,
    (to, distance): (&mut [f32], usize),
) {
    for row in 0..(distance - LINE) / COLUMNS {
        for (tile, first) in columns.clone().step_by(COLUMNS).enumerate() {
            let from = from.at(row, first);
            let to = to[tile * distance + row * COLUMNS..].first_chunk_mut::<COLUMNS>().expect("a row of a tile");
            if from.to_next_column == 1 && columns.end - first >= COLUMNS {
                // SAFETY: the elements are neighbours; as for this function.
                *to = unsafe { from.first.cast::<[f32; COLUMNS]>().read() };
            } else {
                for (column, to) in to.iter_mut().take(columns.end - first).enumerate() {
                    // SAFETY: as for this function.
                    *to = unsafe { from.at(0, column).first.read() };
                }
            }
        }
    }
}

/// Lays out rows as a panel with `height` rows, of which those beyond are 0.
///
/// # Safety
/// The rows must be valid, the elements of rows or of columns neighbours, and the processor must have AVX.
#[target_feature(enable = "avx")]
unsafe fn lay_out<const LANES: usize>(from: &Matrix<*const f32>, rows: Range<usize>, height: usize, to: &mut [f32]) {
    let (from, count) = (from.at(rows.start, 0), rows.len());
    if from.to_next_row != 1 {
        // SAFETY: as for this function.
        return unsafe { transpose(&from, count, height, to) };
    }
    for (column, to) in to.chunks_exact_mut(height).enumerate() {
        // SAFETY: the elements of the column are neighbours; as for this function.
        let column = unsafe { core::slice::from_raw_parts(from.at(0, column).first, count) };
        let (to, beyond) = to.split_at_mut(count);
        let ((vectors, rest), (to, to_rest)) = (column.as_chunks::<LANES>(), to.as_chunks_mut::<LANES>());
        to.iter_mut().zip(vectors).for_each(|(to, vector)| *to = *vector);
        to_rest.copy_from_slice(rest);
        beyond.fill(0.0);
    }
}

/// The sides of the squares in which [`transpose`] moves elements.
const SQUARE: usize = 8;

/// As [`lay_out`], for rows whose elements are neighbours.
///
/// # Safety
/// As for [`lay_out`].
#[target_feature(enable = "avx")]
unsafe fn transpose(from: &Matrix<*const f32>, rows: usize, height: usize, to: &mut [f32]) {
    let columns = to.len() / height;
    let [whole_rows, whole_columns] = [rows, columns].map(|side| side / SQUARE * SQUARE);
    for column in (0..whole_columns).step_by(SQUARE) {
        for row in (0..whole_rows).step_by(SQUARE) {
            for half in [column, column + SQUARE / 2] {
                // SAFETY: the square lies in the matrix.
                let four = unsafe { four_columns(&from.at(row, half)) };
                for (values, to) in four.into_iter().zip(to[half * height..].chunks_exact_mut(height)) {
                    let to: &mut [f32; SQUARE] = to[row..].first_chunk_mut().expect("a column of a square");
                    // SAFETY: there is room for eight elements.
                    unsafe { _mm256_storeu_ps(to.as_mut_ptr(), values) };
                }
            }
        }
    }
    for (column, to) in to.chunks_exact_mut(height).enumerate() {
        let first = if column < whole_columns { whole_rows } else { 0 };
        for (row, to) in to.iter_mut().enumerate().take(rows).skip(first) {
            // SAFETY: the element lies in the matrix.
            *to = unsafe { from.at(row, column).first.read() };
        }
        to[rows..].fill(0.0);
    }
}

/// Returns the first four columns of the first eight rows of a matrix, the elements of whose rows are neighbours.
///
/// # Safety
/// The elements must be valid.
#[inline]
#[target_feature(enable = "avx")]
unsafe fn four_columns(from: &Matrix<*const f32>) -> [__m256; 4] {
    let rows: [__m256; 4] = std::array::from_fn(|row| {
        // A row, and the one four further on.
        // SAFETY: as for this function.
        let [low, high] = [row, row + 4].map(|row| unsafe { _mm_loadu_ps(from.at(row, 0).first) });
        _mm256_insertf128_ps::<1>(_mm256_castps128_ps256(low), high)
    });
    let [a, b, c, d] = rows;
    let [ab_first, ab_last] = [_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b)];
    let [cd_first, cd_last] = [_mm256_unpacklo_ps(c, d), _mm256_unpackhi_ps(c, d)];
    // The first two elements of each half of the vectors, then the last two.
    [
        _mm256_shuffle_ps::<0b01_00_01_00>(ab_first, cd_first),
        _mm256_shuffle_ps::<0b11_10_11_10>(ab_first, cd_first),
        _mm256_shuffle_ps::<0b01_00_01_00>(ab_last, cd_last),
        _mm256_shuffle_ps::<0b11_10_11_10>(ab_last, cd_last),
    ]
}
