//! [`StepSubject`]: the training step of a family that is trained online, which `swm bench online` measures on random transitions.

use rand::Rng as _;
use swm_bench::{Subject, Work};
use swm_core::columns::{ACTION, REWARD, TERMINATED};
use swm_core::{Batch, ColumnSpec, DType, Key, Result, Schema};
use swm_models::nn::{Init, Named};
use swm_models::train::{AdamW, ColumnInfo, DatasetInfo, StepContext};
use swm_models::{Device, TrainConfig, Trainable};
use swm_plan::ActionScale;

/// The column that the published presets observe.
const STATE: &str = "state";

/// A model with random weights, and a batch of random transitions.
pub struct StepSubject<M: Trainable> {
    /// The configuration, with the sizes.
    pub config: TrainConfig<M>,
    dataset_info: DatasetInfo,
    batch: Batch,
    model: Option<M>,
    optimizer: AdamW,
    steps: u64,
}

impl<M: Trainable> StepSubject<M> {
    /// Creates a model of the preset `paper` for states of `observation` elements and actions of `action` elements.
    ///
    /// # Errors
    /// When the preset does not load.
    pub fn new(settings: &[String], observation: usize, action: usize) -> Result<Self> {
        let config = TrainConfig::<M>::load("paper", settings)?;
        let steps = config.data.num_steps;
        let column = |name: &str, shape: Vec<usize>| ColumnSpec::new(name, DType::Float32, shape);
        let columns = [
            column(STATE, vec![steps, observation]),
            column(ACTION, vec![steps, action]),
            column(REWARD, vec![steps]),
            column(TERMINATED, vec![steps]),
        ];
        let mut batch = Batch::zeros(&Schema::new(columns)?, config.data.batch_size);
        let mut rng = Key::new(0).with("batch").rng();
        for row in 0..batch.rows() {
            let mut row = batch.row_mut(row);
            for column in 0..3 {
                row.at::<f32>(column).iter_mut().for_each(|value| *value = rng.random_range(-1.0..1.0));
            }
        }
        let each = |value: f64| vec![value; observation];
        let (mean, std, min, max) = (each(0.0), each(1.0), each(-1.0), each(1.0));
        let info = ColumnInfo { shape: vec![observation], mean, std, min, max };
        let columns = Named::from([(STATE.to_owned(), info)]);
        let dataset_info = DatasetInfo { action: ActionScale::identity(action), columns, env: None };
        let model = M::new(&config, &dataset_info, &Init::new(Key::new(0), &Device::flex()))?;
        let optimizer = AdamW::new(config.optim.clone());
        Ok(Self { config, dataset_info, batch, model: Some(model), optimizer, steps: 0 })
    }
}

impl<M: Trainable> Subject for StepSubject<M> {
    fn run(&mut self, _: Work) -> Result<Vec<f32>> {
        let Some(model) = self.model.take() else { return Ok(vec![]) };
        let (config, dataset_info) = (&self.config, &self.dataset_info);
        let key = Key::new(0).at(self.steps);
        let context = StepContext { config, dataset_info, key, device: &Device::flex(), training: true };
        let output = model.step(&context, &self.batch)?;
        let (model, _) = self.optimizer.step(model, 1.0, output.gradients, M::parameter_group);
        self.model = Some(model.after_step(&context, output.buffers));
        self.steps += 1;
        Ok(vec![])
    }
}
