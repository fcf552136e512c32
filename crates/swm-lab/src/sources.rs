//! Datasets beside the folders: those at URIs that the lab was started with. As in [`crate::folders`], a name is looked up in a listing, so
//! that no request reaches another URI. Work in each source has a limit of its own, so that a store that does not answer delays no
//! other request.

use crate::folders::MOST;
use std::sync::{Arc, Mutex, PoisonError};
use swm_core::{Error, Result};
use swm_data::{FORMATS, Location, objects};
use tokio::sync::Semaphore;

/// Requests that read a source at the same time; others wait.
const AT_ONCE: usize = 4;

/// One dataset, or a prefix whose children are datasets.
pub struct Source {
    location: Location,
    /// The name of the dataset; `None` for a prefix.
    name: Option<String>,
    /// The datasets of a prefix that were listed last.
    listed: Mutex<Vec<String>>,
    work: Arc<Semaphore>,
}

impl Source {
    /// The dataset at a location.
    pub fn dataset(location: Location, name: &str) -> Self {
        Self {
            location,
            name: Some(name.to_owned()),
            listed: Mutex::default(),
            work: Arc::new(Semaphore::new(AT_ONCE)),
        }
    }

    /// What a URI names: a dataset if it has the suffix of a format, else a prefix.
    ///
    /// # Errors
    /// When it is a prefix on a web server, which lists no files.
    pub fn at(location: Location) -> Result<Self> {
        if is_named(&location) {
            let name = location.name().to_owned();
            return Ok(Self::dataset(location, &name));
        }
        if matches!(&location, Location::Uri(url) if url.scheme().starts_with("http")) {
            let problem = "it has no suffix of a dataset, and web servers do not list their files";
            let fix = "give the URI of one dataset, such as https://HOST/rooms.lance";
            return Err(Error::config(location.to_string(), problem, fix));
        }
        Ok(Self { name: None, ..Self::dataset(location, "") })
    }

    /// The location.
    pub fn location(&self) -> &Location {
        &self.location
    }

    /// The name of its dataset; `None` for a prefix.
    pub fn name(&self) -> Option<&str> {
        self.name.as_deref()
    }

    /// The limit of work that reads this source.
    pub fn limit(&self) -> &Arc<Semaphore> {
        &self.work
    }

    /// The names of its datasets, at most 5,000.
    ///
    /// # Errors
    /// When the store does not list them.
    pub fn list(&self) -> Result<Vec<String>> {
        if let Some(name) = self.name() {
            return Ok(vec![name.to_owned()]);
        }
        let names = objects::list_names(&self.location)?.into_iter().filter(|name| {
            let is_plain = !name.starts_with('.') && !name.contains(|c: char| c.is_control() || c == '/');
            is_plain && is_named(&self.location.child(name))
        });
        let names: Vec<String> = names.take(MOST).collect();
        self.listed.lock().unwrap_or_else(PoisonError::into_inner).clone_from(&names);
        Ok(names)
    }

    /// The location of the dataset of this name.
    ///
    /// # Errors
    /// When there is none, or the store does not list them.
    pub fn find(&self, name: &str) -> Result<Location> {
        if let Some(own) = &self.name {
            return if own == name { Ok(self.location.clone()) } else { Err(unknown(name, std::slice::from_ref(own))) };
        }
        // A page asks for many frames of a dataset: one list is enough.
        let known = self.listed.lock().unwrap_or_else(PoisonError::into_inner).iter().any(|known| known == name);
        if !known {
            let names = self.list()?;
            if !names.iter().any(|known| known == name) {
                return Err(unknown(name, &names));
            }
        }
        Ok(self.location.child(name))
    }
}

/// Whether the name of a location has the suffix of a format.
fn is_named(location: &Location) -> bool {
    FORMATS.rows.iter().any(|format| format.has_suffix(location))
}

fn unknown(name: &str, names: &[String]) -> Error {
    Error::unknown("entry", name, names.iter().map(String::as_str), "reload the page, which lists the datasets")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn prefixes_on_web_servers_and_names_outside_are_refused() {
        let at = |uri: &str| Source::at(Location::parse(uri).expect("a URI"));
        let error = at("https://host/sets").err().expect("a prefix").to_string();
        assert!(error.contains("https://host/sets") && error.contains("one dataset"), "{error}");
        let one = at("https://host/sets/rooms.lance").expect("a dataset");
        assert_eq!(one.list().expect("a name"), ["rooms.lance"]);
        assert_eq!(one.find("rooms.lance").expect("a dataset").to_string(), "https://host/sets/rooms.lance");
        for name in ["", "..", "../other.lance", "other.lance", "rooms.lance/", "s3://b/rooms.lance"] {
            assert!(one.find(name).is_err(), "{name}");
        }
        assert!(at("s3://bucket/sets").is_ok_and(|source| source.name.is_none()));
    }

    #[test]
    fn only_listed_children_of_a_prefix_are_found() {
        let root = tempfile::tempdir().expect("a folder");
        for name in ["sets/a.lance", "sets/.hidden.lance", "sets/notes", "sets/deep/b.lance", "other.lance"] {
            std::fs::create_dir_all(root.path().join(name)).expect("a folder");
        }
        std::fs::write(root.path().join("sets/c.h5"), "").expect("a file");
        let source = Source::at(Location::from(root.path().join("sets"))).expect("a prefix");
        assert_eq!(source.list().expect("names"), ["a.lance", "c.h5"]);
        assert!(source.find("a.lance").is_ok());
        for name in ["../other.lance", "deep/b.lance", "notes", ".hidden.lance", "", "..", "a.lance/../../other.lance"]
        {
            assert!(source.find(name).is_err(), "{name}");
        }
        std::fs::create_dir(root.path().join("sets/new.lance")).expect("a folder");
        assert!(source.find("new.lance").is_ok(), "a dataset that came since the last list");
    }
}
