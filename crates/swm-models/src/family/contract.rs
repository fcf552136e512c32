//! [`ModelFamily`]: the operations that a model family supports.

use crate::checkpoint::Checkpoint;
use crate::online::OnlineSummary;
use crate::probe::ImageEncoder;
use crate::train::{DatasetInfo, TrainConfig, TrainOptions, Trainable};
use std::path::Path;
use std::sync::Arc;
use swm_core::requirements::DatasetRequirements;
use swm_core::run::Control;
use swm_core::{CostModel, EnvPool, EnvSpec, Policy, Predictor, Result};
use swm_data::Reader;

/// A trainable model and the operations on checkpoints of the model. A method returns `None` if the family does not
/// support the operation.
pub trait ModelFamily: Trainable {
    /// Whether a trained model acts without a solver.
    const ACTS: bool = false;

    /// Returns the dataset requirements for training with `config`.
    fn requirements(config: &TrainConfig<Self>) -> DatasetRequirements;

    /// Returns the number of frames that a prediction or decision reads.
    fn history(_config: &TrainConfig<Self>) -> usize {
        1
    }

    /// Returns the planning cost of a trained model.
    fn cost(_checkpoint: &Checkpoint<Self>) -> Option<Box<dyn CostModel>> {
        None
    }

    /// Returns a policy that acts without a solver in `slots` environments of `spec`.
    ///
    /// # Errors
    /// When the model was trained for another action space.
    fn policy(_checkpoint: &Checkpoint<Self>, _spec: &EnvSpec, _slots: usize) -> Option<Result<Box<dyn Policy>>> {
        None
    }

    /// Returns a predictor of latents, to compare predictions with recorded trajectories.
    fn predictor(_checkpoint: &Checkpoint<Self>) -> Option<Box<dyn Predictor>> {
        None
    }

    /// Returns the image encoder, for probes.
    fn encoder(_checkpoint: &Checkpoint<Self>) -> Option<Box<dyn ImageEncoder>> {
        None
    }

    /// Converts a checkpoint of the reference implementation, which was trained on a dataset with `dataset_info`.
    ///
    /// # Errors
    /// When a file is damaged or holds another model.
    fn import(_from: &Path, _dataset_info: DatasetInfo) -> Option<Result<Checkpoint<Self>>> {
        None
    }

    /// Writes the files that `load_pretrained` of the reference implementation reads.
    ///
    /// # Errors
    /// When the reference implementation has no model of these sizes, or a file cannot be written.
    fn export(_checkpoint: &Checkpoint<Self>, _folder: &Path) -> Option<Result<()>> {
        None
    }

    /// Trains by acting in environments.
    ///
    /// # Errors
    /// As [`crate::online::train_online`].
    fn train_online(
        _config: &TrainConfig<Self>,
        _run: OnlineRun<'_>,
        _control: &mut Control<'_>,
    ) -> Option<Result<OnlineSummary>> {
        None
    }
}

/// Inputs and outputs of a training run on a dataset.
pub struct TrainRun<'a> {
    /// The dataset.
    pub reader: Arc<dyn Reader>,
    /// The checkpoint whose encoder is used; `None` for families that train an encoder or have none.
    pub encoder: Option<&'a Path>,
    /// The folder of the checkpoint and the logs.
    pub out: &'a Path,
    /// Settings that do not change the result.
    pub options: TrainOptions,
}

/// Inputs and outputs of an online training run.
pub struct OnlineRun<'a> {
    /// Creates a pool of the given number of environments.
    pub environments: &'a dyn Fn(usize) -> Result<EnvPool>,
    /// The folder of the checkpoint and the logs.
    pub out: &'a Path,
    /// Settings that do not change the result.
    pub options: TrainOptions,
}
