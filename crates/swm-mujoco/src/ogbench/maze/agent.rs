//! The agents that move through mazes.

/// An agent of OGBench's locomotion environments.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Agent {
    /// A ball that actions displace.
    Point,
    /// An ant with eight joints.
    Ant,
}

impl Agent {
    /// The model file.
    pub fn file(self) -> &'static str {
        match self {
            Self::Point => "point.xml",
            Self::Ant => "ant.xml",
        }
    }

    /// The distance within which the goal is reached, in metres.
    pub fn goal_tolerance(self) -> f64 {
        match self {
            Self::Point => 1.0,
            Self::Ant => 0.5,
        }
    }
}
