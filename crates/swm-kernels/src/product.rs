//! The products of [`Panels`]: tiles of the result, some rows of a panel, stay in registers while terms are added.
//!
//! Rows may lie anywhere in an array, and a row may be a concatenation of segments, so that convolutions read their
//! patches without copying them.

use crate::panels::{LANES, Pair, Panels, WIDTH};
use swm_simd::{CpuLevel, F32x16, Kernel, Level, dispatch};

/// The number of terms of a segment that are added between two checks of bounds.
const TERMS: usize = 16;

/// A vector of the level `L`.
type Vector<L> = <<L as Level>::F32x16 as F32x16>::Vector;

/// The indices in an array at which rows start.
pub(crate) trait Starts: Copy {
    /// Returns the index of the first element of a row.
    fn of(self, row: usize) -> usize;
}

/// Rows at a constant distance, given in elements.
impl Starts for usize {
    #[inline(always)]
    fn of(self, row: usize) -> usize {
        row * self
    }
}

/// Rows at listed indices.
impl Starts for &[usize] {
    #[inline(always)]
    fn of(self, row: usize) -> usize {
        self[row]
    }
}

/// A part of a row whose elements are contiguous.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Segment {
    /// The distance of the first element from the start of the row, in elements.
    pub offset: usize,
    /// The number of elements.
    pub length: usize,
}

/// The elements of a panel in one row of its matrix.
pub(crate) trait PanelRow {
    /// Returns one of the vectors of the row.
    fn vector(&self, index: usize) -> &[f32; LANES];
}

impl PanelRow for Pair {
    #[inline(always)]
    fn vector(&self, index: usize) -> &[f32; LANES] {
        &self[index].0
    }
}

impl PanelRow for [f32; WIDTH] {
    #[inline(always)]
    fn vector(&self, index: usize) -> &[f32; LANES] {
        &self.as_chunks().0[index]
    }
}

/// The left operand of a product.
pub(crate) trait Operand: Copy {
    /// Whether the operand is transposed and the product is added to the previous result.
    const ADDS: bool;

    /// Returns `sums` with the terms of rows `row .. row + R` and of `W` vectors of a panel. The sums are values, because the compiler
    /// keeps what it has a reference to in memory wherever a check of bounds could panic.
    fn accumulate<L: Level, P: PanelRow, const R: usize, const W: usize>(
        self,
        row: usize,
        panel: &[P],
        first: usize,
        sums: [[Vector<L>; W]; R],
    ) -> [[Vector<L>; W]; R];
}

/// The matrix `[rows, inputs]` whose rows are concatenations of segments.
#[derive(Clone, Copy)]
pub(crate) struct Rows<'a, S> {
    pub values: &'a [f32],
    pub starts: S,
    pub segments: &'a [Segment],
}

/// The transpose of the matrix `[inputs, rows]`.
#[derive(Clone, Copy)]
pub(crate) struct Columns<'a, S> {
    pub values: &'a [f32],
    pub starts: S,
}

/// Adds `x * weights` to a row of a tile.
#[inline(always)]
fn add_term<L: Level, const W: usize>(sums: &mut [Vector<L>; W], x: f32, weights: &[Vector<L>; W]) {
    let simd = L::f32x16();
    let x = simd.splat(x);
    for w in 0..W {
        sums[w] = simd.fma(x, weights[w], sums[w]);
    }
}

/// Loads `W` vectors of a row of a panel.
#[inline(always)]
fn load<L: Level, const W: usize>(row: &impl PanelRow, first: usize) -> [Vector<L>; W] {
    std::array::from_fn(|w| L::f32x16().load(row.vector(first + w)))
}

impl<S: Starts> Operand for Rows<'_, S> {
    const ADDS: bool = false;

    #[inline(always)]
    fn accumulate<L: Level, P: PanelRow, const R: usize, const W: usize>(
        self,
        row: usize,
        panel: &[P],
        first: usize,
        mut sums: [[Vector<L>; W]; R],
    ) -> [[Vector<L>; W]; R] {
        let starts: [usize; R] = std::array::from_fn(|r| self.starts.of(row + r));
        let mut later = panel;
        for segment in self.segments {
            let (now, rest) = later.split_at(segment.length);
            later = rest;
            let (blocks, last) = now.as_chunks::<TERMS>();
            let mut rows: [(&[[f32; TERMS]], &[f32]); R] = [(&[], &[]); R];
            for r in 0..R {
                rows[r] = self.values[starts[r] + segment.offset..][..segment.length].as_chunks();
            }
            for (block, pairs) in blocks.iter().enumerate() {
                let mut terms = [&[0.0; TERMS]; R];
                for r in 0..R {
                    terms[r] = &rows[r].0[block];
                }
                for p in 0..TERMS {
                    let weights = load::<L, W>(&pairs[p], first);
                    for r in 0..R {
                        add_term::<L, W>(&mut sums[r], terms[r][p], &weights);
                    }
                }
            }
            for (p, pair) in last.iter().enumerate() {
                let weights = load::<L, W>(pair, first);
                for r in 0..R {
                    add_term::<L, W>(&mut sums[r], rows[r].1[p], &weights);
                }
            }
        }
        sums
    }
}

impl<S: Starts> Operand for Columns<'_, S> {
    const ADDS: bool = true;

    #[inline(always)]
    fn accumulate<L: Level, P: PanelRow, const R: usize, const W: usize>(
        self,
        row: usize,
        panel: &[P],
        first: usize,
        mut sums: [[Vector<L>; W]; R],
    ) -> [[Vector<L>; W]; R] {
        for (p, pair) in panel.iter().enumerate() {
            let weights = load::<L, W>(pair, first);
            let column = &self.values[self.starts.of(p) + row..][..R];
            for r in 0..R {
                add_term::<L, W>(&mut sums[r], column[r], &weights);
            }
        }
        sums
    }
}

/// Computes the product of `rows` rows of `x` with a matrix. `y` is the array of the result and the starts of its rows.
pub(crate) fn multiply<X: Operand, S: Starts>(rows: usize, x: X, weights: &Panels, y: (&mut [f32], S)) {
    dispatch(Product { rows, x, weights, y });
}

struct Product<'a, X, S> {
    rows: usize,
    x: X,
    weights: &'a Panels,
    y: (&'a mut [f32], S),
}

/// One panel of a matrix.
#[derive(Clone, Copy)]
struct Panel<'a> {
    /// The index of the first column.
    first: usize,
    elements: &'a [Pair],
    bias: &'a Pair,
}

impl<X: Operand, S: Starts> Kernel for Product<'_, X, S> {
    type Output = ();

    #[inline(always)]
    fn run<L: Level>(mut self) {
        let (rows, inputs) = (self.rows, self.weights.inputs);
        for (index, bias) in self.weights.bias.iter().enumerate() {
            let panel =
                Panel { first: index * WIDTH, elements: &self.weights.elements[index * inputs..][..inputs], bias };
            for_tiles::<L>(rows, &mut (&mut self, panel));
        }
    }
}

/// A product of some rows with one panel.
trait Tiles {
    /// Computes `R` rows, `W` vectors at a time.
    fn tile<L: Level, const R: usize, const W: usize>(&mut self, row: usize);
}

/// Computes `rows` rows. The first tiles have as many rows as the registers hold, and smaller tiles compute the remaining rows.
#[inline(always)]
fn for_tiles<L: Level>(rows: usize, product: &mut impl Tiles) {
    let mut row = 0;
    if L::CPU == CpuLevel::Avx512 {
        while rows - row >= 12 {
            product.tile::<L, 12, 2>(row);
            row += 12;
        }
        if rows - row >= 8 {
            product.tile::<L, 8, 2>(row);
            row += 8;
        }
        if rows - row >= 4 {
            product.tile::<L, 4, 2>(row);
            row += 4;
        }
    } else {
        while rows - row >= 6 {
            product.tile::<L, 6, 1>(row);
            row += 6;
        }
    }
    while row < rows {
        product.tile::<L, 1, 2>(row);
        row += 1;
    }
}

impl<X: Operand, S: Starts> Tiles for (&mut Product<'_, X, S>, Panel<'_>) {
    #[inline(always)]
    fn tile<L: Level, const R: usize, const W: usize>(&mut self, row: usize) {
        let (product, panel) = self;
        for half in (0..WIDTH / LANES).step_by(W) {
            let first = panel.first + half * LANES;
            if first >= product.weights.outputs {
                break;
            }
            let sums = [load::<L, W>(panel.bias, half); R];
            let sums = product.x.accumulate::<L, _, R, W>(row, panel.elements, half, sums);
            let width = (product.weights.outputs - first).min(W * LANES);
            for r in 0..R {
                let to = &mut product.y.0[product.y.1.of(row + r) + first..][..width];
                if let Some(to) = to.as_chunks_mut::<LANES>().0.first_chunk_mut::<W>() {
                    store::<L, W, X>(&sums[r], to);
                } else {
                    let mut whole = [[0.0; LANES]; W];
                    whole.as_flattened_mut()[..width].copy_from_slice(to);
                    store::<L, W, X>(&sums[r], &mut whole);
                    to.copy_from_slice(&whole.as_flattened()[..width]);
                }
            }
        }
    }
}

/// What follows a product in [`multiply_panel`].
#[derive(Clone, Copy)]
pub(crate) enum Then<'a> {
    /// Nothing.
    Nothing,
    /// A bias for each row.
    Bias(&'a [f32]),
    /// A bias for each row, then ReLU; NaN stays NaN.
    BiasRelu(&'a [f32]),
    /// 0 where an element of an array of the same shape is not positive.
    WherePositive(&'a [[f32; WIDTH]]),
}

/// Replaces `y` by the product of as many rows of `x` with one panel.
pub(crate) fn multiply_panel<X: Operand>(x: X, panel: &[[f32; WIDTH]], y: &mut [[f32; WIDTH]], then: Then<'_>) {
    dispatch(PanelProduct { x, panel, y, then });
}

struct PanelProduct<'a, X> {
    x: X,
    panel: &'a [[f32; WIDTH]],
    y: &'a mut [[f32; WIDTH]],
    then: Then<'a>,
}

impl<X: Operand> Kernel for PanelProduct<'_, X> {
    type Output = ();

    #[inline(always)]
    fn run<L: Level>(mut self) {
        for_tiles::<L>(self.y.len(), &mut self);
    }
}

impl<X: Operand> Tiles for PanelProduct<'_, X> {
    #[inline(always)]
    fn tile<L: Level, const R: usize, const W: usize>(&mut self, row: usize) {
        let simd = L::f32x16();
        for half in (0..WIDTH / LANES).step_by(W) {
            let sums = [[simd.splat(0.0); W]; R];
            let sums = self.x.accumulate::<L, _, R, W>(row, self.panel, half, sums);
            for r in 0..R {
                for w in 0..W {
                    let sum = sums[r][w];
                    let value = match self.then {
                        Then::Nothing => sum,
                        Then::Bias(bias) => simd.add(sum, simd.splat(bias[row + r])),
                        Then::BiasRelu(bias) => simd.max(simd.splat(0.0), simd.add(sum, simd.splat(bias[row + r]))),
                        Then::WherePositive(y) => simd.where_positive(simd.load(y[row + r].vector(half + w)), sum),
                    };
                    simd.store(value, &mut self.y[row + r].as_chunks_mut().0[half + w]);
                }
            }
        }
    }
}

/// Stores a row of a tile.
#[inline(always)]
fn store<L: Level, const W: usize, X: Operand>(sums: &[Vector<L>; W], to: &mut [[f32; LANES]; W]) {
    let simd = L::f32x16();
    for w in 0..W {
        let sum = if X::ADDS { simd.add(simd.load(&to[w]), sums[w]) } else { sums[w] };
        simd.store(sum, &mut to[w]);
    }
}
