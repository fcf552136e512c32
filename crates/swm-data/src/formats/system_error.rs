//! [`system_error`]: errors of the operating system that a library has turned into text.

use std::io::{Error, ErrorKind};

/// The error of the operating system that a library's message quotes, if there is one. An invalid argument, such as a position in
/// a file that no file has, is damage.
pub(super) fn system_error(text: &str) -> Option<Error> {
    let (_, rest) = text.split_once("(os error ")?;
    let (number, _) = rest.split_once(')')?;
    let error = Error::from_raw_os_error(number.parse().ok()?);
    (error.kind() != ErrorKind::InvalidInput && text.contains(&error.to_string())).then_some(error)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_errors_of_the_system_itself_are_found() {
        // EPERM, ENOENT, EIO, ENOMEM, EACCES, ENFILE, EMFILE, ENOSPC, ELOOP, ESTALE.
        for number in [1, 2, 5, 12, 13, 23, 24, 28, 40, 116] {
            let text = format!("External: {}, while reading", Error::from_raw_os_error(number));
            assert_eq!(system_error(&text).and_then(|error| error.raw_os_error()), Some(number), "{text}");
        }
        // EINVAL.
        let invalid = format!("External: {}", Error::from_raw_os_error(22));
        for text in [&invalid, "no column x(os error 5)", "(os error 5", "(os error x)", "(os error 99999999999)", ""] {
            assert!(system_error(text).is_none(), "{text}");
        }
    }
}
