//! `swm collect`: runs a policy and stores its episodes.

mod recorded;

use super::config::{CodecArgs, VariationArgs, count, image_size};
use super::wrappers::WrapperArgs;
use super::{Context, emit, emit_json, eprint, progress};
use crate::collect_target::Existing;
use crate::resolver::policy_of_choice;
use crate::{collect_target, home};
use clap::Args;
use serde_json::json;
use std::collections::BTreeMap;
use std::time::Instant;
use swm_core::{CameraView, EnvChoice, Error, Key, Manifest, Origin, Policy, Result, Schema, limits};
use swm_data::lance::{Shard, create_shard};
use swm_data::{Continued, FORMATS, ImageCodec, Location, WriteMode, WriteOptions, Writer};
use swm_eval::{CollectConfig, Collected, PolicyChoice, World, WorldConfig};

/// Arguments of `swm collect`.
#[derive(Args)]
pub struct CollectArgs {
    /// The environment, such as swm/TwoRoom-v1 or swm/OGBCube-v0,env_type=double
    #[arg(required_unless_present = "resume")]
    env: Option<String>,
    /// The dataset to write: a path or a name
    #[arg(short, long, value_name = "DATASET")]
    pub(super) output: String,
    /// The policy: random, expert (the default), an expert's id, or a checkpoint
    ///
    /// The checkpoint must act without a solver. `swm envs ENV` lists the experts. Repeat the option with weights for a
    /// mixture (--policy expert:0.7 --policy random:0.3): every episode draws its policy.
    #[arg(long = "policy", value_name = "NAME[:WEIGHT]")]
    policies: Vec<String>,
    /// Add Gaussian noise of this standard deviation to every action
    ///
    /// The unit is that of the action space. Actions are clipped to the space, and stored as executed.
    #[arg(long, value_name = "STD")]
    action_noise: Option<f64>,
    /// Number of episodes of the complete dataset (default: 100)
    #[arg(long, value_parser = count::<1, { limits::EPISODES.max }>)]
    episodes: Option<usize>,
    /// Seed; an episode depends only on it and on its own index (default: 0)
    #[arg(long)]
    seed: Option<u64>,
    /// Parallel environments; the dataset does not depend on their number
    #[arg(long, default_value_t = 8)]
    envs: usize,
    /// Frame size in pixels: 64 or HEIGHTxWIDTH (default: 224)
    #[arg(long, value_parser = image_size)]
    image: Option<(usize, usize)>,
    /// Store no frames
    #[arg(long, conflicts_with = "image")]
    no_pixels: bool,
    /// Another camera view: CAMERA, depth, segmentation, or CAMERA:depth
    ///
    /// `swm envs ENV` lists the cameras.
    #[arg(long = "view", value_name = "VIEW", conflicts_with = "no_pixels")]
    views: Vec<String>,
    /// Time limit of an episode, in steps (default: the environment's)
    #[arg(long, value_name = "STEPS")]
    max_steps: Option<usize>,
    /// Dataset format (default: from the suffix); `swm formats` lists them
    #[arg(long, value_name = "NAME")]
    pub(super) format: Option<String>,
    /// Collect shard I of N, counted from 0, of a Lance dataset
    ///
    /// `swm datasets commit` commits the shards of all machines.
    #[arg(long, value_name = "I/N", value_parser = shard, conflicts_with = "format")]
    pub(super) shard: Option<Shard>,
    /// Stop at NaN and infinite values instead of counting them
    ///
    /// Without it they are stored, and the manifest contains their number in each column.
    #[arg(long)]
    strict_finite: bool,
    /// Continue a dataset whose frames come from another renderer
    #[arg(long, requires = "resume")]
    mix_renderers: bool,
    #[command(flatten)]
    codec: CodecArgs,
    /// Continue an interrupted collection; with --output alone, as it began
    #[arg(long, conflicts_with = "overwrite")]
    pub(super) resume: bool,
    /// Replace an existing dataset
    #[arg(long)]
    pub(super) overwrite: bool,
    #[command(flatten)]
    wrappers: WrapperArgs,
    #[command(flatten)]
    variation: VariationArgs,
}

impl CollectArgs {
    /// The number of episodes of the complete dataset.
    pub fn episodes(&self) -> usize {
        self.episodes.unwrap_or(DEFAULT_EPISODES)
    }

    /// The policies and their weights.
    fn policy(&self) -> Result<PolicyChoice> {
        if self.policies.is_empty() { Ok(DEFAULT_POLICY.into()) } else { PolicyChoice::parse(&self.policies) }
    }
}

/// The number of episodes, the policy, and the height and width of frames, unless the command line says otherwise.
const DEFAULT_EPISODES: usize = 100;
const DEFAULT_POLICY: &str = "expert";
const DEFAULT_IMAGE: (usize, usize) = (224, 224);

/// What to do about a dataset that exists.
const EXISTS: &str = "continue it with --resume, replace it with --overwrite, or choose another name";

/// Parses `I/N`.
pub(super) fn shard(text: &str) -> std::result::Result<Shard, String> {
    let parts = text.split_once('/').and_then(|(index, count)| Some((index.parse().ok()?, count.parse().ok()?)));
    match parts {
        Some((index, count)) if index < count => Ok(Shard { index, count }),
        _ => Err(format!("'{text}' is not a shard: write 0/4 for the first of four")),
    }
}

/// The settings of a collection.
pub struct Collection<'a> {
    /// The environment.
    pub env: EnvChoice,
    /// The dataset to write.
    pub location: &'a Location,
    /// The format; `None` to infer it from the location.
    pub format: Option<&'a str>,
    /// The shard to collect; `None` for the whole dataset.
    pub shard: Option<Shard>,
    /// The number of environments, the frames, and the number of threads.
    pub world: WorldConfig,
    /// The policies, the episodes, the seed, and the factors of variation.
    pub config: CollectConfig,
    /// Whether to create, continue or replace the dataset.
    pub mode: WriteMode,
    /// The codec of frames.
    pub codec: ImageCodec,
    /// Wrappers of the frames.
    pub wrappers: WrapperArgs,
    /// Whether the dataset may contain frames of several renderers.
    pub mix_renderers: bool,
}

/// Runs `swm collect`. `trust` says whether a dataset that is continued may choose any name.
pub fn collect(args: &CollectArgs, trust: bool, context: &Context) -> anyhow::Result<()> {
    if args.env.is_none() {
        let (args, command) = recorded::complete(args, trust)?;
        eprint(&format!("continuing: {command}\n"));
        return collect(&args, trust, context).map_err(recorded::unknown_policy);
    }
    let (location, collected) = run_args(args, context)?;
    if context.json {
        return emit_json(&json!({"dataset": location.to_string(), "collected": collected}));
    }
    emit(&format!("{location}\n"));
    Ok(())
}

/// Collects the dataset of a command line, and shows progress.
pub fn run_args(args: &CollectArgs, context: &Context) -> anyhow::Result<(Location, Collected)> {
    let location = home::target(&args.output, args.format.as_deref())?;
    let collected = run(&Collection::of(args, &location, context.threads)?, context)?;
    Ok((location, collected))
}

impl<'a> Collection<'a> {
    /// Returns the collection of a command line.
    fn of(args: &'a CollectArgs, location: &'a Location, threads: usize) -> Result<Self> {
        let Some(env) = &args.env else {
            return Err(Error::config("ENV", "no environment is given", "name one; `swm envs` lists them"));
        };
        // A dataset may have been begun with a codec that has no effect, and is continued with the same settings.
        let continues = args.resume && matches!(location, Location::Path(path) if path.exists());
        if !continues {
            args.codec.check_format(location, args.format.as_deref())?;
        }
        Ok(Self {
            env: crate::env(env, &Origin::User)?,
            location,
            format: args.format.as_deref(),
            shard: args.shard,
            world: WorldConfig {
                envs: args.envs,
                image: (!args.no_pixels).then_some(args.image.unwrap_or(DEFAULT_IMAGE)),
                views: args.views.iter().map(|view| CameraView::parse(view)).collect::<Result<_>>()?,
                max_episode_steps: args.max_steps,
                threads,
            },
            config: CollectConfig {
                episodes: args.episodes(),
                seed: args.seed.unwrap_or(0),
                variation: args.variation.request()?,
                policy: args.policy()?,
                action_noise: args.action_noise.unwrap_or(0.0),
                strict_finite: args.strict_finite,
                ..CollectConfig::default()
            },
            mode: match (args.resume, args.overwrite) {
                (true, _) => WriteMode::Append,
                (_, true) => WriteMode::Overwrite,
                _ => WriteMode::Create,
            },
            codec: args.codec.codec()?,
            wrappers: args.wrappers.clone(),
            mix_renderers: args.mix_renderers,
        })
    }
}

/// Checks the options of a command line against each other, the environment and the policies, and writes nothing. Returns
/// the columns of the dataset.
///
/// # Errors
/// As [`run_args`], before the first episode.
pub fn check(args: &CollectArgs) -> Result<Schema> {
    let location = home::target(&args.output, args.format.as_deref())?;
    let mut collection = Collection::of(args, &location, 1)?;
    limits::ENVS.check(args.envs)?;
    collection.world.envs = 1;
    let (mut world, ..) = collection.prepare()?;
    // Environments check camera views when they render.
    world.reset(args.seed.unwrap_or(0), &collection.config.variation)?;
    world.collect_schema(&collection.config)
}

/// Returns the manifest of the dataset that a command line collects. If a policy cannot be loaded, the manifest has no hashes
/// of weights, and the error is returned beside it. Writes nothing.
///
/// # Errors
/// As [`check`], but for the policies.
pub fn manifest(args: &CollectArgs) -> Result<(Manifest, Option<Error>)> {
    let location = home::target(&args.output, args.format.as_deref())?;
    let mut collection = Collection::of(args, &location, 1)?;
    collection.world.envs = 1;
    let world = collection.make_world()?;
    let (weights, problem) = match policy_of_choice(&collection.env.entry, &collection.config.policy, &world) {
        Ok((_, weights)) => (weights, None),
        Err(error) => (BTreeMap::new(), Some(error)),
    };
    Ok((collection.manifest(&world, weights)?, problem))
}

/// Collects, and shows progress.
pub fn run(collection: &Collection<'_>, context: &Context) -> Result<Collected> {
    let Collection { location, config, .. } = collection;
    // Invalid options fail before an older dataset is replaced.
    let (mut world, mut policy, weights) = collection.prepare()?;
    swm_data::recover(location)?;
    let mut manifest = collection.manifest(&world, weights)?;
    let Existing { continues, not_finite } = match (collection.shard, collection.mode) {
        (None, mode) => collect_target::check(location, mode, &manifest, collection.mix_renderers, EXISTS)?,
        (Some(shard), WriteMode::Append) => {
            Existing { not_finite: collect_target::not_finite_of_shard(location, shard)?, ..Existing::default() }
        }
        (Some(_), _) => Existing::default(),
    };
    manifest.not_finite = not_finite;
    let writer = collection.writer(&world.collect_schema(config)?, collection.mode, manifest.clone(), continues)?;
    let episodes = collection.shard.map_or(0..config.episodes, |shard| shard.episodes(config.episodes));
    let config = &CollectConfig { episodes: episodes.len(), first: episodes.start, ..config.clone() };
    let start = Instant::now();
    let collected = world.collect(&mut *policy, writer, config, &mut progress::control(context));
    if let Some(warning) = collect_target::describe_not_finite(world.not_finite()) {
        eprint(&format!("warning: {warning}\n"));
        collect_target::add_not_finite(&mut manifest, world.not_finite());
        let writer = collection.writer(&world.collect_schema(config)?, WriteMode::Append, manifest, None)?;
        if collected.is_ok() { writer.finish()? } else { writer.pause()? }
    }
    let collected = collected?;
    let message = format!(
        "{} episodes in {location} ({} new, {} steps, {})",
        collected.episodes,
        collected.added,
        collected.steps,
        progress::steps_per_second(collected.steps as f64, start.elapsed())
    );
    progress::print_summary("collect", &message);
    Ok(collected)
}

/// The world, the policy and the hashes of the policies' weights.
type Prepared = (World, Box<dyn Policy>, BTreeMap<String, String>);

impl Collection<'_> {
    /// Checks the settings, and returns the world, the policy and the hashes of the policies' weights.
    fn prepare(&self) -> Result<Prepared> {
        let world = self.make_world()?;
        let (policy, weights) = policy_of_choice(&self.env.entry, &self.config.policy, &world)?;
        Ok((world, policy, weights))
    }

    /// Checks the settings but the policies, and returns the world.
    fn make_world(&self) -> Result<World> {
        let Collection { env, config, .. } = self;
        limits::EPISODES.check(config.episodes)?;
        limits::SHARDS.check(self.shard.map_or(0, |shard| shard.count))?;
        let (stack, goal) = self.wrappers.stack()?;
        let world = World::of(|| Ok(stack.wrap(env.env()?, goal)), self.world.clone())?;
        world.spec().variation_space.resolve(&config.variation, Key::new(config.seed))?;
        Ok(world)
    }

    /// Returns the manifest of the dataset; `hashes` are those of the policies' weights.
    fn manifest(&self, world: &World, hashes: BTreeMap<String, String>) -> Result<Manifest> {
        let mut manifest = Manifest { hashes, ..world.collect_manifest(&self.config) };
        manifest.config["codec"] = json!(self.codec);
        if !self.wrappers.wrappers.is_empty() {
            manifest.config["wrappers"] = json!(self.wrappers.choices(&Origin::User)?);
            manifest.config["wrap_goal"] = json!(self.wrappers.wrap_goal);
        }
        Ok(manifest)
    }

    fn writer(
        &self,
        schema: &Schema,
        mode: WriteMode,
        manifest: Manifest,
        continues: Option<Continued>,
    ) -> Result<Box<dyn Writer>> {
        let (codec, manifest) = (self.codec, Some(manifest));
        let options = WriteOptions { mode, codec, manifest, exclusive: true, continues, ..WriteOptions::default() };
        match (self.shard, self.format) {
            (Some(shard), _) => create_shard(self.location, schema, options, shard),
            (None, Some(format)) => FORMATS.get(format)?.create(self.location, schema, options),
            (None, None) => swm_data::create(self.location.clone(), schema, options),
        }
    }
}
