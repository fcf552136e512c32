//! Compares frames of the Python reference with those of this crate: `docs/environments.png`, and the table of
//! `docs/environments.md`.
//!
//!     cargo run --release -p swm-envs --example golden_sheet
//!
//! It reads the recorded rollouts of the golden tests (`tests/golden` and the folder `SWM_GOLDEN`): for each
//! environment, the first rollout with default factors and the first rollout with all factors varied.

use std::fmt::Write as _;
use std::fs::File;
use std::io::Write as _;
use std::path::Path;
use swm_conformance::golden::{self, Golden, image_difference};
use swm_core::{Action, Env, EnvEntry, FrameMut, ResetOptions, Result, Space};
use swm_envs::ENVS;

/// Side of a cell, in pixels.
const CELL: usize = 150;
/// Gap between cells, in pixels.
const GAP: usize = 6;
/// Height of the line of labels above a row, in pixels.
const LABELS: usize = 18;
/// Cells of a row: the recorded frame, the rendered frame and their difference, for the first and the last step.
const COLUMNS: usize = 6;
/// Factor by which differences are amplified.
const AMPLIFICATION: u8 = 8;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let docs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs");
    let mut pairs = vec![];
    for entry in ENVS.rows {
        for kind in ["default", "all"] {
            let files = golden::files(env!("CARGO_MANIFEST_DIR"), &format!("{}-{kind}-", entry.id.replace('/', "_")));
            if let Some(file) = files.first() {
                pairs.push((format!("{} {kind}", entry.id), compare(entry, Golden::open(file))?));
            }
        }
    }
    let width = COLUMNS * (CELL + GAP) + GAP;
    let mut sheet = Sheet { width, rgb: vec![] };
    let mut table = String::from("| environment | factors | first frame | last frame |\n| --- | --- | --- | --- |\n");
    for (name, frames) in &pairs {
        let differences = frames.each_ref().map(|frame| image_difference(&frame.golden, &frame.ours));
        sheet.row(name, frames, &differences);
        let (id, kind) = name.split_once(' ').unwrap_or((name, ""));
        writeln!(table, "| `{id}` | {kind} | {:.3} | {:.3} |", differences[0], differences[1])?;
    }
    sheet.save(&docs.join("environments.png"))?;
    let page = docs.join("environments.md");
    let text = std::fs::read_to_string(&page)?;
    let prose = text.split_once("| environment |").map_or(text.as_str(), |(prose, _)| prose);
    std::fs::write(&page, format!("{prose}{table}"))?;
    std::io::stdout().write_all(table.as_bytes())?;
    Ok(())
}

/// A recorded frame and the frame rendered in the same state.
struct Frames {
    height: usize,
    width: usize,
    golden: Vec<u8>,
    ours: Vec<u8>,
}

/// Replays a rollout and returns its first and last frame.
fn compare(entry: &EnvEntry, mut golden: Golden) -> Result<[Frames; 2]> {
    let mut env = entry.env().expect("creating the environment");
    env.reset(0, &start(entry, &*env, &mut golden))?;
    let first = frames(&mut *env, &mut golden, "frame_first");
    let n = env.spec().action_dim();
    if let Space::Box { .. } = env.spec().action_space {
        golden.read::<f32>("action").chunks_exact(n).try_for_each(|a| env.step(Action::Continuous(a)).map(drop))?;
    } else {
        golden.read::<i64>("action").chunks_exact(n).try_for_each(|a| env.step(Action::Discrete(a)).map(drop))?;
    }
    Ok([first, frames(&mut *env, &mut golden, "frame_last")])
}

/// Returns the reset options of a recorded rollout.
fn start(entry: &EnvEntry, env: &dyn Env, golden: &mut Golden) -> ResetOptions {
    let names = golden.names();
    let has = |name: &&&str| names.iter().any(|known| known == **name);
    let mut variation = golden.variation();
    let n = env.spec().columns.iter().find(|column| column.name == "state").map_or(0, |column| column.len());
    let mut read = |choices: &[&str]| choices.iter().find(has).map(|name| golden.read::<f64>(name)[..n].to_vec());
    let goal_state = read(&["info.goal_state", "goal_state"]);
    let state = match entry.id {
        // The factors contain the start; the recorded state is one physics step later.
        id if id.starts_with("swm/PushT") => None,
        // The reference moves this factor with the agent, so the recorded value is not the start position.
        "swm/SimplePointMaze-v0" => {
            variation.variation_values.extend(read(&["obs"]).map(|position| ("agent.position".to_owned(), position)));
            None
        }
        _ => read(&["start", "info.state"]),
    };
    ResetOptions { variation, state, goal_state }
}

fn frames(env: &mut dyn Env, golden: &mut Golden, name: &str) -> Frames {
    let (height, width, golden) = golden.image(name);
    let mut ours = vec![0; golden.len()];
    env.render(FrameMut::new(width, height, &mut ours)).expect("rendering a frame");
    Frames { height, width, golden, ours }
}

/// A white image that grows downwards.
struct Sheet {
    width: usize,
    rgb: Vec<u8>,
}

impl Sheet {
    /// Adds the frames of one rollout side by side, below a line of labels.
    fn row(&mut self, name: &str, frames: &[Frames; 2], differences: &[f64; 2]) {
        let top = self.rgb.len() / 3 / self.width;
        let height = frames.iter().map(|frame| CELL * frame.height / frame.width).max().unwrap_or(0);
        self.rgb.resize((top + LABELS + height + GAP) * self.width * 3, 255);
        for (i, (frame, difference)) in frames.iter().zip(differences).enumerate() {
            let left = GAP + 3 * i * (CELL + GAP);
            // The name may take two cells, so the second cell has no label.
            let label = if i == 0 { name.trim_start_matches("swm/") } else { "last frame" };
            self.text(label, left, top + 5);
            self.text(&format!("difference {difference:.3}"), left + 2 * (CELL + GAP), top + 5);
            let amplified: Vec<u8> = frame
                .golden
                .iter()
                .zip(&frame.ours)
                .map(|(a, b)| a.abs_diff(*b).saturating_mul(AMPLIFICATION))
                .collect();
            for (k, rgb) in [&frame.golden, &frame.ours, &amplified].into_iter().enumerate() {
                self.image(frame, rgb, left + k * (CELL + GAP), top + LABELS);
            }
        }
    }

    /// Draws a frame, shrunk to a cell: every pixel is the mean of the pixels that it covers.
    fn image(&mut self, Frames { height, width, .. }: &Frames, rgb: &[u8], left: usize, top: usize) {
        let rows = CELL * height / width;
        for (y, x) in (0..rows).flat_map(|y| (0..CELL).map(move |x| (y, x))) {
            let (ys, xs) = (y * height / rows..(y + 1) * height / rows, x * width / CELL..(x + 1) * width / CELL);
            let to = ((top + y) * self.width + left + x) * 3;
            for c in 0..3 {
                let sum: usize =
                    ys.clone().flat_map(|v| xs.clone().map(move |u| usize::from(rgb[(v * width + u) * 3 + c]))).sum();
                let mean = (sum / (ys.len() * xs.len()).max(1)) as u8;
                self.rgb[to + c] = mean;
            }
        }
    }

    /// Draws text with letters of 3 x 5 dots of two pixels.
    fn text(&mut self, text: &str, left: usize, top: usize) {
        for (i, letter) in text.to_uppercase().chars().enumerate() {
            let dots = FONT.iter().find(|(known, _)| *known == letter).map_or(0, |(_, dots)| *dots);
            for (y, x) in (0..10).flat_map(|y| (0..6).map(move |x| (y, x))) {
                if dots >> (14 - (y / 2 * 3 + x / 2)) & 1 == 1 {
                    let at = ((top + y) * self.width + left + 8 * i + x) * 3;
                    self.rgb[at..at + 3].fill(0);
                }
            }
        }
    }

    fn save(&self, path: &Path) -> Result<(), Box<dyn std::error::Error>> {
        let height = self.rgb.len() / 3 / self.width;
        let mut encoder = png::Encoder::new(File::create(path)?, self.width as u32, height as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_compression(png::Compression::High);
        encoder.write_header()?.write_image_data(&self.rgb)?;
        Ok(())
    }
}

/// Letters of five rows, one octal digit per row.
#[rustfmt::skip]
const FONT: &[(char, u16)] = &[
    ('A', 0o25755), ('B', 0o65656), ('C', 0o34443), ('D', 0o65556), ('E', 0o74647), ('F', 0o74644), ('G', 0o34553),
    ('H', 0o55755), ('I', 0o72227), ('J', 0o11152), ('K', 0o55655), ('L', 0o44447), ('M', 0o57755), ('N', 0o65555),
    ('O', 0o25552), ('P', 0o65644), ('Q', 0o25563), ('R', 0o65655), ('S', 0o34216), ('T', 0o72222), ('U', 0o55557),
    ('V', 0o55552), ('W', 0o55775), ('X', 0o55255), ('Y', 0o55222), ('Z', 0o71247), ('0', 0o75557), ('1', 0o26227),
    ('2', 0o61247), ('3', 0o61216), ('4', 0o55711), ('5', 0o74616), ('6', 0o34757), ('7', 0o71222), ('8', 0o75757),
    ('9', 0o75716), ('-', 0o00700), ('.', 0o00002), (',', 0o00024), (':', 0o02020), ('/', 0o11244),
];
