//! Errors of Lance and of object stores, in the words of this crate.

use crate::dataset::objects::without_passwords;
use crate::formats::system_error::system_error;
use std::path::Path;
use swm_core::Error;

/// An error that reports a dataset with damaged files.
pub fn damaged(path: &Path, problem: impl Into<String>) -> Error {
    Error::corrupt(
        path,
        problem,
        "a file of the dataset is damaged or missing: restore it from a copy, or delete the dataset and collect it again",
    )
}

/// Converts Lance's errors: errors of the operating system become [`Error::Io`], errors of a remote store keep their
/// message, and all other errors mean that files are damaged.
pub fn lance_error(label: &Path, action: &str, error: &lance_core::Error) -> Error {
    let text = without_passwords(&error.to_string());
    // Lance takes damage for a fault of its own, and asks for a report.
    let text = without_position(text.split_once("/lance/issues. ").map_or(text.as_str(), |(_, found)| found));
    let text = without_kind(text);
    let remote = label.to_str().is_some_and(|label| label.contains("://"));
    match (system_error(text), error) {
        (Some(error), _) if !remote => Error::io(label, action, error),
        (_, lance_core::Error::NotFound { uri, .. }) => damaged(label, format!("{action}: {uri} is missing")),
        (_, lance_core::Error::NotSupported { .. } | lance_core::Error::VersionConflict { .. }) => Error::corrupt(
            label,
            format!("{action}: {text}"),
            "this version cannot be read; rewrite the table with a current Lance",
        ),
        (_, lance_core::Error::IO { .. }) if remote => {
            let problem = if asks_for_credentials(text) { "no credentials were found" } else { text };
            Error::external(format!("{}: {action}", label.display()), format!("{problem}{}", credentials_hint(text)))
        }
        _ => damaged(label, format!("{action}: {text}")),
    }
}

/// Removes the position in Lance's own source at the end of a message, such as `, rust/lance-io/src/utils.rs:173:28`.
fn without_position(text: &str) -> &str {
    let is_position = |end: &str| {
        let mut parts = end.rsplitn(3, ':');
        let numbers = [parts.next(), parts.next()];
        let is_number = |part: &Option<&str>| part.is_some_and(|part| part.parse::<u32>().is_ok());
        numbers.iter().all(is_number) && parts.next().is_some_and(|file| file.ends_with(".rs"))
    };
    text.rsplit_once(", ").filter(|(_, end)| is_position(end)).map_or(text, |(found, _)| found)
}

/// Removes the kind of error at the start of a message, such as `LanceError(IO): `.
fn without_kind(text: &str) -> &str {
    text.strip_prefix("LanceError(").and_then(|rest| rest.split_once("): ")).map_or(text, |(_, text)| text)
}

/// Whether an error is that of a client which found no credentials and asked the metadata server of a cloud machine for
/// them, in vain.
fn asks_for_credentials(text: &str) -> bool {
    ["169.254.169.254", "metadata.google.internal"].iter().any(|server| text.contains(server))
}

/// Returns the advice for an object store that refused a request, or whose client found no credentials.
fn credentials_hint(text: &str) -> &'static str {
    let refused = ["401", "403", "redential"];
    match asks_for_credentials(text) || refused.iter().any(|part| text.contains(part)) {
        true => {
            "; the store needs credentials: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, GOOGLE_SERVICE_ACCOUNT, or \
             AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY (docs/data.md)"
        }
        false => "",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::ErrorKind;

    #[test]
    fn lance_errors_keep_the_system_error_code() {
        let text = "LanceError(IO): Generic S3 error: PUT http://169.254.169.254/: 403, crates/x/store.rs:379:30";
        assert_eq!(without_kind(without_position(text)), "Generic S3 error: PUT http://169.254.169.254/: 403");
        assert!(credentials_hint(text).contains("AWS_ACCESS_KEY_ID") && credentials_hint("timeout").is_empty());
        let error =
            lance_error(Path::new("s3://b/x.lance"), "listing", &lance_core::Error::io(text.to_owned())).to_string();
        assert!(error.starts_with("s3://b/x.lance: listing: no credentials were found; the store needs"), "{error}");
        let full = lance_core::Error::io("failed to persist: No space left on device (os error 28)".to_owned());
        let error = lance_error(Path::new("x.lance"), "writing", &full);
        assert!(matches!(&error, Error::Io { source, .. } if source.kind() == ErrorKind::StorageFull));
        assert!(error.to_string().contains("free some space"));
    }
}
