//! [`ImageSimilarity`]: compares rendered images with recorded images in tests.

/// The mean absolute difference and the structural similarity (SSIM, Wang et al. 2004) of two RGB images.
#[derive(Clone, Copy, Debug)]
pub struct ImageSimilarity {
    /// Mean absolute difference, 0 to 255; 0 for equal images.
    pub difference: f64,
    /// Mean SSIM over windows of 7 x 7 pixels and channels; 1 for equal images.
    pub ssim: f64,
}

/// The side of an SSIM window, in pixels.
const WINDOW: usize = 7;

impl ImageSimilarity {
    /// Compares two images.
    ///
    /// # Shapes
    /// `a`, `b`: row-major `[height, width, 3]`.
    ///
    /// # Panics
    /// When the lengths differ.
    pub fn of(a: &[u8], b: &[u8], width: usize) -> Self {
        assert_eq!(a.len(), b.len());
        let difference = a.iter().zip(b).map(|(&a, &b)| f64::from(a.abs_diff(b))).sum::<f64>() / a.len() as f64;
        let height = a.len() / (3 * width);
        let (mut sum, mut count) = (0.0, 0.0);
        for channel in 0..3 {
            // Summed-area tables of a, b, and their products.
            let mut sums = vec![[0.0; 5]; (width + 1) * (height + 1)];
            for y in 0..height {
                for x in 0..width {
                    let pixel = 3 * (y * width + x) + channel;
                    let (p, q) = (f64::from(a[pixel]), f64::from(b[pixel]));
                    let products = [p, q, p * p, q * q, p * q];
                    let index = (y + 1) * (width + 1) + x + 1;
                    sums[index] = std::array::from_fn(|k| {
                        products[k] + sums[index - 1][k] + sums[index - width - 1][k] - sums[index - width - 2][k]
                    });
                }
            }
            let n = (WINDOW * WINDOW) as f64;
            for y in WINDOW..=height {
                for x in WINDOW..=width {
                    let at = |x: usize, y: usize, k: usize| sums[y * (width + 1) + x][k];
                    let [p, q, pp, qq, pq]: [f64; 5] = std::array::from_fn(|k| {
                        let (left, top) = (x - WINDOW, y - WINDOW);
                        (at(x, y, k) - at(left, y, k) - at(x, top, k) + at(left, top, k)) / n
                    });
                    let unbiased = n / (n - 1.0);
                    let [vp, vq, cov] = [pp - p * p, qq - q * q, pq - p * q].map(|v| v * unbiased);
                    let [c1, c2] = [0.01f64, 0.03].map(|k| (k * 255.0).powi(2));
                    sum += (2.0 * p * q + c1) * (2.0 * cov + c2) / ((p * p + q * q + c1) * (vp + vq + c2));
                    count += 1.0;
                }
            }
        }
        Self { difference, ssim: sum / count }
    }

    /// Compares an image of the CPU renderer with a recorded one and prints the result. If `SWM_GOLDEN_IMAGES` names a
    /// folder, writes `NAME.png` there: the recorded image, the rendered one, and four times their difference, side by
    /// side.
    #[allow(clippy::print_stderr, reason = "a table for `--no-capture`")]
    pub fn report(name: &str, rendered: &[u8], recorded: &[u8], width: usize) -> Self {
        let similarity = Self::of(rendered, recorded, width);
        eprintln!("cpu {name}: {:.2} of 255, SSIM {:.3}", similarity.difference, similarity.ssim);
        if let Some(folder) = std::env::var_os("SWM_GOLDEN_IMAGES") {
            let difference: Vec<u8> =
                rendered.iter().zip(recorded).map(|(a, b)| a.abs_diff(*b).saturating_mul(4)).collect();
            let rows = recorded.chunks(3 * width).zip(rendered.chunks(3 * width)).zip(difference.chunks(3 * width));
            let sheet: Vec<u8> = rows.flat_map(|((a, b), c)| [a, b, c].concat()).collect();
            let file = std::path::Path::new(&folder).join(format!("{name}.png"));
            let file = std::fs::File::create(file).expect("creating the PNG file");
            let mut encoder = png::Encoder::new(file, 3 * width as u32, (rendered.len() / (3 * width)) as u32);
            encoder.set_color(png::ColorType::Rgb);
            encoder
                .write_header()
                .expect("writing the PNG header")
                .write_image_data(&sheet)
                .expect("writing the PNG image");
        }
        similarity
    }

    /// Whether the images are close enough for models trained on one renderer to work with frames of another renderer.
    pub fn is_close(&self) -> bool {
        self.difference <= 6.0 && self.ssim >= 0.95
    }
}
