//! `swm demo`: collects, trains, plans, evaluates and reports within minutes on a laptop CPU.

use super::collect::{self, Collection};
use super::config::count;
use super::devices::DeviceArgs;
use super::output_folder;
use super::results_tables::summary;
use super::wrappers::WrapperArgs;
use super::{Context, emit, emit_json, eprint, eval, train, training_curves};
use crate::resolver::HomeResolver;
use crate::{ENVS, home};
use clap::Args;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::time::Instant;
use swm_core::files::{self, Lock};
use swm_core::limits::EVALUATED_EPISODES;
use swm_core::results::Counting;
use swm_core::{Error, Origin, Result, VariationRequest};
use swm_data::{ImageCodec, Location, WriteMode};
use swm_eval::{
    Choice, CollectConfig, Condition, EvalRequest, Model, PolicyKind, PolicyRequest, StartsRequest, WorldConfig,
};
use swm_models::pldm::Pldm;
use swm_models::{TrainConfig, TrainOptions, run_folder};
use swm_plan::{Cem, MpcConfig};
use swm_report::ReportOptions;

/// Arguments of `swm demo`. The defaults are sized for two CPU cores.
#[derive(Args)]
pub struct DemoArgs {
    /// Folder of all files (default: demo/ in $STABLEWM_HOME)
    ///
    /// Files of an earlier demo are replaced.
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Seed of data, weights and plans
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Episodes to collect
    #[arg(long, default_value_t = 300, value_parser = count::<1, { EVALUATED_EPISODES.max }>)]
    episodes: usize,
    /// Episodes to evaluate per policy and condition
    #[arg(long, default_value_t = 100, value_parser = count::<1, { EVALUATED_EPISODES.max }>)]
    eval_episodes: usize,
    /// Parallel environments of the evaluation; results do not depend on their number
    #[arg(long, default_value_t = 50)]
    envs: usize,
    #[command(flatten)]
    device: DeviceArgs,
    /// Training settings, such as schedule.steps=500
    #[arg(value_name = "KEY=VALUE")]
    settings: Vec<String>,
}

/// The environment of the demo.
const ENV: &str = "swm/TwoRoom-v1";

/// The name of the model in results.
const MODEL: &str = "pldm";

/// The shifted factor: the agent is blue instead of red.
const SHIFT: (&str, [f64; 3]) = ("agent.color", [0.0, 128.0, 255.0]);

/// The solver of the demo: two rooms need a smaller search than the tasks of the paper, and plans of two model steps solve
/// more than longer ones (`docs/models/pldm.md`).
const SEARCH: Cem = Cem { samples: 128, iterations: 8, elites: 16, sigma: 1.0 };
const HORIZON: usize = 2;
const RECEDING_HORIZON: usize = 1;

/// The time limit of an episode, in steps.
const TIME_LIMIT: usize = 100;

/// Runs `swm demo`.
pub fn demo(args: &DemoArgs, context: &Context) -> anyhow::Result<()> {
    let start = Instant::now();
    let output = match &args.output {
        Some(folder) => folder.clone(),
        None => home::home()?.join("demo"),
    };
    let (data, model, results) = (output.join("rooms.lance"), output.join("pldm-rooms"), output.join("results"));
    let mut config = TrainConfig::<Pldm>::load("tiny", &args.settings)?;
    config.seed = args.seed;
    let side = config.model.image;
    let device = args.device.open()?;
    let _lock = claim(&output)?;
    // The folder may come from a stranger, whose links name folders of the user.
    [&data, &model, &results].into_iter().try_for_each(|path| files::check_no_link(path))?;
    // The other steps replace the files of an earlier demo themselves; training refuses the folder of another run.
    let _ = run_folder::remove(&model)?;
    eprint("1/4 collect: an exploring policy moves through two rooms\n");
    collect_rooms(args, &data, side, context)?;

    eprint("2/4 train: a small PLDM learns to predict its next observations\n");
    let options = TrainOptions { threads: context.threads, device: device.clone(), ..TrainOptions::default() };
    let reader = home::open_dataset(&data.to_string_lossy())?;
    train::run(&config, swm_models::TrainRun { reader, encoder: None, out: &model, options }, context)?;

    eprint("3/4 plan and evaluate: CEM with the model, compared with the random-policy floor\n");
    let resolver = HomeResolver::new(Origin::User).on(device).tracing();
    let request = request(args, &model, side, &resolver)?;
    let (found, file) = eval::run(&request, &resolver, args.envs, (&results, eval::VIDEOS), context)?;

    eprint("4/4 report\n");
    let options = ReportOptions {
        title: Some("Two rooms, one small world model".to_owned()),
        training: vec![training_curves::of_checkpoint(MODEL, &model)],
        command: None,
    };
    let page = swm_report::write_report_with(&[(file, found.clone())], &options, &output)?;
    let seconds = start.elapsed().as_secs_f64();
    if context.json {
        return emit_json(&json!({
            "report": page.to_string_lossy(), "dataset": data.to_string_lossy(), "checkpoint": model.to_string_lossy(),
            "results": found, "seconds": seconds,
        }));
    }
    emit(&summary(&found));
    emit(&format!("{seconds:.0} s in total; the report: {}\n", page.display()));
    Ok(())
}

/// The file that marks the folder of a demo, and its text.
const MARK: &str = ".swm-demo";
const MARK_TEXT: &str =
    "`swm demo` made this folder, and replaces rooms.lance, pldm-rooms, results and index.html in it.\n";

/// Creates the folder of the demo, keeps other writers away, and marks the folder.
///
/// # Errors
/// When another process writes to the folder, or it has contents and no mark: its files may be the user's.
fn claim(folder: &Path) -> Result<Lock> {
    let lock = output_folder::claim(folder, &["index.html"])?;
    files::delete_temporary(folder, |name| name == MARK)?;
    let mark = folder.join(MARK);
    let io = |error| Error::io(folder, "listing the folder", error);
    let is_marked = files::read(&mark, MARK_TEXT.len() as u64).is_ok_and(|text| text == MARK_TEXT.as_bytes());
    if !is_marked && std::fs::read_dir(folder).map_err(io)?.next().is_some() {
        let fix = "give an empty folder with --output, or move its contents away";
        return Err(Error::config(folder.display().to_string(), "has files that `swm demo` did not write", fix));
    }
    files::write(&mark, MARK_TEXT.as_bytes())?;
    Ok(lock)
}

/// Collects the dataset of the demo.
fn collect_rooms(args: &DemoArgs, data: &Path, side: usize, context: &Context) -> Result<()> {
    let collection = Collection {
        env: ENVS.choose(ENV)?,
        location: &Location::from(data),
        format: None,
        shard: None,
        world: WorldConfig {
            envs: 16,
            image: Some((side, side)),
            max_episode_steps: Some(TIME_LIMIT),
            threads: context.threads,
            ..WorldConfig::default()
        },
        config: CollectConfig {
            episodes: args.episodes,
            seed: args.seed,
            policy: "explore".into(),
            ..CollectConfig::default()
        },
        mode: WriteMode::Overwrite,
        mix_renderers: false,
        codec: ImageCodec::default(),
        wrappers: WrapperArgs::default(),
    };
    collect::run(&collection, context).map(|_| ())
}

/// Returns the evaluation of the demo: the model in distribution and with the shifted factor.
fn request(args: &DemoArgs, model: &Path, side: usize, resolver: &HomeResolver) -> Result<EvalRequest> {
    let checkpoint = model.to_string_lossy().into_owned();
    let info = resolver.checkpoint(&checkpoint)?.info()?;
    let mpc = MpcConfig {
        horizon: HORIZON,
        receding_horizon: RECEDING_HORIZON,
        action_block: info.action_block,
        history: info.history,
        ..MpcConfig::default()
    };
    let kind = PolicyKind::Plan {
        model: Model::Checkpoint(checkpoint),
        solver: Choice { id: "cem".to_owned(), settings: json!(SEARCH) },
        mpc: json!(mpc),
        objective: Value::Null,
    };
    let (factor, value) = SHIFT;
    let shift =
        VariationRequest { variation_values: [(factor.to_owned(), value.to_vec())].into(), ..Default::default() };
    Ok(EvalRequest {
        version: EvalRequest::VERSION,
        env: ENV.to_owned(),
        wrappers: vec![],
        wrap_goal: false,
        image: Some([side, side]),
        policies: vec![PolicyRequest { name: MODEL.to_owned(), kind }],
        starts: StartsRequest::Episodic,
        episodes: args.eval_episodes,
        seed: args.seed.wrapping_add(1),
        budget: Some(TIME_LIMIT),
        counting: Counting::default(),
        conditions: vec![
            Condition { name: "in distribution".to_owned(), variation: VariationRequest::default() },
            Condition { name: format!("{factor} shifted"), variation: shift },
        ],
        prediction: None,
        planning_seed: None,
    })
}
