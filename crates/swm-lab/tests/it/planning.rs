//! Planners of the tests: the simulator, without the program that joins the registries, and one that needs frames.

use swm_core::run::Control;
use swm_core::{Batch, EnvPool, EnvSpec, Error, Key, Policy, Predictor, Result, columns};
use swm_data::Reader;
use swm_eval::World;
use swm_lab::plans::{FrameDecoder, Model, Planner, Planners, Planning, Position, SIMULATOR, Settings};
use swm_plan::{ActionKind, ActionScale, MpcPolicy, PlanObserver, SOLVERS, Score, SimulatorCost, pairing};

/// The name of the model that needs frames.
pub const FRAMES: &str = "frames";

/// The simulator, and the simulator as a model that needs frames.
pub struct Simulated;

/// A policy that needs the column of frames.
struct NeedsFrames(MpcPolicy);

impl Policy for NeedsFrames {
    fn begin(&mut self, slot: usize, key: Key) {
        self.0.begin(slot, key);
    }

    fn act(&mut self, infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        infos.schema().index(columns::PIXELS)?;
        self.0.act(infos, active, actions)
    }

    fn observe_envs(&mut self, pool: &EnvPool, active: &[bool]) -> Result<()> {
        self.0.observe_envs(pool, active)
    }
}

impl Planning for Simulated {
    fn models(&self, _: &EnvSpec) -> Vec<Model> {
        let model =
            |name: &str, image| Model { name: name.to_owned(), family: String::new(), block: None, image, history: 1 };
        vec![model(SIMULATOR, None), model(FRAMES, Some(16))]
    }

    fn positions(&self, spec: &EnvSpec) -> &'static [Position] {
        const ROOMS: &[Position] = &[Position { name: "agent", elements: [0, 1], side: 224.0, is_up: false }];
        if spec.id == "swm/TwoRoom-v1" { ROOMS } else { &[] }
    }

    fn planners(&self) -> Box<dyn Planners + '_> {
        Box::new(Self)
    }
}

impl Planners for Simulated {
    fn planner(
        &mut self,
        settings: &Settings,
        model: &Model,
        world: &World,
        observer: Box<dyn PlanObserver>,
    ) -> Result<Planner> {
        let (spec, config) = (world.spec().clone(), settings.mpc(model, world.spec())?);
        let scale = ActionScale::unscaled(&spec);
        let id = spec.id.clone();
        let make = move || swm_envs::ENVS.choose(&id)?.env();
        let mut cost = SimulatorCost::new(make, scale.clone(), config.action_block, Score::Terminal)?;
        pairing(&settings.solver, &mut cost, ActionKind::of(&spec.action_space))?;
        let solver = (SOLVERS.get(&settings.solver)?.make)(&serde_json::Value::Object(settings.settings.clone()))?;
        let policy = MpcPolicy::new(solver, Box::new(cost), config, scale.clone(), &spec, 1)?.observed(observer);
        let policy: Box<dyn Policy> =
            if model.image.is_some() { Box::new(NeedsFrames(policy)) } else { Box::new(policy) };
        Ok(Planner { policy, scale, predictor: None })
    }

    fn decoder(&mut self, _: (&mut dyn Predictor, usize), _: &dyn Reader, _: &mut Control<'_>) -> Result<FrameDecoder> {
        Err(Error::config("simulator", "it has no latents", "choose a model"))
    }
}
