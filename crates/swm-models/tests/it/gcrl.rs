//! Goal-conditioned models learn from episodes of a moving dot and act; probes read the position of the dot.

use crate::dots::{Dots, SIDE, draw};
use std::path::Path;
use std::sync::Arc;
use swm_core::run::Control;
use swm_core::{Batch, ColumnSpec, DType, EnvSpec, Error, Key, Policy as _, Result, Schema, Space, VariationSpace};
use swm_models::feed_forward::FeedForwardPolicy;
use swm_models::gcrl::{Actor, Gcbc, Gciql, Gcivl, GcrlConfig, GoalConditioned};
use swm_models::nn::keypoints::FilterConfig;
use swm_models::nn::{BackboneConfig, ConvConfig, Init, KeypointsConfig, parameters};
use swm_models::pixels::ImageNormalization;
use swm_models::probe::{self, AnglePart, ImageEncoder, ReconstructionConfig, StateConfig};
use swm_models::train::DatasetInfo;
use swm_models::{Checkpoint, TrainConfig, TrainOptions, TrainSummary, Trainable, train};
use swm_plan::ActionScale;

const SMALL: &[&str] = &[
    "model.image=16",
    "model.encoder.pyramid.stages=[{ patch = 4, channels = 16 }, { patch = 2, channels = 16 }]",
    "model.encoder.pyramid.hidden=32",
    "model.encoder.pyramid.dim=16",
    "model.head.dim_head=8",
    "model.head.mlp=32",
    "data.frameskip=2",
    "data.batch_size=32",
    "schedule.steps=12",
    "schedule.warmup=2",
    "log_every=4",
];

pub fn config<M: GoalConditioned<Config = GcrlConfig>>(overrides: &[&str]) -> TrainConfig<M> {
    let overrides = crate::overridden(SMALL, overrides);
    TrainConfig::load("tiny", &overrides).expect("loading the configuration")
}

fn run<M: Trainable>(config: &TrainConfig<M>, out: &Path, options: &TrainOptions) -> Result<TrainSummary> {
    train(config, Arc::new(Dots::new(20, 0)), out, options, &mut Control::new())
}

fn trained<M: Trainable>(config: &TrainConfig<M>, out: &Path) -> Checkpoint<M> {
    run(config, out, &crate::options()).expect("training the model");
    Checkpoint::load(out, &crate::device()).expect("loading the checkpoint")
}

/// The specification of an environment with a dot; the tests do not step the environment.
fn spec(action_space: Space) -> EnvSpec {
    EnvSpec {
        id: "test/Dots-v0".to_owned(),
        action_space,
        columns: vec![],
        observation_space: vec![],
        variation_space: VariationSpace::new(vec![], &[]),
        max_episode_steps: 10,
        cameras: vec![],
        angles: vec![],
    }
}

fn box_actions() -> Space {
    Space::uniform_box([2], DType::Float32, -1.0, 1.0)
}

/// Infos with one row per entry of `positions`: the positions of the dot in the observation and in the goal image.
fn infos(positions: &[([f32; 2], [f32; 2])]) -> Batch {
    let schema = Schema::new([ColumnSpec::image("pixels", SIDE, SIDE), ColumnSpec::image("goal", SIDE, SIDE)]);
    let mut infos = Batch::zeros(&schema.expect("creating the schema"), positions.len());
    for (env, &(at, goal)) in positions.iter().enumerate() {
        let mut row = infos.row_mut(env);
        draw(at, row.at::<u8>(0));
        draw(goal, row.at::<u8>(1));
    }
    infos
}

fn actions(envs: usize) -> Batch {
    Batch::zeros(&Schema::new([ColumnSpec::new("action", DType::Float32, [2])]).expect("creating the schema"), envs)
}

#[test]
fn presets_have_the_steps_and_frozen_encoder_of_their_family() {
    fn check<M: GoalConditioned<Config = GcrlConfig>>() {
        for preset in M::PRESETS {
            let config = TrainConfig::<M>::load(preset.id, &[]).expect(preset.id);
            let frames = config.data.num_steps - config.model.history;
            assert_eq!(frames, usize::from(M::FAMILY != "gcbc"), "{} {}", M::FAMILY, preset.id);
            assert_eq!(config.model.frozen, preset.id == "paper");
        }
    }
    check::<Gcbc>();
    check::<Gcivl>();
    check::<Gciql>();
}

#[test]
fn results_do_not_depend_on_threads() {
    fn check<M: GoalConditioned<Config = GcrlConfig>>(overrides: &[&str]) {
        let folder = tempfile::tempdir().expect("creating a temporary folder");
        let config = config::<M>(overrides);
        let weights = [("one", 1), ("three", 3)].map(|(name, threads)| {
            let out = folder.path().join(name);
            run(&config, &out, &TrainOptions { threads, ..crate::options() }).expect("training the model");
            std::fs::read(out.join("checkpoint/weights.safetensors")).expect("reading the weights")
        });
        assert_eq!(weights[0], weights[1], "{}", M::FAMILY);
    }
    check::<Gcbc>(&["model.history=2", "data.num_steps=2", "model.head.dropout=0.1"]);
    check::<Gciql>(&["model.history=2", "data.num_steps=3", "model.head.dropout=0.1"]);
}

#[test]
fn cells_of_a_feature_map_are_the_patches_of_a_convolutional_encoder() {
    fn check_conv<M: GoalConditioned<Config = GcrlConfig>>() {
        let folder = tempfile::tempdir().expect("creating a temporary folder");
        let mut config = config::<M>(&["schedule.steps=3"]);
        config.model.encoder = BackboneConfig::Conv(ConvConfig { channels: vec![4, 6, 8], hidden: 0, dim: 5 });
        let checkpoint = trained(&config, folder.path());
        let weights = parameters::values(&checkpoint.model);
        let running = &weights["encoder.stages.2.norm.running_mean"].values;
        assert!(running.len() == 8 && running.iter().all(|mean| mean.abs() > 0.0), "{running:?}");
        // An image of 16 pixels gives a map of 2 x 2 cells.
        assert_eq!(M::actor(&checkpoint).latent_dim(), 4 * 8);
    }
    check_conv::<Gcbc>();
    check_conv::<Gciql>();
}

#[test]
fn goal_conditioned_models_learn_on_keypoints_of_frames_that_are_encoded_once() {
    fn check_keypoints<M: GoalConditioned<Config = GcrlConfig>>() {
        let folder = tempfile::tempdir().expect("creating a temporary folder");
        let mut config = config::<M>(&["schedule.steps=40", "log_every=10"]);
        let filters = vec![FilterConfig { kernel: 5, stride: 2, channels: 8 }];
        config.model.encoder = BackboneConfig::Keypoints(KeypointsConfig {
            filters,
            sharpness: 2.0,
            colours: vec![[1.0; 3], [-1.0; 3]],
            hidden: vec![16],
            dim: 12,
            find_colours: 0,
            seed: 0,
        });
        let checkpoint = trained(&config, folder.path());
        let running = &parameters::values(&checkpoint.model)["encoder.norm.running_mean"].values;
        assert!(running.len() == 24 + 2 * 10 && running.iter().any(|mean| mean.abs() > 0.0), "{running:?}");
        assert_eq!(M::actor(&checkpoint).latent_dim(), 12);
        let (first, last) = first_and_last(folder.path(), "loss");
        assert!(last < first, "{}: {last} after {first}", M::FAMILY);
    }
    check_keypoints::<Gcbc>();
    check_keypoints::<Gcivl>();
    check_keypoints::<Gciql>();
}

/// Returns a value in the first and the last line of a run's log.
fn first_and_last(run: &Path, name: &str) -> (f64, f64) {
    let lines = std::fs::read_to_string(run.join("train.jsonl")).expect("reading train.jsonl");
    let value = |line: &str| {
        serde_json::from_str::<serde_json::Value>(line).expect("parsing the JSON")[name]
            .as_f64()
            .expect("a value in the log")
    };
    (value(lines.lines().next().expect("the log has a line")), value(lines.lines().last().expect("the log has a line")))
}

#[test]
fn behaviour_cloning_reduces_the_loss() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let overrides = ["schedule.steps=240", "log_every=40", "model.history=2", "data.num_steps=2"];
    trained(&config::<Gcbc>(&overrides), folder.path());
    let (first, last) = first_and_last(folder.path(), "loss");
    assert!(last < 0.95 * first, "{first} to {last}");
}

#[test]
fn training_lowers_the_mean_value() {
    fn check<M: GoalConditioned<Config = GcrlConfig>>() {
        let folder = tempfile::tempdir().expect("creating a temporary folder");
        let overrides = ["schedule.steps=240", "log_every=20", "loss.target=0.9"];
        trained(&config::<M>(&overrides), folder.path());
        let (first, last) = first_and_last(folder.path(), "value");
        // Every step before the goal has the reward -1, so a value approximates minus the number of steps to the goal.
        assert!(last < first - 0.3 && last > -20.0, "{}: {first} to {last}", M::FAMILY);
    }
    check::<Gcivl>();
    check::<Gciql>();
}

#[test]
fn target_networks_lag_and_frozen_encoders_do_not_change() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let config = config::<Gcivl>(&["loss.target=0.5"]);
    let dataset_info = DatasetInfo { action: ActionScale::identity(2), columns: Default::default(), env: None };
    let init = Init::new(Key::new(config.seed).with("init"), &crate::device());
    let first = Gcivl::new(&config, &dataset_info, &init).expect("creating the model");
    let last = trained(&config, folder.path()).model;
    let (first, last) = (parameters::values(&first), parameters::values(&last));
    let name = "out_proj.weight";
    let (student, teacher) =
        (&last[&format!("value_predictor.student.{name}")], &last[&format!("value_predictor.teacher.{name}")]);
    let initial = &first[&format!("value_predictor.student.{name}")];
    let distance = |a: &parameters::HostTensor, b: &parameters::HostTensor| {
        a.values.iter().zip(&b.values).map(|(a, b)| (a - b).abs()).sum::<f32>()
    };
    let lag = distance(student, teacher);
    assert!(lag > 0.0 && lag < distance(student, initial), "the target network follows the trained network with a lag");

    // A second model uses the trained encoder and freezes it.
    let weights = folder.path().join("checkpoint/weights.safetensors");
    let overrides = [format!("model.weights={}", weights.display()), "model.frozen=true".to_owned()];
    let overrides: Vec<&str> = overrides.iter().map(String::as_str).collect();
    let second = trained(&self::config::<Gcbc>(&overrides), &folder.path().join("frozen")).model;
    let second = parameters::values(&second);
    let encoders: Vec<_> = second.iter().filter(|(name, _)| name.starts_with("encoder.")).collect();
    assert!(!encoders.is_empty() && encoders.iter().all(|(name, tensor)| &last[*name] == *tensor));
    let mut untrained = config.clone();
    untrained.model.frozen = true;
    let message = untrained.check().expect_err("frozen without weights").to_string();
    assert!(message.contains("model.weights"), "{message}");
}

#[test]
fn policy_acts_in_chunks_within_bounds_independent_of_other_environments() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let checkpoint = trained(&config::<Gcbc>(&["model.history=2", "data.num_steps=2"]), folder.path());
    let policy = |slots: usize| -> FeedForwardPolicy<Actor> {
        Gcbc::actor(&checkpoint).policy(&spec(box_actions()), slots).expect("creating the policy")
    };
    let scene = ([4.0, 5.0], [11.0, 9.0]);
    // One policy acts for this environment only. The other policy also acts for an environment that begins later.
    let observed = |step: usize| ([4.0 + step as f32, 5.0], scene.1);
    let (mut alone, mut together) = (policy(1), policy(2));
    alone.begin(0, Key::new(0));
    together.begin(1, Key::new(0));
    let mut taken: Vec<Vec<f32>> = vec![];
    for step in 0..5 {
        let (mut one, mut two) = (actions(1), actions(2));
        alone.act(&infos(&[observed(step)]), &[true], &mut one).expect("choosing an action");
        together
            .act(&infos(&[([9.0, 9.0], [2.0, 2.0]), observed(step)]), &[step > 1, true], &mut two)
            .expect("choosing an action");
        let action = one.row(0).at::<f32>(0).to_vec();
        assert_eq!(action, two.row(1).at::<f32>(0));
        assert!(action.iter().all(|v| (-1.0..=1.0).contains(v)), "{action:?}");
        taken.push(action);
    }
    // With a frameskip of 2, the policy makes a decision at every second step.
    assert_eq!(alone.take_latencies().len(), 3);
    assert_ne!(taken[0], taken[2], "actions do not depend on the image");
}

#[test]
fn invalid_settings_data_and_environments_are_refused() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let message = |overrides: &[&str]| {
        let overrides = crate::overridden(SMALL, overrides);
        TrainConfig::<Gcivl>::load("tiny", &overrides).expect_err("loading must fail").to_string()
    };
    assert!(message(&["data.num_steps=1"]).contains("model.history"), "{}", message(&["data.num_steps=1"]));
    assert!(message(&["model.head.depth=2"]).contains("attends to the goal"));
    assert!(message(&["loss.expectile=1.5"]).contains("loss.expectile"));
    assert!(message(&["loss.goals.random=0.9"]).contains("add up to 1"));
    assert!(message(&["model.image=20"]).contains("patches"), "{}", message(&["model.image=20"]));

    // The images of the dataset have another size than the images of the model.
    let mut large = config::<Gcbc>(&[]);
    large.model.image = 32;
    let error =
        run(&large, &folder.path().join("large"), &crate::options()).expect_err("training must fail").to_string();
    assert!(error.contains("[16, 16, 3]") && error.contains("model.image"), "{error}");

    let checkpoint = trained(&config::<Gcbc>(&[]), &folder.path().join("run"));
    let discrete = Gcbc::actor(&checkpoint).policy(&spec(Space::Discrete { n: 3, start: 0 }), 1);
    let error = discrete.err().expect("a space of discrete actions must be an error").to_string();
    assert!(error.contains("2 means"), "{error}");
    let mut policy = Gcbc::actor(&checkpoint).policy(&spec(box_actions()), 1).expect("creating the policy");
    policy.begin(0, Key::new(0));
    let without_goal =
        Batch::zeros(&Schema::new([ColumnSpec::image("pixels", SIDE, SIDE)]).expect("creating the schema"), 1);
    let error = policy.act(&without_goal, &[true], &mut actions(1)).expect_err("infos without a goal").to_string();
    assert!(error.contains("'goal'"), "{error}");
    // The checkpoint belongs to another family.
    let error = Checkpoint::<Gciql>::load(&folder.path().join("run"), &crate::device())
        .expect_err("another family")
        .to_string();
    assert!(error.contains("gcbc") && error.contains("gciql"), "{error}");
}

/// An encoder whose latents are the sums of the pixels along rows and columns, which determine the position of the dot.
struct Profiles;

impl ImageEncoder for Profiles {
    fn image_size(&self) -> usize {
        SIDE
    }

    fn latent_dim(&self) -> usize {
        2 * SIDE
    }

    fn encode(&self, rgb: &[u8]) -> Result<Vec<f32>> {
        let one = |rgb: &[u8]| {
            let mut sums = vec![0.0; 2 * SIDE];
            for (i, pixel) in rgb.chunks(3).enumerate() {
                sums[i % SIDE] += f32::from(pixel[0]);
                sums[SIDE + i / SIDE] += f32::from(pixel[0]);
            }
            sums
        };
        Ok(rgb.chunks(SIDE * SIDE * 3).flat_map(one).collect())
    }
}

#[test]
fn an_encoder_that_is_trained_with_labels_reads_the_position() {
    let data = Dots::new(40, 1);
    let mut settings = StateConfig::new(vec!["position".to_owned()]);
    (settings.fit.steps, settings.fit.batch_size) = (200, 32);
    let sizes = BackboneConfig::Conv(ConvConfig { channels: vec![8, 16], hidden: 0, dim: 16 });
    let images = ImageNormalization { side: SIDE, mean: [0.5; 3], std: [0.5; 3] };
    let train = |control: &mut Control| probe::train_encoder(&sizes, &images, &data, &settings, control);
    let report = train(&mut Control::new()).expect("training the encoder");
    assert!(report.scores.iter().all(|score| score.r2.expect("a score of a moving dot") > 0.9), "{report:?}");
    let mut steps = 0;
    let mut stop = Control::new().with_poll(|| {
        steps += 1;
        if steps < 3 { Ok(()) } else { Err(Error::Interrupted) }
    });
    assert!(matches!(train(&mut stop), Err(Error::Interrupted)));
}

#[test]
fn probes_read_the_position_and_reconstruct_the_image() {
    let data = Dots::new(40, 1);
    let mut settings = StateConfig::new(vec!["position".to_owned()]);
    settings.fit.steps = 300;
    let report = probe::read_state(&Profiles, &data, &settings, &mut Control::new()).expect("fitting the probe");
    assert_eq!((report.latent, report.linear.len(), report.network.len()), (2 * SIDE, 2, 2));
    for score in report.linear.iter().chain(&report.network) {
        let r2 = score.r2.expect("a score of a moving dot");
        assert!(r2 > 0.95, "{score:?}");
        assert!((r2 - (1.0 - (score.rmse / score.spread).powi(2))).abs() < 1e-9);
    }
    assert_eq!(
        probe::read_state(&Profiles, &data, &settings, &mut Control::new()).expect("fitting the probe"),
        report,
        "a second fit gives another report"
    );
    // Here the baseline is what the latents contain. The angle is the sine and the cosine of the first coordinate.
    let with_baseline = StateConfig {
        angles: vec![("position".to_owned(), 0)],
        baseline: vec!["position".to_owned()],
        ..settings.clone()
    };
    let report = probe::read_state(&Profiles, &data, &with_baseline, &mut Control::new()).expect("fitting the probe");
    let parts: Vec<_> = report.linear.iter().map(|score| (score.index, score.part)).collect();
    assert_eq!(parts, [(0, Some(AnglePart::Sin)), (0, Some(AnglePart::Cos)), (1, None)]);
    assert!(report.linear.iter().all(|score| score.r2.expect("a score of a moving dot") > 0.8), "{report:?}");
    let baseline = report.baseline.expect("a baseline was requested");
    assert!(baseline.network[2].r2.expect("a score of a moving dot") > 0.95, "{baseline:?}");
    assert!(baseline.latent_variance.expect("the latents vary") > 0.3, "{baseline:?}");
    // Actions determine neither the position nor the latents.
    let of_actions = StateConfig { baseline: vec!["action".to_owned()], ..settings.clone() };
    let report = probe::read_state(&Profiles, &data, &of_actions, &mut Control::new()).expect("fitting the probe");
    let baseline = report.baseline.expect("a baseline was requested");
    assert!(baseline.network[1].r2.expect("a score of a moving dot") < 0.2, "{baseline:?}");
    assert!(baseline.latent_variance.expect("the latents vary") < 0.2, "{baseline:?}");
    // Images do not determine the actions. The probe skips the last row of an episode, which has no action.
    let actions = StateConfig { columns: vec!["action".to_owned()], ..settings };
    let report = probe::read_state(&Profiles, &data, &actions, &mut Control::new()).expect("fitting the probe");
    assert!(report.linear.iter().all(|score| score.r2.expect("a score of actions that differ") < 0.1), "{report:?}");

    let mut settings = ReconstructionConfig { channels: vec![16, 8], shown: 6, ..ReconstructionConfig::default() };
    (settings.fit.steps, settings.fit.lr) = (1000, 5e-3);
    let probe::Reconstruction { report, sheet, .. } =
        probe::reconstruct_images(&Profiles, &data, &settings, &mut Control::new()).expect("fitting the decoder");
    assert!(report.explained > 0.2 && report.rmse < report.rmse_of_mean, "{report:?}");
    let cell = SIDE * 8 + 2;
    assert_eq!((sheet.width, sheet.height), (6 * cell + 2, 2 * cell + 2));

    let error = |columns: &[&str]| {
        let columns = columns.iter().map(|&name| name.to_owned()).collect();
        probe::read_state(&Profiles, &data, &StateConfig::new(columns), &mut Control::new())
            .expect_err("the call must fail")
            .to_string()
    };
    assert!(error(&["positoin"]).contains("did you mean position"), "{}", error(&["positoin"]));
    assert!(error(&["pixels"]).contains("holds images"));
    assert!(error(&[]).contains("columns"));
}
