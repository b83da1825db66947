//! Names of parameters in files, where they differ from those here.

/// A name with parts of it replaced: for each pair, the first by the second.
pub fn renamed(name: &str, pairs: &[(&str, &str)]) -> String {
    pairs.iter().fold(name.to_owned(), |name, (ours, theirs)| name.replace(ours, theirs))
}
