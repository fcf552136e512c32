//! The table: its walls, the bodies on it, and the controller that moves the agent.

use super::factors::body_shape;
use super::physics::{self, AGENT, BLOCK, Body, Shape, Simulation, Vec2, WALLS};
use super::shapes::BodyShape;
use swm_core::FactorValues;

/// Side of the table, in pixels.
pub const TABLE: f64 = 512.0;
/// Distance from the agent to the target position for an action component of 1, in pixels.
pub const ACTION_SCALE: f32 = 100.0;
/// Physics steps per step of the environment (10 Hz control).
pub const SUBSTEPS: usize = 10;
/// Gains of the agent's controller: stiffness in 1/s² and damping in 1/s.
const GAINS: [f32; 2] = [100.0, 20.0];
/// The centre lines of the walls, in pixels.
pub const WALL_LINES: [[[f64; 2]; 2]; 4] = [
    [[5.0, 506.0], [5.0, 5.0]],
    [[5.0, 5.0], [506.0, 5.0]],
    [[506.0, 5.0], [506.0, 506.0]],
    [[5.0, 506.0], [506.0, 506.0]],
];
/// Half the thickness of the walls, in pixels.
const WALL_RADIUS: f64 = 2.0;

/// Runs one step of the environment: a spring-damper controller pulls the agent towards the target of an action.
/// Returns the number of contacts, summed over the physics steps.
///
/// The controller computes in single precision, as in the reference.
pub fn advance(simulation: &mut Simulation, action: [f32; 2]) -> usize {
    const DT: f32 = physics::DT as f32;
    let from = simulation.bodies[AGENT].position();
    let target = [from.x as f32 + action[0] * ACTION_SCALE, from.y as f32 + action[1] * ACTION_SCALE];
    let accelerated = |target: f32, at: f64, speed: f64| {
        let acceleration = GAINS[0] * (target - at as f32) + (f64::from(GAINS[1]) * -speed) as f32;
        f64::from(speed as f32 + acceleration * DT)
    };
    let mut contacts = 0;
    for _ in 0..SUBSTEPS {
        let agent = &mut simulation.bodies[AGENT];
        let (at, velocity) = (agent.position(), agent.velocity);
        agent.velocity = Vec2::new(accelerated(target[0], at.x, velocity.x), accelerated(target[1], at.y, velocity.y));
        simulation.step();
        contacts += simulation.contact_count();
    }
    contacts
}

/// Returns the simulation of an episode, before any step.
pub fn simulation(factors: &FactorValues) -> Simulation {
    let shapes = ["agent", "block"].map(|name| body_shape(factors, name));
    let mut bodies = [shapes[AGENT].body(), shapes[BLOCK].body()];
    for (body, name) in bodies.iter_mut().zip(["agent", "block"]) {
        let position = factors.get(&format!("{name}.start_position"));
        body.set_position(Vec2::new(position[0], position[1]));
        if body.is_dynamic() {
            body.set_angle(factors.scalar(&format!("{name}.angle")));
        }
    }
    assemble(&shapes, bodies)
}

/// Makes a simulation of agent, block and walls.
pub fn assemble(shapes: &[BodyShape; 2], [agent, block]: [Body; 2]) -> Simulation {
    let wall = |[a, b]: [[f64; 2]; 2]| Shape::segment(WALLS, a.into(), b.into(), WALL_RADIUS);
    let mut colliders: Vec<Shape> = WALL_LINES.map(wall).into();
    colliders.extend(shapes[AGENT].colliders(AGENT));
    colliders.extend(shapes[BLOCK].colliders(BLOCK));
    Simulation::new(agent, block, colliders, WALL_LINES.len())
}
