//! Links to datasets in other files, as master files of detectors have them. The reader does not follow them.

use std::fs::File;
use std::io::Read;
use std::path::Path;

/// Bytes of a file that are searched: link messages lie among the groups, at the beginning.
const SEARCHED_BYTES: u64 = 1 << 20;

/// Files that are named at most.
const MAX_LISTED: usize = 4;

/// Returns the names of files that external links at the beginning of the file at `path` lead to.
pub(super) fn linked_files(path: &Path) -> Vec<String> {
    let mut head = Vec::new();
    let read = File::open(path).map(|file| file.take(SEARCHED_BYTES).read_to_end(&mut head));
    if read.is_ok() { names(&head) } else { Vec::new() }
}

/// Finds external links: a name and the path of an object, both ended by zero (HDF5 file format, IV.A.2.g).
fn names(bytes: &[u8]) -> Vec<String> {
    let mut names: Vec<String> = Vec::new();
    let is_text = |text: &[u8]| text.iter().all(|byte| matches!(byte, 0x20..=0x7e | 0x80..));
    let mut texts = bytes.split(|&byte| byte == 0).peekable();
    while let Some(text) = texts.next() {
        // Flags and lengths may come right before the name.
        let from = text.iter().rposition(|byte| *byte < 0x20).map_or(0, |at| at + 1);
        let name = String::from_utf8_lossy(&text[from..]);
        let extension = Path::new(&*name).extension().map(|e| e.to_string_lossy().to_lowercase());
        let is_file = matches!(extension.as_deref(), Some("h5" | "hdf5" | "hdf" | "nxs" | "he5"));
        let object = texts.peek().is_some_and(|object| object.starts_with(b"/") && is_text(object));
        if is_file && object && !names.iter().any(|other| *other == name) {
            names.push(name.into_owned());
        }
    }
    if names.len() > MAX_LISTED {
        let more = names.len() - MAX_LISTED;
        names.truncate(MAX_LISTED);
        names.push(format!("and {more} more"));
    }
    names
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_files_of_external_links() {
        let mut bytes = b"\x89HDF\r\n\x1a\n\0\0data_000001\x40\x1b\0\0".to_vec();
        for n in 1..=6 {
            bytes.extend(format!("run_data_{n:06}.h5\0/entry/data/data\0\x01").bytes());
        }
        bytes.extend(b"notes.h5\0no path\0");
        let found = names(&bytes);
        assert_eq!(found[0], "run_data_000001.h5");
        assert_eq!(found[4], "and 2 more");
        assert_eq!(names(b"\0a.txt\0/b\0"), Vec::<String>::new());
    }
}
