//! [`Registry`]: one visible list of what there is of a kind. A row holds the id, the constructor and the
//! defaults together, so a family member is added in one place.

use crate::{Error, Result};

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
