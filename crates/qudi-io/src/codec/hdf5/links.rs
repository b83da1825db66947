//! Links to datasets in other files, as master files of detectors have them. They are not followed.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

/// Bytes at the beginning and at the end of a file that are searched: links lie among the groups, apart from
/// the frames.
const SEARCHED_BYTES: u64 = 1 << 20;

/// Files that are named at most.
const MAX_LISTED: usize = 4;

/// Returns the names of files that external links in the file at `path` lead to.
pub(super) fn linked_files(path: &Path) -> Vec<String> {
    let Ok(mut file) = File::open(path) else { return Vec::new() };
    let length = file.metadata().map_or(0, |about| about.len());
    let mut names = Vec::new();
    for start in [0, length.saturating_sub(SEARCHED_BYTES).max(SEARCHED_BYTES)] {
        let mut part = Vec::new();
        let sought = file.seek(SeekFrom::Start(start));
        if sought.and_then(|_| (&file).take(SEARCHED_BYTES).read_to_end(&mut part)).is_ok() {
            add_names(&part, &mut names);
        }
    }
    if names.len() > MAX_LISTED {
        let more = names.len() - MAX_LISTED;
        names.truncate(MAX_LISTED);
        names.push(format!("and {more} more"));
    }
    names
}

/// Finds external links: their length in two bytes, flags of zero, and the names of a file and of an object
/// in it, both ended by zero (HDF5 file format, IV.A.2.g).
fn add_names(bytes: &[u8], names: &mut Vec<String>) {
    let text = |from: usize| {
        let rest = bytes.get(from..)?;
        let end = rest.iter().position(|&byte| byte == 0)?;
        std::str::from_utf8(&rest[..end]).ok().filter(|text| !text.is_empty())
    };
    let length = |at: usize| usize::from(u16::from_le_bytes([bytes[at], bytes[at + 1]]));
    for at in (0..bytes.len().saturating_sub(3)).filter(|&at| bytes[at + 2] == 0 && length(at) > 4)
    {
        let Some(name) = text(at + 3) else { continue };
        let Some(object) = text(at + 3 + name.len() + 1) else { continue };
        let is_link = length(at) == name.len() + object.len() + 3
            && !name.chars().chain(object.chars()).any(char::is_control);
        if is_link && !names.iter().any(|other| other == name) {
            names.push(name.to_owned());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_files_of_external_links() {
        let mut bytes = b"\x89HDF\r\n\x1a\n\0\0".to_vec();
        let link = |name: &str| {
            let value = format!("\0{name}\0/entry/data/data\0");
            [&[0x40, value.len() as u8, 0], value.as_bytes()].concat()
        };
        for n in 1..=6 {
            bytes.extend(b"\x01\x08\x04data");
            bytes.extend(link(&format!("run_data_{n:06}.h5")));
        }
        bytes.extend(b"notes.h5\0/of/no/link\0");
        let mut found = Vec::new();
        add_names(&bytes, &mut found);
        assert_eq!(found.len(), 6, "{found:?}");
        assert_eq!(found[0], "run_data_000001.h5");
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("master.h5");
        // Links at the end of a long file.
        let mut file = vec![7; 3 << 20];
        file.extend(&bytes);
        std::fs::write(&path, &file).unwrap();
        assert_eq!(linked_files(&path)[4], "and 2 more");
        std::fs::write(&path, [7; 50]).unwrap();
        assert_eq!(linked_files(&path), Vec::<String>::new());
    }
}
