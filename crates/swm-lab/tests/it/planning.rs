//! A planner of the tests: the simulator, without the program that joins the registries.

use swm_core::run::Control;
use swm_core::{EnvSpec, Error, Predictor, Result};
use swm_data::Reader;
use swm_eval::World;
use swm_lab::plans::{FrameDecoder, Model, Planner, Planners, Planning, Position, SIMULATOR, Settings};
use swm_plan::{ActionKind, ActionScale, MpcPolicy, PlanObserver, SOLVERS, Score, SimulatorCost, pairing};

/// The simulator alone.
pub struct Simulated;

impl Planning for Simulated {
    fn models(&self, _: &EnvSpec) -> Vec<Model> {
        let (name, family) = (SIMULATOR.to_owned(), String::new());
        vec![Model { name, family, block: None, image: None, history: 1 }]
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
        Ok(Planner { policy: Box::new(policy), scale, predictor: None })
    }

    fn decoder(&mut self, _: (&mut dyn Predictor, usize), _: &dyn Reader, _: &mut Control<'_>) -> Result<FrameDecoder> {
        Err(Error::config("simulator", "it has no latents", "choose a model"))
    }
}
