//! The models that plan in the lab: the simulator, the capsules of the zoo, and the checkpoints in the folders of the lab.

use crate::resolver::{HomeResolver, WatchedPolicy};
use crate::zoo;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::SystemTime;
use swm_core::columns::PIXELS;
use swm_core::run::Control;
use swm_core::{Batch, ColumnSpec, EnvSpec, Error, Origin, Predictor, Result, Schema};
use swm_data::Reader;
use swm_eval::{Choice, Model as PlannedIn, World};
use swm_lab::folders::Folders;
use swm_lab::plans::{FrameDecoder, Model, Planner, Planners, Planning, Position, SIMULATOR, Settings};
use swm_models::Device;
use swm_models::probe::reconstruction::to_bytes;
use swm_models::probe::{ImageEncoder, Reconstruction, ReconstructionConfig, reconstruct_images};
use swm_plan::PlanObserver;

/// How deep checkpoints are looked for in the folders of runs.
const DEPTH: usize = 2;

/// A checkpoint that plans, and the environment that it was trained in.
type Found = Option<(Model, Option<String>)>;

/// What the lab knows of models.
pub struct HomePlanning {
    runs: Folders,
    /// The checkpoints that were loaded, by path and time of change, so that a list does not load them again.
    known: Mutex<BTreeMap<(PathBuf, Option<SystemTime>), Found>>,
}

impl HomePlanning {
    /// The models of the zoo and of these folders.
    pub fn new(runs: Folders) -> Self {
        Self { runs, known: Mutex::default() }
    }

    /// All checkpoints by the name that `swm eval` knows.
    fn checkpoints(&self) -> Vec<(String, PathBuf)> {
        let zoo = zoo::capsules().into_iter().map(|(name, path)| (format!("{}{name}", zoo::PREFIX), path));
        let found = self.runs.list(DEPTH, |path| swm_models::stored::family(path).is_some());
        let named = found.into_iter().map(|found| {
            let name = if found.folder == 0 { found.name } else { found.path.display().to_string() };
            (name, found.path)
        });
        zoo.chain(named).collect()
    }

    /// What is known of a checkpoint, which is loaded the first time. One that is damaged cannot be chosen.
    fn found(&self, name: &str, path: &Path) -> Found {
        let changed = path.join("checkpoint/manifest.json").metadata().or_else(|_| path.metadata());
        let key = (path.to_owned(), changed.and_then(|metadata| metadata.modified()).ok());
        if let Some(known) = self.known.lock().unwrap_or_else(PoisonError::into_inner).get(&key) {
            return known.clone();
        }
        let read = || -> Result<Found> {
            let loaded = swm_models::load(path, &Device::flex())?;
            let info = loaded.info()?;
            let model = Model {
                name: name.to_owned(),
                family: info.family.to_owned(),
                block: Some(info.action_block),
                image: info.image_size,
                history: info.history,
            };
            Ok(loaded.cost().map(|_| (model, info.dataset_info.env)))
        };
        let found = read().unwrap_or_default();
        self.known.lock().unwrap_or_else(PoisonError::into_inner).insert(key, found.clone());
        found
    }
}

impl Planning for HomePlanning {
    fn models(&self, spec: &EnvSpec) -> Vec<Model> {
        let simulator = Model {
            name: SIMULATOR.to_owned(),
            family: "the environment itself".to_owned(),
            block: None,
            image: None,
            history: 1,
        };
        let found = self.checkpoints().into_iter().filter_map(|(name, path)| self.found(&name, &path));
        let fit = found.filter(|(_, env)| env.as_ref().is_none_or(|env| *env == spec.id)).map(|(model, _)| model);
        std::iter::once(simulator).chain(fit).collect()
    }

    fn positions(&self, spec: &EnvSpec) -> &'static [Position] {
        const fn at(name: &'static str, first: usize, side: f64, is_up: bool) -> Position {
            Position { name, elements: [first, first + 1], side, is_up }
        }
        const PUSH_T: &[Position] = &[at("agent", 0, 512.0, false), at("block", 2, 512.0, false)];
        const ROOMS: &[Position] = &[at("agent", 0, 224.0, false)];
        const MAZE: &[Position] = &[at("agent", 0, 5.0, true)];
        match spec.id.split(',').next().unwrap_or_default() {
            "swm/PushT-v1" | "swm/PushT-Discrete-v1" => PUSH_T,
            "swm/TwoRoom-v1" | "swm/Piecewise-v0" => ROOMS,
            "swm/SimplePointMaze-v0" => MAZE,
            _ => &[],
        }
    }

    fn planners(&self) -> Box<dyn Planners + '_> {
        Box::new(HomePlanners { planning: self, resolver: HomeResolver::new(Origin::User) })
    }
}

/// Makes planners; loaded checkpoints stay loaded.
struct HomePlanners<'a> {
    planning: &'a HomePlanning,
    resolver: HomeResolver,
}

impl Planners for HomePlanners<'_> {
    fn planner(
        &mut self,
        settings: &Settings,
        model: &Model,
        world: &World,
        observer: Box<dyn PlanObserver>,
    ) -> Result<Planner> {
        let planned_in = if model.name == SIMULATOR {
            PlannedIn::Simulator { score: settings.score.clone() }
        } else {
            // The name is looked up again: the path is one of the list.
            let found = self.planning.checkpoints().into_iter().find(|(name, _)| *name == model.name);
            let gone = || Error::config(&model.name, "it is no longer there", "choose another model");
            PlannedIn::Checkpoint(found.ok_or_else(gone)?.1.display().to_string())
        };
        let solver = Choice { id: settings.solver.clone(), settings: Value::Object(settings.settings.clone()) };
        let mpc = json!(settings.mpc(model, world.spec())?);
        let WatchedPolicy { policy, scale, predictor } =
            self.resolver.watched_policy(&planned_in, (&solver, &mpc), world, observer)?;
        Ok(Planner { policy, scale, predictor })
    }

    fn decoder(
        &mut self,
        (predictor, side): (&mut dyn Predictor, usize),
        dataset: &dyn Reader,
        control: &mut Control<'_>,
    ) -> Result<FrameDecoder> {
        let dim = predictor.latent_dim();
        let schema = Schema::new([ColumnSpec::image(PIXELS, side, side)])?;
        let encoder = Encoding { predictor: Mutex::new(predictor), schema, side, dim };
        let config = ReconstructionConfig::default();
        let Reconstruction { decoder, report, .. } = reconstruct_images(&encoder, dataset, &config, control)?;
        let decode = move |latents: &[f32]| to_bytes(&decoder.decode(latents));
        Ok(FrameDecoder { decode: Box::new(decode), explained: report.explained })
    }
}

/// The encoder of a model that predicts.
struct Encoding<'a> {
    predictor: Mutex<&'a mut dyn Predictor>,
    schema: Schema,
    side: usize,
    dim: usize,
}

impl ImageEncoder for Encoding<'_> {
    fn image_size(&self) -> usize {
        self.side
    }

    fn latent_dim(&self) -> usize {
        self.dim
    }

    fn encode(&self, rgb: &[u8]) -> Result<Vec<f32>> {
        let bytes = self.side * self.side * 3;
        let mut rows = Batch::zeros(&self.schema, rgb.len() / bytes);
        for (i, frame) in rgb.chunks_exact(bytes).enumerate() {
            rows.row_mut(i).at::<u8>(0).copy_from_slice(frame);
        }
        let mut latents = vec![0.0; rows.rows() * self.dim];
        self.predictor.lock().unwrap_or_else(PoisonError::into_inner).encode(&rows, &mut latents)?;
        Ok(latents)
    }
}
