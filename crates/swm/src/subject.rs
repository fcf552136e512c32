//! [`LewmSubject`]: the LeWM that `swm bench plan` and `swm bench train` measure. Its weights are random, because the speed
//! of planning and training does not depend on the weights.

use rand::Rng as _;
use std::path::Path;
use swm_bench::{Subject, Work};
use swm_core::columns::{ACTION, GOAL, PIXELS};
use swm_core::{
    Batch, Candidates, ColumnSpec, CostModel as _, DType, Error, Key, PlanProblem, PlanSpace, Predictor as _, Result,
    Schema, Solver as _,
};
use swm_models::lewm::{EncoderConfig, Lewm, LewmCost, LewmPredictor, pixels};
use swm_models::nn::parameters::{self, HostTensor};
use swm_models::nn::{Init, Named};
use swm_models::train::{AdamW, DatasetInfo, StepContext};
use swm_models::{Device, TrainConfig, Trainable as _, weights};
use swm_plan::{ActionScale, Cem};

/// Model steps of a plan.
const HORIZON: usize = 5;
/// The dimension of an environment action.
const ACTION_DIM: usize = 2;

/// The work of a [`LewmSubject`].
pub struct LewmWork<'a> {
    /// The preset with the sizes of the model.
    pub preset: &'a str,
    /// Iterations of a plan.
    pub iterations: usize,
    /// Environments of a plan.
    pub envs: usize,
    /// Whether a device computes the candidates of all environments in one call.
    pub together: bool,
    /// Images encoded at once by [`Work::Frames`].
    pub frames: usize,
    /// Clips of a training batch.
    pub clips: usize,
}

/// A LeWM with inputs for planning and training.
pub struct LewmSubject {
    config: TrainConfig<Lewm>,
    frames: usize,
    device: Device,
    model: Lewm,
    cost: LewmCost,
    /// Whether the cost observed all environments last, not only the first.
    observed_all: bool,
    cem: Cem,
    /// The columns `pixels` and `goal` of each environment.
    infos: Batch,
    /// Candidate action sequences, `[samples, HORIZON, frameskip * ACTION_DIM]`.
    candidates: Vec<f32>,
    training: Option<TrainingRun>,
}

/// The state of a training run.
struct TrainingRun {
    model: Lewm,
    optimizer: AdamW,
    dataset_info: DatasetInfo,
    batch: Batch,
    steps: u64,
}

impl LewmSubject {
    /// Creates a model with random weights and the inputs of its work.
    ///
    /// # Errors
    /// When there is no such preset.
    pub fn new(work: &LewmWork<'_>, device: &Device) -> Result<Self> {
        let LewmWork { preset, iterations, envs, together, frames, clips } = *work;
        let shards = if *device == Device::flex() { rayon::current_num_threads() } else { 1 };
        let settings = [format!("data.batch_size={clips}"), format!("shards={shards}")];
        let config = TrainConfig::<Lewm>::load(preset, &settings)?;
        let action_dim = config.data.frameskip * ACTION_DIM;
        let model = with_modulations(Lewm::init(&config.model, action_dim, &Init::new(Key::new(0), device)));
        let mut cost = LewmCost::of(&model, &config.model, action_dim);
        if together {
            cost.plan_together();
        }
        let side = config.model.image;
        let columns = [ColumnSpec::image(PIXELS, side, side), ColumnSpec::image(GOAL, side, side)];
        let mut infos = Batch::zeros(&Schema::new(columns)?, envs);
        let mut rng = Key::new(0).with("inputs").rng();
        for env in 0..envs {
            let mut row = infos.row_mut(env);
            (0..2).for_each(|column| rng.fill(row.at::<u8>(column)));
        }
        cost.observe(&infos, &[0])?;
        let cem = Cem { iterations, ..Cem::default() };
        let candidates = (0..cem.samples * HORIZON * action_dim).map(|_| rng.random_range(-1.0..1.0)).collect();
        Ok(Self {
            config,
            frames,
            device: device.clone(),
            model,
            cost,
            observed_all: false,
            cem,
            infos,
            candidates,
            training: None,
        })
    }

    /// Returns the sizes of the model and of the benchmark as JSON, for the process that runs the reference
    /// implementation.
    ///
    /// # Errors
    /// When that process cannot run the encoder.
    pub fn sizes(&self) -> Result<serde_json::Value> {
        let (model, predictor) = (&self.config.model, &self.config.model.predictor);
        let mut sizes = match &model.encoder {
            EncoderConfig::Vit(vit) => serde_json::json!({
                "patch": vit.patch, "vit_layers": vit.depth, "vit_heads": vit.heads, "vit_mlp": vit.mlp,
            }),
            EncoderConfig::Conv(conv) => serde_json::json!({ "channels": conv.channels, "hidden": conv.hidden }),
            EncoderConfig::Dinov2(_) | EncoderConfig::PatchCnn(_) | EncoderConfig::Keypoints(_) => {
                return Err(Error::config(
                    "preset",
                    "the reference implementation has no such encoder",
                    "choose a preset with `vit` or `conv`: paper or small",
                ));
            }
        };
        let all = serde_json::json!({
            "device": if self.device == Device::flex() { "cpu" } else { "cuda" },
            "image": model.image, "dim": model.encoder.dim(), "latent": model.latent, "proj_hidden": model.projector,
            "actions": self.action_dim(),
            "history": predictor.history, "depth": predictor.depth, "heads": predictor.heads, "mlp": predictor.mlp,
            "predictor_dim": predictor.dim, "dim_head": predictor.dim_head, "dropout": predictor.dropout,
            "envs": self.infos.rows(), "frames": self.frames, "iterations": self.cem.iterations, "elites": self.cem.elites, "batch": self.config.data.batch_size,
            "knots": self.config.loss.knots, "directions": self.config.loss.directions,
        });
        if let (Some(sizes), serde_json::Value::Object(all)) = (sizes.as_object_mut(), all) {
            sizes.extend(all);
        }
        Ok(sizes)
    }

    /// Writes weights (`w.NAME`) and inputs (`i.NAME`, with normalised images) for the process that runs the reference
    /// implementation.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<()> {
        let weights = parameters::values(&self.model).into_iter();
        let mut tensors: Named<HostTensor> = weights.map(|(name, tensor)| (format!("w.{name}"), tensor)).collect();
        let side = self.config.model.image;
        for name in [PIXELS, GOAL] {
            let planes = pixels::planes(&self.config.model, self.infos.get::<u8>(name)?, &Device::flex())?;
            let values = planes.into_data().iter::<f32>().collect();
            tensors.insert(format!("i.{name}"), HostTensor { shape: vec![self.infos.rows(), 3, side, side], values });
        }
        let shape = vec![self.cem.samples, HORIZON, self.action_dim()];
        tensors.insert("i.candidates".to_owned(), HostTensor { shape, values: self.candidates.clone() });
        weights::torch::write(path, &tensors)
    }

    /// The action dimension of a model step.
    fn action_dim(&self) -> usize {
        self.config.data.frameskip * ACTION_DIM
    }

    fn costs(&mut self) -> Result<Vec<f32>> {
        if std::mem::take(&mut self.observed_all) {
            self.cost.observe(&self.infos, &[0])?;
        }
        let mut costs = vec![0.0; self.cem.samples];
        let (samples, dim) = (self.cem.samples, self.action_dim());
        let candidates = Candidates { actions: &self.candidates, envs: 1, samples, horizon: HORIZON, dim };
        self.cost.cost(candidates, &mut costs)?;
        Ok(costs)
    }

    fn plan(&mut self) -> Result<()> {
        let envs: Vec<usize> = (0..self.infos.rows()).collect();
        self.observed_all = true;
        self.cost.observe(&self.infos, &envs)?;
        let (low, high) = (vec![-1.0; self.action_dim()], vec![1.0; self.action_dim()]);
        let space = PlanSpace::Continuous { low: &low, high: &high };
        let keys: Vec<Key> = envs.iter().map(|&env| Key::new(env as u64)).collect();
        let problem = PlanProblem { horizon: HORIZON, space, keys: &keys, init: None, deadline: None, observer: None };
        self.cem.solve(&mut self.cost, problem).map(|_| ())
    }

    /// Encodes [`LewmWork::frames`] copies of an image: in one call on a device, as when planning for several environments together.
    fn encode_frames(&self) -> Result<()> {
        let (model, config) = (&self.model, &self.config.model);
        let image = &self.infos.get::<u8>(PIXELS)?[..config.image.pow(2) * 3];
        if self.device == Device::flex() {
            let columns = [ColumnSpec::image(PIXELS, config.image, config.image)];
            let mut rows = Batch::zeros(&Schema::new(columns)?, self.frames);
            (0..self.frames).for_each(|row| rows.row_mut(row).at::<u8>(0).copy_from_slice(image));
            let scale = ActionScale::identity(ACTION_DIM);
            let mut latents = vec![0.0; self.frames * config.latent];
            return LewmPredictor::new(model, config, scale, self.config.data.frameskip).encode(&rows, &mut latents);
        }
        let latents = model.encode(pixels::patches(config, &image.repeat(self.frames), &self.device)?);
        latents.into_data();
        Ok(())
    }

    fn train(&mut self) -> Result<()> {
        let (config, device) = (&self.config, &self.device);
        let mut training = match self.training.take() {
            Some(training) => training,
            None => TrainingRun::new(config, &self.model)?,
        };
        let key = Key::new(0).at(training.steps);
        let context = StepContext { config, dataset_info: &training.dataset_info, key, device, training: true };
        let output = training.model.step(&context, &training.batch)?;
        let (model, _) = training.optimizer.step(training.model, 1.0, output.gradients, Lewm::parameter_group);
        training.model = model.after_step(&context, output.buffers);
        training.steps += 1;
        self.training = Some(training);
        Ok(())
    }
}

impl TrainingRun {
    fn new(config: &TrainConfig<Lewm>, model: &Lewm) -> Result<Self> {
        let (steps, side) = (config.data.num_steps, config.model.image);
        let columns = [
            ColumnSpec::new(PIXELS, DType::U8, [steps, side, side, 3]),
            ColumnSpec::new(ACTION, DType::Float32, [steps, config.data.frameskip * ACTION_DIM]),
        ];
        let mut batch = Batch::zeros(&Schema::new(columns)?, config.data.batch_size);
        let mut rng = Key::new(0).with("batch").rng();
        for row in 0..batch.rows() {
            let mut row = batch.row_mut(row);
            rng.fill(row.at::<u8>(0));
            row.at::<f32>(1).iter_mut().for_each(|action| *action = rng.random_range(-1.0..1.0));
        }
        let dataset_info = DatasetInfo { action: ActionScale::identity(ACTION_DIM), columns: Named::new(), env: None };
        Ok(Self { model: model.clone(), optimizer: AdamW::new(config.optim.clone()), dataset_info, batch, steps: 0 })
    }
}

impl Subject for LewmSubject {
    fn run(&mut self, work: Work) -> Result<Vec<f32>> {
        match work {
            Work::Cost => return self.costs(),
            Work::Encode => {
                let image = self.config.model.image.pow(2) * 3;
                return self.cost.latent_of(&self.infos.get::<u8>(PIXELS)?[..image]);
            }
            Work::Frames => self.encode_frames()?,
            Work::Plan => self.plan()?,
            Work::Train => self.train()?,
        }
        Ok(vec![])
    }
}

/// Replaces the zero-initialised modulations by random values, because actions have no effect on zero modulations.
fn with_modulations(model: Lewm) -> Lewm {
    let mut values = parameters::values(&model);
    let mut rng = Key::new(0).with("modulations").rng();
    for (_, tensor) in values.iter_mut().filter(|(name, _)| name.contains("adaLN")) {
        tensor.values.iter_mut().for_each(|value| *value = rng.random_range(-0.1..0.1));
    }
    parameters::load(model, &values)
}
