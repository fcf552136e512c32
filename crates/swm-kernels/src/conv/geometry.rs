//! [`Geometry`]: where a convolution reads and writes the elements of feature maps.
//!
//! A feature map is `[side, side, width]`, row by row, where the width is the number of channels rounded up to whole SIMD
//! vectors. The input of a layer is copied to a map with a margin of zeros, so that no patch crosses its border. The
//! gradient of the output has a margin as well, for the gradient of the input.

use crate::product::Segment;

/// Sizes of a convolution and the indices of its rows.
#[derive(Clone, Debug)]
pub(super) struct Geometry {
    /// The side of the input map without margin.
    pub side: usize,
    /// The elements of a pixel of the input map.
    pub inputs: usize,
    /// The side of the kernel.
    pub kernel: usize,
    pub stride: usize,
    /// The pixels of zeros before the first row and the first column of the input map.
    pub margin: usize,
    /// The side of the output map.
    pub out: usize,
    /// The elements of a pixel of the output map.
    pub outputs: usize,
}

/// Rows of a product that computes the pixels of an input map that have equal coordinates modulo the stride.
pub(super) struct Phase {
    /// The kernel's rows and columns that reach the pixels, in the order in which the product reads the output map.
    pub taps: [Vec<usize>; 2],
    /// Segments of the rows.
    pub segments: Vec<Segment>,
    /// The start of each row in a padded gradient of the output, image by image.
    pub from: Vec<usize>,
    /// The start of each pixel in the gradient of the input, image by image.
    pub to: Vec<usize>,
}

impl Geometry {
    /// A 3 x 3 convolution with stride 2 and a padding of 1.
    pub fn convolution(side: usize, inputs: usize, outputs: usize) -> Self {
        Self { side, inputs, kernel: 3, stride: 2, margin: 1, out: side.div_ceil(2), outputs }
    }

    /// A linear layer of a whole feature map.
    pub fn linear(side: usize, inputs: usize, outputs: usize) -> Self {
        Self { side, inputs, kernel: side, stride: side, margin: 0, out: 1, outputs }
    }

    /// The elements of a patch.
    pub fn patch(&self) -> usize {
        self.kernel * self.kernel * self.inputs
    }

    /// The pixels of an output map.
    pub fn pixels(&self) -> usize {
        self.out * self.out
    }

    /// The elements of an input map without margin.
    pub fn input(&self) -> usize {
        self.side * self.side * self.inputs
    }

    /// The elements of an output map.
    pub fn output(&self) -> usize {
        self.pixels() * self.outputs
    }

    /// The side of an input map with its margin.
    pub fn padded_side(&self) -> usize {
        self.stride * (self.out - 1) + self.kernel
    }

    /// The elements of an input map with its margin.
    pub fn padded_input(&self) -> usize {
        self.padded_side().pow(2) * self.inputs
    }

    /// The side of an output map with the margin after its last row and its last column.
    pub fn gradient_side(&self) -> usize {
        self.out + usize::from(self.kernel > self.stride)
    }

    /// The elements of an output map with its margin.
    pub fn padded_gradient(&self) -> usize {
        self.gradient_side().pow(2) * self.outputs
    }

    /// The start of each patch in padded input maps.
    pub fn patches(&self, images: usize) -> Vec<usize> {
        let side = self.padded_side() * self.inputs;
        self.pixels_of(images, |image, y, x| {
            image * self.padded_input() + y * self.stride * side + x * self.stride * self.inputs
        })
    }

    /// The parts of a patch that are contiguous: the rows of the kernel.
    pub fn segments(&self) -> Vec<Segment> {
        let row = self.padded_side() * self.inputs;
        (0..self.kernel).map(|y| Segment { offset: y * row, length: self.kernel * self.inputs }).collect()
    }

    /// The start of each pixel in padded gradients of the output.
    pub fn gradients(&self, images: usize) -> Vec<usize> {
        let side = self.gradient_side();
        self.pixels_of(images, |image, y, x| image * self.padded_gradient() + (y * side + x) * self.outputs)
    }

    fn pixels_of(&self, images: usize, index: impl Fn(usize, usize, usize) -> usize) -> Vec<usize> {
        (0..images * self.pixels())
            .map(|pixel| index(pixel / self.pixels(), pixel % self.pixels() / self.out, pixel % self.out))
            .collect()
    }

    /// Copies input maps to padded maps, whose margins keep their zeros.
    pub fn pad(&self, maps: &[f32], padded: &mut [f32]) {
        self.copy_rows(maps, padded, |from, to| to.copy_from_slice(from));
    }

    /// Calls `copy` for every row of input maps and the row of padded maps that it belongs to.
    pub fn copy_rows(&self, maps: &[f32], padded: &mut [f32], copy: impl Fn(&[f32], &mut [f32])) {
        let (row, padded_row) = (self.side * self.inputs, self.padded_side() * self.inputs);
        let maps = maps.chunks_exact(self.input()).zip(padded.chunks_exact_mut(self.padded_input()));
        for (from, to) in maps {
            let rows = to[self.margin * padded_row..].chunks_exact_mut(padded_row);
            for (from, to) in from.chunks_exact(row).zip(rows) {
                copy(from, &mut to[self.margin * self.inputs..][..row]);
            }
        }
    }

    /// The phases that compute the gradient of the input.
    pub fn phases(&self, images: usize) -> Vec<Phase> {
        (0..self.stride.pow(2))
            .filter_map(|phase| self.phase([phase / self.stride, phase % self.stride], images))
            .collect()
    }

    fn phase(&self, remainder: [usize; 2], images: usize) -> Option<Phase> {
        // Padded pixel `stride * i + r` receives tap `r + stride * j` of output pixel `i - j`; the product reads the output
        // pixels in ascending order.
        let taps = remainder.map(|r| (r..self.kernel).step_by(self.stride).rev().collect::<Vec<_>>());
        let pixels = remainder.map(|r| -> Vec<usize> {
            let first = self.margin.saturating_sub(r).div_ceil(self.stride);
            (first..).take_while(|i| self.stride * i + r < self.margin + self.side).collect()
        });
        if taps.iter().chain(&pixels).any(Vec::is_empty) {
            return None;
        }
        let (side, [ys, xs]) = (self.gradient_side(), &pixels);
        let (mut from, mut to) = (vec![], vec![]);
        for image in 0..images {
            for (y, x) in ys.iter().flat_map(|y| xs.iter().map(move |x| (y, x))) {
                let pixel = (y + 1 - taps[0].len()) * side + x + 1 - taps[1].len();
                from.push(image * self.padded_gradient() + pixel * self.outputs);
                let [y, x] = [(y, remainder[0]), (x, remainder[1])].map(|(i, r)| self.stride * i + r - self.margin);
                to.push(image * self.input() + (y * self.side + x) * self.inputs);
            }
        }
        let length = taps[1].len() * self.outputs;
        let segments = (0..taps[0].len()).map(|y| Segment { offset: y * side * self.outputs, length }).collect();
        Some(Phase { taps, segments, from, to })
    }
}
