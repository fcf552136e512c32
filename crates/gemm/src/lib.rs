//! The matrix product of Burn's CPU backend, with sums that are the same on every machine.
//!
//! Burn calls [`gemm()`] of the registry's crate of this name, which this one replaces (`[patch]` in the `Cargo.toml` of the
//! workspace). The original cuts a long sum into blocks whose length follows from the size and the ways of the processor's first
//! cache: 512 products with 32 KiB and 8 ways, 1024 with 48 KiB and 12. Rounded sums depend on where they are cut, so that a training
//! gave other weights on another processor. Here sums of more than 512 products are cut into equal blocks of at most 512 first, which
//! the original's kernels (`gemm-f32` and its siblings) compute as one on every machine. Nothing else of a kernel's
//! result depends on the caches.
//!
//! Of single precision, products are computed with AVX-512 where the processor has it, in tiles whose elements are summed one by one
//! like those of AVX2. Products of rows with columns are the exception: their sums are over the lanes of a vector, so that they
//! are computed with AVX2 everywhere. All but small products are laid out for these kernels in `tiles.rs`.

#![allow(unsafe_code, reason = "products are computed on pointers, as Burn gives them")]

use core::any::TypeId;
pub use gemm_common::Parallelism;

#[cfg(target_arch = "x86_64")]
mod single;
#[cfg(test)]
mod tests;
#[cfg(target_arch = "x86_64")]
mod tiles;

/// The longest sum that the kernels do not cut, whatever the caches.
const BLOCK: usize = 512;
/// The largest side of products for which the kernels always cut sums after 512 products.
const SMALL: usize = 64;
/// The most elements of products of rows with columns, which the kernels cut after 1024 products on every machine.
const DOTS: usize = 16 * 16;

/// A product of matrices: `[m, k]` times `[k, n]`.
struct Product<T> {
    /// m, n and k.
    sides: [usize; 3],
    dst: Matrix<*mut T>,
    lhs: Matrix<*const T>,
    rhs: Matrix<*const T>,
}

/// The first element of a matrix, and the distances between neighbours along a row (from column to column) and along a column.
#[derive(Clone, Copy)]
struct Matrix<P> {
    first: P,
    to_next_column: isize,
    to_next_row: isize,
}

impl<T> Product<T> {
    /// The same product, of elements of the type that `T` is.
    fn cast<U>(self) -> Product<U> {
        let Self { sides, dst, lhs, rhs } = self;
        Product {
            sides,
            dst: Matrix::new(dst.first.cast(), dst.to_next_column, dst.to_next_row),
            lhs: Matrix::new(lhs.first.cast(), lhs.to_next_column, lhs.to_next_row),
            rhs: Matrix::new(rhs.first.cast(), rhs.to_next_column, rhs.to_next_row),
        }
    }

    /// Returns the product whose destination has its elements of a column closer than those of a row, as the kernels prefer.
    fn oriented(self) -> Self {
        if self.dst.to_next_column.abs() >= self.dst.to_next_row.abs() {
            return self;
        }
        let [m, n, k] = self.sides;
        Self { sides: [n, m, k], dst: self.dst.transposed(), lhs: self.rhs.transposed(), rhs: self.lhs.transposed() }
    }

    /// Whether neighbouring terms of a sum are neighbours in memory, in both matrices.
    fn is_of_rows_and_columns(&self) -> bool {
        self.lhs.to_next_column == 1 && self.rhs.to_next_row == 1
    }

    /// Whether the kernels sum the lanes of vectors, whose number then decides how sums are rounded.
    fn has_sums_over_lanes(&self) -> bool {
        let [m, n, _] = self.sides;
        self.is_of_rows_and_columns() && (m * n <= DOTS || m.min(n) <= 1)
    }

    /// Returns the lengths of the blocks into which sums are cut here; the last may be shorter.
    fn block(&self) -> usize {
        let [m, n, k] = self.sides;
        let (lhs, rhs, dst) = (&self.lhs, &self.rhs, &self.dst);
        let of_rows_and_columns = self.is_of_rows_and_columns();
        let by_columns = n <= 1 && lhs.to_next_row == 1 && dst.to_next_row == 1;
        let by_rows = m <= 1 && rhs.to_next_column == 1 && dst.to_next_column == 1;
        let is_vector = by_columns || by_rows || (m.min(n) <= 1 && of_rows_and_columns);
        let is_cut_alike = m.max(n) <= SMALL || is_vector || (of_rows_and_columns && m * n <= DOTS);
        if k <= BLOCK || is_cut_alike { k } else { k.div_ceil(k.div_ceil(BLOCK)) }
    }
}

impl<P> Matrix<P> {
    const fn new(first: P, to_next_column: isize, to_next_row: isize) -> Self {
        Self { first, to_next_column, to_next_row }
    }

    fn transposed(self) -> Self {
        Self { to_next_column: self.to_next_row, to_next_row: self.to_next_column, ..self }
    }
}

/// Pointers to elements.
trait Pointer: Copy {
    /// Returns the pointer to the element at a distance, in elements.
    fn offset(self, distance: isize) -> Self;
}

impl<T> Pointer for *const T {
    fn offset(self, distance: isize) -> Self {
        self.wrapping_offset(distance)
    }
}

impl<T> Pointer for *mut T {
    fn offset(self, distance: isize) -> Self {
        self.wrapping_offset(distance)
    }
}

impl<P: Pointer> Matrix<P> {
    /// Returns the matrix below and to the right of an element.
    #[inline(always)]
    fn at(&self, row: usize, column: usize) -> Self {
        let distance = row as isize * self.to_next_row + column as isize * self.to_next_column;
        Self { first: self.first.offset(distance), ..*self }
    }
}

/// A kernel: as [`gemm()`], for one type.
type Kernel<T> = unsafe fn(
    usize,
    usize,
    usize,
    *mut T,
    isize,
    isize,
    bool,
    *const T,
    isize,
    isize,
    *const T,
    isize,
    isize,
    T,
    T,
    bool,
    bool,
    bool,
    Parallelism,
);

/// The factors of a product: of the destination, none if it is not read, and of the product of the two other matrices.
type Factors<T> = (Option<T>, T);

/// Computes a product with a kernel of another crate. `zero` is any factor of a destination that is not read.
///
/// # Safety
/// As for [`gemm()`].
unsafe fn call<T: Copy>(
    kernel: Kernel<T>,
    product: &Product<T>,
    (alpha, beta): Factors<T>,
    zero: T,
    parallelism: Parallelism,
) {
    let Product { sides: [m, n, k], dst, lhs, rhs } = product;
    // SAFETY: as for this function.
    unsafe {
        kernel(
            *m,
            *n,
            *k,
            dst.first,
            dst.to_next_column,
            dst.to_next_row,
            alpha.is_some(),
            lhs.first,
            lhs.to_next_column,
            lhs.to_next_row,
            rhs.first,
            rhs.to_next_column,
            rhs.to_next_row,
            alpha.unwrap_or(zero),
            beta,
            false,
            false,
            false,
            parallelism,
        );
    }
}

/// Single precision on other processors.
#[cfg(not(target_arch = "x86_64"))]
mod single {
    use crate::{Factors, Parallelism, Product, call};

    /// Computes a product.
    ///
    /// # Safety
    /// As for [`gemm()`](crate::gemm()).
    pub unsafe fn multiply(product: &Product<f32>, factors: Factors<f32>, parallelism: Parallelism) {
        // SAFETY: as for this function.
        unsafe { call(gemm_f32::gemm::f32::get_gemm_fn(), product, factors, 0.0, parallelism) };
    }
}

/// Computes a product block by block. `multiply` computes a block, of which it vouches that all elements are valid; `one` is 1.
fn in_blocks<T: Copy>(
    multiply: impl Fn(&Product<T>, Factors<T>),
    product: Product<T>,
    (mut alpha, beta): Factors<T>,
    one: T,
) {
    let product = product.oriented();
    let block = product.block();
    let Product { sides: [m, n, k], dst, lhs, rhs } = product;
    let mut done = 0;
    loop {
        let length = block.min(k - done);
        let block = Product { sides: [m, n, length], dst, lhs: lhs.at(0, done), rhs: rhs.at(done, 0) };
        multiply(&block, (alpha, beta));
        done += length;
        // The destination holds the sum of the blocks so far.
        alpha = Some(one);
        if done == k {
            return;
        }
    }
}

/// Computes `dst = alpha * dst + beta * lhs * rhs`, without the first term unless `read_dst`. A matrix is given by its first element
/// and the distances, in elements, between neighbours in a row (`_cs`, from column to column) and in a column (`_rs`).
///
/// # Shapes
/// `dst` is `[m, n]`, `lhs` `[m, k]` and `rhs` `[k, n]`.
///
/// # Panics
/// If `T` is not `f32`, `f64` or `f16`, or a matrix is to be conjugated.
///
/// # Safety
/// All elements of the three matrices must be valid, and no other thread may access those of `dst`.
#[allow(clippy::too_many_arguments, clippy::fn_params_excessive_bools, reason = "the signature that Burn calls")]
pub unsafe fn gemm<T: 'static>(
    m: usize,
    n: usize,
    k: usize,
    dst: *mut T,
    dst_cs: isize,
    dst_rs: isize,
    read_dst: bool,
    lhs: *const T,
    lhs_cs: isize,
    lhs_rs: isize,
    rhs: *const T,
    rhs_cs: isize,
    rhs_rs: isize,
    alpha: T,
    beta: T,
    conj_dst: bool,
    conj_lhs: bool,
    conj_rhs: bool,
    parallelism: Parallelism,
) {
    assert!(!(conj_dst || conj_lhs || conj_rhs), "products of complex numbers are not computed here");
    let product = Product {
        sides: [m, n, k],
        dst: Matrix::new(dst, dst_cs, dst_rs),
        lhs: Matrix::new(lhs, lhs_cs, lhs_rs),
        rhs: Matrix::new(rhs, rhs_cs, rhs_rs),
    };
    let factors = (read_dst.then_some(alpha), beta);
    let factors = &raw const factors;
    // SAFETY: `T` is the type that is compared; otherwise as for this function.
    unsafe {
        if TypeId::of::<T>() == TypeId::of::<f32>() {
            let multiply = |product: &_, factors| single::multiply(product, factors, parallelism);
            in_blocks(multiply, product.cast(), factors.cast::<Factors<f32>>().read(), 1.0);
        } else if TypeId::of::<T>() == TypeId::of::<f64>() {
            let kernel = gemm_f64::gemm::f64::get_gemm_fn();
            let multiply = |product: &_, factors| call(kernel, product, factors, 0.0, parallelism);
            in_blocks(multiply, product.cast(), factors.cast::<Factors<f64>>().read(), 1.0);
        } else {
            assert!(TypeId::of::<T>() == TypeId::of::<gemm_f16::f16>(), "products of this type are not computed here");
            let (kernel, zero) = (gemm_f16::gemm::f16::get_gemm_fn(), gemm_f16::f16::ZERO);
            let multiply = |product: &_, factors| call(kernel, product, factors, zero, parallelism);
            let factors = factors.cast::<Factors<gemm_f16::f16>>().read();
            in_blocks(multiply, product.cast(), factors, gemm_f16::f16::ONE);
        }
    }
}
