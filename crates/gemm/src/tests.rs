//! Tests of the sums' bits.

use super::*;

/// Values between -1 and 1 that have no short binary form.
fn values(count: usize, seed: usize) -> Vec<f32> {
    (0..count).map(|i| (((i + seed) * 7919 % 10007) as f32 / 5003.5 - 1.0) * 0.9).collect()
}

/// The product of row-major matrices, with sums that are cut into blocks of this length.
fn expected(sides: [usize; 3], lhs: &[f32], rhs: &[f32], block: usize) -> Vec<f32> {
    let [m, n, k] = sides;
    let sum = |row: usize, column: usize| {
        let of_block = |start: usize| {
            let range = start..(start + block).min(k);
            range.fold(0.0_f32, |sum, i| lhs[row * k + i].mul_add(rhs[i * n + column], sum))
        };
        (0..k).step_by(block).map(of_block).reduce(|sum, of_block| sum + of_block).unwrap_or(0.0)
    };
    (0..m * n).map(|i| sum(i / n, i % n)).collect()
}

fn product(sides: [usize; 3], lhs: &[f32], rhs: &[f32], parallelism: Parallelism) -> Vec<f32> {
    let [m, n, k] = sides;
    assert_eq!((lhs.len(), rhs.len()), (m * k, k * n));
    let mut out = vec![f32::NAN; m * n];
    let (n_, k_) = (n as isize, k as isize);
    // SAFETY: the matrices have the stated sizes.
    unsafe {
        gemm(
            m,
            n,
            k,
            out.as_mut_ptr(),
            1,
            n_,
            false,
            lhs.as_ptr(),
            1,
            k_,
            rhs.as_ptr(),
            1,
            n_,
            0.0,
            1.0,
            false,
            false,
            false,
            parallelism,
        );
    }
    out
}

#[test]
fn sums_have_the_same_bits_on_every_machine() {
    let fused = cfg!(target_arch = "aarch64") || has_fma();
    // Blocks of 512 and less, of 512 and a rest where both sides are small, and one that is not cut.
    for (sides, block) in [
        ([70, 33, 700], 350),
        ([66, 130, 1025], 342),
        ([130, 5, 2048], 512),
        ([64, 64, 700], 512),
        ([80, 40, 512], 512),
        ([3, 90, 9], 9),
    ] {
        let [m, n, k] = sides;
        let (lhs, rhs) = (values(m * k, 1), values(k * n, 5));
        let found = product(sides, &lhs, &rhs, Parallelism::None);
        #[cfg(feature = "rayon")]
        assert!(found == product(sides, &lhs, &rhs, Parallelism::Rayon(2)), "{sides:?}: threads change the sums");
        let expected = expected(sides, &lhs, &rhs, block);
        let largest = found.iter().zip(&expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(largest < 1e-4, "{sides:?}: off by {largest}");
        assert!(!fused || found == expected, "{sides:?}: sums are cut elsewhere, off by {largest}");
    }
}

#[cfg(target_arch = "x86_64")]
fn has_fma() -> bool {
    std::arch::is_x86_feature_detected!("fma") && std::arch::is_x86_feature_detected!("avx2")
}

#[cfg(not(target_arch = "x86_64"))]
fn has_fma() -> bool {
    false
}

/// The distances between neighbours of a matrix, how many elements they span, and the index of the first.
#[cfg(target_arch = "x86_64")]
struct Layout {
    to_next_column: isize,
    to_next_row: isize,
    length: usize,
    first: usize,
}

#[cfg(target_arch = "x86_64")]
impl Layout {
    fn new(rows: usize, columns: usize, [to_next_column, to_next_row]: [isize; 2]) -> Self {
        let spans = [(columns, to_next_column), (rows, to_next_row)].map(|(n, step)| (n as isize - 1) * step);
        let before: isize = spans.iter().map(|span| span.min(&0)).sum();
        let after: isize = spans.iter().map(|span| span.max(&0)).sum();
        Self { to_next_column, to_next_row, length: (after - before + 1) as usize, first: (-before) as usize }
    }
}

/// All ways to compute a product whose matrices have these layouts give the bits of a kernel without tiles, and write no other
/// element.
#[cfg(target_arch = "x86_64")]
fn check_ways(sides: [usize; 3], [dst, lhs, rhs]: [&Layout; 3], alpha: Option<f32>) {
    type Way<'a> = (&'a str, &'a dyn Fn(&Product<f32>, Factors<f32>));
    // The elements before and behind the destination.
    const EDGE: usize = 32;
    let (left, right) = (values(lhs.length, 1), values(rhs.length, 5));
    // SAFETY: the layouts are those of the memory, and the processor has the instructions.
    let ways: &[Way<'_>] = unsafe {
        &[
            ("kernel", &|product, factors| call(single::fma::kernel, product, factors, 0.0, Parallelism::None)),
            ("AVX2", &|product, factors| single::fma::multiply(product, factors, Parallelism::None)),
            ("widest", &|product, factors| single::multiply(product, factors, Parallelism::None)),
            #[cfg(feature = "rayon")]
            ("three threads", &|product, factors| single::multiply(product, factors, Parallelism::Rayon(3))),
            #[cfg(feature = "rayon")]
            ("many threads", &|product, factors| single::multiply(product, factors, Parallelism::Rayon(40))),
        ]
    };
    let outs = ways.iter().map(|(name, way)| {
        let mut out = values(dst.length + 2 * EDGE, 3);
        let product = Product {
            sides,
            dst: Matrix::new(out[EDGE + dst.first..].as_mut_ptr(), dst.to_next_column, dst.to_next_row),
            lhs: Matrix::new(left[lhs.first..].as_ptr(), lhs.to_next_column, lhs.to_next_row),
            rhs: Matrix::new(right[rhs.first..].as_ptr(), rhs.to_next_column, rhs.to_next_row),
        };
        in_blocks(*way, product, (alpha, 2.0), 1.0);
        (name, out.into_iter().map(f32::to_bits).collect::<Vec<_>>())
    });
    let outs: Vec<_> = outs.collect();
    for (name, out) in &outs[1..] {
        let steps = [dst, lhs, rhs].map(|layout| [layout.to_next_column, layout.to_next_row]);
        assert!(*out == outs[0].1, "{sides:?}, {steps:?}, {alpha:?}: {name}");
    }
}

/// Products of every orientation, with small and large sides and with long sums.
#[cfg(target_arch = "x86_64")]
#[test]
fn vectors_of_both_widths_tiles_and_threads_give_the_bits_of_the_kernels() {
    if !has_fma() {
        return;
    }
    let small = [1, 7, 16, 33, 64, 130].map(|m| [1, 5, 6, 17, 65].map(|n| [1, 2, 3, 24, 129, 700].map(|k| [m, n, k])));
    // More panels than are laid out at once, and rows of the right matrix that lie a multiple of 4 KiB apart.
    for sides in small.into_iter().flatten().flatten().chain([[330, 1024, 500]]) {
        let [m, n, k] = sides;
        for layouts in 0..8 {
            let layout = |bit: usize, rows: usize, columns: usize| {
                let row_major = layouts >> bit & 1 == 0;
                Layout::new(rows, columns, if row_major { [1, columns as isize] } else { [rows as isize, 1] })
            };
            let [dst, lhs, rhs] = [layout(0, m, n), layout(1, m, k), layout(2, k, n)];
            let alphas = if m > 200 { &[None][..] } else { &[None, Some(1.0), Some(0.5)] };
            alphas.iter().for_each(|alpha| check_ways(sides, [&dst, &lhs, &rhs], *alpha));
        }
    }
}

/// Products of parts of matrices, and of rows and columns that repeat or run backwards.
#[cfg(target_arch = "x86_64")]
#[test]
fn matrices_may_have_any_layout() {
    if !has_fma() {
        return;
    }
    let mut state = 1_u64;
    let mut draw = |below: usize| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as usize % below
    };
    for case in 0..600 {
        let [m, n, k] = [2 + draw(200), 2 + draw(200), 1 + draw(560)];
        let mut layout = |rows: usize, columns: usize, is_read: bool| {
            let padding = [0, 1, 7][draw(3)];
            let [to_next_column, to_next_row] = match draw(if is_read { 6 } else { 4 }) {
                0 => [1, columns + padding],
                1 => [rows + padding, 1],
                2 => [1, 1024.max(columns)],
                3 => [2, 2 * columns + padding],
                4 => [1, 0],
                _ => [0, 1],
            }
            .map(|step| step as isize);
            let backwards = draw(6);
            let sign = |of: usize| if backwards == of { -1 } else { 1 };
            Layout::new(rows, columns, [sign(0) * to_next_column, sign(1) * to_next_row])
        };
        let [dst, lhs, rhs] = [layout(m, n, false), layout(m, k, true), layout(k, n, true)];
        check_ways([m, n, k], [&dst, &lhs, &rhs], [None, Some(1.0), Some(0.5), Some(0.0)][case % 4]);
    }
}

#[test]
fn the_destination_is_added_to_once() {
    let (lhs, rhs) = (values(70 * 700, 1), values(700 * 66, 5));
    let plain = product([70, 66, 700], &lhs, &rhs, Parallelism::None);
    let mut out = vec![2.0_f64; 70 * 66];
    let (lhs, rhs): (Vec<f64>, Vec<f64>) =
        (lhs.iter().map(|v| (*v).into()).collect(), rhs.iter().map(|v| (*v).into()).collect());
    // SAFETY: the matrices have the stated sizes. The destination is column-major.
    unsafe {
        gemm(
            70,
            66,
            700,
            out.as_mut_ptr(),
            70,
            1,
            true,
            lhs.as_ptr(),
            1,
            700,
            rhs.as_ptr(),
            1,
            66,
            0.5,
            2.0,
            false,
            false,
            false,
            Parallelism::None,
        );
    }
    for (i, found) in out.iter().enumerate() {
        let expected = 0.5 * 2.0 + 2.0 * f64::from(plain[(i % 70) * 66 + i / 70]);
        assert!((found - expected).abs() < 1e-3, "{i}: {found}, expected {expected}");
    }
}
