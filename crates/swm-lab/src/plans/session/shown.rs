//! What a plan session shows: its frame, its goal, its tree, and a plan.

use super::{Mode, PlanSession, text};
use crate::plans::messages::Reply;
use crate::plans::tree;
use crate::session::Frame;
use serde_json::{Value, json};
use std::sync::Arc;
use swm_core::{Result, columns};

/// Elements of a state that the page receives.
const MOST_STATE: usize = 32;

impl PlanSession<'_> {
    pub(super) fn send_plan(&self, plan: &str) {
        let node = self.tree.node().id;
        self.out.send(format!(r#"{{"type":"planned","node":{node},"plan":{plan}}}"#));
    }

    pub(super) fn send_tree(&self) {
        self.out.send(text(&Reply::Tree {
            nodes: self.tree.nodes(),
            present: self.tree.node().id,
            bytes: self.tree.bytes(),
            most_nodes: tree::MOST_NODES,
            most_bytes: tree::MOST_BYTES,
        }));
    }

    /// Sends the frame of the goal, if the environment can render it.
    pub(super) fn send_goal(&mut self) {
        if let Ok(jpeg) = self.scratch.image(self.tree.snapshot(), true, self.setup.side) {
            self.out.reply(&Reply::Goal { jpeg });
        }
    }

    /// Puts the present frame into the slot.
    pub(super) fn send_frame(&mut self) -> Result<()> {
        self.number += 1;
        let header = self.header()?.to_string();
        let mut bytes = u32::try_from(header.len()).unwrap_or_default().to_le_bytes().to_vec();
        bytes.extend(header.as_bytes());
        let snapshot = self.tree.snapshot();
        self.scratch.render(snapshot, false, self.setup.side, &mut bytes)?;
        self.out.frames.send_replace(Arc::new(Frame { bytes }));
        Ok(())
    }

    /// What the page shows beside the frame.
    fn header(&self) -> Result<Value> {
        let mut state = self.world.pool().infos().row(0).to_f64(columns::STATE)?;
        state.truncate(MOST_STATE);
        let node = self.tree.node();
        let factors = self.world.pool().env(0).factors();
        let factors: serde_json::Map<String, Value> =
            factors.iter().map(|(key, value)| (key.to_owned(), json!(value))).collect();
        Ok(json!({
            "number": self.number,
            "node": node.id,
            "step": node.step,
            "reward": node.reward,
            "total": node.total,
            "distance": node.distance,
            "success": node.success,
            "ended": node.ended,
            "playing": self.mode != Mode::Paused,
            "searching": self.is_searching,
            "left": self.left,
            "state": state,
            "factors": factors,
        }))
    }
}
