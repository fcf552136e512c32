//! Tests of the bits of products.

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

#[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
fn has_fma() -> bool {
    std::arch::is_x86_feature_detected!("fma") && std::arch::is_x86_feature_detected!("avx2")
}

#[cfg(not(any(target_arch = "x86", target_arch = "x86_64")))]
fn has_fma() -> bool {
    false
}

/// Products of every orientation, with small and large sides and with long sums, that are added to what is there.
#[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
#[test]
fn vectors_of_both_widths_give_the_same_bits() {
    if !(has_fma() && std::arch::is_x86_feature_detected!("avx512f")) {
        return;
    }
    for m in [1, 7, 16, 33, 64, 130] {
        for n in [1, 5, 6, 17, 65] {
            for k in [1, 2, 3, 24, 129, 700] {
                for layouts in 0..8 {
                    let (lhs, rhs) = (values(m * k, 1), values(k * n, 5));
                    let [with_avx512, with_avx2] = [None, Some(single::fma as Kernel<f32>)].map(|kernel| {
                        let mut out = values(m * n, 3);
                        // The strides to the next column and row: row-major or column-major.
                        let strides = |bit: usize, rows: usize, columns: usize| {
                            if layouts >> bit & 1 == 0 { (1, columns as isize) } else { (rows as isize, 1) }
                        };
                        let [dst, l, r] = [strides(0, m, n), strides(1, m, k), strides(2, k, n)];
                        let product = Product {
                            sides: [m, n, k],
                            dst: Matrix::new(out.as_mut_ptr(), dst.0, dst.1),
                            lhs: Matrix::new(lhs.as_ptr(), l.0, l.1),
                            rhs: Matrix::new(rhs.as_ptr(), r.0, r.1),
                        };
                        let choose = |product: &Product<f32>| {
                            kernel.unwrap_or_else(|| single::kernel(product.has_sums_over_lanes()))
                        };
                        // SAFETY: the matrices have the stated sizes.
                        unsafe { in_blocks(choose, product, (Some(0.5), 2.0, 1.0), Parallelism::None) };
                        out
                    });
                    assert!(with_avx512 == with_avx2, "{m} x {k} x {n}, layouts {layouts}");
                }
            }
        }
    }
}

#[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
#[test]
fn a_copied_left_matrix_gives_the_bits_of_the_kernels() {
    for m in [16, 33, 70, 130] {
        for n in [2, 9, 65] {
            for k in [16, 31, 200] {
                let (lhs, rhs) = (values(m * k, 1), values(k * n, 5));
                let [copied, given] = [true, false].map(|is_copied| {
                    let mut out = values(m * n, 3);
                    // Rows on the left, and a result of columns.
                    let product = Product {
                        sides: [m, n, k],
                        dst: Matrix::new(out.as_mut_ptr(), m as isize, 1),
                        lhs: Matrix::new(lhs.as_ptr(), 1, k as isize),
                        rhs: Matrix::new(rhs.as_ptr(), 1, n as isize),
                    };
                    assert!(product.has_rows_on_the_left());
                    // SAFETY: the matrices have the stated sizes.
                    unsafe {
                        if is_copied {
                            in_blocks(|_| single::kernel(false), product, (Some(0.5), 2.0, 1.0), Parallelism::None);
                        } else {
                            let Product { dst, lhs, rhs, .. } = product;
                            single::kernel(false)(
                                m,
                                n,
                                k,
                                dst.first,
                                dst.to_next_column,
                                dst.to_next_row,
                                true,
                                lhs.first,
                                lhs.to_next_column,
                                lhs.to_next_row,
                                rhs.first,
                                rhs.to_next_column,
                                rhs.to_next_row,
                                0.5,
                                2.0,
                                false,
                                false,
                                false,
                                Parallelism::None,
                            );
                        }
                    }
                    out
                });
                assert!(copied == given, "{m} x {k} x {n}");
            }
        }
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
