//! [`Arm`]: the plane geometry of the manipulator's arm, for its scripted expert. Positions are x and z in metres.

use std::f64::consts::{FRAC_1_SQRT_2, PI};

/// A position or a velocity in the plane.
pub type Point = [f64; 2];
/// The angles of root, shoulder, elbow and wrist, in radians.
pub type Angles = [f64; 4];

/// The root of the arm.
const ROOT: Point = [0.0, 0.4];
/// The lengths of the second and the third link.
const LINKS: [f64; 2] = [0.15, 0.12];
/// The distance from the wrist to the point between the fingers that is brought to the ball.
const GRASP: f64 = 0.082;
/// The largest angles of shoulder, elbow and wrist, with a margin.
const LIMITS: [f64; 3] = [2.74, 2.74, 2.39];
/// Half of the thickness of a link.
const THICKNESS: f64 = 0.02;
/// The distance between the axes of the hand and of the first two links at which they nearly touch.
const HAND_CLEARANCE: f64 = 0.075;
/// Clearances below this cost as much as turning the arm.
const MARGIN: f64 = 0.03;
/// The angles of the wrist that [`Arm::reach`] tries.
const WRISTS: usize = 23;

/// An arm, whose first link can have other lengths (a factor of variation).
#[derive(Clone, Copy)]
pub struct Arm {
    /// The length of the first link.
    pub upper: f64,
}

/// Where a configuration puts the arm.
pub struct Pose {
    /// Root, shoulder, elbow, wrist, and the point of the grasp.
    pub points: [Point; 5],
    /// The direction of the hand: 0 is up, π down.
    pub hand: f64,
}

/// The hand directions that [`Arm::reach`] tries: `count` of them, at most `spread` from `centre`, in radians.
#[derive(Clone, Copy)]
pub struct Directions {
    /// The direction in the middle.
    pub centre: f64,
    /// The largest difference from it.
    pub spread: f64,
    /// The number of directions.
    pub count: usize,
    /// The cost of a squared radian from the centre, relative to turning the root by a radian.
    pub weight: f64,
}

/// The direction of a link that is turned by `angle` from upright.
fn direction(angle: f64) -> Point {
    [-angle.sin(), angle.cos()]
}

/// Returns `a + factor * b`.
pub fn add(a: Point, b: Point, factor: f64) -> Point {
    [a[0] + factor * b[0], a[1] + factor * b[1]]
}

/// Returns `a - b`.
pub fn difference(a: Point, b: Point) -> Point {
    add(a, b, -1.0)
}

/// Returns the length of a vector.
pub fn length([x, z]: Point) -> f64 {
    x.hypot(z)
}

/// Returns the angle in -π .. π.
pub fn wrapped(angle: f64) -> f64 {
    (angle + PI).rem_euclid(2.0 * PI) - PI
}

/// `count` values from `-spread` to `spread`.
fn values(spread: f64, count: usize) -> impl Iterator<Item = f64> {
    (0..count).map(move |i| spread * (2.0 * i as f64 / (count - 1) as f64 - 1.0))
}

/// The distance of a point from the floor or the next of the two walls, which lean outwards by 45 degrees.
fn above_ground([x, z]: Point) -> f64 {
    z.min((0.4 + x + z) * FRAC_1_SQRT_2).min((0.4 - x + z) * FRAC_1_SQRT_2)
}

/// The distance of a point from a segment.
fn from_segment(point: Point, [from, to]: [Point; 2]) -> f64 {
    let (along, offset) = (difference(to, from), difference(point, from));
    let part = (along[0] * offset[0] + along[1] * offset[1]) / (along[0] * along[0] + along[1] * along[1]);
    length(add(offset, along, -part.clamp(0.0, 1.0)))
}

impl Arm {
    /// Returns the arm whose first link ends where the wrist is, given the other angles.
    pub fn with_wrist(angles: Angles, wrist: Point) -> Self {
        let without = Self { upper: 0.0 }.pose(angles).points[3];
        let (along, rest) = (direction(angles[0]), difference(wrist, without));
        Self { upper: along[0] * rest[0] + along[1] * rest[1] }
    }

    /// Returns where the arm is with these angles.
    pub fn pose(self, angles: Angles) -> Pose {
        let (mut points, mut hand) = ([ROOT; 5], 0.0);
        for (i, length) in [self.upper, LINKS[0], LINKS[1], GRASP].into_iter().enumerate() {
            hand += angles[i];
            points[i + 1] = add(points[i], direction(hand), length);
        }
        Pose { points, hand }
    }

    /// Searches angles that put the grasp at `goal`: those that turn the arm from `from` the least, away from the ground and from the arm
    /// itself. `None` if the goal is out of reach.
    pub fn reach(self, goal: Point, from: Angles, directions: Directions) -> Option<Angles> {
        let mut best = (f64::INFINITY, None);
        for turn in values(directions.spread, directions.count) {
            let hand = directions.centre + turn;
            let wrist = add(goal, direction(hand), -GRASP);
            for bend in values(2.2, WRISTS) {
                let elbow = difference(add(wrist, direction(hand - bend), -LINKS[1]), ROOT);
                for angles in self.two_links(elbow, hand, bend).into_iter().flatten() {
                    let [mut root, shoulder, elbow, wrist] = std::array::from_fn(|i| angles[i] - from[i]);
                    root = wrapped(root);
                    let turned = root.abs() + 0.8 * shoulder.abs() + 0.5 * elbow.abs() + 0.3 * wrist.abs();
                    let short = (MARGIN - self.clearance(angles)).max(0.0);
                    let cost = turned + 3.0 * directions.weight * turn * turn + 30.0 * short;
                    if short < 2.0 * MARGIN && cost < best.0 {
                        best = (cost, Some([from[0] + root, angles[1], angles[2], angles[3]]));
                    }
                }
            }
        }
        best.1
    }

    /// The angles that put the end of the second link at `elbow`, relative to the root, and then the hand in a direction with the wrist bent by
    /// `bend`: one for each side on which the shoulder can be, within the limits of the joints.
    fn two_links(self, elbow: Point, hand: f64, bend: f64) -> [Option<Angles>; 2] {
        let ([second, _], distance) = (LINKS, length(elbow));
        let cos = (distance * distance - self.upper * self.upper - second * second) / (2.0 * self.upper * second);
        [1.0, -1.0].map(|side| {
            let shoulder = side * cos.clamp(-1.0, 1.0).acos();
            let root =
                (-elbow[0]).atan2(elbow[1]) - (second * shoulder.sin()).atan2(self.upper + second * shoulder.cos());
            let angles = [root, shoulder, wrapped(hand - bend - root - shoulder), bend];
            let is_within = angles[1..].iter().zip(LIMITS).all(|(angle, limit)| angle.abs() < limit);
            (cos.abs() <= 1.0 && is_within).then_some(angles)
        })
    }

    /// The distance that is left between the arm and the ground, or between the hand and the rest of the arm.
    fn clearance(self, angles: Angles) -> f64 {
        let Pose { points: [root, shoulder, elbow, wrist, _], hand } = self.pose(angles);
        let ground = above_ground(elbow).min(above_ground(wrist)) - THICKNESS;
        let along = |distance: f64| add(wrist, direction(hand), distance);
        let upper = [0.0, 0.05, 0.1].map(|distance| from_segment(along(distance), [root, shoulder]));
        let middle = [0.05, 0.1].map(|distance| from_segment(along(distance), [shoulder, elbow]));
        let apart = upper.into_iter().chain(middle).fold(f64::INFINITY, f64::min) - HAND_CLEARANCE;
        // The arm must not be in the ground, but the hand may come closer to the arm than it should.
        if ground < 0.0 { -MARGIN } else { ground.min(apart) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reached_goals_are_at_the_grasp_and_the_first_link_is_found() {
        let arm = Arm { upper: 0.2 };
        let from = [0.5, -1.0, 0.3, 0.2];
        assert!((Arm::with_wrist(from, arm.pose(from).points[3]).upper - 0.2).abs() < 1e-12);
        let down = Directions { centre: PI, spread: 1.2, count: 17, weight: 0.3 };
        for goal in [[0.0, 0.05], [0.3, 0.13], [-0.38, 0.1], [0.2, 0.4]] {
            let angles = arm.reach(goal, from, down).expect("a goal within reach");
            let pose = arm.pose(angles);
            assert!(length(difference(pose.points[4], goal)) < 1e-9, "{goal:?}");
            assert!(wrapped(pose.hand - PI).abs() < 1.3 && (angles[0] - from[0]).abs() <= PI);
        }
        assert!(arm.reach([1.0, 0.1], from, down).is_none());
    }
}
