//! Import and export of TD-MPC2 checkpoints of the reference implementation, whose weights have the names of the
//! parameters of [`Tdmpc2`].

use super::config::{Encoding, LossConfig, Tdmpc2Config};
use super::model::Tdmpc2;
use crate::Checkpoint;
use crate::nn::parameters::{self, HostTensor};
use crate::nn::{Bins, Init, Named};
use crate::train::{DatasetInfo, TrainConfig, check_sizes, limits};
use crate::weights::reference::{Reference, write};
use burn::tensor::Device;
use serde::de::{Deserializer, MapAccess, Visitor};
use serde::{Deserialize, Serialize, Serializer};
use serde_json::json;
use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;
use swm_core::columns::PIXELS;
use swm_core::{Error, Manifest, Result, files};

const CLASS: &str = "stable_worldmodel.wm.tdmpc2.TDMPC2";

/// Converts a TD-MPC2 of the reference implementation: a folder with `weights.pt` and `config.json`, or the path of the
/// weights. The files do not store how actions were scaled to -1 ..= 1, so `dataset_info` must describe the environment
/// or the dataset.
///
/// # Errors
/// When a file is damaged or holds another model, or the action dimension differs from
/// `dataset_info`.
pub fn import(from: &Path, dataset_info: DatasetInfo) -> Result<Checkpoint<Tdmpc2>> {
    let reference = Reference::open(from, "TDMPC2")?;
    let folder = if from.is_dir() { from } else { from.parent().unwrap_or(Path::new("")) };
    let path = folder.join("config.json");
    let text = files::read(&path, limits::JSON_BYTES)?;
    let published = serde_json::from_slice::<Tree>(&text).map_err(|error| reference.wrong(error.to_string()))?.cfg;
    if published.action_dim != dataset_info.action.dim() {
        return Err(Error::mismatch(
            "importing a checkpoint",
            format!("{} action elements in the dataset", dataset_info.action.dim()),
            format!("{}, as the model was trained", published.action_dim),
        ));
    }
    let model = published.with(&reference.weights, &Device::flex())?;
    let mut config = TrainConfig::<Tdmpc2>::load("paper", &[])?;
    (config.model, config.loss) = (published.model(), published.loss());
    config.data.num_steps = published.wm.horizon.saturating_add(1);
    config.check()?;
    let manifest = Manifest::new("import", 0, json!({ "from": from.display().to_string() }));
    Ok(Checkpoint { model, config, dataset_info, manifest })
}

/// Writes the `weights.pt` and `config.json` that `load_pretrained` of the reference implementation reads.
///
/// # Errors
/// When the model predicts terminations, which the reference implementation does not, or a file cannot be written.
pub fn export(checkpoint: &Checkpoint<Tdmpc2>, folder: &Path) -> Result<()> {
    let (model, loss) = (&checkpoint.config.model, &checkpoint.config.loss);
    if model.termination {
        let fix = "train with model.termination=false";
        return Err(Error::config(
            "exporting a model",
            "the reference implementation does not predict terminations",
            fix,
        ));
    }
    let widths = checkpoint.model.extra_encoders.iter();
    let widths = widths.map(|(column, encoder)| (column.to_owned(), encoder._0.weight.dims()[1]));
    let cfg = Published {
        action_dim: checkpoint.model.action_dim(),
        extra_dims: widths.collect(),
        image_size: model.image,
        wm: WorldModel {
            encoding: InOrder(
                model.encoding.iter().map(|encoding| (encoding.column.clone(), encoding.latent)).collect(),
            ),
            enc_dim: model.encoder,
            mlp_dim: model.hidden,
            num_bins: model.bins.count,
            vmin: model.bins.low,
            vmax: model.bins.high,
            num_q: model.critics,
            simnorm_dim: model.simplex,
            horizon: checkpoint.config.data.num_steps - 1,
            tau: loss.tau,
            rho: loss.rho,
            discount: loss.discount,
            uncertainty_penalty: loss.uncertainty,
            entropy_coef: loss.entropy,
            consistency_coef: loss.consistency,
            reward_coef: loss.reward,
            value_coef: loss.value,
        },
    };
    write(folder, &Tree { class: CLASS.to_owned(), cfg }, &parameters::values(&checkpoint.model))
}

/// The content of `config.json`: a class and the configuration of the class.
#[derive(Serialize, Deserialize)]
struct Tree {
    #[serde(rename = "_target_")]
    class: String,
    cfg: Published,
}

/// A configuration of the reference implementation.
#[derive(Serialize, Deserialize)]
pub struct Published {
    action_dim: usize,
    #[serde(default)]
    extra_dims: BTreeMap<String, usize>,
    #[serde(default)]
    image_size: usize,
    wm: WorldModel,
}

/// The model configuration of the reference implementation, with the published values as defaults.
#[derive(Serialize, Deserialize)]
#[serde(default)]
struct WorldModel {
    encoding: InOrder,
    enc_dim: usize,
    mlp_dim: usize,
    num_bins: usize,
    vmin: f64,
    vmax: f64,
    num_q: usize,
    simnorm_dim: usize,
    horizon: usize,
    tau: f64,
    rho: f64,
    discount: f64,
    uncertainty_penalty: f64,
    entropy_coef: f64,
    consistency_coef: f64,
    reward_coef: f64,
    value_coef: f64,
}

impl Default for WorldModel {
    fn default() -> Self {
        Self {
            encoding: InOrder(vec![]),
            enc_dim: 256,
            mlp_dim: 512,
            num_bins: 101,
            vmin: -10.0,
            vmax: 10.0,
            num_q: 5,
            simnorm_dim: 8,
            horizon: 3,
            tau: 0.01,
            rho: 0.5,
            discount: 0.99,
            uncertainty_penalty: 0.5,
            entropy_coef: 1e-4,
            consistency_coef: 20.0,
            reward_coef: 0.1,
            value_coef: 0.1,
        }
    }
}

/// The latent dimension of each column, in the order of a JSON object.
struct InOrder(Vec<(String, usize)>);

impl<'de> Deserialize<'de> for InOrder {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Self, D::Error> {
        struct Entries;
        impl<'de> Visitor<'de> for Entries {
            type Value = InOrder;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("latent sizes by column")
            }
            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> std::result::Result<InOrder, A::Error> {
                let mut entries = vec![];
                while let Some(entry) = map.next_entry()? {
                    entries.push(entry);
                }
                Ok(InOrder(entries))
            }
        }
        deserializer.deserialize_map(Entries)
    }
}

impl Serialize for InOrder {
    fn serialize<S: Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        serializer.collect_map(self.0.iter().map(|(column, latent)| (column, latent)))
    }
}

impl Published {
    /// Parses the JSON of a configuration.
    ///
    /// # Errors
    /// When `json` is not the configuration of a TD-MPC2.
    pub fn read(json: &str) -> Result<Self> {
        serde_json::from_str(json).map_err(|error| {
            Error::config(
                "the configuration of a published TD-MPC2",
                error.to_string(),
                "give the config.json of the reference implementation",
            )
        })
    }

    /// Returns the model configuration.
    pub fn model(&self) -> Tdmpc2Config {
        let WorldModel { encoding, enc_dim, mlp_dim, num_bins, vmin, vmax, num_q, simnorm_dim, .. } = &self.wm;
        // Images come first in a latent, whatever the order in the file.
        let (images, columns): (Vec<_>, Vec<_>) = encoding.0.iter().partition(|(column, _)| column == PIXELS);
        let to_encoding = |(column, latent): &(String, usize)| Encoding { column: column.clone(), latent: *latent };
        Tdmpc2Config {
            encoding: images.into_iter().chain(columns).map(to_encoding).collect(),
            image: self.image_size,
            encoder: *enc_dim,
            hidden: *mlp_dim,
            simplex: *simnorm_dim,
            bins: Bins { count: *num_bins, low: *vmin, high: *vmax },
            critics: *num_q,
            dropout: 0.01,
            termination: false,
        }
    }

    /// Returns the settings of the loss.
    pub fn loss(&self) -> LossConfig {
        LossConfig {
            discount: self.wm.discount,
            rho: self.wm.rho,
            tau: self.wm.tau,
            consistency: self.wm.consistency_coef,
            reward: self.wm.reward_coef,
            value: self.wm.value_coef,
            entropy: self.wm.entropy_coef,
            termination: 0.0,
            uncertainty: self.wm.uncertainty_penalty,
        }
    }

    /// Returns the model with published weights.
    ///
    /// # Errors
    /// When the width of a column or a weight is missing, a weight has another shape, or there is an unknown weight.
    pub fn with(&self, weights: &Named<HostTensor>, device: &Device) -> Result<Tdmpc2> {
        let config = self.model();
        config.check()?;
        let width = |encoding: &Encoding| {
            self.extra_dims.get(&encoding.column).copied().ok_or_else(|| {
                let fix = "add the column with its number of elements";
                Error::config("extra_dims", format!("the column '{}' has no entry", encoding.column), fix)
            })
        };
        let widths: Vec<usize> = config.column_encodings().map(width).collect::<Result<_>>()?;
        let columns = widths.iter().map(|width| ("extra_dims", *width, 1, limits::FEATURES));
        let sizes: Vec<_> = columns.chain([("action_dim", self.action_dim, 1, limits::FEATURES)]).collect();
        check_sizes(&sizes)?;
        let init = Init::for_weights(weights, device);
        let model = Tdmpc2::init(&config, &widths, self.action_dim, &init);
        init.check()?;
        let shapes = parameters::shapes(&model);
        for (name, shape) in &shapes {
            let given = weights.get(name).map(|weight| &weight.shape);
            if given != Some(shape) {
                let given = given.map_or("no such weight".to_owned(), |shape| format!("{shape:?}"));
                return Err(Error::mismatch(
                    format!("loading '{name}' of a published TD-MPC2"),
                    given,
                    format!("{shape:?}"),
                ));
            }
        }
        match weights.keys().find(|name| !shapes.contains_key(*name)) {
            None => Ok(parameters::load(model, weights)),
            Some(name) => {
                let expected = "the weights that config.json describes";
                Err(Error::mismatch("loading a published TD-MPC2", format!("a weight '{name}'"), expected))
            }
        }
    }
}
