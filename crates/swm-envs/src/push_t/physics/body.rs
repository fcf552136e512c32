//! Rigid bodies: pose, velocity, mass and moment of inertia.

use super::vec2::Vec2;
use bytemuck::{Pod, Zeroable};

/// A rotation about the origin followed by a translation.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Pose {
    /// Cosine and sine of the angle, as x and y.
    rotation: Vec2,
    /// The position of the origin after the transformation, in table coordinates.
    pub origin: Vec2,
}

impl Pose {
    /// Makes the pose of a body whose centre of gravity `cog` (in body coordinates) is at `position`; `angle` in
    /// radians.
    pub fn new(position: Vec2, angle: f64, cog: Vec2) -> Self {
        let (sin, cos) = angle.sin_cos();
        let rotated = Vec2::new(cog.x * cos - cog.y * sin, cog.x * sin + cog.y * cos);
        Self { rotation: Vec2::new(cos, sin), origin: position - rotated }
    }

    /// Converts a direction from body to table coordinates.
    pub fn direction(&self, v: Vec2) -> Vec2 {
        let Vec2 { x: cos, y: sin } = self.rotation;
        Vec2::new(cos * v.x - sin * v.y, sin * v.x + cos * v.y)
    }

    /// Converts a point from body to table coordinates.
    pub fn point(&self, p: Vec2) -> Vec2 {
        self.direction(p) + self.origin
    }
}

/// A rigid body. Lengths are in pixels, velocities in pixels and radians per second; dynamic bodies have mass 1.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Body {
    /// The centre of gravity, in table coordinates.
    pub centre: Vec2,
    /// The angle in radians, not wrapped.
    pub angle: f64,
    /// The velocity of the centre of gravity.
    pub velocity: Vec2,
    /// The angular velocity in radians per second, from x towards y.
    pub angular_velocity: f64,
    /// The bias velocity, which separates overlapping shapes; it acts in one step only.
    pub bias_velocity: Vec2,
    /// The angular bias velocity, which separates overlapping shapes; it acts in one step only.
    pub bias_angular_velocity: f64,
    /// 1 / mass; 0 for static and kinematic bodies.
    pub inverse_mass: f64,
    /// 1 / moment of inertia; 0 for static and kinematic bodies.
    pub inverse_inertia: f64,
    /// The centre of gravity, in body coordinates.
    pub cog: Vec2,
    /// The transformation from body to table coordinates.
    pub pose: Pose,
}

impl Body {
    /// Makes a body at the origin; `mass` and `inertia` may be infinite.
    pub fn new(mass: f64, inertia: f64, cog: Vec2) -> Self {
        Self {
            centre: Vec2::ZERO,
            angle: 0.0,
            velocity: Vec2::ZERO,
            angular_velocity: 0.0,
            bias_velocity: Vec2::ZERO,
            bias_angular_velocity: 0.0,
            inverse_mass: 1.0 / mass,
            inverse_inertia: 1.0 / inertia,
            cog,
            pose: Pose::new(Vec2::ZERO, 0.0, Vec2::ZERO),
        }
    }

    /// The position of the body's origin, which is not its centre of gravity.
    pub fn position(&self) -> Vec2 {
        self.pose.origin
    }

    /// Moves the body's origin to a position.
    pub fn set_position(&mut self, position: Vec2) {
        self.centre = self.pose.direction(self.cog) + position;
        self.pose = Pose::new(self.centre, self.angle, self.cog);
    }

    /// Rotates the body about its centre of gravity to an angle in radians.
    pub fn set_angle(&mut self, angle: f64) {
        self.angle = angle;
        self.pose = Pose::new(self.centre, angle, self.cog);
    }

    /// Returns whether contacts can move the body.
    pub fn is_dynamic(&self) -> bool {
        self.inverse_mass != 0.0
    }

    /// Moves the body with its velocities for `dt` seconds.
    pub fn integrate_position(&mut self, dt: f64) {
        self.centre += (self.velocity + self.bias_velocity) * dt;
        self.set_angle(self.angle + (self.angular_velocity + self.bias_angular_velocity) * dt);
        self.bias_velocity = Vec2::ZERO;
        self.bias_angular_velocity = 0.0;
    }

    /// Returns the velocity of the point at `arm` from the centre of gravity.
    pub fn velocity_at(&self, arm: Vec2) -> Vec2 {
        self.velocity + arm.perp() * self.angular_velocity
    }

    /// Returns the bias velocity of the point at `arm` from the centre of gravity.
    pub fn bias_velocity_at(&self, arm: Vec2) -> Vec2 {
        self.bias_velocity + arm.perp() * self.bias_angular_velocity
    }

    /// Applies an impulse at `arm` from the centre of gravity.
    pub fn apply_impulse(&mut self, impulse: Vec2, arm: Vec2) {
        self.velocity += impulse * self.inverse_mass;
        self.angular_velocity += self.inverse_inertia * arm.cross(impulse);
    }

    /// Applies an impulse at `arm` from the centre of gravity to the bias velocity.
    pub fn apply_bias_impulse(&mut self, impulse: Vec2, arm: Vec2) {
        self.bias_velocity += impulse * self.inverse_mass;
        self.bias_angular_velocity += self.inverse_inertia * arm.cross(impulse);
    }

    /// Returns the change of speed along `n` that a unit impulse along `n` at `arm` causes (the inverse effective
    /// mass).
    pub fn response(&self, arm: Vec2, n: Vec2) -> f64 {
        let lever = arm.cross(n);
        self.inverse_mass + self.inverse_inertia * lever * lever
    }
}
