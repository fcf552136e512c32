//! The wrappers of frames in the lab: those of the registry that read no files.

use crate::cli::wrappers::WrapperArgs;
use serde_json::{Value, json};
use swm_core::{Env, Error, Origin, Result};
use swm_envs::wrappers::{WRAPPERS, read};
use swm_lab::rendering::Wrapping;

/// The wrappers of this program.
pub struct OwnWrappers;

/// The wrappers of a page as arguments of a command.
fn arguments(wrappers: &[String], wrap_goal: bool) -> Result<WrapperArgs> {
    for text in wrappers {
        let (entry, _) = read(text)?;
        if entry.reads_files() {
            let fix = "give it to a command: swm collect --wrapper";
            return Err(Error::config(
                format!("wrapper '{}'", entry.id),
                "it reads files, which no page may choose",
                fix,
            ));
        }
    }
    Ok(WrapperArgs { wrappers: wrappers.to_vec(), wrap_goal })
}

impl Wrapping for OwnWrappers {
    fn listed(&self) -> Value {
        let rows = WRAPPERS.rows.iter().filter(|row| !row.reads_files());
        let listed = rows.map(|row| {
            let mut described = row.describe();
            described["id"] = json!(row.id);
            described
        });
        listed.collect()
    }

    fn wrap(&self, env: Box<dyn Env>, wrappers: &[String], wrap_goal: bool) -> Result<Box<dyn Env>> {
        let (stack, goal) = arguments(wrappers, wrap_goal)?.stack()?;
        Ok(stack.wrap(env, goal))
    }

    fn manifest(&self, wrappers: &[String]) -> Result<Value> {
        Ok(json!(arguments(wrappers, false)?.choices(&Origin::User)?))
    }
}
