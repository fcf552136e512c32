//! Text from files, made safe to print.

use std::borrow::Cow;

/// Returns `text` with its control characters escaped, so that a name from a file cannot move the cursor, change
/// colours, or reorder the line of a terminal. Line feeds and tabs stay; text without control characters is borrowed.
pub fn printable(text: &str) -> Cow<'_, str> {
    if !text.chars().any(is_control) {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len() + 16);
    for c in text.chars() {
        if is_control(c) {
            out.extend(c.escape_default());
        } else {
            out.push(c);
        }
    }
    Cow::Owned(out)
}

/// Returns a statement of a stranger, such as an author or a server's message, as one line of at most 200 characters.
pub fn one_line(text: &str) -> String {
    const MAX: usize = 200;
    let words = text.split_whitespace().flat_map(|word| word.chars().chain([' ']));
    let start: String = words.take(MAX + 1).collect();
    let line = start.trim_end();
    match line.char_indices().nth(MAX) {
        Some((end, _)) => format!("{}…", printable(line[..end].trim_end())),
        None => printable(line).into_owned(),
    }
}

/// Returns whether a character controls a terminal instead of appearing on it: C0 and C1 controls except line feed and
/// tab, separators of lines and paragraphs, and the marks, embeddings, overrides and isolates of bidirectional text.
fn is_control(c: char) -> bool {
    match c {
        '\n' | '\t' => false,
        '\u{061c}' | '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}' => true,
        _ => c.is_control(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn escapes_control_and_bidirectional_characters() {
        let title = "a\u{1b}]0;owned\u{7}b\r\u{9b}31m\u{7f}\u{202e}\u{2066}";
        let expected = "a\\u{1b}]0;owned\\u{7}b\\r\\u{9b}31m\\u{7f}\\u{202e}\\u{2066}";
        assert_eq!(printable(title), expected);
        assert!(printable(&printable(title)) == expected, "escaped text stays as it is");
    }

    #[test]
    fn statements_of_strangers_are_one_short_line() {
        assert_eq!(one_line(" Ada\n\nerror: all\tlost \u{1b}[31m"), "Ada error: all lost \\u{1b}[31m");
        assert_eq!(one_line(""), "");
        let long = one_line(&"größe ".repeat(1_000_000));
        assert!(long.chars().count() <= 201 && long.starts_with("größe größe") && long.ends_with('…'), "{long}");
        assert_eq!(one_line(&"x".repeat(200)), "x".repeat(200));
    }

    #[test]
    fn returns_printable_text_borrowed() {
        for text in ["", "pixels", "two\nlines\tof text", "größe 大きさ 🙂 e\u{301}"] {
            assert!(matches!(printable(text), Cow::Borrowed(same) if same == text));
        }
    }
}
