//! [`Trainable`] for goal-conditioned models, which connects [`super::step`] to the training loop.

use super::config::GcrlConfig;
use super::loss::{CloningLoss, ValueLoss};
use super::model::{Gcbc, Gciql, Gcivl};
use super::policy::Actor;
use super::step::{Clips, ENCODER, Relabelled};
use crate::checkpoint::Checkpoint;
use crate::nn::{BackboneConfig, DropoutRng, Init, Named};
use crate::pixels::{Frames, ImageNormalization};
use crate::train::{
    DatasetInfo, FixedPart, ParameterGroup, Preset, StepContext, StepOutput, TrainConfig, Trainable, shards,
};
use crate::{pixels, weights};
use burn::tensor::{Device, Tensor, TensorData};
use std::ops::Range;
use std::path::Path;
use swm_core::columns::{ACTION, PIXELS};
use swm_core::{Batch, Error, Result, Schema};
use swm_data::{ClipSpec, GoalMixture, GoalSpec, LoaderConfig};

/// Prefixes of the goals' columns in a batch: `goal_pixels`, `policy_goal_pixels`.
const GOAL: &str = "goal";
const POLICY_GOAL: &str = "policy_goal";

const TINY: &str = "64 px, a small trained convolutional encoder: minutes on two CPU cores";
const SMALL: &str = "64 px, overlapping convolutions, for small and rotated objects: for two CPU cores";
const KEYPOINTS: &str =
    "64 px, keypoints of fixed random filters, encoded once per frame: trains in minutes on two CPU cores";
const COLOURS: &str = "64 px, moments of six colours of the frames, for scenes of flat colours, encoded once per frame: minutes on two CPU cores";
const PAPER: &str = "224 px, frozen DINOv2-small, heads of 6 layers, history 3: the published size, for a GPU";

macro_rules! presets {
    ($family:literal) => {
        &[
            Preset { id: "tiny", summary: TINY, toml: include_str!(concat!("../../presets/", $family, "/tiny.toml")) },
            Preset {
                id: "small",
                summary: SMALL,
                toml: include_str!(concat!("../../presets/", $family, "/small.toml")),
            },
            Preset {
                id: "keypoints",
                summary: KEYPOINTS,
                toml: include_str!(concat!("../../presets/", $family, "/keypoints.toml")),
            },
            Preset {
                id: "colours",
                summary: COLOURS,
                toml: include_str!(concat!("../../presets/", $family, "/colours.toml")),
            },
            Preset {
                id: "paper",
                summary: PAPER,
                toml: include_str!(concat!("../../presets/", $family, "/paper.toml")),
            },
        ]
    };
}

/// A family of goal-conditioned models.
pub trait GoalConditioned: Trainable {
    /// Returns the encoder and the policy head of a checkpoint, which together compute actions.
    fn actor(checkpoint: &Checkpoint<Self>) -> Actor;
}

macro_rules! goal_conditioned {
    ($($model:ty),*) => {
        $(impl GoalConditioned for $model {
            fn actor(checkpoint: &Checkpoint<Self>) -> Actor {
                let model = &checkpoint.model;
                Actor {
                    encoder: model.encoder.clone(),
                    head: model.action_predictor.clone(),
                    config: model.config.clone(),
                    scale: checkpoint.dataset_info.action.clone(),
                }
            }
        })*
    };
}
goal_conditioned!(Gcbc, Gcivl, Gciql);

impl Trainable for Gcbc {
    const FAMILY: &'static str = "gcbc";
    const SUMMARY: &'static str =
        "goal-conditioned behavioural cloning: a policy that imitates actions that led to a goal";
    const PRESETS: &'static [Preset] = presets!("gcbc");
    type Config = GcrlConfig;
    type Loss = CloningLoss;

    fn check(config: &TrainConfig<Self>) -> Result<()> {
        config.model.check()?;
        config.model.check_no_metric(Self::FAMILY)?;
        check_frames(config.data.num_steps, config.model.history)?;
        goals(&config.loss.goals, GOAL, &config.model).check(&clip(config.data.num_steps, config.data.frameskip))
    }

    fn image_size(config: &GcrlConfig) -> Option<usize> {
        Some(config.image)
    }

    fn encoder_config(config: &mut GcrlConfig) -> Option<(&mut BackboneConfig, ImageNormalization)> {
        let images = config.pixels();
        Some((&mut config.encoder, images))
    }

    fn loader_config(config: &TrainConfig<Self>, schema: &Schema) -> Result<LoaderConfig> {
        pixels::check(config.model.image, schema, PIXELS)?;
        Ok(LoaderConfig {
            clip: clip(config.data.num_steps, config.data.frameskip),
            goals: vec![goals(&config.loss.goals, GOAL, &config.model)],
            ..LoaderConfig::default()
        })
    }

    fn new(config: &TrainConfig<Self>, dataset_info: &DatasetInfo, init: &Init) -> Result<Self> {
        Ok(Self::init(&config.model, config.data.frameskip * dataset_info.action.dim(), init))
    }

    fn with_pretrained_weights(mut self, config: &TrainConfig<Self>, cache: &Path) -> Result<Self> {
        let inputs = (&config.model.encoder, &config.model.pixels());
        self.encoder = weights::encoder::fill(self.encoder, inputs, &config.model.weights, cache)?;
        Ok(self)
    }

    fn step(&self, context: &StepContext<'_, Self>, batch: &Batch) -> Result<StepOutput> {
        let StepContext { config, dataset_info, key, device, training } = context;
        let reader = BatchReader::new(
            &config.model,
            dataset_info,
            (config.data.num_steps, config.data.frameskip),
            batch,
            device,
        )?;
        shards::mean(batch.rows(), config.shards, |range| {
            let mut rng = key.with("dropout").at(range.start as u64).rng();
            let mut noise = DropoutRng(training.then_some(&mut rng));
            Ok(self.losses(&reader.clips(range)?, &mut noise, *training))
        })
    }

    fn fixed_part(&self, config: &GcrlConfig) -> Option<FixedPart> {
        Some(FixedPart { kernels: self.encoder.fixed_part(config.image)?, images: config.pixels() })
    }

    fn after_step(mut self, _: &StepContext<'_, Self>, mut buffers: Named<Tensor<1>>) -> Self {
        self.encoder.track(ENCODER, &mut buffers);
        self
    }
}

/// The families whose value may be a metric.
pub(super) const METRIC_FAMILIES: &[&str] = &["gcivl"];

macro_rules! value_learner {
    ($model:ty, $family:literal, $summary:literal, [$($target:ident),*]) => {
        impl Trainable for $model {
            const FAMILY: &'static str = $family;
            const SUMMARY: &'static str = $summary;
            const PRESETS: &'static [Preset] = presets!($family);
            type Config = GcrlConfig;
            type Loss = ValueLoss;

            fn check(config: &TrainConfig<Self>) -> Result<()> {
                config.model.check()?;
                if !METRIC_FAMILIES.contains(&Self::FAMILY) {
                    config.model.check_no_metric(Self::FAMILY)?;
                }
                config.loss.check()?;
                check_frames(config.data.num_steps, config.model.history + 1)?;
                let clip = clip(config.data.num_steps, config.data.frameskip);
                goals(&config.loss.goals, GOAL, &config.model).check(&clip)?;
                goals(&config.loss.policy_goals, POLICY_GOAL, &config.model).check(&clip)
            }

            fn image_size(config: &GcrlConfig) -> Option<usize> {
                Some(config.image)
            }

            fn encoder_config(config: &mut GcrlConfig) -> Option<(&mut BackboneConfig, ImageNormalization)> {
                let images = config.pixels();
                Some((&mut config.encoder, images))
            }

            fn loader_config(config: &TrainConfig<Self>, schema: &Schema) -> Result<LoaderConfig> {
                pixels::check(config.model.image, schema, PIXELS)?;
                Ok(LoaderConfig {
                    clip: clip(config.data.num_steps, config.data.frameskip),
                    goals: vec![
                        goals(&config.loss.goals, GOAL, &config.model),
                        goals(&config.loss.policy_goals, POLICY_GOAL, &config.model),
                    ],
                    ..LoaderConfig::default()
                })
            }

            fn new(config: &TrainConfig<Self>, dataset_info: &DatasetInfo, init: &Init) -> Result<Self> {
                Ok(Self::init(&config.model, config.data.frameskip * dataset_info.action.dim(), init))
            }

            fn with_pretrained_weights(mut self, config: &TrainConfig<Self>, cache: &Path) -> Result<Self> {
                let inputs = (&config.model.encoder, &config.model.pixels());
                self.encoder = weights::encoder::fill(self.encoder, inputs, &config.model.weights, cache)?;
                Ok(self)
            }

            fn step(&self, context: &StepContext<'_, Self>, batch: &Batch) -> Result<StepOutput> {
                let StepContext { config, dataset_info, key, device, training } = context;
                let steps = (config.data.num_steps, config.data.frameskip);
                let reader = BatchReader::new(&config.model, dataset_info, steps, batch, device)?;
                shards::mean(batch.rows(), config.shards, |range| {
                    let mut rng = key.with("dropout").at(range.start as u64).rng();
                    let mut noise = DropoutRng(training.then_some(&mut rng));
                    let (clips, relabelled) = (reader.clips(range.clone())?, reader.relabelled(range)?);
                    Ok(self.losses(&clips, &relabelled, &config.loss, &mut noise, *training))
                })
            }

            fn fixed_part(&self, config: &GcrlConfig) -> Option<FixedPart> {
                Some(FixedPart { kernels: self.encoder.fixed_part(config.image)?, images: config.pixels() })
            }

            fn after_step(mut self, context: &StepContext<'_, Self>, mut buffers: Named<Tensor<1>>) -> Self {
                self.encoder.track(ENCODER, &mut buffers);
                let keep = f64::from(context.config.loss.target);
                $(self.$target = self.$target.update_target(keep);)*
                self
            }

            fn parameter_group(name: &str) -> ParameterGroup {
                parameter_group(name)
            }
        }
    };
}
value_learner!(
    Gcivl,
    "gcivl",
    "goal-conditioned implicit value learning: values by expectile regression, advantage-weighted policy regression",
    [value_predictor]
);
value_learner!(
    Gciql,
    "gciql",
    "goal-conditioned implicit Q-learning: critic and values, advantage-weighted policy regression",
    [value_predictor, critic_predictor]
);

/// Returns the parameter group of a weight: one group per network, whose gradients are clipped separately, because the
/// published scripts have one optimizer per network.
fn parameter_group(name: &str) -> ParameterGroup {
    let clip = match name.split('.').next() {
        Some("action_predictor" | "log_stds") => 1,
        Some("value_predictor") => 2,
        Some("critic_predictor") => 3,
        _ => 0,
    };
    ParameterGroup { clip, ..ParameterGroup::default() }
}

impl ValueLoss {
    fn check(&self) -> Result<()> {
        let fractions =
            [("loss.discount", self.discount), ("loss.expectile", self.expectile), ("loss.target", self.target)];
        for (what, fraction) in fractions {
            if !(0.0..1.0).contains(&fraction) {
                return Err(Error::config(what, fraction.to_string(), "give at least 0 and below 1"));
            }
        }
        if !(self.temperature.is_finite() && self.temperature >= 0.0) {
            let fix = "give at least 0 (0 is behavioural cloning)";
            return Err(Error::config("loss.temperature", self.temperature.to_string(), fix));
        }
        Ok(())
    }
}

/// Checks the number of frames in a clip, which the history determines.
fn check_frames(given: usize, expected: usize) -> Result<()> {
    if given == expected {
        return Ok(());
    }
    Err(Error::config(
        "data.num_steps",
        format!("{given} frames in a clip"),
        format!("give {expected}, which model.history requires, or change model.history"),
    ))
}

fn clip(num_steps: usize, frameskip: usize) -> ClipSpec {
    ClipSpec { num_steps, frameskip, columns: vec![PIXELS.to_owned(), ACTION.to_owned()] }
}

/// Returns the specification of goal images, relative to the last frame of the history.
fn goals(mixture: &GoalMixture, name: &str, model: &GcrlConfig) -> GoalSpec {
    GoalSpec {
        name: name.to_owned(),
        columns: vec![PIXELS.to_owned()],
        anchor: Some(model.history.saturating_sub(1)),
        mixture: *mixture,
    }
}

/// A batch that is read one range of clips at a time.
struct BatchReader<'a> {
    config: &'a GcrlConfig,
    device: &'a Device,
    /// Frames of a clip.
    steps: usize,
    frames: Frames<'a>,
    batch: &'a Batch,
    actions: Tensor<3>,
}

impl<'a> BatchReader<'a> {
    fn new(
        config: &'a GcrlConfig,
        dataset_info: &DatasetInfo,
        (steps, frameskip): (usize, usize),
        batch: &'a Batch,
        device: &'a Device,
    ) -> Result<Self> {
        let actions = dataset_info.actions(batch, steps, frameskip, device)?;
        let frames = Frames::of(&config.pixels(), batch, PIXELS)?;
        Ok(Self { config, device, steps, frames, batch, actions })
    }

    /// Returns the frames of a range of clips.
    fn frames_of(&self, clips: &Range<usize>) -> Frames<'a> {
        self.frames.range(clips.start * self.steps..clips.end * self.steps)
    }

    fn inputs(&self, frames: Frames<'_>) -> Result<Tensor<3>> {
        frames.inputs(&self.config.pixels(), self.config.encoder.patch(), self.device)
    }

    /// Returns the goals of a range of clips.
    fn goals(&self, name: &str, clips: &Range<usize>) -> Result<Frames<'a>> {
        Ok(Frames::of(&self.config.pixels(), self.batch, &format!("{name}_pixels"))?.range(clips.clone()))
    }

    fn clips(&self, clips: Range<usize>) -> Result<Clips> {
        let [_, _, elements] = self.actions.dims();
        Ok(Clips {
            frames: self.inputs(self.frames_of(&clips))?,
            goal: self.inputs(self.goals(GOAL, &clips)?)?,
            actions: self.actions.clone().slice([clips, 0..self.config.history, 0..elements]),
        })
    }

    fn relabelled(&self, clips: Range<usize>) -> Result<Relabelled> {
        let goals = self.goals(GOAL, &clips)?;
        // A goal is reached if the frame equals the goal image.
        let mut reached: Vec<f32> = vec![];
        for (clip, goal) in clips.clone().zip(goals.each()) {
            let history = self.frames.range(clip * self.steps..clip * self.steps + self.config.history);
            reached.extend(history.each().map(|frame| if frame == goal { 1.0 } else { 0.0 }));
        }
        let shape = [clips.len(), self.config.history, 1];
        Ok(Relabelled {
            policy_goal: self.inputs(self.goals(POLICY_GOAL, &clips)?)?,
            reached: Tensor::from_data(TensorData::new(reached, shape), self.device),
        })
    }
}
