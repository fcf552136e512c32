//! Vectors of three values, and rotations.

/// A point, direction or colour.
pub type V3 = [f32; 3];

/// The identity rotation.
pub const IDENTITY: [f32; 9] = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];

pub(crate) fn add(a: V3, b: V3) -> V3 {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

pub(crate) fn sub(a: V3, b: V3) -> V3 {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

pub(crate) fn scale(a: V3, by: f32) -> V3 {
    [a[0] * by, a[1] * by, a[2] * by]
}

pub(crate) fn dot(a: V3, b: V3) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(crate) fn cross(a: V3, b: V3) -> V3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

pub(crate) fn length(a: V3) -> f32 {
    dot(a, a).sqrt()
}

/// Scales a vector to length 1; the zero vector stays zero.
pub(crate) fn unit(a: V3) -> V3 {
    let length = length(a);
    if length > 0.0 { scale(a, 1.0 / length) } else { [0.0; 3] }
}

/// Returns a unit vector perpendicular to a unit vector.
pub(crate) fn across(a: V3) -> V3 {
    let helper = if a[0].abs() < 0.9 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] };
    unit(cross(a, helper))
}

/// Rotates a local vector into the world. Rotations are `[3, 3]` row-major; their columns are the local axes.
pub(crate) fn rotate(by: &[f32; 9], a: V3) -> V3 {
    [
        by[0] * a[0] + by[1] * a[1] + by[2] * a[2],
        by[3] * a[0] + by[4] * a[1] + by[5] * a[2],
        by[6] * a[0] + by[7] * a[1] + by[8] * a[2],
    ]
}

/// Rotates a world vector into local axes.
pub(crate) fn unrotate(by: &[f32; 9], a: V3) -> V3 {
    [
        by[0] * a[0] + by[3] * a[1] + by[6] * a[2],
        by[1] * a[0] + by[4] * a[1] + by[7] * a[2],
        by[2] * a[0] + by[5] * a[1] + by[8] * a[2],
    ]
}
