//! Formatting of numbers and texts.

use swm_core::results::EpisodeResult;

/// Replaces control characters, which XML forbids, by spaces, and so overrides and isolates of bidirectional text, which
/// would reorder the rest of a line.
pub(crate) fn plain(words: &str) -> String {
    let space = |c: char| match c {
        '\n' | '\t' => c,
        '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}' => ' ',
        c if c.is_control() => ' ',
        c => c,
    };
    words.chars().map(space).collect()
}

/// Escapes a text for HTML and quoted attributes, and makes it [`plain`].
pub(crate) fn escape(words: &str) -> String {
    let mut safe = String::with_capacity(words.len());
    for c in plain(words).chars() {
        match c {
            '&' => safe.push_str("&amp;"),
            '<' => safe.push_str("&lt;"),
            '>' => safe.push_str("&gt;"),
            '"' => safe.push_str("&quot;"),
            '\'' => safe.push_str("&#39;"),
            c => safe.push(c),
        }
    }
    safe
}

/// The outcome of an episode: its CSS class and a description.
pub(crate) fn outcome(episode: &EpisodeResult) -> (&'static str, String) {
    let also = if episode.solved_at_start { ", solved at the start" } else { "" };
    match episode.time_to_goal() {
        _ if episode.solved_at_start && episode.steps == 0 => ("start", "solved at the start, not counted".to_owned()),
        Some(steps) => ("solved", format!("solved in {steps} steps{also}")),
        None => ("unsolved", format!("not solved in {} steps{also}", episode.steps)),
    }
}

/// Truncates a text to `most` characters, with an ellipsis.
pub(crate) fn shorten(words: &str, most: usize) -> String {
    if words.chars().count() <= most {
        return words.to_owned();
    }
    let mut short: String = words.chars().take(most.saturating_sub(1)).collect();
    short.push('…');
    short
}

/// A fraction as a percentage with one decimal and a non-breaking space: `92.5 %`.
pub(crate) fn percent(rate: f64) -> String {
    format!("{:.1}\u{a0}%", rate * 100.0)
}

/// A difference of fractions in percentage points, with its sign: `+34.0`.
pub(crate) fn points(difference: f64) -> String {
    format!("{:+.1}", difference * 100.0).replace('-', "\u{2212}")
}

/// A difference of fractions in whole percentage points, with its sign: `+34`.
pub(crate) fn whole_points(difference: f64) -> String {
    format!("{:+.0}", difference * 100.0).replace('-', "\u{2212}")
}

/// A p-value: `p = 0.032`, `p < 0.001`.
pub(crate) fn p_value(p: f64) -> String {
    if p < 0.001 { "p\u{a0}<\u{a0}0.001".to_owned() } else { format!("p\u{a0}=\u{a0}{p:.3}") }
}

/// Formats a number with about four significant digits and no trailing zeros.
pub fn number(value: f64) -> String {
    let size = value.abs();
    if !value.is_finite() {
        return "–".to_owned();
    }
    if size != 0.0 && !(1e-4..1e7).contains(&size) {
        return format!("{value:.2e}");
    }
    let decimals = match size {
        s if s >= 1000.0 => 0,
        s if s >= 100.0 => 1,
        s if s >= 10.0 => 2,
        s if s >= 1.0 || s == 0.0 => 3,
        s if s >= 0.1 => 4,
        s if s >= 0.01 => 5,
        _ => 6,
    };
    let text = format!("{value:.decimals$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

/// A duration: `0.8 ms`, `12 ms`, `1.42 s`, `3 min 20 s`, `2 h 5 min`.
pub(crate) fn duration(seconds: f64) -> String {
    match seconds {
        s if !s.is_finite() || s < 0.0 => "–".to_owned(),
        s if s < 0.009_95 => format!("{:.1} ms", s * 1e3),
        s if s < 0.999_5 => format!("{:.0} ms", s * 1e3),
        s if s < 9.995 => format!("{s:.2} s"),
        s if s < 59.95 => format!("{s:.1} s"),
        s if s < 3599.5 => {
            let whole = s.round();
            format!("{:.0} min {:.0} s", (whole / 60.0).floor(), whole % 60.0)
        }
        s => {
            let minutes = (s / 60.0).round();
            format!("{:.0} h {:.0} min", (minutes / 60.0).floor(), minutes % 60.0)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_escaped_and_truncated() {
        assert_eq!(escape("<b a=\"1\" c='2'>&\u{1}\u{202e}é"), "&lt;b a=&quot;1&quot; c=&#39;2&#39;&gt;&amp;  é");
        assert_eq!((shorten("éclair", 6), shorten("éclairs", 6)), ("éclair".to_owned(), "éclai…".to_owned()));
    }

    #[test]
    fn numbers_durations_percentages_and_p_values_are_formatted() {
        let numbers = [0.0, 1.0, -2.5, 0.123_456, 12_345.6, 1e-9, 150.0, f64::NAN].map(number);
        assert_eq!(numbers, ["0", "1", "-2.5", "0.1235", "12346", "1.00e-9", "150", "–"]);
        let times = [0.000_84, 0.012, 0.9996, 1.417, 59.96, 200.0, 7500.0, -1.0].map(duration);
        assert_eq!(times, ["0.8 ms", "12 ms", "1.00 s", "1.42 s", "1 min 0 s", "3 min 20 s", "2 h 5 min", "–"]);
        assert_eq!(percent(0.925), "92.5\u{a0}%");
        assert_eq!((points(0.34), points(-0.051)), ("+34.0".to_owned(), "\u{2212}5.1".to_owned()));
        assert_eq!((whole_points(0.347), whole_points(-0.057)), ("+35".to_owned(), "\u{2212}6".to_owned()));
        assert_eq!(
            [0.2, 0.000_99, 1.0].map(p_value).map(|p| p.replace('\u{a0}', " ")),
            ["p = 0.200", "p < 0.001", "p = 1.000"]
        );
    }
}
