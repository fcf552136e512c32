//! `swm demo`: the whole pipeline on a laptop CPU, in minutes.

use super::collect::{self, Collection};
use super::wrappers::WrapperArgs;
use super::{Context, complain, emit, emit_json, eval, train};
use clap::Args;
use serde_json::{Value, json};
use std::path::PathBuf;
use std::time::Instant;
use swm::resolver::Home;
use swm::{ENVS, home};
use swm_core::VariationRequest;
use swm_core::results::Counting;
use swm_data::Location;
use swm_data::{ImageCodec, WriteMode};
use swm_eval::{
    Choice, CollectConfig, Condition, EvalRequest, Model, PolicyKind, PolicyRequest, StartsRequest, WorldConfig,
};
use swm_models::lewm::Lewm;
use swm_models::{Checkpoint, Device, TrainConfig, TrainOptions};
use swm_plan::{Cem, MpcConfig};
use swm_report::ReportOptions;

/// Arguments of `swm demo`. The defaults are sized for two CPU cores.
#[derive(Args)]
pub struct DemoArgs {
    /// Where everything goes (default: demo/ under $STABLEWM_HOME); what an earlier demo left there is replaced
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// What decides data, weights and plans
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Episodes to collect
    #[arg(long, default_value_t = 300)]
    episodes: usize,
    /// Episodes to evaluate, each way
    #[arg(long, default_value_t = 100)]
    eval_episodes: usize,
    /// Environments played, and planned for, at the same time; results do not depend on it
    #[arg(long, default_value_t = 50)]
    envs: usize,
    /// Training settings, such as schedule.steps=500
    #[arg(value_name = "KEY=VALUE")]
    settings: Vec<String>,
}

/// The world of the demo.
const ENV: &str = "swm/TwoRoom-v1";

/// What is shifted: the floor turns from white to a pale blue.
const SHIFT: (&str, [f64; 3]) = ("background.color", [200.0, 220.0, 255.0]);

/// How the demo plans: a smaller search than the paper's, which is enough here.
const SEARCH: Cem = Cem { samples: 128, iterations: 8, elites: 16, sigma: 1.0 };
const HORIZON: usize = 6;
const RECEDING_HORIZON: usize = 2;

/// Collects, trains, evaluates and reports.
pub fn demo(args: &DemoArgs, context: &Context) -> anyhow::Result<()> {
    let begun = Instant::now();
    let env = ENVS.choose(ENV)?;
    let output = args.output.clone().unwrap_or_else(|| home::home().join("demo"));
    let (data, model, results) = (output.join("rooms.lance"), output.join("lewm-rooms"), output.join("results"));
    let mut config = TrainConfig::<Lewm>::load("tiny", &args.settings)?;
    config.seed = args.seed;
    let image = (config.model.image, config.model.image);
    for old in [&model, &results] {
        if old.exists() {
            std::fs::remove_dir_all(old).map_err(|e| swm_core::Error::io(old, "removing the last demo", e))?;
        }
    }

    complain("1/4 collect: an exploring policy wanders through two rooms\n");
    let world = WorldConfig {
        envs: 16,
        image: Some(image),
        max_episode_steps: Some(100),
        threads: context.threads,
        ..WorldConfig::default()
    };
    let collection = Collection {
        env,
        location: &Location::from(&data),
        format: None,
        shard: None,
        policy: "explore",
        world: world.clone(),
        config: CollectConfig {
            episodes: args.episodes,
            seed: args.seed,
            policy: "explore".to_owned(),
            ..CollectConfig::default()
        },
        mode: WriteMode::Overwrite,
        mix_renderers: false,
        codec: ImageCodec::default(),
        wrappers: WrapperArgs::default(),
    };
    collect::run(&collection, context)?;

    complain("2/4 train: a small LeWM learns to predict what it will see\n");
    let options = TrainOptions { threads: context.threads, ..TrainOptions::default() };
    let reader = home::open_dataset(&data.to_string_lossy())?;
    train::run(&config, swm_models::TrainRun { reader, encoder: None, out: &model, options }, context)?;
    let checkpoint = Checkpoint::<Lewm>::load(&model, &Device::flex())?;

    complain("3/4 plan and evaluate: CEM over the model, beside the random floor\n");
    let shift =
        VariationRequest { variation_values: [(SHIFT.0.to_owned(), SHIFT.1.to_vec())].into(), ..Default::default() };
    let mpc = MpcConfig {
        horizon: HORIZON,
        receding_horizon: RECEDING_HORIZON,
        action_block: checkpoint.config.data.frameskip,
        history: checkpoint.config.model.predictor.history,
        ..MpcConfig::default()
    };
    let kind = PolicyKind::Plan {
        model: Model::Checkpoint(model.to_string_lossy().into_owned()),
        solver: Choice { id: "cem".to_owned(), settings: json!(SEARCH) },
        mpc: json!(mpc),
        objective: Value::Null,
    };
    let request = EvalRequest {
        version: EvalRequest::VERSION,
        env: ENV.to_owned(),
        wrappers: vec![],
        wrap_goal: false,
        image: Some(image.into()),
        policies: vec![PolicyRequest { name: "lewm".to_owned(), kind }],
        starts: StartsRequest::Episodic,
        episodes: args.eval_episodes,
        seed: args.seed + 1,
        budget: world.max_episode_steps,
        counting: Counting::default(),
        conditions: vec![
            Condition { name: "in distribution".to_owned(), variation: VariationRequest::default() },
            Condition { name: format!("{} shifted", SHIFT.0), variation: shift },
        ],
        prediction: None,
    };
    let (found, file) = eval::run(&request, &Home::tracing(), args.envs, (&results, 3), context)?;

    complain("4/4 report\n");
    let options = ReportOptions {
        title: Some("Two rooms, one small world model".to_owned()),
        metrics: Some(train::log_of(&model)),
        command: None,
    };
    let page = swm_report::write_report_with(&[(file, found.clone())], &options, &output)?;
    if context.json {
        return emit_json(&json!({
            "report": page, "dataset": data, "checkpoint": model, "results": found, "seconds": begun.elapsed().as_secs_f64(),
        }));
    }
    emit(&eval::summary(&found));
    emit(&format!("{:.0} s in all; the report: {}\n", begun.elapsed().as_secs_f64(), page.display()));
    Ok(())
}
