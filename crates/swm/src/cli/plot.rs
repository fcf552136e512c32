//! `swm plot`: the training curves of runs, in the terminal and as SVG.

use super::training_curves::log_of;
use super::{emit, emit_json, output_folder};
use crate::home;
use clap::Args;
use serde_json::json;
use std::path::PathBuf;
use swm_core::{Error, Result, files};
use swm_report::{Metrics, read_metrics};

/// Arguments of `swm plot`.
#[derive(Args)]
pub struct PlotArgs {
    /// Checkpoints: paths or names
    #[arg(required = true, value_name = "RUN")]
    runs: Vec<String>,
    /// The metric; `--list` names them
    #[arg(long, default_value = "loss")]
    metric: String,
    /// List the metrics of the runs instead
    #[arg(long, conflicts_with_all = ["metric", "output"])]
    list: bool,
    /// Write the curves to this SVG file as well
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
}

/// A name and the points of its curve.
type Curve = (String, Vec<(f64, f64)>);

/// Width and height of a curve in the terminal, in characters.
const SIZE: (usize, usize) = (60, 12);
/// Points of a character of braille, along its sides.
const DOTS: (usize, usize) = (2, 4);

/// Runs `swm plot`.
pub fn plot(args: &PlotArgs, as_json: bool) -> anyhow::Result<()> {
    let read = |run: &String| {
        let log = log_of(&home::find_checkpoint(run)?);
        if !log.exists() {
            let fix = "give the folder that `swm train --output` wrote";
            return Err(Error::config(run, "has no log of a training, train.jsonl", fix));
        }
        Ok((run.clone(), read_metrics(&log)?))
    };
    let runs: Vec<(String, Metrics)> = args.runs.iter().map(read).collect::<Result<_>>()?;
    if args.list {
        return list(&runs, as_json);
    }
    let curves: Vec<Curve> = runs.iter().map(|run| curve(run, &args.metric)).collect::<Result<_>>()?;
    let over = runs.first().map_or("step", |(_, metrics)| metrics.over.as_str());
    if let Some(path) = &args.output {
        output_folder::check_file(path)?;
        files::check_own(path, |path| files::read(path, 1 << 26).is_ok_and(|text| text.starts_with(b"<svg ")))?;
        files::write(path, swm_report::curves_svg(&args.metric, over, &curves)?.as_bytes())?;
    }
    if as_json {
        let curves = curves.iter().map(|(run, points)| json!({"run": run, "points": points}));
        return emit_json(&json!({"metric": args.metric, "over": over, "curves": curves.collect::<Vec<_>>()}));
    }
    for (run, points) in &curves {
        emit(&format!("{run}: {} over {over}\n{}", args.metric, drawing(points)));
    }
    if let Some(path) = &args.output {
        emit(&format!("{}\n", path.display()));
    }
    Ok(())
}

/// Lists the metrics of the runs.
fn list(runs: &[(String, Metrics)], as_json: bool) -> anyhow::Result<()> {
    let mut names: Vec<&str> =
        runs.iter().flat_map(|(_, run)| run.series.iter().map(|one| one.name.as_str())).collect();
    names.sort_unstable();
    names.dedup();
    if as_json {
        return emit_json(&names);
    }
    emit(&names.iter().map(|name| format!("{name}\n")).collect::<String>());
    Ok(())
}

/// Returns the curve of a run.
///
/// # Errors
/// When the run has not logged the metric.
fn curve((run, metrics): &(String, Metrics), metric: &str) -> Result<Curve> {
    match metrics.series.iter().find(|series| series.name == metric) {
        Some(series) => Ok((run.clone(), series.points.clone())),
        None => {
            let names = metrics.series.iter().map(|series| series.name.as_str());
            Err(Error::unknown("metric", metric, names, format!("`swm plot {run} --list` lists those of the run")))
        }
    }
}

/// Draws a curve in characters of braille, with its range.
fn drawing(points: &[(f64, f64)]) -> String {
    let finite: Vec<(f64, f64)> = points.iter().copied().filter(|(x, y)| x.is_finite() && y.is_finite()).collect();
    let range = |pick: fn(&(f64, f64)) -> f64| {
        let values = finite.iter().map(pick);
        values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)))
    };
    if finite.is_empty() {
        return "no finite value\n".to_owned();
    }
    let ((left, right), (low, high)) = (range(|point| point.0), range(|point| point.1));
    let (width, height) = (SIZE.0 * DOTS.0, SIZE.1 * DOTS.1);
    let scaled = |value: f64, low: f64, high: f64, count: usize| {
        let share = if high > low { (value - low) / (high - low) } else { 0.5 };
        (share * (count - 1) as f64).round() as usize
    };
    let mut canvas = vec![0_u8; SIZE.0 * SIZE.1];
    let mut mark = |x: usize, y: usize| {
        // The bits of braille: the columns from top to bottom, and the lowest row apart.
        const BITS: [[u8; 4]; 2] = [[0x01, 0x02, 0x04, 0x40], [0x08, 0x10, 0x20, 0x80]];
        let y = height - 1 - y;
        canvas[y / DOTS.1 * SIZE.0 + x / DOTS.0] |= BITS[x % DOTS.0][y % DOTS.1];
    };
    let at = |(x, y): (f64, f64)| (scaled(x, left, right, width), scaled(y, low, high, height));
    let mut last = at(finite[0]);
    for point in &finite {
        let (x, y) = at(*point);
        // A line from the last point: as many marks as its longer side has.
        let count = x.abs_diff(last.0).max(y.abs_diff(last.1)).max(1);
        for step in 0..=count {
            let between = |from: usize, to: usize| (from * (count - step) + to * step + count / 2) / count;
            mark(between(last.0, x), between(last.1, y));
        }
        last = (x, y);
    }
    let mut text = String::new();
    for (row, cells) in canvas.chunks(SIZE.0).enumerate() {
        let label = match row {
            0 => short(high),
            row if row == SIZE.1 - 1 => short(low),
            _ => String::new(),
        };
        let line: String = cells.iter().map(|&bits| char::from_u32(0x2800 + u32::from(bits)).unwrap_or(' ')).collect();
        text += &format!("{label:>10} │{line}\n");
    }
    let ends = format!("{:<30}{:>30}", short(left), short(right));
    text + &format!("{:>10} └{}\n{:>12}{ends}\n", "", "─".repeat(SIZE.0), "")
}

/// Formats a value with four significant digits.
pub fn short(value: f64) -> String {
    let digits = if value == 0.0 { 0.0 } else { value.abs().log10().floor() };
    match (-4.0..5.0).contains(&digits) {
        true => format!("{value:.*}", (3.0 - digits).max(0.0) as usize),
        false => format!("{value:.3e}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draws_a_falling_curve_from_the_upper_left_to_the_lower_right() {
        let text = drawing(&[(0.0, 2.0), (50.0, 1.0), (100.0, 0.5)]);
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines.len(), SIZE.1 + 2);
        assert!(lines[0].trim_start().starts_with("2.000 │⠑"), "{text}");
        assert!(lines[SIZE.1 - 1].starts_with("    0.5000 │⠀"), "{text}");
        assert!(lines.iter().all(|line| line.chars().count() <= 79), "{text}");
        assert_eq!(drawing(&[(0.0, f64::NAN)]), "no finite value\n");
        assert!(drawing(&[(1.0, 1.0)]).contains("1.000"));
    }

    #[test]
    fn values_have_four_digits() {
        assert_eq!([0.0, 12.345_6, -0.001_234_56, 1e9].map(short), ["0.000", "12.35", "-0.001235", "1.000e9"]);
    }
}
