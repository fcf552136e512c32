//! [`Episode`]: the inputs that determine the state of a Gymnasium environment, and their encoding as a snapshot.

use crate::dataset_start::GoalFrame;
use swm_core::Snapshot;

/// The inputs of an episode so far.
pub(crate) struct Episode {
    /// The arguments of its reset, as JSON.
    pub reset: String,
    /// The frame of its goal, if the episode starts at a dataset row and the dataset has frames.
    pub goal: Option<GoalFrame>,
    /// The bytes of its actions, concatenated.
    pub actions: Vec<u8>,
}

impl Episode {
    /// The snapshot of an episode of the environment `id`; `None` before the first reset.
    pub fn snapshot(episode: Option<&Self>, id: &str) -> Snapshot {
        let mut bytes = format!("{id}\n").into_bytes();
        if let Some(Self { reset, goal, actions }) = episode {
            let ([height, width], rgb) = goal.as_ref().map_or(([0, 0], &[][..]), |goal| (goal.size, &goal.rgb));
            bytes.extend(format!("{reset}\n{height} {width}\n").bytes());
            bytes.extend(rgb);
            bytes.extend(actions);
        }
        Snapshot(bytes)
    }

    /// Parses a snapshot of the environment `id`, whose actions have `action_bytes` bytes; `None` for another snapshot.
    pub fn parse(snapshot: &Snapshot, id: &str, action_bytes: usize) -> Option<Self> {
        let (snapshot_id, rest) = line(&snapshot.0)?;
        let (reset, rest) = line(rest)?;
        let (size, rest) = line(rest)?;
        let (height, width) = size.split_once(' ')?;
        let size: [usize; 2] = [height.parse().ok()?, width.parse().ok()?];
        let (rgb, actions) = rest.split_at_checked(size[0].checked_mul(size[1])?.checked_mul(3)?)?;
        let goal = (!rgb.is_empty()).then(|| GoalFrame { size, rgb: rgb.to_vec() });
        (snapshot_id == id && actions.len().is_multiple_of(action_bytes)).then(|| Self {
            reset,
            goal,
            actions: actions.to_vec(),
        })
    }
}

/// Splits off the first line.
fn line(bytes: &[u8]) -> Option<(String, &[u8])> {
    let end = bytes.iter().position(|&byte| byte == b'\n')?;
    Some((String::from_utf8(bytes[..end].to_vec()).ok()?, &bytes[end + 1..]))
}
