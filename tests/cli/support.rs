//! Shared helpers of the tests: running the program, empty folders, NumPy files.

use assert_cmd::Command;
use std::path::{Path, PathBuf};

/// Returns the command `qudi` for a folder, without the weights in the user's cache.
pub(crate) fn qudi(folder: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_qudi"));
    command.current_dir(folder).env("NO_COLOR", "1");
    command.env("XDG_CACHE_HOME", Path::new(env!("CARGO_TARGET_TMPDIR")).join("no-cache"));
    command
}

/// Creates an empty folder of this name.
pub(crate) fn scratch(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).unwrap();
    folder
}

/// Lists the names in a folder, sorted.
pub(crate) fn listing(folder: &Path) -> Vec<String> {
    let mut names: Vec<_> = std::fs::read_dir(folder)
        .unwrap()
        .map(|e| e.unwrap().file_name().to_string_lossy().into_owned())
        .collect();
    names.sort();
    names
}

/// Runs the program, which must succeed, and returns its output.
pub(crate) fn run(folder: &Path, args: &str) -> String {
    let output = qudi(folder).args(args.split_whitespace()).output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{args}: {text}");
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// Checks that arguments are refused with a three-part error that contains these words.
pub(crate) fn refused(folder: &Path, args: &str, words: &[&str]) {
    let output = qudi(folder).args(args.split_whitespace()).output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{args}: {text}");
    for part in ["error: ", "where: ", "help: "].iter().chain(words) {
        assert!(text.contains(part), "{args}: no `{part}` in\n{text}");
    }
}

/// Returns a `.npy` file as NumPy would write it.
pub(crate) fn npy_bytes(descr: &str, shape: &str, data: &[u8]) -> Vec<u8> {
    let text = format!(
        "{:<117}\n",
        format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}")
    );
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((text.len() as u16).to_le_bytes());
    bytes.extend(text.as_bytes());
    bytes.extend(data);
    bytes
}
