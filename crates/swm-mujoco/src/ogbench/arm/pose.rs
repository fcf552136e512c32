//! Rotations and rigid transforms. Quaternions are unit quaternions `[w, x, y, z]`, as in MuJoCo.

/// A position (m) or a direction.
pub type Vec3 = [f64; 3];
/// A rotation.
pub type Quat = [f64; 4];

/// The identity rotation.
pub const IDENTITY: Quat = [1.0, 0.0, 0.0, 0.0];

/// `a + b`.
pub fn add(a: Vec3, b: Vec3) -> Vec3 {
    std::array::from_fn(|i| a[i] + b[i])
}

/// `a - b`.
pub fn sub(a: Vec3, b: Vec3) -> Vec3 {
    std::array::from_fn(|i| a[i] - b[i])
}

/// `by * a`.
pub fn scale(a: Vec3, by: f64) -> Vec3 {
    a.map(|v| v * by)
}

/// The cross product.
pub fn cross(a: Vec3, b: Vec3) -> Vec3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// The Euclidean norm of a vector of any length.
pub fn norm(a: &[f64]) -> f64 {
    a.iter().map(|v| v * v).sum::<f64>().sqrt()
}

/// The Euclidean distance of two points, in metres.
pub fn distance(a: Vec3, b: Vec3) -> f64 {
    norm(&sub(a, b))
}

/// The quaternion product: rotation by `b`, then by `a`.
pub fn mul(a: Quat, b: Quat) -> Quat {
    [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]
}

/// The inverse rotation.
pub fn inverse(q: Quat) -> Quat {
    [q[0], -q[1], -q[2], -q[3]]
}

/// The quaternion scaled to length 1.
pub fn normalized(q: Quat) -> Quat {
    q.map(|v| v / norm(&q))
}

/// Rotates a vector.
pub fn rotate(q: Quat, v: Vec3) -> Vec3 {
    let (w, u) = (q[0], [q[1], q[2], q[3]]);
    let t = scale(cross(u, v), 2.0);
    add(add(v, scale(t, w)), cross(u, t))
}

/// The rotation by `angle` (rad) about a unit axis.
pub fn about(axis: Vec3, angle: f64) -> Quat {
    let (sin, cos) = (angle / 2.0).sin_cos();
    [cos, axis[0] * sin, axis[1] * sin, axis[2] * sin]
}

/// The rotation by `angle` (rad) about the vertical.
pub fn about_z(angle: f64) -> Quat {
    about([0.0, 0.0, 1.0], angle)
}

/// The rotation vector: the axis times the angle (rad), which is at most π.
pub fn log(q: Quat) -> Vec3 {
    let (w, u) = (q[0], [q[1], q[2], q[3]]);
    let sin = norm(&u);
    if sin == 0.0 {
        return [0.0; 3];
    }
    let angle = wrap(2.0 * sin.atan2(w));
    scale(u, angle / sin)
}

/// The yaw (rad) of a rotation, in the decomposition into roll, pitch and yaw.
pub fn yaw(q: Quat) -> f64 {
    (2.0 * (q[0] * q[3] + q[1] * q[2])).atan2(1.0 - 2.0 * (q[2] * q[2] + q[3] * q[3]))
}

/// The [`yaw`] of a row-major rotation matrix.
pub fn yaw_of_matrix(m: &[f64; 9]) -> f64 {
    m[3].atan2(m[0])
}

/// The equivalent angle in [-π, π].
pub fn wrap(angle: f64) -> f64 {
    use std::f64::consts::{PI, TAU};
    let wrapped = (angle + PI).rem_euclid(TAU) - PI;
    if wrapped == -PI && angle > 0.0 { PI } else { wrapped }
}

/// A position and an orientation, or the rigid transform to them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// The position, in metres.
    pub position: Vec3,
    /// The orientation.
    pub rotation: Quat,
}

impl Pose {
    /// Composes transforms: converts the pose `inner` from the frame of `self` to the parent frame of `self`.
    pub fn then(self, inner: Self) -> Self {
        Self {
            position: add(self.position, rotate(self.rotation, inner.position)),
            rotation: mul(self.rotation, inner.rotation),
        }
    }

    /// The inverse transform.
    pub fn inverse(self) -> Self {
        let rotation = inverse(self.rotation);
        Self { position: scale(rotate(rotation, self.position), -1.0), rotation }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    fn close(a: &[f64], b: &[f64]) -> bool {
        a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12)
    }

    #[test]
    fn rotations_compose_and_invert() {
        let (a, b) = (about([0.6, 0.0, 0.8], 1.1), about([0.0, 1.0, 0.0], -2.3));
        let v = [0.3, -0.2, 0.9];
        assert!(close(&rotate(mul(a, b), v), &rotate(a, rotate(b, v))));
        let pose = Pose { position: [1.0, 2.0, 3.0], rotation: a };
        let home = pose.then(pose.inverse());
        assert!(close(&home.position, &[0.0; 3]) && close(&home.rotation, &IDENTITY));
        assert!(close(&log(b), &[0.0, -2.3, 0.0]));
        assert!(close(&log(about([1.0, 0.0, 0.0], 4.0)), &[4.0 - 2.0 * PI, 0.0, 0.0]));
        assert_eq!(log(IDENTITY), [0.0; 3]);
    }

    #[test]
    fn yaw_is_the_rotation_about_the_vertical() {
        for angle in [-3.0, -0.4, 0.0, 1.2, 3.1] {
            let down = mul(about_z(angle), [0.0, 1.0, 0.0, 0.0]);
            assert!((yaw(about_z(angle)) - angle).abs() < 1e-12);
            assert!((yaw(down) - angle).abs() < 1e-12, "{} for {angle}", yaw(down));
            let x = rotate(down, [1.0, 0.0, 0.0]);
            assert!((yaw_of_matrix(&[x[0], 0.0, 0.0, x[1], 0.0, 0.0, x[2], 0.0, 0.0]) - angle).abs() < 1e-12);
        }
        assert_eq!(wrap(0.5 + 4.0 * PI), 0.5 + 4.0 * PI - 4.0 * PI);
        assert_eq!(wrap(PI), PI);
    }
}
