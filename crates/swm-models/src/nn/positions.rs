//! Positions that were learnt for one grid of patches, used on another.

use burn::tensor::{Tensor, TensorData};

/// How a grid of positions is resampled; both as PyTorch does it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Resampling {
    /// Bicubic through the four nearest, as ViT and DINOv2 ask for.
    Bicubic,
    /// Bicubic, over a wider neighbourhood where the grid becomes smaller, as DINOv2 with registers asks for.
    Antialiased,
}

/// Learnt positions for a square grid of `count` patches, unchanged where that is the grid they were learnt for.
///
/// # Shapes
/// `[1, 1 + grid * grid, dim]`, the class token's first, to `[1, 1 + count, dim]`.
pub fn positions(learnt: Tensor<3>, count: usize, resampling: Resampling) -> Tensor<3> {
    let [_, all, dim] = learnt.dims();
    if all == 1 + count {
        return learnt;
    }
    let (from, to) = ((all - 1).isqrt(), count.isqrt());
    let resize = Tensor::<2>::from_data(TensorData::new(matrix(from, to, resampling), [to, from]), &learnt.device());
    let class = learnt.clone().slice([0..1, 0..1, 0..dim]);
    // Rows, then columns: both are the same matrix, applied to the first axis.
    let along = |grid: Tensor<3>| {
        let [_, other, dim] = grid.dims();
        resize.clone().matmul(grid.reshape([from, other * dim])).reshape([to, other, dim]).swap_dims(0, 1)
    };
    let grid = learnt.slice([0..1, 1..all, 0..dim]).reshape([from, from, dim]);
    Tensor::cat(vec![class, along(along(grid)).reshape([1, count, dim])], 1)
}

/// The weights of `from` numbers in each of `to` resampled ones, `[to, from]`, with pixels' centres half a pixel in.
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_possible_wrap)]
fn matrix(from: usize, to: usize, resampling: Resampling) -> Vec<f32> {
    let scale = from as f64 / to as f64;
    // The kernel's sharpness and its width, which PyTorch chooses differently for the two.
    let (sharpness, width) = match resampling {
        Resampling::Bicubic => (-0.75, 1.0),
        Resampling::Antialiased => (-0.5, scale.max(1.0)),
    };
    let mut weights = vec![0.0f64; to * from];
    for (index, row) in weights.chunks_exact_mut(from).enumerate() {
        let centre = (index as f64 + 0.5) * scale - 0.5;
        let reach = 2.0 * width;
        for place in (centre - reach).ceil() as i64..=(centre + reach).floor() as i64 {
            let weight = cubic((place as f64 - centre) / width, sharpness);
            match resampling {
                // The border is repeated outwards,
                Resampling::Bicubic => row[place.clamp(0, from as i64 - 1) as usize] += weight,
                // or left out.
                Resampling::Antialiased if (0..from as i64).contains(&place) => row[place as usize] += weight,
                Resampling::Antialiased => {}
            }
        }
        let sum: f64 = row.iter().sum();
        row.iter_mut().for_each(|weight| *weight /= sum);
    }
    weights.into_iter().map(|weight| weight as f32).collect()
}

/// The cubic convolution kernel (Keys 1981), 0 from a distance of 2 on.
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
    fn a_constant_stays_and_a_ramp_stays_straight_inside() {
        for resampling in [Resampling::Bicubic, Resampling::Antialiased] {
            for (from, to) in [(8, 5), (5, 8), (37, 16)] {
                let weights = matrix(from, to, resampling);
                for (index, row) in weights.chunks(from).enumerate() {
                    assert!((row.iter().sum::<f32>() - 1.0).abs() < 1e-6);
                    let centre = (index as f32 + 0.5) * from as f32 / to as f32 - 0.5;
                    // Two neighbours on either side, or the border shows.
                    let reach = 2.0 * (from as f32 / to as f32).max(1.0);
                    if centre > reach && centre + reach < from as f32 - 1.0 && to > from {
                        let value: f32 = row.iter().enumerate().map(|(place, weight)| place as f32 * weight).sum();
                        assert!((value - centre).abs() < 1e-4, "{resampling:?} {from} to {to}: {value} for {centre}");
                    }
                }
            }
        }
    }
}
