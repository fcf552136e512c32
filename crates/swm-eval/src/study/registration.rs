//! Registering a study before it has results: the hash of all that it decides.

use super::cell::{Study, hash};
use super::folder::{MAX_BYTES, StudyFolder, json};
use serde::{Deserialize, Serialize};
use swm_core::files::{self, Lock};
use swm_core::results::Registration;
use swm_core::{Error, Result};

/// The name of the file with the registration.
const REGISTRATION: &str = "registration.json";

/// The content of the file.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Registered {
    /// The title of the study, for readers.
    title: String,
    /// The number of cells, for readers.
    cells: usize,
    /// The hash.
    registered: String,
    /// What the clock of the machine showed, in UTC. Anybody can set a clock and edit this file: only a published hash proves a date.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    unproven_date: Option<String>,
}

impl Study {
    /// The hash of all that decides the results and what they are taken to say: the question, the cells with their inputs and
    /// names, and the families. Published values and the command that made the study are left out.
    ///
    /// # Errors
    /// When a request cannot be written as JSON.
    pub fn registration_hash(&self) -> Result<String> {
        hash(&Self { published: vec![], arguments: vec![], ..self.clone() })
    }
}

impl StudyFolder {
    /// Registers a study that has no results yet, at a date that a clock showed. A study that is registered already keeps its date.
    /// Keeps other writers away until the lock is dropped.
    ///
    /// # Errors
    /// When a cell is done, the folder has a damaged registration, or as [`StudyFolder::create`].
    pub fn register(&self, study: &Study, date: &str) -> Result<(Lock, Registration)> {
        let lock = self.create(study)?;
        let cells = self.root.join("cells");
        let io = |error| Error::io(&cells, "reading the folder", error);
        if std::fs::read_dir(&cells).map_err(io)?.next().is_some() {
            let fix = "register a study in an empty folder, before its first run";
            return Err(Error::config(self.root.display().to_string(), "has results already", fix));
        }
        if let Some(found) = self.registration(study)?.filter(|found| found.is_same && found.date.is_some()) {
            return Ok((lock, found));
        }
        let found = Registration { hash: study.registration_hash()?, is_same: true, date: Some(date.to_owned()) };
        let content = Registered {
            title: study.title.clone(),
            cells: study.cells.len(),
            registered: found.hash.clone(),
            unproven_date: found.date.clone(),
        };
        files::write(&self.root.join(REGISTRATION), &json(&content)?)?;
        Ok((lock, found))
    }

    /// The registration of the study in this folder; `None` if it was not registered.
    ///
    /// # Errors
    /// When the file is damaged.
    pub(super) fn registration(&self, study: &Study) -> Result<Option<Registration>> {
        let path = self.root.join(REGISTRATION);
        if !path.exists() {
            return Ok(None);
        }
        let fix = "restore the file, or remove it: the study then counts as not registered";
        let found: Registered = serde_json::from_slice(&files::read(&path, MAX_BYTES)?)
            .map_err(|error| Error::corrupt(&path, format!("is not a registration ({error})"), fix))?;
        if found.unproven_date.as_ref().is_some_and(|date| !is_date(date)) {
            return Err(Error::corrupt(&path, "unproven_date is no date, such as 2026-11-24T01:02:03Z", fix));
        }
        let is_same = found.registered == study.registration_hash()?;
        Ok(Some(Registration { hash: found.registered, is_same, date: found.unproven_date }))
    }
}

/// Whether a text has the form of a date that [`StudyFolder::register`] stores: `2026-11-24T01:02:03Z`.
fn is_date(text: &str) -> bool {
    let form = text.bytes().map(|byte| if byte.is_ascii_digit() { b'0' } else { byte });
    let number = |from: usize| text.get(from..from + 2).and_then(|digits| digits.parse().ok()).unwrap_or(u8::MAX);
    form.eq(*b"0000-00-00T00:00:00Z")
        && (1..=12).contains(&number(5))
        && (1..=31).contains(&number(8))
        && number(11) < 24
        && number(14) < 60
        && number(17) < 60
}
