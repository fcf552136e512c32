//! `swm leaderboard`: submits results, verifies entries, and builds the pages of a leaderboard.

use super::eval::run_options;
use super::progress::control;
use super::report::results_file;
use super::results_tables::percent;
use super::{Context, as_texts, emit, emit_json, output_folder};
use crate::home;
use crate::leaderboard::{
    Class, Entry, How, REWARD_TOLERANCE, Submission, TOLERANCE, Verification, board, entries, verify,
};
use clap::{Args, Subcommand};
use serde_json::json;
use std::collections::hash_map::RandomState;
use std::hash::{BuildHasher as _, Hasher as _};
use std::path::{Path, PathBuf};
use swm_core::{Error, Result, files};
use swm_models::capsule::Capsule;
use swm_report::{BoardPages, Move};

/// Arguments of `swm leaderboard`.
#[derive(Args)]
pub struct LeaderboardArgs {
    #[command(subcommand)]
    command: LeaderboardCommand,
}

#[derive(Subcommand)]
enum LeaderboardCommand {
    /// Write results as an entry: one file that others can verify
    ///
    /// Submit on the machine that evaluated: the entry states its processor, on which all bits are equal.
    #[command(after_help = "Example: swm leaderboard submit results --output entry.json --author Ada --licence MIT")]
    Submit(SubmitArgs),
    /// Play the episodes of an entry again, and refuse it if one differs
    #[command(after_help = "Example: swm leaderboard verify entry.json --share 0.1")]
    Verify(VerifyArgs),
    /// Write the pages of a folder of entries: static files for any server
    #[command(after_help = "Example: swm leaderboard build leaderboard --output site")]
    Build(BuildArgs),
}

#[derive(Args)]
struct SubmitArgs {
    /// A results.json, or the folder that contains it
    results: PathBuf,
    /// The entry to write
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// The policy (default: the only one with weights)
    ///
    /// Other policies with weights are left out; the floor and the baselines stay.
    #[arg(long, value_name = "NAME")]
    policy: Option<String>,
    /// Who submits the entry (default: the author of the capsule)
    #[arg(long, value_name = "TEXT")]
    author: Option<String>,
    /// Licence of weights and results (default: that of the capsule)
    #[arg(long, value_name = "TEXT")]
    licence: Option<String>,
}

#[derive(Args)]
struct VerifyArgs {
    /// The file of an entry
    entry: PathBuf,
    /// Share of the episodes to play, chosen at random
    #[arg(long, default_value_t = 1.0, value_parser = share)]
    share: f64,
    /// Seed of the choice (default: random)
    ///
    /// Nobody can guess which episodes a random seed chooses.
    #[arg(long)]
    seed: Option<u64>,
    /// Refuse another kind of processor or device, which has a tolerance
    #[arg(long)]
    exact: bool,
    /// The checkpoint, if it is not where the entry says
    #[arg(long, value_name = "CHECKPOINT")]
    checkpoint: Option<String>,
    /// The dataset of the starts, if it is not where the entry says
    #[arg(long, value_name = "DATASET")]
    dataset: Option<String>,
    /// The environment, if the entry may not choose it
    ///
    /// An entry may choose built-in environments and those registered with Gymnasium (docs/security.md).
    #[arg(long)]
    env: Option<String>,
    /// Allow the entry to choose any environment, wrapper and dataset
    #[arg(long)]
    trust: bool,
    /// Parallel environments; results do not depend on their number
    #[arg(long, default_value_t = 16)]
    envs: usize,
}

#[derive(Args)]
struct BuildArgs {
    /// The folder of the entries: *.json, also in two levels of folders below
    ///
    /// Symbolic links are refused, and entries in deeper folders: no entry is left out.
    folder: PathBuf,
    /// Folder of the pages
    #[arg(short, long, default_value = "site", value_name = "DIR")]
    output: PathBuf,
    /// Title
    #[arg(long, default_value = "Leaderboard")]
    title: String,
}

/// The most differences that are printed.
const SHOWN: usize = 20;

/// Runs `swm leaderboard`.
pub fn leaderboard(args: &LeaderboardArgs, context: &Context) -> anyhow::Result<()> {
    match &args.command {
        LeaderboardCommand::Submit(args) => submit(args, context),
        LeaderboardCommand::Verify(args) => verify_entry(args, context),
        LeaderboardCommand::Build(args) => build(args, context),
    }
}

fn submit(args: &SubmitArgs, context: &Context) -> anyhow::Result<()> {
    output_folder::check_file(&args.output)?;
    let file = results_file(&args.results)?;
    files::check_own(&args.output, |path| Entry::read(path).is_ok())?;
    let submission = Submission {
        results: swm_report::read_results(&file)?,
        policy: args.policy.clone(),
        author: args.author.clone().unwrap_or_default(),
        licence: args.licence.clone().unwrap_or_default(),
    };
    let entry = match (&args.author, &args.licence) {
        (Some(_), Some(_)) => Entry::new(submission)?,
        _ => {
            // Its author and licence are those of the capsule, where it has some.
            let stated = |text: &Option<String>, from: Option<String>, option: &str| {
                text.clone().or(from).ok_or_else(|| {
                    let problem = format!("no {option} is given, and the checkpoint states none");
                    Error::config("the entry", problem, format!("give it with --{option}"))
                })
            };
            let unnamed = Submission { author: "?".to_owned(), licence: "?".to_owned(), ..submission.clone() };
            let name = Entry::new(unnamed)?.checkpoint()?;
            if name.contains("://") {
                // The results may be those of a stranger.
                let fix = "give --author and --licence";
                let problem = "is on a server, which is not asked for its author and licence";
                return Err(Error::config(format!("the checkpoint '{name}'"), problem, fix).into());
            }
            let capsule = capsule(&name)?;
            let (author, licence) =
                capsule.map_or((None, None), |capsule| (capsule.description.author, capsule.description.licence));
            let (author, licence) =
                (stated(&args.author, author, "author")?, stated(&args.licence, licence, "licence")?);
            Entry::new(Submission { author, licence, ..submission })?
        }
    };
    entry.write(&args.output)?;
    if context.json {
        let path = args.output.to_string_lossy();
        return emit_json(&json!({"path": path, "hash": entry.hash, "weights": entry.weights()?}));
    }
    emit(&format!("{}\n", args.output.display()));
    Ok(())
}

/// Returns the capsule with this name; `None` for a checkpoint folder.
fn capsule(name: &str) -> Result<Option<Capsule>> {
    let path = home::find_checkpoint(name)?;
    path.is_file().then(|| Capsule::read(&path)).transpose()
}

fn verify_entry(args: &VerifyArgs, context: &Context) -> anyhow::Result<()> {
    let seed = args.seed.unwrap_or_else(|| RandomState::new().build_hasher().finish());
    let how = How {
        share: args.share,
        seed,
        exact: args.exact,
        trust: args.trust,
        env: args.env.clone(),
        checkpoint: args.checkpoint.clone(),
        dataset: args.dataset.clone(),
    };
    let found = verify(&args.entry, &how, &run_options(args.envs, None, context), &mut control(context))?;
    if context.json {
        emit_json(&json!({"holds": found.faults.is_empty(), "seed": seed, "verification": found}))?;
    } else {
        emit(&sentences(&found, seed));
    }
    if !found.faults.is_empty() {
        anyhow::bail!("{} does not hold: {} differences", args.entry.display(), found.faults.len());
    }
    Ok(())
}

/// Describes a verification in lines.
fn sentences(found: &Verification, seed: u64) -> String {
    let mut lines = String::new();
    for (kind, differences) in [("differs", &found.faults), ("remark", &found.remarks)] {
        for difference in differences.iter().take(SHOWN) {
            // A difference has texts of the entry, which could end the line.
            lines += &format!("{kind}: {}\n", difference.replace('\n', "\\n"));
        }
        if differences.len() > SHOWN {
            lines += &format!("{kind}: {} more\n", differences.len() - SHOWN);
        }
    }
    let Verification { played, episodes, runs, made_on, verified_on, .. } = found;
    let of_share = if played.len() == *episodes { String::new() } else { format!(" (seed {seed})") };
    let class = match found.class {
        Class::Exact => format!("bit for bit, on {made_on}"),
        Class::Outcomes => {
            let most = 100.0 * TOLERANCE;
            let rewards = 100.0 * REWARD_TOLERANCE;
            format!(
                "made on {made_on}, verified on {verified_on}: at most {most:.0} % of the episodes may end differently, and sums of rewards \
                 differ by {rewards:.0} %"
            )
        }
    };
    lines += &format!("played {} of {episodes} episodes of {runs} runs{of_share}; {class}\n", played.len());
    if found.faults.is_empty() {
        lines += &format!("the entry {} holds\n", found.hash);
    }
    lines
}

fn build(args: &BuildArgs, context: &Context) -> anyhow::Result<()> {
    if same_folder(&args.folder, &args.output) {
        let fix = "give another folder with --output";
        return Err(Error::config(args.output.display().to_string(), "is the folder of the entries", fix).into());
    }
    let found = entries(&args.folder)?;
    let board = board(&found, &args.title)?;
    let pages = board.pages();
    let names: Vec<&str> = pages.iter().filter_map(|page| page.to_str()).collect();
    let _lock = output_folder::claim(&args.output, &names)?;
    let BoardPages { first: page, moves, deleted } = swm_report::write_leaderboard(&board, &args.output)?;
    if context.json {
        let tables = board.tables.iter().map(|table| {
            let rates = table.rows.iter().map(|row| json!({"policy": row.label, "success": row.run.success}));
            json!({"env": table.env, "condition": table.condition, "policies": rates.collect::<Vec<_>>()})
        });
        return emit_json(&json!({
            "page": page.to_string_lossy(),
            "pages": names,
            "tables": tables.collect::<Vec<_>>(),
            "moves": moves,
            "deleted": as_texts(&deleted),
        }));
    }
    for table in &board.tables {
        let rates: Vec<String> =
            table.rows.iter().map(|row| format!("{} {}", row.label, percent(&row.run.success))).collect();
        emit(&format!("{}, {}: {}\n", table.env, table.condition, rates.join(", ")));
    }
    for Move { table, policy, from, to } in moves.iter().take(SHOWN) {
        let [from, to] = [from.as_deref().unwrap_or("new"), to.as_deref().unwrap_or("gone")];
        emit(&format!("moved: {policy} in {table}: {from} -> {to}\n"));
    }
    for page in &deleted {
        emit(&format!("deleted {}, whose entry is gone\n", args.output.join(page).display()));
    }
    emit(&format!("{}\n", page.display()));
    Ok(())
}

fn same_folder(a: &Path, b: &Path) -> bool {
    a.canonicalize().is_ok_and(|a| b.canonicalize().is_ok_and(|b| a == b))
}

/// Parses a share of episodes.
fn share(given: &str) -> std::result::Result<f64, String> {
    let share = given.parse::<f64>().ok().filter(|share| *share > 0.0 && *share <= 1.0);
    share.ok_or_else(|| format!("'{given}' is not a number above 0 and at most 1"))
}
