//! Training on datasets: one loop for every [`Trainable`] model, its configuration and its logs.
//!
//! The configuration and the data determine a run. The step number determines the next batches and their random
//! numbers, so an interrupted and resumed run gives the same results as an uninterrupted run.
//!
//! Training by interaction with an environment is in [`crate::online`]; both loops update a model through the same
//! learner.

pub mod checks;
pub(crate) mod colours;
pub mod config;
mod dataset_info;
pub(crate) mod described;
pub(crate) mod failed_batch;
mod fixed_features;
pub(crate) mod learner;
pub mod log;
pub(crate) mod metrics;
pub mod optim;
mod options;
pub mod presets;
pub(crate) mod resume;
pub(crate) mod run;
pub(crate) mod run_state;
pub mod schedule;
pub mod shards;
mod split;
mod step_output;
mod trainable;

pub(crate) use checks::check_finite;
pub use checks::{check_sizes, limits};
pub use config::{DataConfig, TrainConfig, ValidationConfig};
pub use dataset_info::{ColumnInfo, DatasetInfo};
pub use fixed_features::FixedPart;
pub use optim::{AdamW, OptimConfig, ParameterGroup};
pub use options::{TrainOptions, TrainSummary};
pub use presets::Preset;
pub use run::{TrainingPlan, begin, check_data, train};
pub use schedule::ScheduleConfig;
pub(crate) use split::episodes;
pub use step_output::StepOutput;
pub use trainable::{StepContext, Trainable};
