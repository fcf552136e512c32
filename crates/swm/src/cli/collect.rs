//! `swm collect`: run a policy and store its episodes.

use super::config::{CodecArgs, VariationArgs, image_size};
use super::wrappers::WrapperArgs;
use super::{Context, Progress, emit, emit_json};
use clap::Args;
use serde_json::json;
use std::path::{Path, PathBuf};
use std::time::Instant;
use swm::home;
use swm::resolver::acting;
use swm_core::run::{Control, Event};
use swm_core::{CameraView, EnvChoice, Error, Result};
use swm_data::lance::{Shard, create_shard};
use swm_data::{FORMATS, ImageCodec, Location, WriteMode, WriteOptions};
use swm_eval::{CollectConfig, Collected, World, WorldConfig};

/// Arguments of `swm collect`.
#[derive(Args)]
pub struct CollectArgs {
    /// The environment, such as swm/TwoRoom-v1; options behind it: swm/OGBCube-v0,env_type=double
    env: String,
    /// The dataset to write: a path or a name
    #[arg(short, long, value_name = "DATASET")]
    output: String,
    /// Who acts: random, expert, one of the environment's experts by name, or a checkpoint that acts by itself
    #[arg(long, default_value = "expert")]
    policy: String,
    /// Episodes the dataset shall have
    #[arg(long, default_value_t = 100)]
    episodes: usize,
    /// What decides every episode, together with its number
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Environments played at the same time; the dataset does not depend on it
    #[arg(long, default_value_t = 8)]
    envs: usize,
    /// Picture size: 64 or HEIGHTxWIDTH
    #[arg(long, default_value = "224", value_parser = image_size)]
    image: (usize, usize),
    /// Store no pictures
    #[arg(long, conflicts_with = "image")]
    no_pixels: bool,
    /// Another picture to store: CAMERA, depth, segmentation, or CAMERA:depth (`swm envs ENV` names the cameras)
    #[arg(long = "view", value_name = "VIEW", conflicts_with = "no_pixels")]
    views: Vec<String>,
    /// Steps after which an episode is truncated (default: the environment's own)
    #[arg(long, value_name = "STEPS")]
    max_steps: Option<usize>,
    /// Its format, where the name does not say it (`swm formats` lists them)
    #[arg(long, value_name = "NAME")]
    format: Option<String>,
    /// Collect the part I of N, counted from 0, of a Lance dataset; `swm datasets commit` makes one of all parts
    #[arg(long, value_name = "I/N", value_parser = shard, conflicts_with = "format")]
    shard: Option<Shard>,
    /// Add to a dataset whose pictures another renderer drew
    #[arg(long, requires = "resume")]
    mix_renderers: bool,
    #[command(flatten)]
    codec: CodecArgs,
    /// Continue an interrupted collection
    #[arg(long, conflicts_with = "overwrite")]
    resume: bool,
    /// Replace a dataset that is already there
    #[arg(long)]
    overwrite: bool,
    #[command(flatten)]
    wrappers: WrapperArgs,
    #[command(flatten)]
    variation: VariationArgs,
}

/// Reads `I/N`.
fn shard(text: &str) -> std::result::Result<Shard, String> {
    let parts = text.split_once('/').and_then(|(index, count)| Some((index.parse().ok()?, count.parse().ok()?)));
    match parts {
        Some((index, count)) if index < count => Ok(Shard { index, count }),
        _ => Err(format!("'{text}' is no part: write 0/4 for the first of four")),
    }
}

/// A collection, as `swm collect` and `swm demo` ask for it.
pub struct Collection<'a> {
    /// The environment.
    pub env: EnvChoice,
    /// Where to.
    pub location: &'a Location,
    /// The format, where the location does not say it.
    pub format: Option<&'a str>,
    /// Which part of the dataset, if not all.
    pub shard: Option<Shard>,
    /// Who acts.
    pub policy: &'a str,
    /// Environments, pictures, threads.
    pub world: WorldConfig,
    /// Episodes, seed, factors.
    pub config: CollectConfig,
    /// What to do with a dataset that is there.
    pub mode: WriteMode,
    /// How pictures are stored.
    pub codec: ImageCodec,
    /// What pictures pass through before they are stored.
    pub wrappers: WrapperArgs,
    /// Whether pictures of another renderer may stand beside those that are there.
    pub mix_renderers: bool,
}

/// Runs a policy and stores its episodes.
pub fn collect(args: &CollectArgs, context: &Context) -> anyhow::Result<()> {
    let location = home::target(&args.output, args.format.as_deref())?;
    let collection = Collection {
        env: swm::env(&args.env)?,
        location: &location,
        format: args.format.as_deref(),
        shard: args.shard,
        policy: &args.policy,
        world: WorldConfig {
            envs: args.envs,
            image: (!args.no_pixels).then_some(args.image),
            views: args.views.iter().map(|view| CameraView::parse(view)).collect::<Result<_>>()?,
            max_episode_steps: args.max_steps,
            threads: context.threads,
        },
        config: CollectConfig {
            episodes: args.episodes,
            seed: args.seed,
            variation: args.variation.request()?,
            policy: args.policy.clone(),
            ..CollectConfig::default()
        },
        mode: match (args.resume, args.overwrite) {
            (true, _) => WriteMode::Append,
            (_, true) => WriteMode::Overwrite,
            _ => WriteMode::Create,
        },
        codec: args.codec.codec(),
        wrappers: args.wrappers.clone(),
        mix_renderers: args.mix_renderers,
    };
    let collected = run(&collection, context)?;
    if context.json {
        return emit_json(&json!({"dataset": location.to_string(), "collected": collected}));
    }
    emit(&format!("{location}\n"));
    Ok(())
}

/// Runs a collection with a progress bar.
pub fn run(collection: &Collection<'_>, context: &Context) -> Result<Collected> {
    let Collection { env, location, config, .. } = collection;
    let (stack, goal) = collection.wrappers.stack()?;
    let mut world = World::of(|| Ok(stack.wrap(env.env()?, goal)), collection.world.clone())?;
    let (mut policy, weights) = acting(&env.entry, collection.policy, &world)?;
    // A wrong factor is found before anything of an older dataset is replaced.
    world.spec().variation_space.resolve(&config.variation, swm_core::Key::new(config.seed))?;
    let mut manifest = world.collect_manifest(config);
    if let Some(weights) = weights {
        manifest.hashes.insert("policy".to_owned(), weights);
    }
    manifest.config["codec"] = json!(collection.codec);
    if !collection.wrappers.wrappers.is_empty() {
        manifest.config["wrappers"] = json!(collection.wrappers.choices()?);
        manifest.config["wrap_goal"] = json!(collection.wrappers.wrap_goal);
    }
    if collection.shard.is_none() {
        swm::collect::check(location, collection.mode, &manifest, collection.mix_renderers)?;
    }
    let schema = world.collect_schema(config.goal)?;
    let options = WriteOptions {
        mode: collection.mode,
        codec: collection.codec,
        manifest: Some(manifest),
        ..WriteOptions::default()
    };
    // A part has a run of the episodes, so that the whole has them in order.
    let part = collection.shard.map_or(0..config.episodes, |Shard { index, count }| {
        config.episodes * index / count..config.episodes * (index + 1) / count
    });
    let writer = match (collection.shard, collection.format) {
        (Some(shard), _) => create_shard(location, &schema, options, shard)?,
        (None, Some(format)) => FORMATS.get(format)?.create(location, &schema, options)?,
        (None, None) => swm_data::create(*location, &schema, options)?,
    };
    let config = &CollectConfig { episodes: part.len(), first: part.start, ..config.clone() };
    let mut progress = Progress::new("collect", config.episodes);
    let begun = Instant::now();
    let speed = |steps: f64| format!("{:.0} steps/s", steps / begun.elapsed().as_secs_f64().max(1e-9));
    let collected = {
        let progress = &mut progress;
        let mut control = Control::new().with_interrupt(context.stop.clone()).with_events(move |event| {
            if let Event::Progress(at) = event {
                progress.at(at.done, speed(at.metric("steps").unwrap_or_default()));
            }
        });
        world.collect(&mut *policy, writer, config, &mut control)?
    };
    progress.done(&format!(
        "{} episodes in {location} ({} new, {} steps, {})",
        collected.episodes,
        collected.added,
        collected.steps,
        speed(collected.steps as f64)
    ));
    Ok(collected)
}

/// What `--output` of a command becomes: the folder, made.
pub fn folder(path: &Path) -> Result<PathBuf> {
    std::fs::create_dir_all(path).map_err(|e| Error::io(path, "creating the folder", e))?;
    Ok(path.to_owned())
}
