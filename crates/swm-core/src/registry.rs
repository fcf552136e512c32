//! [`Registry`]: one visible list of what there is of a kind. A row holds the id, the constructor and the
//! defaults together, so a family member is added in one place.

use crate::policy::Expert;
use crate::{Env, Error, Result};

/// A row of a registry.
pub trait Named {
    /// The id users type.
    fn id(&self) -> &'static str;
}

/// A list of rows with unique ids.
#[derive(Clone, Copy)]
pub struct Registry<T: 'static> {
    /// What the rows are, for messages: "environment".
    pub kind: &'static str,
    /// What lists them, for messages: "`swm envs` lists them".
    pub hint: &'static str,
    /// The rows.
    pub rows: &'static [T],
}

impl<T: Named> Registry<T> {
    /// The row of an id.
    ///
    /// # Errors
    /// When there is none; names the nearest.
    pub fn get(&self, id: &str) -> Result<&'static T> {
        self.rows
            .iter()
            .find(|row| row.id() == id)
            .ok_or_else(|| Error::unknown(self.kind, id, self.rows.iter().map(Named::id), self.hint))
    }
}

/// An environment that can be made.
pub struct EnvEntry {
    /// Its id, such as `swm/PushT-v1`.
    pub id: &'static str,
    /// What one does there, in a sentence.
    pub summary: &'static str,
    /// Makes one.
    pub make: fn() -> Box<dyn Env>,
    /// Who can demonstrate it; the first is the default expert.
    pub experts: &'static [ExpertEntry],
}

impl Named for EnvEntry {
    fn id(&self) -> &'static str {
        self.id
    }
}

/// A scripted policy that can be made.
pub struct ExpertEntry {
    /// Its name, such as `expert` or `weak`.
    pub id: &'static str,
    /// How it acts, in a sentence.
    pub summary: &'static str,
    /// Makes one, for one environment.
    pub make: fn() -> Box<dyn Expert>,
}

impl Named for ExpertEntry {
    fn id(&self) -> &'static str {
        self.id
    }
}
