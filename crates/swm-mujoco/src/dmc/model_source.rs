//! [`ModelSource`]: the MJCF text of a model of the suite, compiled with factors of variation.

use super::model_edit::ModelEdit;
use crate::physics::{COMPILATION_BYTES, compile_spec};
use crate::{assets, link};
use mujoco_rs::wrappers::mj_auxiliary::MjVfs;
use mujoco_rs::wrappers::{MjModel, MjSpec};
use std::path::Path;
use swm_core::{Error, FactorValues, Result};

/// The files that every model of the suite includes.
const COMMON: [&str; 3] = ["./common/materials.xml", "./common/skybox.xml", "./common/visual.xml"];

/// The MJCF text of a model and of the files it includes.
pub struct ModelSource {
    name: &'static str,
    text: String,
    common: Vec<Vec<u8>>,
}

impl ModelSource {
    /// Reads a file of the suite and prepares its text for a task.
    ///
    /// # Errors
    /// When the suite's models are not installed, or are not of the pinned version.
    pub fn read(name: &'static str, prepare: impl FnOnce(String) -> Result<String>) -> Result<Self> {
        let suite = assets::path("dm_control")?.join("dm_control/suite");
        let read = |path: &Path| std::fs::read(path).map_err(|error| Error::io(path, "reading a model", error));
        let text = String::from_utf8_lossy(&read(&suite.join(name))?).into_owned();
        let common = COMMON.iter().map(|file| read(&suite.join(file))).collect::<Result<_>>()?;
        Ok(Self { name, text: prepare(text)?, common })
    }

    /// Compiles the model with factors of variation.
    ///
    /// # Errors
    /// When MuJoCo is not installed or rejects the model, or an edit names an element that the model lacks.
    pub fn compile(
        &self,
        factors: &FactorValues,
        edit: impl FnOnce(&mut ModelEdit<'_>) -> Result<()>,
    ) -> Result<MjModel> {
        link::load_to_compile(COMPILATION_BYTES)?;
        let failed = |error: &dyn std::fmt::Display| Error::external(format!("compiling {}", self.name), error);
        let mut vfs = MjVfs::new();
        for (name, content) in COMMON.iter().zip(&self.common) {
            vfs.add_from_buffer(name, content).map_err(|error| failed(&error))?;
        }
        vfs.add_from_buffer(self.name, self.text.as_bytes()).map_err(|error| failed(&error))?;
        let mut spec = MjSpec::from_xml_vfs(self.name, &vfs).map_err(|error| failed(&error))?;
        edit(&mut ModelEdit::new(&mut spec, factors))?;
        compile_spec(&mut spec).map_err(|error| failed(&error))
    }
}

/// Returns MJCF text without the element of the given tag and name.
///
/// # Errors
/// When there is no such element.
pub fn without_element(text: &str, tag: &str, name: &str) -> Result<String> {
    let missing = || {
        let given = format!("a file without the {tag} '{name}'");
        let expected = "the pinned files (`swm assets verify dm_control` checks them)";
        Error::mismatch("preparing a dm_control suite model", given, expected)
    };
    let begin = text.find(&format!("<{tag} name=\"{name}\"")).ok_or_else(missing)?;
    let (open, close) = (format!("<{tag} "), format!("</{tag}>"));
    let head = begin + text[begin..].find('>').ok_or_else(missing)?;
    let mut end = head + 1;
    // The content may contain elements of the same tag.
    let mut depth = usize::from(!text[..head].ends_with('/'));
    while depth > 0 {
        let closing = end + text[end..].find(&close).ok_or_else(missing)?;
        let opened = text[end..closing].match_indices(&open).filter(|(at, _)| {
            let inner = &text[end + at..closing];
            inner.find('>').is_some_and(|bracket| !inner[..bracket].ends_with('/'))
        });
        depth = depth - 1 + opened.count();
        end = closing + close.len();
    }
    Ok(format!("{}{}", &text[..begin], &text[end..]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn removes_elements_with_their_content() {
        let text = r#"<w><body name="a"><body name="b"><geom/></body><body name="c"/><body name="d"></body></body><body name="e"/></w>"#;
        let without = |tag, name| without_element(text, tag, name).expect("removing an element");
        assert_eq!(without("body", "a"), r#"<w><body name="e"/></w>"#);
        assert_eq!(without("body", "e"), text.replace(r#"<body name="e"/>"#, ""));
        assert_eq!(without("body", "b"), text.replace(r#"<body name="b"><geom/></body>"#, ""));
        assert!(
            without_element(text, "body", "z")
                .expect_err("removing a missing element")
                .to_string()
                .contains("body 'z'")
        );
    }
}
