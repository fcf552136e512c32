//! Contacts between shapes, and the impulses that are carried over from step to step.

use super::body::Body;
use super::vec2::Vec2;
use bytemuck::{Pod, Zeroable};

/// A point at which two shapes touch.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
pub struct Contact {
    /// Lever arms: from the centre of gravity of each body to the surface of its shape, in pixels.
    pub arms: [Vec2; 2],
    /// A hash that identifies the contact in the next step.
    pub hash: u64,
    /// The accumulated normal impulse, in mass × pixels per second.
    pub impulse: f64,
    /// The accumulated impulse of this step that separates overlapping shapes, in mass × pixels per second.
    pub bias_impulse: f64,
    /// The speed at which the overlap is removed, in pixels per second.
    pub bias_speed: f64,
    /// The effective mass along the normal.
    pub mass: f64,
}

/// The contacts of two touching shapes (Chipmunk's arbiter).
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub struct Arbiter {
    /// Unit vector from the first shape to the second.
    pub normal: Vec2,
    /// The contacts; the first `count` are valid.
    pub contacts: [Contact; 2],
    /// The number of contacts.
    pub count: u32,
    /// Indices of the two shapes.
    pub shapes: [u32; 2],
    /// Indices of the bodies of the two shapes.
    pub bodies: [u32; 2],
    /// The last step in which the shapes touched.
    pub stamp: u32,
    /// 1 if the shapes did not touch in the last step, so that no impulses exist for a warm start.
    pub is_new: u32,
    /// 1 if the shapes touched in an earlier step and no longer touch.
    pub separated: u32,
}

impl Arbiter {
    /// The contacts.
    pub fn contacts(&self) -> &[Contact] {
        &self.contacts[..self.count as usize]
    }

    /// The contacts, mutable.
    pub fn contacts_mut(&mut self) -> &mut [Contact] {
        &mut self.contacts[..self.count as usize]
    }

    /// Indices of the two bodies.
    pub fn bodies(&self) -> [usize; 2] {
        [self.bodies[0] as usize, self.bodies[1] as usize]
    }

    /// Applies the impulses of the last step, unless the contacts are new.
    pub fn warm_start(&self, bodies: &mut [Body; 3]) {
        if self.is_new != 0 {
            return;
        }
        let [a, b] = self.bodies();
        for contact in self.contacts() {
            let impulse = self.normal * contact.impulse;
            bodies[a].apply_impulse(-impulse, contact.arms[0]);
            bodies[b].apply_impulse(impulse, contact.arms[1]);
        }
    }

    /// Runs one round of sequential impulses.
    pub fn solve(&mut self, bodies: &mut [Body; 3]) {
        let n = self.normal;
        let [a, b] = self.bodies();
        for contact in self.contacts_mut() {
            let [arm_a, arm_b] = contact.arms;
            let bias_speed = (bodies[b].bias_velocity_at(arm_b) - bodies[a].bias_velocity_at(arm_a)).dot(n);
            let speed = (bodies[b].velocity_at(arm_b) - bodies[a].velocity_at(arm_a)).dot(n);

            let bias_impulse = (contact.bias_impulse + (contact.bias_speed - bias_speed) * contact.mass).max(0.0);
            let impulse = (contact.impulse + -speed * contact.mass).max(0.0);
            let more_bias = n * (bias_impulse - contact.bias_impulse);
            let more = n * (impulse - contact.impulse);
            (contact.bias_impulse, contact.impulse) = (bias_impulse, impulse);

            bodies[a].apply_bias_impulse(-more_bias, arm_a);
            bodies[b].apply_bias_impulse(more_bias, arm_b);
            bodies[a].apply_impulse(-more, arm_a);
            bodies[b].apply_impulse(more, arm_b);
        }
    }
}
