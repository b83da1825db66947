//! Text that a terminal shows and does not obey.

use std::borrow::Cow;
use std::fmt::Write;

/// Escapes control characters, so that a file name or a record cannot steer the terminal.
///
/// Line feeds and tabs stay: they lay out our own text. Bidirectional overrides are escaped as well, since
/// they show characters in another order than they have.
pub(crate) fn printable(text: &str) -> Cow<'_, str> {
    if !text.chars().any(is_unprintable) {
        return Cow::Borrowed(text);
    }
    let mut escaped = String::with_capacity(text.len() + 16);
    for c in text.chars() {
        if is_unprintable(c) {
            let _ = write!(escaped, "{}", c.escape_unicode());
        } else {
            escaped.push(c);
        }
    }
    Cow::Owned(escaped)
}

/// Returns true if a terminal would act on a character instead of showing it.
pub(super) fn is_unprintable(c: char) -> bool {
    let is_bidi =
        matches!(c, '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    is_bidi || c.is_control() && !matches!(c, '\n' | '\t')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn escapes_terminal_sequences() {
        assert_eq!(printable("a\u{1b}[31mb\u{7}\r\u{9b}2J"), r"a\u{1b}[31mb\u{7}\u{d}\u{9b}2J");
    }

    #[test]
    fn escapes_bidirectional_overrides() {
        assert_eq!(printable("gpj.\u{202e}exe"), r"gpj.\u{202e}exe");
    }

    #[test]
    fn keeps_ordinary_text_lines_and_tabs() {
        let text = "Überblick µm ±\n\t写真 █▇";
        assert!(matches!(printable(text), Cow::Borrowed(kept) if kept == text));
    }
}
