//! Parity with the published models: names of weights, outputs, losses and gradients of the reference implementation.
//! Every test reads all files `MODEL-*.safetensors` in the folder that the environment variable `SWM_GOLDEN_MODELS`
//! names. The default folders are `tests/golden`, which also contains the exporters of the files, and
//! `shared/reference/models` next to the workspace.

mod conv;
mod dino_wm;
mod gcrl;
mod lewm;
mod pldm;
mod tdmpc2;
mod vit;
mod weights;

use burn::tensor::{Tensor, TensorData};
use safetensors::SafeTensors;
use std::collections::BTreeMap;
use std::path::PathBuf;
use swm_models::nn::parameters::{HostTensor, Named};

const TOLERANCE: f32 = 1e-4;

/// A golden file: tensors by name and the configuration of the model.
pub struct Golden {
    /// The metadata `config` as text and parsed.
    text: String,
    config: serde_json::Value,
    tensors: BTreeMap<String, HostTensor>,
}

impl Golden {
    pub fn read(path: &std::path::Path) -> Self {
        let bytes = std::fs::read(path).expect("reading a golden file");
        let (_, metadata) = SafeTensors::read_metadata(&bytes).expect("parsing the safetensors file");
        let config = &metadata.metadata().as_ref().expect("the metadata of a golden file")["config"];
        let tensors = SafeTensors::deserialize(&bytes).expect("parsing the safetensors file");
        let tensors = tensors
            .iter()
            .filter(|(_, view)| view.dtype() == safetensors::Dtype::F32)
            .map(|(name, view)| {
                let values =
                    view.data().chunks(4).map(|b| f32::from_le_bytes(b.try_into().expect("4 bytes"))).collect();
                (name.to_owned(), HostTensor { shape: view.shape().to_vec(), values })
            })
            .collect();
        Self { text: config.clone(), config: serde_json::from_str(config).expect("parsing the configuration"), tensors }
    }

    fn size(&self, name: &str) -> usize {
        usize::try_from(self.config[name].as_u64().expect(name)).expect("a size that fits usize")
    }

    fn get(&self, name: &str) -> &HostTensor {
        self.tensors.get(name).unwrap_or_else(|| panic!("no tensor {name}"))
    }

    pub fn tensor<const D: usize>(&self, name: &str) -> Tensor<D> {
        let host = self.get(name);
        let shape: [usize; D] = host.shape.clone().try_into().expect("a tensor of rank D");
        Tensor::from_data(TensorData::new(host.values.clone(), shape), &crate::device())
    }

    fn group(&self, prefix: &str) -> Named<HostTensor> {
        let strip =
            |(name, tensor): (&String, &HostTensor)| Some((name.strip_prefix(prefix)?.to_owned(), tensor.clone()));
        self.tensors.iter().filter_map(strip).collect()
    }

    /// Compares gradients with all recorded gradients. Parameters whose names end in an entry of `without_effect` have
    /// no effect, because a batch normalisation or a softmax cancels them. Their gradients are zero up to rounding, so
    /// the errors of these gradients are relative to the largest gradient of all parameters.
    fn check_gradients(&self, actual: &Named<Tensor<1>>, without_effect: &[&str]) {
        let expected = self.group("g.");
        let largest = expected.values().flat_map(|g| &g.values).fold(0.0f32, |m, v| m.max(v.abs()));
        let mut worst = (0.0, String::new());
        for (name, gradient) in &expected {
            let actual = values(actual.get(name).unwrap_or_else(|| panic!("a gradient of {name}")).clone());
            let floor = if without_effect.iter().any(|end| name.ends_with(end)) { largest } else { 1e-12 };
            let error = error(&actual, &gradient.values, floor);
            if error > worst.0 {
                worst = (error, name.clone());
            }
        }
        println!("worst gradient: {:.1e} ({})", worst.0, worst.1);
        assert!(worst.0 < TOLERANCE, "gradient of {} differs by {:.1e}", worst.1, worst.0);
        let names = |all: Vec<&String>| all.into_iter().cloned().collect::<Vec<_>>();
        assert_eq!(
            names(actual.keys().collect()),
            names(expected.keys().collect()),
            "names of the parameters with gradients"
        );
    }

    /// Normalised images of the configured size as patches.
    pub fn patches(&self, name: &str) -> Tensor<3> {
        self.patches_of_side(name, self.size("image"))
    }

    /// Normalised images `[…, 3, image, image]` as patches `[frames, patches, 3 * patch * patch]`.
    fn patches_of_side(&self, name: &str, image: usize) -> Tensor<3> {
        let patch = self.size("patch");
        let (host, grid) = (self.get(name), image / patch);
        let frames = host.values.len() / (3 * image * image);
        let frames_tensor =
            Tensor::<1>::from_data(TensorData::new(host.values.clone(), [host.values.len()]), &crate::device());
        frames_tensor.reshape([frames, 3, grid, patch, grid, patch]).permute([0, 2, 4, 1, 3, 5]).reshape([
            frames,
            grid * grid,
            3 * patch * patch,
        ])
    }
}

/// The largest difference, relative to the largest expected value, or to `floor` if all expected values are smaller.
fn error(actual: &[f32], expected: &[f32], floor: f32) -> f32 {
    assert_eq!(actual.len(), expected.len());
    let scale = expected.iter().fold(floor, |m, v| m.max(v.abs()));
    actual.iter().zip(expected).fold(0.0f32, |m, (a, b)| m.max((a - b).abs())) / scale
}

/// The values of a tensor in row-major order.
pub fn values<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().iter::<f32>().collect()
}

/// Compares values with the tensor `name` of a golden file.
pub fn check(golden: &Golden, name: &str, actual: &[f32]) {
    let error = error(actual, &golden.get(name).values, 1e-6);
    println!("{name}: {error:.1e}");
    assert!(error < TOLERANCE, "{name} differs by {error:.1e}");
}

/// The recorded files of a model.
fn files(model: &str) -> Vec<PathBuf> {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    let folders = match std::env::var_os("SWM_GOLDEN_MODELS") {
        Some(folder) => vec![PathBuf::from(folder)],
        None => vec![root.join("tests/golden"), root.join("../../../shared/reference/models")],
    };
    let mut files: Vec<PathBuf> = folders
        .iter()
        .filter_map(|folder| std::fs::read_dir(folder).ok())
        .flatten()
        .map(|entry| entry.expect("reading the folder entry").path())
        .filter(|path| {
            let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
            name.starts_with(&format!("{model}-")) && name.ends_with(".safetensors")
        })
        .collect();
    files.sort();
    assert!(
        !files.is_empty(),
        "no {model}-*.safetensors in {folders:?}: set SWM_GOLDEN_MODELS to a folder that has one"
    );
    files
}
