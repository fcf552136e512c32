//! How alike two pictures are; for tests.

/// The mean absolute difference, of 255, and the structural similarity (Wang et al. 2004) of two RGB pictures.
#[derive(Clone, Copy, Debug)]
pub struct Likeness {
    /// Of 255; 0 for equal pictures.
    pub difference: f64,
    /// Mean over windows of 7 x 7 pixels and over channels; 1 for equal pictures.
    pub similarity: f64,
}

/// The side of a window.
const WINDOW: usize = 7;

impl Likeness {
    /// Of two pictures of `width` pixels a row.
    #[allow(clippy::cast_precision_loss)]
    pub fn of(a: &[u8], b: &[u8], width: usize) -> Self {
        assert_eq!(a.len(), b.len());
        let difference = a.iter().zip(b).map(|(&a, &b)| f64::from(a.abs_diff(b))).sum::<f64>() / a.len() as f64;
        let height = a.len() / (3 * width);
        let (mut sum, mut count) = (0.0, 0.0);
        for channel in 0..3 {
            // Sums over everything above and left of a pixel, of a, b, and their products.
            let mut sums = vec![[0.0; 5]; (width + 1) * (height + 1)];
            for y in 0..height {
                for x in 0..width {
                    let at = 3 * (y * width + x) + channel;
                    let (p, q) = (f64::from(a[at]), f64::from(b[at]));
                    let own = [p, q, p * p, q * q, p * q];
                    let place = (y + 1) * (width + 1) + x + 1;
                    sums[place] = std::array::from_fn(|k| {
                        own[k] + sums[place - 1][k] + sums[place - width - 1][k] - sums[place - width - 2][k]
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
        Self { difference, similarity: sum / count }
    }

    /// Compares a picture of the CPU's with a recorded one, and says so; in `SWM_GOLDEN_PICTURES`, both and their difference,
    /// four times as strong, are kept.
    #[allow(
        clippy::print_stderr,
        clippy::cast_possible_truncation,
        reason = "the table for whoever runs it with --no-capture"
    )]
    pub fn note(name: &str, drawn: &[u8], recorded: &[u8], width: usize) -> Self {
        let likeness = Self::of(drawn, recorded, width);
        eprintln!("cpu {name}: {:.2} of 255, similarity {:.3}", likeness.difference, likeness.similarity);
        if let Some(folder) = std::env::var_os("SWM_GOLDEN_PICTURES") {
            let difference: Vec<u8> =
                drawn.iter().zip(recorded).map(|(a, b)| a.abs_diff(*b).saturating_mul(4)).collect();
            let rows = recorded.chunks(3 * width).zip(drawn.chunks(3 * width)).zip(difference.chunks(3 * width));
            let sheet: Vec<u8> = rows.flat_map(|((a, b), c)| [a, b, c].concat()).collect();
            let file = std::path::Path::new(&folder).join(format!("{name}.png"));
            let file = std::fs::File::create(file).expect("a file");
            let mut encoder = png::Encoder::new(file, 3 * width as u32, (drawn.len() / (3 * width)) as u32);
            encoder.set_color(png::ColorType::Rgb);
            encoder.write_header().expect("a header").write_image_data(&sheet).expect("a picture");
        }
        likeness
    }

    /// Whether nobody who learns from pictures sees a difference.
    pub fn suffices(&self) -> bool {
        self.difference <= 6.0 && self.similarity >= 0.95
    }
}
