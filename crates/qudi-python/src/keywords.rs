//! Keyword arguments instead of flags in the texts of the command line.

/// Flags whose value may be a word.
const WORDS: [&str; 11] = [
    "axes",
    "bitorder",
    "cfa",
    "device",
    "format",
    "mask",
    "method",
    "orient",
    "pack-axis",
    "precision",
    "sensor",
];

/// Words that follow a flag without being its value.
const CONJUNCTIONS: [&str; 8] = ["and", "as", "for", "if", "is", "of", "or", "to"];

/// Returns a text with keyword arguments instead of flags: `sum=7` for `--sum 7`, `pack_axis` for
/// `--pack-axis`. Commands in backticks stay.
pub(crate) fn keywords(text: &str) -> String {
    let text = text.replace("overwrite it with --force", "overwrite it with overwrite=True");
    let parts = text.split('`').enumerate().map(|(n, part)| {
        let is_command = part.starts_with("qudi ") || part.starts_with("--features");
        if n % 2 == 1 && is_command { part.to_owned() } else { translated(part, n % 2 == 1) }
    });
    parts.collect::<Vec<_>>().join("`")
}

/// Translates the flags of a text, which may be quoted itself.
fn translated(text: &str, quoted: bool) -> String {
    let mut out = String::new();
    let mut rest = text;
    while let Some(at) = rest.find("--") {
        let (before, after) = rest.split_at(at);
        out += before;
        let letters = |c: char| !c.is_ascii_lowercase() && c != '-';
        let flag = &after[2..];
        let flag = &flag[..flag.find(letters).unwrap_or(flag.len())];
        // A dash between words, or a rule of dashes, is no flag.
        let follows = before.is_empty() || before.ends_with([' ', '(', '\'']);
        if !follows || !flag.starts_with(|c: char| c.is_ascii_lowercase()) {
            out += "--";
            rest = &after[2..];
            continue;
        }
        rest = &after[2 + flag.len()..];
        let next = rest.strip_prefix(' ').unwrap_or("");
        let next = &next[..next.find([' ', ',', ';', ':', ')', '\n']).unwrap_or(next.len())];
        let name = if flag == "set" { "settings".to_owned() } else { flag.replace('-', "_") };
        match value(flag, next) {
            Some(value) => {
                out += &format!("{name}={value}");
                rest = &rest[1 + next.len()..];
            }
            None if quoted || before.ends_with('\'') => out += &name,
            None => out += &format!("`{name}`"),
        }
    }
    out + rest
}

/// Returns the value of a flag in Python's notation, if the next word is its value.
fn value(flag: &str, next: &str) -> Option<String> {
    let is_stand_in = !next.is_empty() && next.chars().all(|c| c.is_ascii_uppercase());
    if next.parse::<f64>().is_ok() || is_stand_in {
        return Some(next.to_owned());
    }
    if next == "HxW" {
        return Some("(H, W)".to_owned());
    }
    let is_word = !next.is_empty() && WORDS.contains(&flag) && !CONJUNCTIONS.contains(&next);
    is_word.then(|| format!("\"{next}\""))
}
