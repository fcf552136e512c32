//! Requirements of the model families on datasets, which `swm doctor` compares with a dataset.

use swm_core::requirements::DatasetRequirements;

/// The requirements of every family. World models train on clips of 4 steps with frameskip 5, goal-conditioned learners
/// on pairs of rows, TD-MPC2 on 4 consecutive rows.
pub const DATASET_REQUIREMENTS: [DatasetRequirements; 7] = [
    from_images("LeWM", 20),
    from_images("PLDM", 20),
    from_images("DINO-WM", 20),
    DatasetRequirements { model: "TD-MPC2", images: false, reward: true, clip_rows: 4 },
    from_images("GCBC", 2),
    from_images("GCIVL", 2),
    from_images("GCIQL", 2),
];

const fn from_images(model: &'static str, clip_rows: usize) -> DatasetRequirements {
    DatasetRequirements { model, images: true, reward: false, clip_rows }
}
