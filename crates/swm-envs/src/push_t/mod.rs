//! Push-T: an agent pushes a block of some shape to a goal pose, on a table with walls.
//!
//! The README beside this file lists actions, observations, reward, factors, and where it differs from the
//! Python reference. Constants are those of the reference's `env.py` unless said otherwise.

pub mod discrete;
mod expert;
mod physics;
mod render;
mod shapes;

use physics::{AGENT, BLOCK, Body, Shape, Vec2, WALLS, World, put, take_array};
use render::{Renderer, Scene};
use shapes::Design;
use std::f64::consts::{PI, TAU};
use swm_core::factors;
use swm_core::{
    Action, ColumnSpec, DType, Env, EnvEntry, EnvSpec, Error, ExpertEntry, Factor, FactorValues, FrameMut, Key,
    ResetOptions, Result, RowMut, RowRef, Snapshot, Space, Transition, VariationRequest, VariationSpace,
};

/// The registry row.
pub const ENTRY: EnvEntry = EnvEntry {
    id: "swm/PushT-v1",
    summary: "push a block to a goal pose",
    options: &[],
    make: |_| Ok(Box::new(PushT::new())),
    experts: EXPERTS,
};

const EXPERTS: &[ExpertEntry] = &[
    ExpertEntry {
        id: "expert",
        summary: "pushes planned with the world's own physics",
        make: || Box::new(expert::Pusher::new(|action| action)),
    },
    ExpertEntry {
        id: "weak",
        summary: "random actions that stay near the block",
        make: || Box::new(expert::Weak::default()),
    },
];

/// Side of the table, in pixels.
pub const TABLE: f64 = 512.0;
/// Pixels that an action of 1 asks the agent to move.
pub const ACTION_SCALE: f32 = 100.0;
/// Physics steps in one step of the environment (10 Hz control).
const SUBSTEPS: usize = 10;
/// Gains of the controller that moves the agent to where the action points.
const GAINS: [f32; 2] = [100.0, 20.0];
/// The goal is reached when agent and block together are nearer than this, in pixels,
const REACH: f64 = 20.0;
/// and the block's angle is nearer than this, in radians.
const REACH_ANGLE: f64 = PI / 9.0;
/// What the agent's way to its goal counts in the distance to it, beside the block's. It is little, because the agent has
/// to leave its goal to push the block: a plan that minimised both alike would park the agent and leave the block.
const AGENT_SHARE: f64 = 0.05;
/// The middle lines of the walls, and half their thickness, in pixels.
const WALL_LINES: [[[f64; 2]; 2]; 4] = [
    [[5.0, 506.0], [5.0, 5.0]],
    [[5.0, 5.0], [506.0, 5.0]],
    [[506.0, 5.0], [506.0, 506.0]],
    [[5.0, 506.0], [506.0, 506.0]],
];
const WALL_RADIUS: f64 = 2.0;
/// How many goals are tried before giving up.
const GOAL_TRIES: usize = 1000;

/// Agent x y, block x y, block angle, agent velocity x y.
type State = [f64; 7];

/// The environment; see the module.
pub struct PushT {
    spec: EnvSpec,
    factors: FactorValues,
    world: World,
    goal: State,
    /// The world as it looks at the goal.
    goal_scene: Scene,
    /// Contact points of all physics steps since the last action.
    contacts: usize,
    /// Agent shape and scale, block shape and scale.
    shapes: [f64; 4],
    renderer: Renderer,
}

impl PushT {
    /// `swm/PushT-v1` in the default state of its factors.
    pub fn new() -> Self {
        Self::with_actions(ENTRY.id, Space::uniform_box([2], DType::Float32, -1.0, 1.0))
    }

    /// The same world under another id, with a box or the grid of [`discrete`] for its actions.
    fn with_actions(id: &'static str, action_space: Space) -> Self {
        let variation_space = variation_space();
        let nothing = VariationRequest { variation: Some(vec![]), ..VariationRequest::default() };
        let factors = variation_space.resolve(&nothing, Key::new(0)).expect("defaults are in their spaces");
        let goal = start_of(&factors);
        let world = settle(world_of(&factors), &goal);
        let goal_scene = Scene::of(&world);
        let observation_space = observation_space();
        let spec = EnvSpec {
            id: id.to_owned(),
            action_space,
            columns: columns(),
            observation_space,
            variation_space,
            max_episode_steps: 200,
            cameras: vec![],
        };
        let (renderer, shapes) = (Renderer::new(&factors), shapes_of(&factors));
        Self { spec, factors, world, goal, goal_scene, contacts: 0, shapes, renderer }
    }

    fn state(&self) -> State {
        state_of(&self.world)
    }

    /// Begins an episode with these factors: at the goal for its picture, then wherever `start` puts the world.
    fn begin(&mut self, factors: FactorValues, goal: State) {
        self.world = settle(world_of(&factors), &goal);
        self.contacts = self.world.contacts();
        self.goal_scene = Scene::of(&self.world);
        self.goal = goal;
        self.renderer.begin(&factors);
        self.shapes = shapes_of(&factors);
        self.factors = factors;
    }
}

/// The reference's bounds; agents may go beyond them, as there.
fn observation_space() -> Vec<(&'static str, Space)> {
    let (side, speed) = (512.0, 512.0);
    let space = |low: &[f64], high: &[f64]| Space::Box {
        shape: vec![low.len()],
        dtype: DType::Float64,
        low: low.to_vec(),
        high: high.to_vec(),
    };
    vec![
        ("proprio", space(&[0.0, 0.0, -speed, -speed], &[side, side, speed, speed])),
        ("state", space(&[0.0, 0.0, 0.0, 0.0, 0.0, -speed, -speed], &[side, side, side, side, TAU, speed, speed])),
    ]
}

impl Default for PushT {
    fn default() -> Self {
        Self::new()
    }
}

impl Env for PushT {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, seed: u64, options: &ResetOptions) -> Result<()> {
        let key = Key::new(seed);
        let factors = self.spec.variation_space.resolve(&options.variation, key)?;
        let start = match &options.state {
            Some(state) => checked(state, "state")?,
            None => start_of(&factors),
        };
        let goal = match &options.goal_state {
            Some(state) => checked(state, "goal_state")?,
            None => find_goal(&factors, &start, key.with("goal"))?,
        };
        self.begin(factors, goal);
        // As in the reference, the world goes on from the goal, so that what the solver remembers of it stays.
        place(&mut self.world, &start);
        self.world.step();
        self.contacts += self.world.contacts();
        Ok(())
    }

    fn step(&mut self, action: Action<'_>) -> Result<Transition> {
        let action = match &self.spec.action_space {
            Space::Box { .. } => action.continuous(2).map(|action| [action[0], action[1]])?,
            grid => discrete::action(action.discrete(grid)?),
        };
        self.contacts = advance(&mut self.world, action);
        let state = self.state();
        Ok(Transition {
            reward: -distance(&self.goal, &state),
            terminated: reached(&self.factors, &self.goal, &state),
            truncated: false,
        })
    }

    fn observe(&self, row: &mut RowMut<'_>) {
        let state = self.state();
        let [x, y, block_x, block_y, _, vx, vy] = state;
        let goal = self.goal;
        let target = self.factors.get("goal.position");
        row.set(0, &state);
        row.set(1, &[x, y, vx, vy]);
        row.set(2, &[x, y]);
        row.set(3, &[vx, vy]);
        row.set(4, &[block_x, block_y, self.world.bodies[BLOCK].angle]);
        row.set(5, &[target[0], target[1], self.factors.scalar("goal.angle")]);
        row.set(6, &goal);
        row.set(7, &[goal[0], goal[1], goal[5], goal[6]]);
        #[allow(clippy::cast_possible_wrap)]
        row.set(8, &[self.contacts.div_ceil(SUBSTEPS) as i64]);
        row.set(9, &self.shapes);
        row.set(10, &[x, y, self.world.bodies[AGENT].angle]);
    }

    fn render(&mut self, frame: FrameMut<'_>) -> Result<()> {
        self.renderer.draw(&Scene::of(&self.world), frame);
        Ok(())
    }

    fn render_goal(&mut self, frame: FrameMut<'_>) -> Result<()> {
        self.renderer.draw(&self.goal_scene, frame);
        Ok(())
    }

    fn factors(&self) -> &FactorValues {
        &self.factors
    }

    fn snapshot(&self) -> Snapshot {
        let Snapshot(mut bytes) = factors::snapshot(&self.spec.id, &self.factors, []);
        put(&mut bytes, &self.goal);
        put(&mut bytes, &[self.contacts as u64]);
        self.world.save(&mut bytes);
        Snapshot(bytes)
    }

    fn restore(&mut self, snapshot: &Snapshot) -> Result<()> {
        let foreign = || factors::foreign(&self.spec.id, "other bytes");
        let (factors, mut bytes) =
            factors::restored(&self.spec.id, &self.spec.variation_space, &self.factors, snapshot)?;
        let goal = take_array::<f64, 7>(&mut bytes).ok_or_else(foreign)?;
        let [contacts] = take_array::<u64, 1>(&mut bytes).ok_or_else(foreign)?;
        let goal = checked(&goal, "goal of a snapshot")?;
        let contacts = usize::try_from(contacts).map_err(|_| foreign())?;
        if factors.is_some() || goal != self.goal {
            self.begin(factors.unwrap_or_else(|| self.factors.clone()), goal);
        }
        if self.world.load(&mut bytes).is_none() || !bytes.is_empty() {
            // Half a world is none: the episode begins anew, at its goal.
            self.begin(self.factors.clone(), goal);
            return Err(factors::foreign(&self.spec.id, "other bytes"));
        }
        self.contacts = contacts;
        Ok(())
    }

    fn restore_from(&mut self, start: RowRef<'_>, goal: RowRef<'_>) -> Result<()> {
        let factors = factors::from_row(&self.spec.variation_space, &self.factors, start)?;
        let start = checked(&start.to_f64("state")?, "state of the start row")?;
        let goal = checked(&goal.to_f64("state")?, "state of the goal row")?;
        self.begin(factors, goal);
        // A fresh world: nothing has touched yet, and the state is the row's to the last digit.
        self.world = world_of(&self.factors);
        self.contacts = 0;
        place(&mut self.world, &start);
        Ok(())
    }

    fn sample_goal(&mut self, key: Key) -> Result<()> {
        self.goal = find_goal(&self.factors, &self.state(), key.with("goal"))?;
        self.goal_scene = Scene::of(&settle(world_of(&self.factors), &self.goal));
        Ok(())
    }

    fn is_success(&self) -> bool {
        reached(&self.factors, &self.goal, &self.state())
    }

    fn goal_distance(&self) -> f64 {
        let (state, goal) = (self.state(), &self.goal);
        let apart = |x: usize| (state[x] - goal[x]).hypot(state[x + 1] - goal[x + 1]) / REACH;
        let turn = turn(self.factors.integer("block.shape"), goal[4], state[4]) / REACH_ANGLE;
        (AGENT_SHARE * apart(0)).hypot(apart(2)).hypot(turn)
    }
}

/// One step of the environment: pulls the agent to where an action points, in single precision as the reference
/// does. Returns how many contact points the physics steps had, all together.
#[allow(clippy::cast_possible_truncation)]
fn advance(world: &mut World, action: [f32; 2]) -> usize {
    const DT: f32 = physics::DT as f32;
    let from = world.bodies[AGENT].position();
    let target = [from.x as f32 + action[0] * ACTION_SCALE, from.y as f32 + action[1] * ACTION_SCALE];
    let pulled = |target: f32, at: f64, speed: f64| {
        let pull = GAINS[0] * (target - at as f32) + (f64::from(GAINS[1]) * -speed) as f32;
        f64::from(speed as f32 + pull * DT)
    };
    let mut contacts = 0;
    for _ in 0..SUBSTEPS {
        let agent = &mut world.bodies[AGENT];
        let (at, velocity) = (agent.position(), agent.velocity);
        agent.velocity = Vec2::new(pulled(target[0], at.x, velocity.x), pulled(target[1], at.y, velocity.y));
        world.step();
        contacts += world.contacts();
    }
    contacts
}

/// The world of an episode, before anything moved.
fn world_of(factors: &FactorValues) -> World {
    let designs = ["agent", "block"].map(|name| design(factors, name));
    let mut bodies = [designs[AGENT].body(), designs[BLOCK].body()];
    for (body, name) in bodies.iter_mut().zip(["agent", "block"]) {
        let position = factors.get(&format!("{name}.start_position"));
        body.set_position(Vec2::new(position[0], position[1]));
        if body.is_dynamic() {
            body.set_angle(factors.scalar(&format!("{name}.angle")));
        }
    }
    assemble(&designs, bodies)
}

/// Agent and block between the walls.
fn assemble(designs: &[Design; 2], [agent, block]: [Body; 2]) -> World {
    let wall = |[a, b]: [[f64; 2]; 2]| Shape::segment(WALLS, a.into(), b.into(), WALL_RADIUS);
    let mut shapes: Vec<Shape> = WALL_LINES.map(wall).into();
    shapes.extend(designs[AGENT].shapes(AGENT));
    shapes.extend(designs[BLOCK].shapes(BLOCK));
    World::new(agent, block, shapes, WALL_LINES.len())
}

/// The shape of `agent` or `block`.
fn design(factors: &FactorValues, name: &str) -> Design {
    Design::new(factors.integer(&format!("{name}.shape")), factors.scalar(&format!("{name}.scale")))
}

/// Agent shape and scale, block shape and scale.
fn shapes_of(factors: &FactorValues) -> [f64; 4] {
    ["agent.shape", "agent.scale", "block.shape", "block.scale"].map(|key| factors.scalar(key))
}

/// Puts the bodies where a state says.
fn place(world: &mut World, state: &State) {
    let [x, y, block_x, block_y, angle, vx, vy] = *state;
    world.bodies[AGENT].velocity = Vec2::new(vx, vy);
    world.bodies[AGENT].set_position(Vec2::new(x, y));
    world.bodies[BLOCK].set_angle(angle);
    world.bodies[BLOCK].set_position(Vec2::new(block_x, block_y));
}

/// A world in a state, one physics step later, as the reference sets states.
fn settle(mut world: World, state: &State) -> World {
    place(&mut world, state);
    world.step();
    world
}

fn state_of(world: &World) -> State {
    let [agent, block, _] = &world.bodies;
    let (a, b) = (agent.position(), block.position());
    [a.x, a.y, b.x, b.y, block.angle.rem_euclid(TAU), agent.velocity.x, agent.velocity.y]
}

/// The start that the factors describe.
fn start_of(factors: &FactorValues) -> State {
    let (agent, block) = (factors.get("agent.start_position"), factors.get("block.start_position"));
    let velocity = factors.get("agent.velocity");
    [agent[0], agent[1], block[0], block[1], factors.scalar("block.angle"), velocity[0], velocity[1]]
}

/// A state that a caller gave.
fn checked(state: &[f64], what: &str) -> Result<State> {
    if let Some(bad) = state.iter().find(|v| !v.is_finite()) {
        let fix = "give finite positions, angle and velocities".to_owned();
        return Err(Error::NotFinite { what: what.to_owned(), given: bad.to_string(), fix });
    }
    state.try_into().map_err(|_| {
        let expected = "7: agent x y, block x y, block angle, agent velocity x y";
        Error::mismatch(format!("reading a {what}"), format!("{} numbers", state.len()), expected)
    })
}

fn distance(a: &State, b: &State) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
}

/// Whether a state counts as the goal: agent and block in place, the block turned so that it looks the same.
fn reached(factors: &FactorValues, goal: &State, state: &State) -> bool {
    let apart = goal[..4].iter().zip(state).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt();
    apart < REACH && turn(factors.integer("block.shape"), goal[4], state[4]) < REACH_ANGLE
}

/// The smallest turn from one angle to another after which a block looks the same.
fn turn(shape: i64, from: f64, to: f64) -> f64 {
    let symmetry = Design::symmetry(shape);
    let turn = (from - to).rem_euclid(symmetry);
    turn.min(symmetry - turn)
}

/// A goal at rest that can be reached (nothing overlaps there) and is not reached at `start`.
fn find_goal(factors: &FactorValues, start: &State, key: Key) -> Result<State> {
    let space = |name: &str| factors.factors().iter().find(|factor| factor.key == name).map(|factor| &factor.space);
    let (Some(agents), Some(blocks)) = (space("agent.start_position"), space("block.start_position")) else {
        return Err(Error::config("goal", "its spaces are missing", "report this"));
    };
    let mut rng = key.rng();
    let turn = Space::uniform_box([], DType::Float64, 0.0, TAU);
    for _ in 0..GOAL_TRIES {
        let (agent, block, angle) = (agents.sample(&mut rng), blocks.sample(&mut rng), turn.sample(&mut rng));
        let goal = [agent[0], agent[1], block[0], block[1], angle[0], 0.0, 0.0];
        if !reached(factors, &goal, start) && settle(world_of(factors), &goal).contacts() == 0 {
            return Ok(goal);
        }
    }
    Err(Error::Unsatisfiable {
        factor: "goal".to_owned(),
        constraint: "agent, block and walls do not overlap".to_owned(),
        tries: GOAL_TRIES,
    })
}

/// What [`Env::observe`] writes, in order.
fn columns() -> Vec<ColumnSpec> {
    let column = |name: &str, n: usize| ColumnSpec::new(name, DType::Float64, [n]);
    vec![
        column("state", 7),
        column("proprio", 4),
        column("pos_agent", 2),
        column("vel_agent", 2),
        column("block_pose", 3),
        column("goal_pose", 3),
        column("goal_state", 7),
        column("goal_proprio", 4),
        ColumnSpec::new("n_contacts", DType::Int64, []),
        column("shapes", 4),
        column("agent_pose", 3),
    ]
}

/// Every factor, in the reference's sampling order.
fn variation_space() -> VariationSpace {
    let pixels = |low: f64, high: f64| Space::uniform_box([2], DType::Float64, low, high);
    let angle = || Space::uniform_box([], DType::Float64, -TAU, TAU);
    let scale = || Space::uniform_box([], DType::Float32, 20.0, 60.0);
    VariationSpace::new(
        vec![
            Factor::new("background.color", Space::Rgb, [255.0, 255.0, 255.0]),
            Factor::new("goal.angle", angle(), [PI / 4.0]),
            Factor::new("goal.color", Space::Rgb, [144.0, 238.0, 144.0]),
            Factor::new("goal.position", pixels(50.0, 450.0), [256.0, 256.0]),
            Factor::new("goal.scale", scale(), [40.0]),
            Factor::new("block.angle", angle(), [0.0]),
            Factor::new("block.color", Space::Rgb, [119.0, 136.0, 153.0]),
            Factor::new("block.scale", scale(), [30.0]),
            Factor::new("block.shape", Space::Discrete { n: 7, start: 1 }, [2.0]),
            Factor::new("block.start_position", pixels(100.0, 400.0), [400.0, 100.0]),
            Factor::new("agent.angle", angle(), [0.0]),
            Factor::new("agent.color", Space::Rgb, [65.0, 105.0, 225.0]),
            Factor::new("agent.scale", scale(), [40.0]),
            Factor::new("agent.shape", Space::Discrete { n: 8, start: 0 }, [0.0]),
            Factor::new("agent.start_position", pixels(50.0, 450.0), [256.0, 400.0]),
            Factor::new("agent.velocity", pixels(0.0, TABLE), [0.0, 0.0]),
            Factor::new("rendering.render_goal", Space::Discrete { n: 2, start: 0 }, [1.0]),
        ],
        &["agent.start_position", "block.start_position", "block.angle"],
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn goals_are_reached_up_to_turns_that_look_the_same() {
        let pinned = |shape: f64| VariationRequest {
            variation: Some(vec![]),
            variation_values: [("block.shape".to_owned(), vec![shape])].into(),
        };
        let goal = [100.0, 100.0, 200.0, 200.0, -3.0, 0.0, 0.0];
        // Square and + look the same after a quarter turn, Z and I after half a turn, L and both T after a full one.
        for (shape, quarter, half) in
            [(1, false, false), (2, false, false), (3, false, true), (4, true, true), (5, false, true), (7, true, true)]
        {
            let factors = variation_space().resolve(&pinned(f64::from(shape)), Key::new(0)).expect("a shape");
            for (turn, wanted) in [(0.0, true), (TAU, true), (0.4, false), (PI / 2.0, quarter), (PI, half)] {
                let state = [110.0, 100.0, 200.0, 210.0, goal[4] + turn, 50.0, 0.0];
                assert_eq!(reached(&factors, &goal, &state), wanted, "shape {shape}, turned by {turn}");
            }
            let far = [115.0, 100.0, 200.0, 215.0, goal[4], 0.0, 0.0];
            assert!(!reached(&factors, &goal, &far), "agent and block are 21 pixels off together");
        }
    }

    #[test]
    fn impulses_are_part_of_a_snapshot() {
        let mut env = PushT::new();
        let start = vec![256.0, 300.0, 256.0, 256.0, 0.0, 0.0, 0.0];
        env.reset(3, &ResetOptions { state: Some(start), ..ResetOptions::default() }).expect("a start");
        let push = Action::Continuous(&[0.0, -0.5]);
        (0..3).for_each(|_| {
            env.step(push).expect("a step");
        });
        assert!(env.contacts > 0, "the agent pushes the block");
        let snapshot = env.snapshot();
        let after = |env: &mut PushT| {
            (0..20).for_each(|_| {
                env.step(push).expect("a step");
            });
            env.snapshot()
        };
        let wanted = after(&mut env);
        let mut other = PushT::new();
        other.restore(&snapshot).expect("a snapshot");
        assert_eq!(other.snapshot(), snapshot);
        assert_eq!(after(&mut other), wanted);
        assert!(other.restore(&Snapshot(snapshot.0[..snapshot.0.len() - 1].to_vec())).is_err());
        // The same positions and velocities without what the solver remembers go another way.
        let mut memoryless = PushT::new();
        memoryless.restore(&snapshot).expect("a snapshot");
        let state = memoryless.state();
        memoryless.world = world_of(&memoryless.factors);
        place(&mut memoryless.world, &state);
        assert_ne!(after(&mut memoryless), wanted);
    }

    #[test]
    fn the_expert_reaches_goals() {
        let mut env = PushT::new();
        let schema = swm_core::Schema::new(env.spec.columns.clone()).expect("a schema");
        let mut row = swm_core::Batch::zeros(&schema, 1);
        let mut reaches = |seed: u64, options: &ResetOptions| {
            let mut expert = (EXPERTS[0].make)();
            expert.begin(Key::new(seed));
            env.reset(seed, options).expect("a reset");
            (0..env.spec.max_episode_steps).any(|_| {
                env.observe(&mut row.row_mut(0));
                let mut action = [0.0; 2];
                expert.act(row.row(0), &mut action).expect("an action");
                env.step(Action::Continuous(&action.map(|v| v as f32))).expect("a step").terminated
            })
        };
        assert!((0..10).filter(|&seed| reaches(seed, &ResetOptions::default())).count() >= 9);
        // An agent that is pushed back, and turned, by what it pushes.
        let pinned = [("agent.shape", 4.0), ("agent.scale", 25.0), ("block.shape", 6.0)];
        let mut square = ResetOptions::default();
        square.variation.variation_values =
            pinned.into_iter().map(|(key, value)| (key.to_owned(), vec![value])).collect();
        assert!((0..10).filter(|&seed| reaches(seed, &square)).count() >= 7);
    }
}
