//! Rigid bodies: where they are, how fast they move, how hard they are to move.

use super::Vec2;
use bytemuck::{Pod, Zeroable};

/// A rotation about the origin followed by a shift.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Pose {
    /// Cosine and sine of the angle.
    rotation: Vec2,
    /// Where the origin goes.
    pub origin: Vec2,
}

impl Pose {
    /// The pose of a body whose centre of gravity `cog` (body coordinates) is at `position`.
    pub fn new(position: Vec2, angle: f64, cog: Vec2) -> Self {
        let (sin, cos) = angle.sin_cos();
        let turned = Vec2::new(cog.x * cos - cog.y * sin, cog.x * sin + cog.y * cos);
        Self { rotation: Vec2::new(cos, sin), origin: position - turned }
    }

    /// A direction of the body in the world.
    pub fn direction(&self, v: Vec2) -> Vec2 {
        let Vec2 { x: cos, y: sin } = self.rotation;
        Vec2::new(cos * v.x - sin * v.y, sin * v.x + cos * v.y)
    }

    /// A point of the body in the world.
    pub fn point(&self, p: Vec2) -> Vec2 {
        self.direction(p) + self.origin
    }
}

/// A rigid body. Velocities are in pixels and radians per second, mass is 1 for everything that can be pushed.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Body {
    /// The centre of gravity, in the world.
    pub centre: Vec2,
    /// Radians, not wrapped.
    pub angle: f64,
    /// Velocity of the centre of gravity.
    pub velocity: Vec2,
    /// Angular velocity.
    pub spin: f64,
    /// The part of the velocity that only pushes overlapping shapes apart; used once.
    pub push: Vec2,
    /// The part of the angular velocity that only turns overlapping shapes apart; used once.
    pub push_spin: f64,
    /// 1 / mass; 0 for bodies that nothing moves.
    pub inverse_mass: f64,
    /// 1 / moment of inertia; 0 for bodies that nothing turns.
    pub inverse_inertia: f64,
    /// The centre of gravity, in body coordinates.
    pub cog: Vec2,
    /// From body to world coordinates.
    pub pose: Pose,
}

impl Body {
    /// A body at the origin; `mass` and `inertia` may be infinite.
    pub fn new(mass: f64, inertia: f64, cog: Vec2) -> Self {
        Self {
            centre: Vec2::ZERO,
            angle: 0.0,
            velocity: Vec2::ZERO,
            spin: 0.0,
            push: Vec2::ZERO,
            push_spin: 0.0,
            inverse_mass: 1.0 / mass,
            inverse_inertia: 1.0 / inertia,
            cog,
            pose: Pose::new(Vec2::ZERO, 0.0, Vec2::ZERO),
        }
    }

    /// Where the body's origin (not its centre of gravity) is.
    pub fn position(&self) -> Vec2 {
        self.pose.origin
    }

    /// Puts the body's origin somewhere.
    pub fn set_position(&mut self, position: Vec2) {
        self.centre = self.pose.direction(self.cog) + position;
        self.pose = Pose::new(self.centre, self.angle, self.cog);
    }

    /// Turns the body about its centre of gravity.
    pub fn set_angle(&mut self, angle: f64) {
        self.angle = angle;
        self.pose = Pose::new(self.centre, angle, self.cog);
    }

    /// Whether contacts can move it.
    pub fn is_dynamic(&self) -> bool {
        self.inverse_mass != 0.0
    }

    /// Moves along for `dt` seconds.
    pub fn integrate_position(&mut self, dt: f64) {
        self.centre += (self.velocity + self.push) * dt;
        self.set_angle(self.angle + (self.spin + self.push_spin) * dt);
        self.push = Vec2::ZERO;
        self.push_spin = 0.0;
    }

    /// Velocity of the point at `arm` from the centre of gravity.
    pub fn velocity_at(&self, arm: Vec2) -> Vec2 {
        self.velocity + arm.perp() * self.spin
    }

    /// As [`Body::velocity_at`], of the part that pushes overlapping shapes apart.
    pub fn push_at(&self, arm: Vec2) -> Vec2 {
        self.push + arm.perp() * self.push_spin
    }

    /// Changes the velocity by an impulse at `arm` from the centre of gravity.
    pub fn apply_impulse(&mut self, impulse: Vec2, arm: Vec2) {
        self.velocity += impulse * self.inverse_mass;
        self.spin += self.inverse_inertia * arm.cross(impulse);
    }

    /// As [`Body::apply_impulse`], of the part that pushes overlapping shapes apart.
    pub fn apply_push(&mut self, impulse: Vec2, arm: Vec2) {
        self.push += impulse * self.inverse_mass;
        self.push_spin += self.inverse_inertia * arm.cross(impulse);
    }

    /// How much speed along `n` a unit impulse along `n` at `arm` brings.
    pub fn response(&self, arm: Vec2, n: Vec2) -> f64 {
        let turn = arm.cross(n);
        self.inverse_mass + self.inverse_inertia * turn * turn
    }
}
