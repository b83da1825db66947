//! Downloads by the `curl` program on PATH: it brings the certificates of the system, and this program needs
//! no network code.

use super::weight_files::WeightFile;
use qudi_core::atomic_file::{Overwrite, PendingFile};
use qudi_core::{Error, Result};
use sha2::{Digest, Sha256};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

/// Longest file: VGG16 has 528 MB.
const LONGEST: &str = "700000000";

/// Brings `file` from `base` into `folder` unless it is there, whole and with the right hash or not at all.
///
/// # Errors
/// [`Error`] if there is no curl, if it fails, or if what it brings, or what is there, has another hash.
pub(super) fn fetch(file: &WeightFile, base: &str, folder: &Path) -> Result<PathBuf> {
    let path = folder.join(file.names[0]);
    if path.exists() {
        let mut present =
            std::fs::File::open(&path).map_err(|e| Error::io("read the weights", &path, e))?;
        let sum = copy(&mut present, &mut std::io::sink(), &path)?;
        check(file, &sum, &path, "remove it and fetch it again")?;
        return Ok(path);
    }
    std::fs::create_dir_all(folder).map_err(|e| Error::io("create the folder", folder, e))?;
    let mut pending = PendingFile::create(&path, Overwrite::No)?;
    let url = format!("{base}/{}", file.remote);
    let mut curl = Running(start(&url, &path)?);
    let mut body = curl.0.stdout.take().expect("stdout is piped");
    let sum = copy(&mut body, &mut pending, &path)?;
    let mut words = String::new();
    if let Some(stderr) = &mut curl.0.stderr {
        // Without its words the status still says that it failed.
        let _ = stderr.take(4096).read_to_string(&mut words);
    }
    let status = curl.0.wait().map_err(|e| Error::io("wait for curl at", &path, e))?;
    if !status.success() {
        let reason = words.lines().next().unwrap_or("it gave no reason").trim();
        return Err(Error::data(
            format!("curl cannot fetch {url}: {reason}"),
            &path,
            "check the network; or download the address by other means to this place",
        ));
    }
    let help = "the download is not the published file: fetch it again, or check for a proxy that answers instead";
    check(file, &sum, &path, help)?;
    pending.finish()?;
    Ok(path)
}

/// A process that does not outlive its handle.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn start(url: &str, path: &Path) -> Result<Child> {
    let spawned = Command::new("curl")
        .args(["--disable", "--silent", "--show-error", "--fail", "--location"])
        .args(["--proto", "=https,file", "--proto-redir", "=https", "--max-filesize", LONGEST])
        .args(["--connect-timeout", "30", "--speed-time", "60", "--speed-limit", "1000"])
        .args(["--output", "-", "--url", url])
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn();
    spawned.map_err(|e| match e.kind() {
        std::io::ErrorKind::NotFound => Error::data(
            "files are fetched by curl, and there is no `curl` on PATH",
            path,
            format!("install curl (https://curl.se), or download {url} to this place"),
        ),
        _ => Error::io("start curl for", path, e),
    })
}

/// Copies everything and gives the SHA-256 of it, in hexadecimal.
fn copy(from: &mut impl Read, to: &mut impl Write, path: &Path) -> Result<String> {
    let failed = |e| Error::io("fetch", path, e);
    let (mut hash, mut part) = (Sha256::new(), vec![0; 1 << 16]);
    loop {
        let count = match from.read(&mut part) {
            Ok(0) => break,
            Ok(count) => count,
            Err(e) if e.kind() == std::io::ErrorKind::Interrupted => continue,
            Err(e) => return Err(failed(e)),
        };
        hash.update(&part[..count]);
        to.write_all(&part[..count]).map_err(failed)?;
    }
    Ok(format!("{:x}", hash.finalize()))
}

fn check(file: &WeightFile, sum: &str, path: &Path, help: &str) -> Result<()> {
    if sum.starts_with(file.sha256) {
        return Ok(());
    }
    let digits = &sum[..file.sha256.len().min(sum.len())];
    Err(Error::data(format!("the SHA-256 is {digits}, expected {}", file.sha256), path, help))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    /// A file whose SHA-256 is known: of "abc" (FIPS 180-2, appendix B.1).
    const ABC: WeightFile = WeightFile {
        names: ["named.pth", "other.pth"],
        base: "",
        remote: "abc.pth",
        sha256: "ba7816bf",
    };

    #[test]
    fn keeps_only_files_with_the_published_hash() {
        let [from, to] = [(); 2].map(|()| tempfile::tempdir().unwrap());
        let base = format!("file://{}", from.path().display());
        let error = fetch(&ABC, &base, to.path()).unwrap_err().to_string();
        assert!(error.contains("curl"), "{error}");
        if error.contains("no `curl`") {
            #[expect(clippy::print_stderr, reason = "tells that the test was skipped")]
            {
                eprintln!("skipped: there is no `curl` on PATH");
            }
            return;
        }
        std::fs::write(from.path().join("abc.pth"), b"abd").unwrap();
        let error = fetch(&ABC, &base, to.path()).unwrap_err().to_string();
        assert!(error.contains("SHA-256"), "{error}");
        assert_eq!(std::fs::read_dir(to.path()).unwrap().count(), 0, "something was left behind");
        std::fs::write(from.path().join("abc.pth"), b"abc").unwrap();
        let path = fetch(&ABC, &base, &to.path().join("new/folder")).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"abc");
        // What is there is checked, not fetched again.
        std::fs::remove_file(from.path().join("abc.pth")).unwrap();
        fetch(&ABC, &base, &to.path().join("new/folder")).unwrap();
        std::fs::write(&path, b"ab").unwrap();
        assert!(fetch(&ABC, &base, &to.path().join("new/folder")).is_err());
        assert_eq!(std::fs::read(&path).unwrap(), b"ab", "a user's file was overwritten");
    }
}
