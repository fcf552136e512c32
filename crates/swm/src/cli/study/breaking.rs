//! `swm study break`: where success breaks along a ray of one factor of variation.

use super::colour;
use super::expand;
use super::file::{OF_THE_COMMAND, POLICY, StudyFile, Table, Values};
use super::{cluster_cells, output_text, show, submit, with_rule};
use crate::cli::config::count;
use crate::cli::eval::{run_options, write_json};
use crate::cli::on_ray::OnRayArgs;
use crate::cli::on_ray::study::check_output;
use crate::cli::progress::control;
use crate::cli::recipes::Datasets;
use crate::cli::{Context, emit_json};
use crate::resolver::HomeResolver;
use clap::Args;
use serde_json::json;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use swm_core::results::{BreakingPoint, Ray, StudyResults, Until};
use swm_core::{DType, Error, Factor, Origin, Result, Space, VariationSpace, limits};
use swm_eval::{Cell, Common, Resolver as _, Study, StudyFolder};

/// Arguments of `swm study break`.
#[derive(Args)]
pub struct BreakArgs {
    /// The policy: a checkpoint, expert, an expert's id, or simulator
    #[arg(value_name = "MODEL")]
    policy: String,
    /// Options of `swm eval` for all evaluations, such as episodes=100
    #[arg(value_name = "KEY=VALUE")]
    settings: Vec<String>,
    /// The factor of variation
    #[arg(long, value_name = "KEY")]
    factor: String,
    /// The end of the ray: numbers, or a colour such as cyan or hsv(180,1,1)
    ///
    /// By default, the end of the range that is farther from the factor's default. Without it, all values of a factor with
    /// few of them, such as a shape, are evaluated.
    #[arg(long, value_name = "VALUE")]
    towards: Option<String>,
    /// The success rate below which success is broken in absolute terms, in percent
    #[arg(long, value_name = "PERCENT", default_value_t = 50, value_parser = clap::value_parser!(u8).range(1..=100))]
    below: u8,
    /// Folder of the study
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Play starts until a rule is met, as in `swm study run`
    #[arg(long, value_name = "RULE")]
    until: Option<Until>,
    /// Parallel environments; results do not depend on their number
    #[arg(long, default_value_t = 16, value_parser = count::<1, { limits::ENVS.max }>)]
    envs: usize,
    /// Evaluate nothing: choose the levels inside from the results of the grid, a cell
    #[arg(long, hide = true, conflicts_with = "on")]
    inside: bool,
    #[command(flatten)]
    on: OnRayArgs,
}

/// The file with the study of all levels, for the run on a cluster.
const LEVELS: &str = "levels.json";

/// Colours with a name, as pins.
const COLOURS: [(&str, &str); 9] = [
    ("red", "255,0,0"),
    ("yellow", "255,255,0"),
    ("green", "0,255,0"),
    ("cyan", "0,255,255"),
    ("blue", "0,0,255"),
    ("magenta", "255,0,255"),
    ("white", "255,255,255"),
    ("grey", "128,128,128"),
    ("black", "0,0,0"),
];

/// A change of the factor: its share of the ray if there is an order, and its value.
type Level = (Option<f64>, Vec<f64>);

/// Runs `swm study break`.
pub fn run(args: &BreakArgs, context: &Context) -> anyhow::Result<()> {
    let own_env = args.settings.iter().find_map(|setting| setting.strip_prefix("env="));
    let resolver = own_env.into_iter().fold(HomeResolver::new(Origin::User), HomeResolver::with_env);
    let output = output_text(&args.on, &args.output)?;
    let plain = args.study(&[], true, &resolver, context)?;
    let request = plain.cells.first().map(|cell| &cell.request);
    let env = request.map(|request| resolver.env(request)).transpose()?;
    let space = env.as_ref().map(|env| env.spec().variation_space.clone());
    let Some(space) = space else { return Ok(()) };
    let ray = args.ray(&space.factors()[args.factor(&space)?])?;
    let study = |levels: &[Level]| args.study(levels, ray.is_ordered(), &resolver, context);
    let first = study(&ray.grid())?;
    if args.on.is_given() {
        check_output(output, &first.title, args.until, &args.on)?;
        let mut cells = cluster_cells(&first, &resolver)?;
        cells["inside"] = json!(if ray.is_ordered() { most_inside(&plain) } else { 0 });
        return submit(&args.on, &args.output, cells, context);
    }
    let folder = StudyFolder::new(&args.output);
    let options = run_options(args.envs, None, context);
    if let Some(whole) = chosen_before(&folder, &first)?.filter(|_| !args.inside) {
        let _lock = folder.create(&whole)?;
        whole.run(&folder, &resolver, &options, &mut control(context))?;
        return show(&whole.results(&folder)?, context.json);
    }
    let lock = folder.create(&first)?;
    if !args.inside {
        first.run(&folder, &resolver, &options, &mut control(context))?;
    }
    let whole = study(&ray.levels(&first.results(&folder)?))?;
    if args.inside {
        write_json(&args.output.join(LEVELS), &cluster_cells(&whole, &resolver)?)?;
        return emit_json(&json!({"cells": whole.cells.len()}));
    }
    drop(lock);
    let _lock = folder.create(&whole)?;
    whole.run(&folder, &resolver, &options, &mut control(context))?;
    show(&whole.results(&folder)?, context.json)
}

/// The study of a folder, if it has the grid of `first` and levels inside an interval. They were chosen by the results of that time; under
/// a rule that ends a study, those of now may choose others, of which nothing is played yet.
fn chosen_before(folder: &StudyFolder, first: &Study) -> Result<Option<Study>> {
    let Ok(found) = folder.study() else { return Ok(None) };
    let ids = |study: &Study| study.cells.iter().map(Cell::id).collect::<Result<BTreeSet<_>>>();
    let (all, grid) = (ids(&found)?, ids(first)?);
    let same = (&found.title, &found.ray, found.until, &found.families)
        == (&first.title, &first.ray, first.until, &first.families);
    Ok((same && all.len() > grid.len() && all.is_superset(&grid)).then_some(found))
}

/// The most cells that the levels inside an interval add to the grid: each unshifted cell may have an interval of its own, and all of
/// them are evaluated at its levels.
fn most_inside(unshifted: &Study) -> usize {
    Ray::INSIDE * unshifted.cells.len().pow(2)
}

impl BreakArgs {
    /// The study of some levels with all names resolved; without levels, the unshifted condition alone.
    fn study(&self, levels: &[Level], ordered: bool, resolver: &HomeResolver, context: &Context) -> Result<Study> {
        let mut study = expand::study(&self.file(levels), &self.settings, resolver, &mut control(context))?;
        study.arguments = self.arguments();
        let below = f64::from(self.below) / 100.0;
        study.ray = (!levels.is_empty()).then(|| Ray { factor: self.factor.clone(), below, ordered });
        if levels.is_empty() { Ok(study) } else { with_rule(study, self.until) }
    }

    /// The index of the factor.
    fn factor(&self, space: &VariationSpace) -> Result<usize> {
        let names = || space.factors().iter().map(|factor| factor.key.as_str());
        let found = space.find(&self.factor).ok_or_else(|| {
            Error::unknown("factor of variation", &self.factor, names(), "`swm fovs ENV` lists the factors")
        })?;
        if space.defaults().iter().any(|key| space.select(key).is_ok_and(|chosen| chosen.contains(&found))) {
            let problem = "the environment draws it in every episode, so there is no default to start from";
            let fix = "give a factor that has one value in distribution";
            return Err(Error::config(format!("--factor {}", self.factor), problem, fix));
        }
        Ok(found)
    }

    /// The ray of the factor.
    fn ray<'f>(&self, factor: &'f Factor) -> Result<Line<'f>> {
        let Some(towards) = &self.towards else {
            if has_few_values(&factor.space) {
                return Ok(Line { factor, end: None });
            }
            let far = |(i, start): (usize, &f64)| {
                let (low, high) = factor.space.bounds(i);
                if high - start >= start - low { high } else { low }
            };
            return Ok(Line { factor, end: Some(factor.init_value.iter().enumerate().map(far).collect()) });
        };
        let named = COLOURS.iter().find(|(name, _)| name == towards).map_or(towards.as_str(), |(_, value)| value);
        let pin = colour::resolve(&format!("{}={named}", factor.key), "--towards")?;
        let numbers = pin.split_once('=').map_or("", |(_, value)| value).split(',');
        let end: Vec<f64> =
            numbers.map(|number| number.trim().parse()).collect::<std::result::Result<_, _>>().map_err(|_| {
                let names = COLOURS.map(|(name, _)| name).join(", ");
                let fix =
                    format!("give numbers with commas between them, hsv(HUE,SATURATION,VALUE), or one of {names}");
                Error::config(format!("--towards {towards}"), "is no value of the factor", fix)
            })?;
        factor.space.check(&factor.key, &end)?;
        if end == factor.init_value {
            return Err(Error::config(
                format!("--towards {towards}"),
                "is the default of the factor",
                "give another value",
            ));
        }
        Ok(Line { factor, end: Some(end) })
    }

    /// The study of some levels.
    fn file(&self, levels: &[Level]) -> StudyFile {
        let name = Path::new(&self.policy)
            .file_name()
            .map_or_else(|| self.policy.clone(), |name| name.to_string_lossy().into());
        let table = |name: String, change: Option<f64>, option: Option<(&str, String)>| Table {
            at: OF_THE_COMMAND.to_owned(),
            name,
            options: option.into_iter().map(|(key, value)| (key.to_owned(), vec![value])).collect::<BTreeMap<_, _>>(),
            each: change
                .map(|change| (Ray::VARIABLE.to_owned(), Values::List(vec![change.to_string()])))
                .into_iter()
                .collect(),
            starts: vec![],
        };
        let ordered = levels.iter().any(|(change, _)| change.is_some());
        let mut conditions = vec![table("in distribution".to_owned(), ordered.then_some(0.0), None)];
        conditions.extend(levels.iter().map(|(change, value)| {
            let value = value.iter().map(f64::to_string).collect::<Vec<_>>().join(",");
            let pin = format!("{}={value}", self.factor);
            let share = change.map_or(String::new(), |change| format!(" ({} %)", 100.0 * change));
            table(format!("{pin}{share}"), *change, Some(("pin", pin)))
        }));
        StudyFile {
            title: format!("Breaking point of {name} along {}", self.factor),
            question: format!("At which change of {} does {name} lose half of its success?", self.factor),
            families: Common::by_default(),
            defaults: Table::default(),
            starts: vec![Table::default()],
            conditions,
            policies: vec![table(name, None, Some((POLICY, self.policy.clone())))],
            published: vec![],
            datasets: Datasets::default(),
        }
    }

    /// The command's arguments, for the command that runs the study again.
    fn arguments(&self) -> Vec<String> {
        let mut arguments = vec![self.policy.clone()];
        arguments.extend(self.settings.iter().cloned());
        arguments.extend(["--factor".to_owned(), self.factor.clone()]);
        arguments.extend(self.towards.iter().flat_map(|end| ["--towards".to_owned(), end.clone()]));
        arguments.extend(["--below".to_owned(), self.below.to_string()]);
        arguments
    }
}

/// Whether a space has so few values that all can be evaluated.
fn has_few_values(space: &Space) -> bool {
    let count = |i: usize| {
        let (low, high) = space.bounds(i);
        high - low + 1.0
    };
    matches!(space, Space::Discrete { .. } | Space::MultiDiscrete { .. })
        && (0..space.len()).map(count).product::<f64>() <= (1 + Ray::LEVELS) as f64
}

/// From the default of a factor to another value; without an end, all values of the factor.
struct Line<'f> {
    factor: &'f Factor,
    end: Option<Vec<f64>>,
}

impl Line<'_> {
    fn is_ordered(&self) -> bool {
        self.end.is_some()
    }

    /// The levels of the grid: those that differ from the default.
    fn grid(&self) -> Vec<Level> {
        let mut levels = if self.is_ordered() {
            let shares = (1..=Ray::GRID).map(|i| i as f64 / Ray::GRID as f64);
            shares.filter_map(|share| self.at(share)).collect()
        } else {
            self.values()
        };
        levels.retain(|(_, value)| *value != self.factor.init_value);
        levels.dedup_by(|a, b| a.1 == b.1);
        levels
    }

    /// The levels of the grid, and those inside the first intervals in which success falls below half.
    fn levels(&self, grid: &StudyResults) -> Vec<Level> {
        let mut levels = self.grid();
        levels.extend(grid.breaking.iter().filter_map(BreakingPoint::first).flat_map(|ends| self.inside(ends)));
        levels.sort_by(|a, b| a.0.unwrap_or_default().total_cmp(&b.0.unwrap_or_default()));
        levels.dedup_by(|a, b| a.1 == b.1);
        levels
    }

    /// The levels inside an interval.
    fn inside(&self, [low, high]: [f64; 2]) -> Vec<Level> {
        let share = |i: usize| low + (high - low) * i as f64 / (Ray::INSIDE + 1) as f64;
        let mut levels: Vec<Level> = (1..=Ray::INSIDE).filter_map(|i| self.at(share(i))).collect();
        levels.retain(|(_, value)| *value != self.factor.init_value);
        levels
    }

    /// The value at a share of the way.
    fn at(&self, share: f64) -> Option<Level> {
        let is_whole = !matches!(self.factor.space.dtype(), DType::Float32 | DType::Float64);
        let between = |(from, to): (&f64, &f64)| {
            let value = from + share * (to - from);
            if is_whole { value.round() } else { self.factor.space.round(value) }
        };
        Some((Some(share), self.factor.init_value.iter().zip(self.end.as_ref()?).map(between).collect()))
    }

    /// All values of a factor with few of them.
    fn values(&self) -> Vec<Level> {
        let mut values: Vec<Vec<f64>> = vec![vec![]];
        for i in 0..self.factor.space.len() {
            let (low, high) = self.factor.space.bounds(i);
            let with = |known: &Vec<f64>| {
                let known = known.clone();
                (low as i64..=high as i64).map(move |value| [&known[..], &[value as f64]].concat())
            };
            values = values.iter().flat_map(with).collect();
        }
        values.into_iter().map(|value| (None, value)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Command {
        #[command(flatten)]
        args: BreakArgs,
    }

    fn args(more: &[&str]) -> BreakArgs {
        let words = [&["break", "expert", "--factor", "x", "--output", "out"][..], more].concat();
        Command::try_parse_from(words).expect("arguments").args
    }

    #[test]
    fn rays_lead_from_the_default_to_the_far_end_or_a_named_value() {
        let colour = Factor::new("x", Space::Rgb, [255.0, 0.0, 0.0]);
        let end = |args: &BreakArgs| args.ray(&colour).expect("a ray").end.expect("an end");
        assert_eq!(end(&args(&[])), [0.0, 255.0, 255.0]);
        assert_eq!(end(&args(&["--towards", "blue"])), [0.0, 0.0, 255.0]);
        assert_eq!(end(&args(&["--towards", "hsv(120,1,1)"])), [0.0, 255.0, 0.0]);
        assert_eq!(end(&args(&["--towards", "1,2,3"])), [1.0, 2.0, 3.0]);
        for (wrong, part) in [("red", "is the default"), ("reddish", "magenta"), ("1,2", "x"), ("300,0,0", "255")] {
            let error = args(&["--towards", wrong]).ray(&colour).err().expect("no value").to_string();
            assert!(error.contains(part), "{error}");
        }
        let grid = args(&[]).ray(&colour).expect("a ray").grid();
        assert_eq!((grid.len(), &grid[1]), (8, &(Some(0.25), vec![191.0, 64.0, 64.0])));
        let number = Factor::new("x", Space::uniform_box([], DType::Float32, 0.0, 8.0), [6.0]);
        let ray = args(&[]).ray(&number).expect("a ray");
        assert_eq!(
            ray.inside([0.5, 0.625]),
            [0.53125, 0.5625, 0.59375].map(|share| (Some(share), vec![6.0 - 6.0 * share]))
        );
    }

    #[test]
    fn factors_with_few_values_have_all_but_the_default() {
        let shape = Factor::new("x", Space::Discrete { n: 4, start: 1 }, [2.0]);
        let ray = args(&[]).ray(&shape).expect("a ray");
        let values: Vec<Vec<f64>> = ray.grid().into_iter().map(|(_, value)| value).collect();
        assert!(!ray.is_ordered() && values == [[1.0], [3.0], [4.0]].map(Vec::from), "{values:?}");
        let ray = args(&["--towards", "4"]).ray(&shape).expect("a ray");
        assert_eq!(ray.grid().into_iter().map(|(_, value)| value[0]).collect::<Vec<_>>(), [3.0, 4.0]);
        let many = Factor::new("x", Space::Discrete { n: 100, start: 0 }, [20.0]);
        assert_eq!(args(&[]).ray(&many).expect("a ray").end, Some(vec![99.0]));
        // A factor with few values has fewer levels.
        let count = Factor::new("x", Space::uniform_box([], DType::Int64, 0.0, 3.0), [0.0]);
        let grid = args(&[]).ray(&count).expect("a ray").grid();
        assert_eq!(grid.iter().map(|(_, value)| value[0]).collect::<Vec<_>>(), [1.0, 2.0, 3.0]);
    }
}
