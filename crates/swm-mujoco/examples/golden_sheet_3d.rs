//! Compares frames of the Python reference with those of the CPU renderer: writes `docs/environments-3d.png` and the
//! table of `docs/environments-3d.md`.
//!
//! ```text
//! SWM_GOLDEN_IMAGES=DIR cargo nextest run --release -p swm-mujoco golden
//! cargo run --release -p swm-mujoco --example golden_sheet_3d DIR
//! ```
//! The golden tests write triptychs to the folder: the recorded frame, the frame of the CPU renderer, and their
//! difference.
#![allow(clippy::print_stdout, reason = "a command-line program")]

use std::fmt::Write as _;
use std::fs::File;
use std::io::{BufReader, BufWriter};
use std::path::Path;
use swm_mujoco::ENVS;

/// Side of a frame in the sheet, in pixels.
const CELL: usize = 66;
/// Gap between two triptychs in the sheet, in pixels.
const GAP: usize = 4;

type Failure = Box<dyn std::error::Error>;

/// An RGB image.
struct Image {
    width: usize,
    rgb: Vec<u8>,
}

impl Image {
    fn read(path: &Path) -> Result<Self, Failure> {
        let mut reader = png::Decoder::new(BufReader::new(File::open(path)?)).read_info()?;
        let mut rgb = vec![0; reader.output_buffer_size().ok_or("the image is too large")?];
        let width = reader.next_frame(&mut rgb)?.width as usize;
        Ok(Self { width, rgb })
    }

    /// The mean absolute difference of the first two frames of a triptych, on a scale of 0 to 255.
    fn difference(&self) -> f64 {
        let third = self.width;
        let rows = self.rgb.chunks_exact(3 * self.width).map(|row| row[..third].iter().zip(&row[third..2 * third]));
        let total: f64 = rows.flatten().map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
        3.0 * total / self.rgb.len() as f64
    }

    /// Shrinks the three frames of a triptych to [`CELL`] pixels a side by averaging pixels.
    fn shrunk(&self) -> Self {
        let (third, height) = (self.width / 3, self.rgb.len() / 3 / self.width);
        let mut rgb = vec![];
        for y in 0..CELL {
            for x in 0..3 * CELL {
                let (panel, x) = (x / CELL, x % CELL);
                for channel in 0..3 {
                    let rows = y * height / CELL..(y + 1) * height / CELL;
                    let columns = panel * third + x * third / CELL..panel * third + (x + 1) * third / CELL;
                    let pixels = rows.len() * columns.len();
                    let row = |y: usize| {
                        columns.clone().map(move |x| usize::from(self.rgb[3 * (y * self.width + x) + channel]))
                    };
                    let sum: usize = rows.flat_map(row).sum();
                    rgb.push(u8::try_from(sum / pixels).unwrap_or(u8::MAX));
                }
            }
        }
        Self { width: 3 * CELL, rgb }
    }
}

fn main() -> Result<(), Failure> {
    let folder = std::env::args().nth(1).ok_or("give the folder of the triptychs (see the head of this program)")?;
    let read = |id: &str, kind: &str, frame: &str| {
        Image::read(&Path::new(&folder).join(format!("{}-{kind}-0-frame_{frame}.png", id.replace('/', "_"))))
    };
    let mut table = String::from(
        "| environment | default factors: first frame | last frame | all varied: first frame | last frame |\n\
         | --- | --- | --- | --- | --- |\n",
    );
    let (mut sheet, width) = (vec![], 6 * CELL + GAP);
    for id in ENVS.rows.iter().map(|row| row.id) {
        // Environments that differ only in their rewards were recorded once.
        let Ok(first) = read(id, "default", "first") else { continue };
        let last = read(id, "all", "last")?;
        let between = [read(id, "default", "last")?.difference(), read(id, "all", "first")?.difference()];
        let [a, d] = [&first, &last].map(Image::difference);
        writeln!(table, "| `{id}` | {a:.2} | {:.2} | {:.2} | {d:.2} |", between[0], between[1])?;
        let [left, right] = [first.shrunk(), last.shrunk()];
        for (left, right) in left.rgb.chunks_exact(3 * left.width).zip(right.rgb.chunks_exact(3 * right.width)) {
            sheet.extend([left, &[255; 3 * GAP], right].concat());
        }
        sheet.extend(vec![255; 3 * GAP * width]);
    }
    let docs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs");
    let height = sheet.len() / 3 / width;
    let file = BufWriter::new(File::create(docs.join("environments-3d.png"))?);
    let mut encoder = png::Encoder::new(file, u32::try_from(width)?, u32::try_from(height)?);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_compression(png::Compression::High);
    encoder.write_header()?.write_image_data(&sheet)?;
    let page = docs.join("environments-3d.md");
    let text = std::fs::read_to_string(&page)?;
    let prose = text.split_once("| environment |").map_or(text.as_str(), |(prose, _)| prose);
    std::fs::write(&page, format!("{prose}{table}"))?;
    print!("{table}");
    Ok(())
}
