//! Training gives the same bytes with any number of threads, interrupted or not.

use crate::dots::Dots;
use burn::tensor::{Tensor, TensorData};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use swm_core::files::Lock;
use swm_core::run::{Control, Event};
use swm_core::{DType, Key, Result};
use swm_models::lewm::{DecoderConfig, EncoderConfig, Lewm};
use swm_models::nn::keypoints::FilterConfig;
use swm_models::nn::{ConvConfig, Init, KeypointsConfig, parameters};
use swm_models::train::DatasetInfo;
use swm_models::{Checkpoint, TrainConfig, TrainOptions, TrainSummary, run_folder, train};

/// A model of a few thousand parameters.
pub fn config(overrides: &[&str]) -> TrainConfig<Lewm> {
    let small = [
        "model.image=16",
        "model.latent=4",
        "model.projector=16",
        "model.encoder.pyramid.stages=[{ patch = 4, channels = 8 }, { patch = 2, channels = 8 }]",
        "model.encoder.pyramid.hidden=16",
        "model.encoder.pyramid.dim=16",
        "model.predictor.dim=16",
        "model.predictor.history=2",
        "model.predictor.mlp=32",
        "model.predictor.dim_head=8",
        "model.predictor.dropout=0.1",
        "data.frameskip=2",
        "data.num_steps=4",
        "data.batch_size=16",
        "loss.directions=16",
        "schedule.steps=10",
        "schedule.warmup=2",
        "log_every=5",
    ];
    let overrides = crate::overridden(&small, overrides);
    TrainConfig::load("tiny", &overrides).expect("loading the configuration")
}

/// A control that interrupts the run after the step `stop_at`.
pub fn stop_after(stop_at: usize) -> Control<'static> {
    let flag = Arc::new(AtomicBool::new(false));
    Control::new().with_interrupt(Arc::clone(&flag)).with_events(move |event| {
        if let Event::Progress(progress) = event {
            flag.store(progress.done == stop_at, Ordering::Relaxed);
        }
    })
}

pub fn run(config: &TrainConfig<Lewm>, out: &Path, options: &TrainOptions, stop_at: usize) -> Result<TrainSummary> {
    train(config, Arc::new(Dots::new(6, 0)), out, options, &mut stop_after(stop_at))
}

fn files(run: &Path) -> Vec<Vec<u8>> {
    ["config.json", "weights.safetensors", "optimizer.safetensors", "state.json", "manifest.json"]
        .map(|name| std::fs::read(run.join("checkpoint").join(name)).expect(name))
        .to_vec()
}

#[test]
fn float64_actions_train_as_their_float32_values() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let trained = |name: &str, dots: Dots| {
        train(&config(&[]), Arc::new(dots), &folder.path().join(name), &crate::options(), &mut Control::new())
    };
    let single = trained("single", Dots::new(6, 0)).expect("training on float32 actions");
    let double = Dots::new(6, 0).stored_as(1, DType::Float64, f64::from);
    assert_eq!(trained("double", double).expect("training on float64 actions").weights, single.weights);
    let far = Dots::new(6, 0).stored_as(1, DType::Float64, |value| f64::from(value) + 1e9);
    for bounded in [false, true] {
        let error = DatasetInfo::for_training(&far, &[], bounded).expect_err("single precision").to_string();
        assert!(error.contains("column 'action', element 0") && error.contains("offset"), "{error}");
    }
    let discrete = Dots::new(6, 0).stored_as(1, DType::U8, |value| f64::from(value.abs()));
    let error = trained("discrete", discrete).expect_err("discrete actions").to_string();
    assert!(error.contains("uint8 actions") && error.contains("choose a dataset"), "{error}");
}

#[test]
fn rewards_and_flags_in_bytes_are_not_in_the_statistics() {
    for (name, dtype, has_statistics) in [
        ("terminated", DType::U8, false),
        ("reward", DType::U8, false),
        ("reward", DType::Float32, true),
        ("state", DType::U8, true),
    ] {
        let dots = Dots::new(6, 0).stored_as(2, dtype, |value| f64::from(value.round())).renamed(2, name);
        let info = DatasetInfo::for_training(&dots, &[name.to_owned()], false).expect("the statistics");
        assert_eq!(info.columns.contains_key(name), has_statistics, "{name} of {}", dtype.name());
    }
}

#[test]
fn resuming_a_run_that_ended_early_changes_nothing() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    // At this learning rate no validation improves on the first.
    let early =
        ["validation.every=1", "validation.batches=1", "validation.patience=2", "optim.lr=1e-30", "save_every=2"];
    let config = config(&[&early[..], &["data.hold_out=true"]].concat());
    let options = crate::options();
    let train = |options: &TrainOptions| {
        train(&config, Arc::new(Dots::new(40, 0)), folder.path(), options, &mut stop_after(0))
            .expect("training the model")
    };
    let first = train(&options);
    assert!(first.stopped_early && first.steps < 10, "{} steps", first.steps);
    let before = files(folder.path());
    let again = train(&TrainOptions { resume: true, ..options });
    assert!((again.steps, again.stopped_early) == (first.steps, true));
    assert_eq!(files(folder.path()), before);
}

#[test]
fn run_whose_best_weights_are_missing_is_not_resumed() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let config = config(&["validation.every=1", "validation.batches=1", "data.hold_out=true"]);
    let train = |options: &TrainOptions, stop_at| {
        train(&config, Arc::new(Dots::new(40, 0)), folder.path(), options, &mut stop_after(stop_at))
    };
    train(&crate::options(), 2).expect("training the model");
    std::fs::rename(folder.path().join("best"), folder.path().join("moved")).expect("moving the best checkpoint");
    let resume = TrainOptions { resume: true, ..crate::options() };
    let error = train(&resume, 0).expect_err("it has no best weights").to_string();
    assert!(error.contains("the best weights of the run") && error.contains("are missing"), "{error}");
    std::fs::rename(folder.path().join("moved"), folder.path().join("best")).expect("moving it back");
    assert_eq!(train(&resume, 0).expect("continuing the run").steps, 10);
}

#[test]
fn resumed_run_gives_the_files_of_an_uninterrupted_run() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let (complete, resumed) = (folder.path().join("complete"), folder.path().join("resumed"));
    // 6 episodes of 17 clips give 6 batches of 16 clips. The first epoch therefore ends after step 6, which the resumed
    // run makes.
    let config = config(&[]);
    let options = crate::options();
    let summary = run(&config, &complete, &options, 0).expect("training the model");
    assert!((summary.steps, summary.interrupted) == (10, false));
    // Between two lines of the log.
    let first = run(&config, &resumed, &options, 4).expect("training the model");
    assert!((first.steps, first.interrupted) == (4, true));
    let refused = run(&config, &resumed, &options, 0).expect_err("the folder holds a run").to_string();
    assert!(refused.contains("resume"), "{refused}");
    let resume = TrainOptions { resume: true, ..options };
    let second = run(&config, &resumed, &resume, 0).expect("training the model");
    assert_eq!((second.steps, &second.weights), (10, &summary.weights));
    assert_eq!(files(&complete), files(&resumed));
    let lines = crate::online::lines(&resumed);
    assert_eq!(lines, crate::online::lines(&complete), "each line averages the steps since the line before");
    let steps: Vec<_> = lines.iter().map(|line| line["step"].as_u64().expect("the step is an integer")).collect();
    assert_eq!(steps, [5, 10]);
}

#[test]
fn run_whose_data_break_keeps_the_steps_before() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let (complete, broken) = (folder.path().join("complete"), folder.path().join("broken"));
    let (config, options) = (config(&[]), crate::options());
    run(&config, &complete, &options, 0).expect("training the model");
    let reader = Arc::new(Dots::new(6, 0).breaking_after(90));
    let error = train(&config, reader, &broken, &options, &mut Control::new()).expect_err("broken data");
    assert!(error.to_string().contains("the disk is gone"), "{error}");
    let state = std::fs::read_to_string(broken.join("checkpoint/state.json")).expect("a checkpoint");
    let step = serde_json::from_str::<serde_json::Value>(&state).expect("JSON")["step"].as_u64();
    assert!(step.is_some_and(|step| (1..10).contains(&step)), "{state}");
    let resume = TrainOptions { resume: true, ..options };
    let again = run(&config, &broken, &resume, 0).expect("resuming");
    assert!((again.steps, again.interrupted) == (10, false));
    assert_eq!(files(&complete), files(&broken));
    // Before the first step there is nothing to keep.
    let (empty, reader) = (folder.path().join("empty"), Arc::new(Dots::new(6, 0).breaking_after(0)));
    train(&config, reader, &empty, &crate::options(), &mut Control::new()).expect_err("broken data");
    assert!(!Checkpoint::<Lewm>::exists(&empty));
}

#[test]
fn running_statistics_of_the_encoder_are_stored_and_resumed() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let (complete, resumed) = (folder.path().join("complete"), folder.path().join("resumed"));
    let (config, options) = (conv_config(), crate::options());
    run(&config, &complete, &options, 0).expect("training the model");
    run(&config, &resumed, &options, 5).expect("training the model");
    run(&config, &resumed, &TrainOptions { resume: true, ..options }, 0).expect("training the model");
    assert_eq!(files(&complete), files(&resumed));
    let checkpoint = Checkpoint::<Lewm>::load(&complete, &crate::device()).expect("loading the checkpoint");
    let weights = parameters::values(&checkpoint.model);
    for stage in 0..2 {
        let running = |name: &str| &weights[&format!("encoder.stages.{stage}.norm.{name}")].values;
        assert!(running("running_mean").iter().all(|mean| *mean != 0.0));
        assert!(running("running_var").iter().all(|variance| *variance != 1.0));
    }
}

#[test]
fn second_training_into_a_folder_is_refused() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let out = folder.path().join("run");
    let first = Lock::folder(&out).expect("locking the folder for another process");
    let error = run(&config(&[]), &out, &crate::options(), 0).expect_err("training into a locked folder");
    assert!(error.is_usage() && error.to_string().contains(&out.display().to_string()), "{error}");
    assert_eq!(out.read_dir().expect("listing the folder").count(), 0, "the second run writes nothing");
    drop(first);
    assert!(run(&config(&[]), &out, &crate::options(), 1).expect("training the model").interrupted);
}

/// A model with an encoder of overlapping convolutions.
fn conv_config() -> TrainConfig<Lewm> {
    let mut config = config(&["model.predictor.dropout=0"]);
    config.model.encoder = EncoderConfig::Conv(ConvConfig { channels: vec![6, 9], hidden: 0, dim: 10 });
    config
}

/// A model with an encoder of keypoints and colours, and a decoder of their features.
pub fn keypoints_config() -> TrainConfig<Lewm> {
    let mut config = config(&["model.predictor.dropout=0"]);
    let filters =
        vec![FilterConfig { kernel: 3, stride: 2, channels: 5 }, FilterConfig { kernel: 5, stride: 4, channels: 3 }];
    config.model.encoder = EncoderConfig::Keypoints(KeypointsConfig {
        filters,
        sharpness: 2.0,
        colours: vec![[1.0, 0.5, -1.0], [-1.0, 0.0, 0.5]],
        find_colours: 0,
        hidden: vec![12],
        dim: 10,
        seed: 0,
    });
    config.model.decoder = Some(DecoderConfig { hidden: 9, weight: 2.0 });
    config
}

#[test]
fn fixed_filters_are_not_trained_and_give_the_same_latents_from_frames_as_in_training() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let config = keypoints_config();
    let out = folder.path().join("run");
    let summary = run(&config, &out, &crate::options(), 0).expect("training the model");
    assert!(summary.metrics.iter().any(|(name, value)| name == "features" && *value > 0.0), "{:?}", summary.metrics);
    let model = Checkpoint::<Lewm>::load(&out, &crate::device()).expect("loading the checkpoint").model;
    let initial = Lewm::init(&config.model, 2 * 2, &Init::new(Key::new(config.seed).with("init"), &crate::device()));
    let (trained, initial) = (parameters::values(&model), parameters::values(&initial));
    for (name, value) in trained.iter().filter(|(name, _)| name.starts_with("encoder.") || name.starts_with("decoder."))
    {
        assert_eq!(*value == initial[name], name.contains("filters"), "{name}");
    }
    let images: Vec<f32> = (0..3 * 16 * 16 * 3).map(|i| (i * 37 % 101) as f32 / 50.0 - 1.0).collect();
    let kernels = model.encoder.fixed_part(16).expect("an encoder with fixed filters");
    let features = TensorData::new(kernels.features(&images), [3, 1, kernels.count()]);
    let latents = |data| model.encode(Tensor::<3>::from_data(data, &crate::device())).into_data();
    assert_eq!(latents(TensorData::new(images, [3, 16 * 16, 3])), latents(features));
}

#[test]
fn later_runs_find_the_features_of_fixed_filters_in_a_folder() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let mut config = keypoints_config();
    let run = |name: &str, feature_cache: Option<&Path>, config: &TrainConfig<Lewm>| {
        let options = TrainOptions { feature_cache: feature_cache.map(Path::to_owned), ..crate::options() };
        let (out, dots) = (folder.path().join(name), Arc::new(Dots::new(6, 0)));
        train(config, Arc::<Dots>::clone(&dots), &out, &options, &mut stop_after(0)).expect("training the model");
        (files(&out), dots.frames_read.load(Ordering::Relaxed))
    };
    let cache = folder.path().join("cache");
    let (in_memory, frames) = run("memory", None, &config);
    assert_eq!(frames, 6 * 24);
    assert_eq!(run("first", Some(&cache), &config), (in_memory.clone(), frames));
    assert_eq!(run("second", Some(&cache), &config), (in_memory, 0));
    // Another training has the same filters.
    config.seed = 1;
    assert_eq!(run("another seed", Some(&cache), &config).1, 0);
    if let EncoderConfig::Keypoints(keypoints) = &mut config.model.encoder {
        keypoints.seed = 1;
    }
    assert_eq!(run("other filters", Some(&cache), &config).1, frames);
    if let EncoderConfig::Keypoints(keypoints) = &mut config.model.encoder {
        keypoints.colours[0][0] = 0.75;
    }
    assert_eq!(run("other colours", Some(&cache), &config).1, frames);
}

#[test]
fn colours_are_found_in_the_training_data() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let mut config = keypoints_config();
    let EncoderConfig::Keypoints(keypoints) = &mut config.model.encoder else {
        unreachable!("an encoder of keypoints")
    };
    (keypoints.filters, keypoints.colours, keypoints.find_colours) = (vec![], vec![], 4);
    config.check().expect("colours that are to be found");
    let train_with = |name: &str, config: &TrainConfig<Lewm>, stop_at| {
        let out = folder.path().join(name);
        let options = TrainOptions { resume: out.exists(), ..crate::options() };
        run(config, &out, &options, stop_at).expect("training the model");
        (Checkpoint::<Lewm>::load(&out, &crate::device()).expect("loading the checkpoint").config, files(&out))
    };
    let (stored, whole) = train_with("whole", &config, 0);
    let EncoderConfig::Keypoints(found) = &stored.model.encoder else { unreachable!("an encoder of keypoints") };
    assert_eq!((found.find_colours, found.colours.len()), (4, 4));
    // The frames are grey, from black to white, in the units of normalised images.
    let (mean, std) = (config.model.pixel_mean, config.model.pixel_std);
    for colour in &found.colours {
        let grey = [0, 1, 2].map(|i| colour[i] * std[i] + mean[i]);
        assert!((grey[0] - grey[1]).abs() < 1e-5 && (grey[1] - grey[2]).abs() < 1e-5, "{grey:?}");
        assert!((-1e-6..=1.0).contains(&grey[0]), "{grey:?}");
    }
    train_with("parts", &config, 4);
    let (_, resumed) = train_with("parts", &config, 0);
    assert!(whole == resumed, "a resumed run finds other colours");
    // The stored configuration gives the same weights.
    assert!(train_with("again", &stored, 0).1[1] == whole[1], "the colours that were found give other weights");
    config.seed = 1;
    assert_eq!(train_with("seed", &config, 0).0.model.encoder, stored.model.encoder);
    let EncoderConfig::Keypoints(keypoints) = &mut config.model.encoder else {
        unreachable!("an encoder of keypoints")
    };
    keypoints.find_colours = 256;
    let error = run(&config, &folder.path().join("many"), &crate::options(), 0).expect_err("more colours than greys");
    assert!(error.is_usage() && error.to_string().contains("of 256 colours"), "{error}");

    let path = folder.path().join("whole/checkpoint/config.json");
    let mut changed: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).expect("a file")).expect("JSON");
    changed["config"]["model"]["encoder"]["keypoints"].as_object_mut().expect("an encoder").remove("colours");
    std::fs::write(&path, changed.to_string()).expect("a written file");
    let error = Checkpoint::<Lewm>::load(&folder.path().join("whole"), &crate::device()).expect_err("no colours");
    assert!(error.to_string().contains("no colours"), "{error}");
}

#[test]
fn decoder_without_fixed_filters_is_refused() {
    let mut config = conv_config();
    config.model.decoder = keypoints_config().model.decoder;
    let error = config.check().expect_err("checking a decoder of a trained encoder");
    assert!(error.is_usage() && error.to_string().contains("model.decoder"), "{error}");
    let mut config = keypoints_config();
    if let EncoderConfig::Keypoints(keypoints) = &mut config.model.encoder {
        keypoints.filters[1].kernel = 4;
    }
    let error = config.check().expect_err("checking filters without a centre");
    assert!(error.to_string().contains("choose an odd side"), "{error}");
    if let EncoderConfig::Keypoints(keypoints) = &mut config.model.encoder {
        keypoints.filters = vec![FilterConfig { kernel: 15, stride: 4, channels: 200_000 }];
    }
    let error = config.check().expect_err("checking filters that are too many").to_string();
    assert!(error.contains("the weights of model.encoder.keypoints.filters: 135000000; give at most"), "{error}");
    let colours = [
        (vec![[f32::NAN; 3]; 2], "give a finite value"),
        (vec![[0.0; 3], [255.0, 0.0, 0.0]], "not bytes"),
        (vec![[1.0; 3]], "give at least two"),
        (vec![[1.0; 3], [0.0; 3], [1.0; 3]], "twice, the second time at 2"),
        (vec![], "at least one size of filters, or colours"),
    ];
    for (colours, fix) in colours {
        if let EncoderConfig::Keypoints(keypoints) = &mut config.model.encoder {
            (keypoints.filters, keypoints.colours) = (vec![], colours);
        }
        let error = config.check().expect_err("checking an encoder without features").to_string();
        assert!(error.contains(fix), "{error}");
    }
}

#[test]
fn results_do_not_depend_on_threads() {
    threads_give_equal_files(&config(&[]));
    threads_give_equal_files(&conv_config());
    threads_give_equal_files(&keypoints_config());
}

fn threads_give_equal_files(config: &TrainConfig<Lewm>) {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let mut all = vec![];
    for (name, threads, loader_threads) in [("one", 1, 0), ("two", 2, 1), ("three", 3, 2)] {
        let options = TrainOptions { threads, loader_threads, ..crate::options() };
        run(config, &folder.path().join(name), &options, 0).expect("training the model");
        all.push(files(&folder.path().join(name)));
    }
    assert_eq!(all[0], all[1]);
    assert_eq!(all[0], all[2]);
    let mut other = config.clone();
    other.seed = 1;
    run(&other, &folder.path().join("other"), &crate::options(), 0).expect("training the model");
    assert_ne!(files(&folder.path().join("other"))[1], all[0][1]);
}

#[test]
fn training_reduces_the_loss() {
    let overrides = ["schedule.steps=300", "log_every=20", "model.predictor.dropout=0", "optim.lr=3e-3"];
    loss_is_reduced(&config(&overrides));
    loss_is_reduced(&TrainConfig { model: conv_config().model, ..config(&overrides) });
}

fn loss_is_reduced(config: &TrainConfig<Lewm>) {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    run(config, folder.path(), &crate::options(), 0).expect("training the model");
    let lines = std::fs::read_to_string(folder.path().join("train.jsonl")).expect("reading train.jsonl");
    let value = |line: &str, name: &str| {
        serde_json::from_str::<serde_json::Value>(line).expect("parsing the JSON")[name].as_f64().expect(name)
    };
    let (first, last) =
        (lines.lines().next().expect("the log has a line"), lines.lines().last().expect("the log has a line"));
    assert!(value(last, "loss") < 0.5 * value(first, "loss"), "{first}\n{last}");
    // Collapsed latents are predicted perfectly, but their SIGReg loss is about a tenth of the batch size.
    assert!(value(last, "sigreg") < 2.0, "{last}");
}

#[test]
fn non_finite_loss_stops_the_run() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let error = run(&config(&["optim.lr=1e30", "optim.clip=1e30"]), folder.path(), &crate::options(), 0);
    let message = error.expect_err("a loss that is not finite").to_string();
    assert!(message.contains("not finite") && message.contains("optim.lr"), "{message}");
}

#[test]
fn gradients_with_an_infinite_norm_stop_the_run() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let mut config = keypoints_config();
    config.model.decoder.as_mut().expect("a decoder").weight = 1e30;
    let error = run(&config, folder.path(), &crate::options(), 0).expect_err("a gradient that clipping makes 0");
    let message = error.to_string();
    assert!(message.contains("the norm of the gradient at training step 1 is not finite"), "{message}");
    assert!(message.contains("the weights of the loss") && !folder.path().join("checkpoint").exists(), "{message}");
}

#[test]
fn negative_weights_of_losses_are_refused() {
    for (given, part) in [("loss.weight=-1", "loss.weight: -1"), ("loss.temp_straight=-1", "loss.temp_straight: -1")] {
        let error = TrainConfig::<Lewm>::load("tiny", &crate::overridden(&[], &[given]))
            .expect_err("a negative weight")
            .to_string();
        assert!(error.contains(part) && error.contains("at least 0"), "{error}");
    }
}

#[test]
fn failed_batch_replaces_only_a_failed_batch() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let (diverging, batch) =
        (config(&["optim.lr=1e30", "optim.clip=1e30"]), folder.path().join("failed-batch.safetensors"));
    let message = || run(&diverging, folder.path(), &crate::options(), 0).expect_err("divergence").to_string();
    std::fs::write(&batch, "thesis").expect("writing a file of the user");
    let refused = message();
    assert!(refused.contains("could not be saved") && refused.contains("not written by this program"), "{refused}");
    assert_eq!(std::fs::read(&batch).expect("reading the file of the user"), b"thesis");
    run_folder::remove(folder.path()).expect("removing the run");
    assert!(batch.exists());
    std::fs::remove_file(&batch).expect("removing the file of the user");
    for _ in 0..2 {
        std::fs::create_dir_all(folder.path()).expect("creating the folder");
        let saved = message();
        assert!(saved.contains("the batch is in"), "{saved}");
    }
    run_folder::remove(folder.path()).expect("removing the run");
    assert!(!batch.exists());
}
