//! Resampling of position embeddings from the patch grid of the trained embeddings to another grid.

use burn::tensor::{Tensor, TensorData};

/// The method that resamples a grid of position embeddings; the results equal PyTorch's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Resampling {
    /// Bicubic with the four nearest neighbours per axis, as in ViT and DINOv2.
    Bicubic,
    /// Bicubic with a wider neighbourhood where the grid becomes smaller, as in DINOv2 with registers.
    Antialiased,
}

/// Resamples position embeddings to a square grid of `count` patches. Returns them unchanged if the grid already has
/// that size.
///
/// # Shapes
/// Maps `[1, 1 + grid * grid, dim]`, with the class token first, to `[1, 1 + count, dim]`.
pub fn positions(trained: Tensor<3>, count: usize, resampling: Resampling) -> Tensor<3> {
    let [_, all, dim] = trained.dims();
    if all == 1 + count {
        return trained;
    }
    let (from, to) = ((all - 1).isqrt(), count.isqrt());
    let resize = Tensor::<2>::from_data(TensorData::new(matrix(from, to, resampling), [to, from]), &trained.device());
    let class = trained.clone().slice([0..1, 0..1, 0..dim]);
    // Resamples the first axis and swaps it with the second axis, so that two calls resample both axes.
    let along = |grid: Tensor<3>| {
        let [_, other, dim] = grid.dims();
        resize.clone().matmul(grid.reshape([from, other * dim])).reshape([to, other, dim]).swap_dims(0, 1)
    };
    let grid = trained.slice([0..1, 1..all, 0..dim]).reshape([from, from, dim]);
    Tensor::cat(vec![class, along(along(grid)).reshape([1, count, dim])], 1)
}

/// The matrix that resamples `from` values to `to` values, with pixel centres at half-integers.
///
/// # Shapes
/// `[to, from]`.
fn matrix(from: usize, to: usize, resampling: Resampling) -> Vec<f32> {
    let scale = from as f64 / to as f64;
    // The parameter `a` and the width of the kernel, as in PyTorch.
    let (a, width) = match resampling {
        Resampling::Bicubic => (-0.75, 1.0),
        Resampling::Antialiased => (-0.5, scale.max(1.0)),
    };
    let mut weights = vec![0.0f64; to * from];
    for (index, row) in weights.chunks_exact_mut(from).enumerate() {
        let centre = (index as f64 + 0.5) * scale - 0.5;
        let reach = 2.0 * width;
        for index in (centre - reach).ceil() as i64..=(centre + reach).floor() as i64 {
            let weight = cubic((index as f64 - centre) / width, a);
            match resampling {
                // Repeats the border value outside of the grid.
                Resampling::Bicubic => row[index.clamp(0, from as i64 - 1) as usize] += weight,
                // Skips neighbours outside of the grid.
                Resampling::Antialiased if (0..from as i64).contains(&index) => row[index as usize] += weight,
                Resampling::Antialiased => {}
            }
        }
        let sum: f64 = row.iter().sum();
        row.iter_mut().for_each(|weight| *weight /= sum);
    }
    weights.into_iter().map(|weight| weight as f32).collect()
}

/// The cubic convolution kernel (Keys 1981, equation 4 for `a = -1/2`), which is 0 at distances of 2 and more.
fn cubic(x: f64, a: f64) -> f64 {
    let x = x.abs();
    match x {
        _ if x <= 1.0 => ((a + 2.0) * x - (a + 3.0)) * x * x + 1.0,
        _ if x < 2.0 => ((a * x - 5.0 * a) * x + 8.0 * a) * x - 4.0 * a,
        _ => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn position_resampling_preserves_constants_and_linear_ramps() {
        for resampling in [Resampling::Bicubic, Resampling::Antialiased] {
            for (from, to) in [(8, 5), (5, 8), (37, 16)] {
                let weights = matrix(from, to, resampling);
                for (index, row) in weights.chunks(from).enumerate() {
                    assert!((row.iter().sum::<f32>() - 1.0).abs() < 1e-6);
                    let centre = (index as f32 + 0.5) * from as f32 / to as f32 - 0.5;
                    // Only a kernel that does not reach the border of the grid preserves a ramp.
                    let reach = 2.0 * (from as f32 / to as f32).max(1.0);
                    if centre > reach && centre + reach < from as f32 - 1.0 && to > from {
                        let value: f32 = row.iter().enumerate().map(|(index, weight)| index as f32 * weight).sum();
                        assert!((value - centre).abs() < 1e-4, "{resampling:?} {from} to {to}: {value}, not {centre}");
                    }
                }
            }
        }
    }
}
