//! Regular files only: a device never ends, and opening a named pipe waits for a writer.

use crate::error::{Error, Result};
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// Refuses anything that is no regular file, without opening it: opening a named pipe waits for a writer.
///
/// # Errors
/// [`Error`] if there is nothing, or a folder, a device, a pipe or a socket.
pub fn require_regular(path: &Path, action: &str) -> Result<u64> {
    let about = std::fs::metadata(path).map_err(|e| Error::io(action, path, e))?;
    if about.is_dir() {
        return Err(Error::io(action, path, std::io::ErrorKind::IsADirectory.into()));
    }
    if !about.is_file() {
        return Err(Error::data(
            format!("cannot {action}: not a regular file"),
            path,
            "copy its contents into a file first",
        ));
    }
    Ok(about.len())
}

/// Opens a regular file; `action` names the purpose in errors, as in "open the GIF".
///
/// # Errors
/// [`Error`] if it is no regular file or cannot be opened.
pub fn open_regular(path: &Path, action: &str) -> Result<File> {
    require_regular(path, action)?;
    File::open(path).map_err(|e| Error::io(action, path, e))
}

/// Reads a regular file of at most `limit` bytes.
///
/// # Errors
/// [`Error`] if it is no regular file, is larger, or cannot be read.
pub fn read_limited(path: &Path, limit: u64, action: &str) -> Result<Vec<u8>> {
    let length = require_regular(path, action)?;
    let too_large = |length: u64| {
        Error::data(
            format!("cannot {action}: {length} bytes are over the limit of {limit}"),
            path,
            "check that it is the right file",
        )
    };
    if length > limit {
        return Err(too_large(length));
    }
    let io = |e| Error::io(action, path, e);
    let mut bytes = Vec::with_capacity(length as usize);
    let file = File::open(path).map_err(io)?;
    // Files of /proc claim no length, and others grow while they are read.
    file.take(limit + 1).read_to_end(&mut bytes).map_err(io)?;
    if bytes.len() as u64 > limit {
        return Err(too_large(bytes.len() as u64));
    }
    Ok(bytes)
}

/// Reads a regular text file of at most `limit` bytes.
///
/// # Errors
/// [`Error`] as [`read_limited`], or if it is not UTF-8.
pub fn read_text(path: &Path, limit: u64, action: &str) -> Result<String> {
    let text = String::from_utf8(read_limited(path, limit, action)?).map_err(|_| {
        Error::data(format!("cannot {action}: not a text file"), path, "save it as text in UTF-8")
    })?;
    // Editors may begin a file with a byte order mark.
    Ok(text.strip_prefix('\u{feff}').map_or(text.clone(), str::to_owned))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_files_up_to_the_limit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.toml");
        std::fs::write(&path, "12345").unwrap();
        assert_eq!(read_text(&path, 5, "read the sensor file").unwrap(), "12345");
        let error = read_text(&path, 4, "read the sensor file").unwrap_err().to_string();
        assert_eq!(error, "cannot read the sensor file: 5 bytes are over the limit of 4");
        assert!(read_text(folder.path(), 5, "read the sensor file").is_err());
    }

    #[cfg(unix)]
    #[test]
    fn refuses_devices_without_opening_them() {
        for device in ["/dev/zero", "/dev/null"] {
            let error = open_regular(Path::new(device), "open the GIF").unwrap_err().to_string();
            assert_eq!(error, "cannot open the GIF: not a regular file");
        }
    }
}
