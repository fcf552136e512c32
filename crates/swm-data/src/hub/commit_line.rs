//! [`Line`]: the lines of a commit as the hub reads them, with the content of small files.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde_json::Value;
use std::fs::File;
use std::io::Read as _;
use std::path::PathBuf;

/// A line of a commit. Files that are part of the commit are read while it is sent.
pub(super) struct Line {
    json: String,
    /// The file whose content belongs into `json`, and its size.
    file: Option<(PathBuf, u64)>,
}

impl Line {
    /// The empty text in `"content":""` stands for the content of the file.
    pub fn new(json: &Value, file: Option<(PathBuf, u64)>) -> Self {
        Self { json: format!("{json}\n"), file }
    }

    /// The number of bytes.
    pub fn length(&self) -> u64 {
        self.json.len() as u64 + self.file.as_ref().map_or(0, |(_, size)| size.div_ceil(3) * 4)
    }

    /// The line as it is sent.
    pub fn bytes(&self) -> std::io::Result<Vec<u8>> {
        const CONTENT: &str = "\"content\":\"";
        let Some((path, size)) = &self.file else { return Ok(self.json.clone().into_bytes()) };
        let mut content = vec![];
        File::open(path)?.take(size + 1).read_to_end(&mut content)?;
        let changed = || std::io::Error::other(format!("{} changed while it was uploaded", path.display()));
        let (before, after) =
            self.json.split_once(CONTENT).filter(|_| content.len() as u64 == *size).ok_or_else(changed)?;
        Ok([before, CONTENT, &STANDARD.encode(content), after].concat().into_bytes())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn lines_of_a_commit_have_the_content_of_their_files() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a");
        for size in [0, 1, 2, 3, 1000] {
            std::fs::write(&path, vec![7; size]).expect("a file");
            let value = |content: &str| json!({"key": "file", "value": {"path": "\"content\":\"", "content": content}});
            let line = Line::new(&value(""), Some((path.clone(), size as u64)));
            let made = line.bytes().expect("a line");
            assert_eq!(made, format!("{}\n", value(&STANDARD.encode(vec![7; size]))).into_bytes());
            assert_eq!(made.len() as u64, line.length());
            std::fs::write(&path, vec![7; size + 1]).expect("a file");
            assert!(line.bytes().is_err(), "the file changed");
        }
    }
}
