//! `swm autopsy`: why a planning world model fails.

use super::config::count;
use super::eval::{run_options, write_json};
use super::probe::element;
use super::progress::control;
use super::results_tables::percent;
use super::{Context, emit, emit_json, eprint, output_folder, study, table};
use crate::autopsy::{Plan, ProbeSource, SEARCH, Strip, plans};
use crate::resolver::HomeResolver;
use clap::Args;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::time::Duration;
use swm_core::results::{Autopsy, Estimate, Ingredient, ProbeScore, ProbeScores, Repair, letters};
use swm_core::{Error, Key, Origin, Result, VariationRequest, files, limits};
use swm_eval::{EvalRequest, PolicyRequest, Resolver as _, StudyFolder, World, WorldConfig};
use swm_report::{AutopsyPage, FrameStrip};

/// Arguments of `swm autopsy`.
#[derive(Args)]
pub struct AutopsyArgs {
    /// The world model: a checkpoint that plans
    model: String,
    /// Options of `swm eval` for all arms, such as budget=100 or solver=cem,samples=64
    #[arg(value_name = "KEY=VALUE")]
    settings: Vec<String>,
    /// The environment (default: the one that the model was trained on)
    #[arg(long)]
    env: Option<String>,
    /// Number of starts
    #[arg(long, default_value_t = 30, value_parser = count::<1, { limits::EVALUATED_EPISODES.max }>)]
    episodes: usize,
    /// Planning seeds per arm, besides the one that selects the failures
    #[arg(long, value_name = "COUNT", default_value_t = Autopsy::MIN_SEEDS)]
    planning_seeds: usize,
    /// Ingredients: some of the letters S, R, D, C and E
    ///
    /// S: ten times as many candidates. R: a new plan after every model step. D: the true dynamics. C: the distance of states
    /// that a probe reads from latents. E, after D and C: the true distance to the goal. Fewer ingredients cost less time and
    /// explain less.
    #[arg(long, value_name = "LETTERS", default_value = "SRDE")]
    ingredients: String,
    /// The dataset on which the probe of C is fitted (default: that of the starts)
    ///
    /// What a linear map and a network read from the latents is shown also without C.
    #[arg(long, value_name = "DATASET")]
    probe_data: Option<String>,
    /// Columns that the probe of C reads
    #[arg(long, value_name = "COLUMN,…", value_delimiter = ',', default_value = "state")]
    probe_columns: Vec<String>,
    /// Columns that predict without an image (default: pos_agent, else proprio)
    ///
    /// What they predict is shown beside what probes read from the latents.
    #[arg(long, value_name = "COLUMN,…", value_delimiter = ',')]
    probe_baseline: Vec<String>,
    /// Folder of the autopsy, which is that of a study
    #[arg(short, long, default_value = "autopsy", value_name = "DIR")]
    output: PathBuf,
    /// Print the estimated time, and run nothing
    #[arg(long)]
    estimate: bool,
    /// Parallel environments; results do not depend on their number
    #[arg(long, default_value_t = 16, value_parser = count::<1, { limits::ENVS.max }>)]
    envs: usize,
}

/// The widest line of the tables.
const COLUMNS: usize = 80;

/// The environments whose plans are timed.
const TIMED_ENVS: usize = 2;

/// Runs `swm autopsy`.
pub fn autopsy(args: &AutopsyArgs, context: &Context) -> anyhow::Result<()> {
    let ingredients = ingredients(&args.ingredients)?;
    output_folder::check_local(&args.output)?;
    let own_env = args.env.iter();
    let resolver = own_env.fold(HomeResolver::new(Origin::User), |resolver, env| resolver.with_env(env));
    let name =
        Path::new(&args.model).file_name().map_or(args.model.clone(), |name| name.to_string_lossy().into_owned());
    let title = format!("Autopsy of {name}");
    let question = format!("Why does {name} fail?");
    if let Some(setting) = args.settings.iter().find(|setting| setting.starts_with("episodes=")) {
        let fix = format!("write --{}", setting.replacen('=', " ", 1));
        return Err(Error::config(setting, "the number of starts is an option of its own", fix).into());
    }
    let env = args.env.iter().map(|env| format!("env={env}"));
    let settings: Vec<String> =
        env.chain([format!("episodes={}", args.episodes)]).chain(args.settings.iter().cloned()).collect();
    let base = study::single([&title, &question, &name, &args.model], &settings, &resolver, &mut control(context))?;
    let plan = Plan::new(base, &ingredients, args.planning_seeds, args.probe(&ingredients))?;
    let folder = StudyFolder::new(&args.output);
    let seconds = estimate(&plan, &folder, &resolver, context)?;
    let (arms, starts) = (plan.arms.len(), plan.request()?.episodes);
    if args.estimate {
        if context.json {
            return emit_json(&json!({"arms": arms, "planning_seeds": args.planning_seeds, "seconds": seconds}));
        }
        emit(&cost(arms, args.planning_seeds, starts, seconds));
        return Ok(());
    }
    eprint(&cost(arms, args.planning_seeds, starts, seconds));
    let _lock = folder.create(&plan.study)?;
    output_folder::check(&args.output, &["index.html", "autopsy.json"])?;
    files::delete_temporary(&args.output, |name| ["autopsy.json", "index.html"].contains(&name))?;
    let options = run_options(args.envs, None, context);
    plan.study.run(&folder, &resolver, &options, &mut control(context))?;
    let found = plan.autopsy(&folder)?;
    let file = args.output.join("autopsy.json");
    let probes = args.probe_scores(&plan, &resolver, context)?;
    let document = args.document(&plan, &found, probes.as_ref())?;
    write_json(&file, &document)?;
    let strips = plan.strips(&found, &folder, &resolver, &options, &mut control(context))?;
    let strips = strips.into_iter().map(|Strip { start, set, png }| FrameStrip { start, set: letters(&set), png });
    let page = AutopsyPage {
        title: title.clone(),
        env: plan.request()?.env.clone(),
        found: found.clone(),
        probes: probes.clone(),
        strips: strips.collect(),
        command: args.command(),
    };
    let page = swm_report::write_autopsy(&page, &args.output)?;
    if context.json {
        return emit_json(&document);
    }
    emit(&format!("{title} in {}\n", plan.request()?.env));
    emit(&text(&found));
    if let Some(probes) = &probes {
        emit(&probe_table(probes));
    }
    emit(&format!("{}\n{}\n", file.display(), page.display()));
    Ok(())
}

impl AutopsyArgs {
    /// The probe, if it is an ingredient and there is a dataset for it.
    fn probe(&self, ingredients: &[Ingredient]) -> Option<ProbeSource> {
        let of_starts = || self.settings.iter().find_map(|setting| setting.strip_prefix("dataset=").map(str::to_owned));
        let dataset =
            self.probe_data.clone().or_else(of_starts).filter(|_| ingredients.contains(&Ingredient::Probe))?;
        Some(ProbeSource { dataset, columns: self.probe_columns.clone() })
    }

    /// The content of `autopsy.json`.
    fn document(&self, plan: &Plan, found: &Autopsy, probes: Option<&ProbeScores>) -> Result<Value> {
        let mut document = json!({
            "version": 1,
            "model": self.model,
            "env": plan.request()?.env,
            "study": plan.study.hash()?,
            "autopsy": found,
        });
        if let Some(probes) = probes {
            document["probes"] = json!(probes);
        }
        Ok(document)
    }

    /// What probes read from the latents of the model; `None` without C and --probe-data.
    fn probe_scores(&self, plan: &Plan, resolver: &HomeResolver, context: &Context) -> Result<Option<ProbeScores>> {
        let of_latents = plan.probe.as_ref().map(|probe| probe.dataset.as_str());
        let Some(dataset) = of_latents.or(self.probe_data.as_deref()) else { return Ok(None) };
        let request = plan.request()?;
        let Some(checkpoint) = request.policies.first().and_then(|policy| policy.kind.checkpoint()) else {
            return Ok(None);
        };
        let env = resolver.env(request)?;
        let probe = (checkpoint, dataset, &self.probe_columns[..]);
        let (latents, trivial) = resolver.probes(probe, &self.probe_baseline, env.spec(), &mut control(context))?;
        let [linear, network] = latents.scores();
        let of_trivial = |i: usize| trivial.as_ref().and_then(|(_, probe)| probe.scores()[1].get(i)?.r2);
        let elements = linear.iter().zip(network).enumerate().map(|(i, (linear, network))| ProbeScore {
            element: element(linear),
            linear: linear.r2,
            network: network.r2,
            trivial: of_trivial(i),
        });
        Ok(Some(ProbeScores {
            dataset: dataset.to_owned(),
            elements: elements.collect(),
            trivial: trivial.as_ref().map(|(columns, _)| columns.join(",")),
        }))
    }

    /// The command that runs the autopsy again. It names a folder of its own, so that equal autopsies have equal pages.
    fn command(&self) -> String {
        let mut words = vec!["swm".to_owned(), "autopsy".to_owned(), self.model.clone()];
        words.extend(self.env.iter().flat_map(|env| ["--env".to_owned(), env.clone()]));
        words.extend(["--episodes".to_owned(), self.episodes.to_string()]);
        words.extend(["--planning-seeds".to_owned(), self.planning_seeds.to_string()]);
        words.extend(["--ingredients".to_owned(), self.ingredients.clone()]);
        words.extend(self.probe_data.iter().flat_map(|data| ["--probe-data".to_owned(), data.clone()]));
        if self.probe_columns != ["state"] {
            words.extend(["--probe-columns".to_owned(), self.probe_columns.join(",")]);
        }
        if !self.probe_baseline.is_empty() {
            words.extend(["--probe-baseline".to_owned(), self.probe_baseline.join(",")]);
        }
        words.extend(self.settings.iter().cloned().chain(["-o".to_owned(), "autopsy".to_owned()]));
        study::shell(&words)
    }
}

/// Parses ingredients by their letters.
fn ingredients(given: &str) -> Result<Vec<Ingredient>> {
    let find = |letter: char| {
        let found = Ingredient::ALL.into_iter().find(|ingredient| ingredient.letter() == letter.to_ascii_uppercase());
        found.ok_or_else(|| {
            let problem = format!("there is no ingredient '{letter}'");
            Error::config("--ingredients", problem, "choose some of S, R, D, C and E, such as SRD")
        })
    };
    let mut found = vec![];
    for letter in given.chars().filter(|c| *c != ',') {
        let ingredient = find(letter)?;
        if found.contains(&ingredient) {
            let problem = format!("the ingredient '{letter}' is given twice");
            return Err(Error::config("--ingredients", problem, "give every letter once"));
        }
        found.push(ingredient);
    }
    Ok(found)
}

/// Returns the most seconds that the arms without results take: plans are timed with each model, and a larger search takes
/// as many times longer. All environments start from the first start.
fn estimate(plan: &Plan, folder: &StudyFolder, resolver: &HomeResolver, context: &Context) -> Result<f64> {
    let request = plan.request()?;
    let config = WorldConfig {
        envs: TIMED_ENVS.min(request.episodes),
        image: request.image.map(|[height, width]| (height, width)),
        views: vec![],
        max_episode_steps: request.budget,
        threads: context.threads,
    };
    let mut world = World::of(|| resolver.env(request), config)?;
    let limit = world.pool().max_episode_steps();
    let variation = request.conditions.first().map_or_else(VariationRequest::default, |c| c.variation.clone());
    world.reset(request.seed, &variation)?;
    let mut timed: Vec<(Vec<Ingredient>, f64)> = vec![];
    let mut total = 0.0;
    let mut control = control(context);
    for (set, cells) in &plan.arms {
        let mut missing = 0;
        for cell in cells {
            missing += usize::from(folder.results(cell)?.is_none());
        }
        if missing == 0 {
            continue;
        }
        // What a plan costs depends on its model; replanning and the search only multiply it.
        let model: Vec<Ingredient> =
            set.iter().copied().filter(|ingredient| *ingredient >= Ingredient::Dynamics).collect();
        let EvalRequest { policies, .. } = request;
        let kind = |set: &[Ingredient]| {
            policies.first().map(|policy| crate::autopsy::with(&policy.kind, set, plan.probe.as_ref())).transpose()
        };
        let known = timed.iter().find(|(known, _)| *known == model).map(|(_, seconds)| *seconds);
        let seconds = match (known, kind(&model)?) {
            (Some(seconds), _) => seconds,
            (None, Some(kind)) => {
                control.check()?;
                let seconds = time(&PolicyRequest { name: "timed".to_owned(), kind }, &mut world, resolver)?;
                timed.push((model, seconds));
                seconds
            }
            (None, None) => 0.0,
        };
        let per_episode = kind(set)?.map_or(0, |kind| plans(&kind, limit));
        let search = if set.contains(&Ingredient::Search) { SEARCH as f64 } else { 1.0 };
        total += seconds * search * (per_episode * missing * request.episodes) as f64;
    }
    Ok(total)
}

/// Returns the seconds of one plan.
fn time(request: &PolicyRequest, world: &mut World, resolver: &HomeResolver) -> Result<f64> {
    let mut policy = resolver.policy(request, world)?.policy;
    let slots = world.pool().len();
    let mut fastest = f64::INFINITY;
    // The first plan also warms caches up.
    for repetition in 0..2 {
        (0..slots).for_each(|slot| policy.begin(slot, Key::new(repetition).at(slot as u64)));
        world.act(&mut *policy, &vec![true; slots])?;
        let latencies = policy.take_latencies();
        fastest = fastest.min(latencies.iter().sum::<f64>() / latencies.len().max(1) as f64);
    }
    Ok(fastest)
}

/// The cost of an autopsy, in words.
fn cost(arms: usize, seeds: usize, starts: usize, seconds: f64) -> String {
    let time = Duration::from_secs_f64(seconds.clamp(0.0, 1e12).ceil()).as_secs();
    let time = match time {
        0..120 => format!("{time} s"),
        120..7200 => format!("{} min", time / 60),
        _ => format!("{:.1} h", time as f64 / 3600.0),
    };
    format!("{arms} arms x {seeds} planning seeds x {starts} starts: at most {time}\n")
}

/// The tables of an autopsy, at most 80 columns wide.
fn text(found: &Autopsy) -> String {
    let Autopsy { starts, selection, planning_seeds, contributions, arms, finding, repairs } = found;
    let failures = repairs.len();
    let mut text = format!(
        "{starts} starts, {failures} failures ({} solved), {planning_seeds} planning seeds\n{}",
        percent(selection),
        wrapped(&finding.to_string())
    );
    let header = ["ingredient", "recovers of failures", "alone", "ranks first"];
    let rows = contributions.iter().map(|contribution| {
        vec![
            format!("{} {}", contribution.ingredient.letter(), contribution.ingredient.summary()),
            signed(found.on_failures(&contribution.recovered)),
            signed(found.on_failures(&contribution.alone)),
            found.on_failures(contribution.first).map_or("–".to_owned(), |first| format!("{:.0} %", 100.0 * first)),
        ]
    });
    text += &format!("\n{}", table(&header, rows));
    let rows = arms.iter().map(|arm| {
        let is_changed = !arm.ingredients.is_empty();
        let Estimate { value, low, high } = arm.success;
        vec![
            letters(&arm.ingredients),
            format!("{:.0} % [{:.0}, {:.0}]", 100.0 * value, 100.0 * low, 100.0 * high),
            signed(found.on_failures(&arm.recovered).filter(|_| is_changed)),
            signed(found.on_solved(&arm.harmed).filter(|_| is_changed)),
        ]
    });
    text += &format!("\n{}", table(&["arm", "success", "recovered", "harmed"], rows));
    let mut counts: Vec<(String, usize)> = vec![];
    for name in repairs.iter().map(repair) {
        match counts.iter_mut().find(|(known, _)| *known == name) {
            Some((_, count)) => *count += 1,
            None => counts.push((name, 1)),
        }
    }
    counts.sort_by_key(|(_, count)| std::cmp::Reverse(*count));
    if !counts.is_empty() {
        let rows = counts.into_iter().map(|(name, count)| vec![name, count.to_string()]);
        text += &format!("\n{}", table(&["smallest repair", "failures"], rows));
    }
    text + "brackets: 95 % bootstrap intervals over starts; recovered: of failures; harmed:\nof solved starts\n"
}

/// What probes read from the latents, at most 80 columns wide.
fn probe_table(probes: &ProbeScores) -> String {
    let r2 = |value: Option<f64>| value.map_or("–".to_owned(), |value| format!("{value:.3}"));
    let trivial = probes.trivial.as_ref().map(|column| format!("{column} alone"));
    let header: Vec<&str> = ["element", "linear R²", "network R²"].into_iter().chain(trivial.as_deref()).collect();
    let rows = probes.elements.iter().map(|score| {
        let values = [score.linear, score.network, score.trivial].map(r2);
        std::iter::once(score.element.clone()).chain(values).take(header.len()).collect()
    });
    format!("\nWhat probes read from the latents\n{}{}", table(&header, rows), wrapped(&probes.note()))
}

/// A sentence in lines of at most 80 columns.
fn wrapped(sentence: &str) -> String {
    let mut lines = String::new();
    let mut width = 0;
    for word in sentence.split(' ') {
        let length = word.chars().count();
        if width > 0 && width + 1 + length > COLUMNS {
            lines.push_str("\n ");
            width = 1;
        }
        if width > 0 {
            lines.push(' ');
            width += 1;
        }
        lines.push_str(word);
        width += length;
    }
    lines + "\n"
}

/// A difference of shares, in percent.
fn signed(shares: Option<&Estimate>) -> String {
    shares.map_or("–".to_owned(), |Estimate { value, low, high }| {
        format!("{:+.0} % [{:+.0}, {:+.0}]", 100.0 * value, 100.0 * low, 100.0 * high)
    })
}

/// The smallest sets of ingredients that solve a failure.
fn repair(repair: &Repair) -> String {
    let sets: Vec<String> = repair.sets.iter().map(|set| letters(set)).collect();
    match &repair.sets[..] {
        [] => "none".to_owned(),
        [set] if set.is_empty() => "another planning seed".to_owned(),
        _ => sets.join(" or "),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::results::{Arm, Contribution, Finding, Proportion};

    #[test]
    fn tables_are_at_most_80_columns_wide() {
        let most = Estimate { value: -1.0, low: -1.0, high: 1.0 };
        let contribution = |ingredient| Contribution { ingredient, recovered: most, alone: most, first: 1.0 };
        let all = Ingredient::ALL.to_vec();
        let sets = all.iter().map(|ingredient| vec![*ingredient]).collect();
        for finding in [
            Finding::Healthy,
            Finding::TooFew,
            Finding::Undecided,
            Finding::Joint(all.clone()),
            Finding::Culprit(Ingredient::Distance),
            Finding::Culprit(Ingredient::Replanning),
        ] {
            let found = Autopsy {
                starts: 1_000_000,
                selection: Proportion::wilson(0, 1_000_000),
                planning_seeds: 100,
                contributions: all.iter().map(|ingredient| contribution(*ingredient)).collect(),
                arms: vec![Arm { ingredients: all.clone(), success: most, recovered: most, harmed: most }],
                finding,
                repairs: vec![Repair { start: 0, row: None, sets: Vec::clone(&sets) }],
            };
            let text = text(&found);
            let widest = text.lines().map(|line| line.trim_end().chars().count()).max();
            assert!(widest.is_some_and(|widest| widest <= COLUMNS), "{widest:?}: {text}");
        }
    }

    #[test]
    fn rates_of_no_starts_are_not_shown() {
        let some = Estimate { value: 0.5, low: 0.5, high: 0.5 };
        let (ingredient, none) = (Ingredient::Dynamics, Estimate::default());
        let repair = |start| Repair { start, row: None, sets: vec![] };
        let shown = |failures: usize, recovered, harmed| {
            let found = Autopsy {
                starts: 2,
                selection: Proportion::wilson(2 - failures, 2),
                planning_seeds: 3,
                contributions: vec![Contribution { ingredient, recovered, alone: recovered, first: 0.12 }],
                arms: vec![Arm { ingredients: vec![ingredient], success: some, recovered, harmed }],
                finding: Finding::TooFew,
                repairs: (0..failures).map(repair).collect(),
            };
            let text = text(&found);
            ["+0 % [+0, +0]", "12 %"].map(|part| text.matches(part).count())
        };
        assert_eq!([shown(2, some, none), shown(0, none, some), shown(1, some, none)], [[0, 1], [0, 0], [1, 1]]);
    }

    #[test]
    fn probes_are_shown_beside_the_trivial_predictor() {
        let score = ProbeScore { element: "cos state[4]".to_owned(), linear: None, network: Some(0.5), trivial: None };
        let mut probes = ProbeScores { dataset: "rooms".to_owned(), trivial: None, elements: vec![score] };
        let words = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ");
        let without = words(&probe_table(&probes));
        assert!(!without.contains("alone") && without.contains("no trivial predictor"), "{without}");
        probes.trivial = Some("pos_agent".to_owned());
        probes.elements[0].trivial = Some(0.25);
        let with = probe_table(&probes);
        for part in ["pos_agent alone", "0.500", "0.250", "–", "not above it"] {
            assert!(words(&with).contains(part), "{part}: {with}");
        }
        assert!(with.lines().all(|line| line.trim_end().chars().count() <= COLUMNS), "{with}");
    }

    #[test]
    fn times_are_rounded_and_letters_checked() {
        assert_eq!(cost(12, 3, 30, 90.2), "12 arms x 3 planning seeds x 30 starts: at most 91 s\n");
        assert!(
            cost(1, 3, 1, 7199.0).ends_with("at most 119 min\n") && cost(1, 3, 1, 1e5).ends_with("at most 27.8 h\n")
        );
        assert_eq!(ingredients("s,D").expect("two letters"), [Ingredient::Search, Ingredient::Dynamics]);
        assert!(ingredients("SX").expect_err("an unknown letter").to_string().contains("'X'"));
    }
}
