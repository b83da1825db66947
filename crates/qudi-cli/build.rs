//! Tells the program its commit and features, for `qudi --version`.

use std::env;
use std::path::{Path, PathBuf};
use std::process::Command;

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rerun-if-env-changed=QUDI_COMMIT");
    let prefix = "CARGO_FEATURE_";
    let mut features: Vec<String> = env::vars()
        .filter_map(|(name, _)| Some(name.strip_prefix(prefix)?.to_lowercase()))
        .filter(|name| name != "default")
        .collect();
    features.sort();
    println!("cargo:rustc-env=QUDI_FEATURES={}", features.join(", "));
    // Debug builds would be compiled anew after every commit.
    let is_release = env::var("PROFILE").is_ok_and(|profile| profile == "release");
    let is_given = env::var("QUDI_COMMIT").is_ok();
    let commit = if is_release && !is_given { packaged_commit().or_else(commit) } else { None };
    if let Some(commit) = commit {
        println!("cargo:rustc-env=QUDI_COMMIT={commit}");
    }
}

/// Returns the commit that cargo noted when it packaged the sources, which then lie in no repository.
fn packaged_commit() -> Option<String> {
    let path = Path::new(&env::var_os("CARGO_MANIFEST_DIR")?).join(".cargo_vcs_info.json");
    let text = std::fs::read_to_string(path).ok()?;
    let (_, commit) = text.split_once("\"sha1\": \"")?;
    let (commit, _) = commit.split_once('"')?;
    Some(commit.to_owned())
}

/// Returns the commit of the repository; none without git, and where the sources lie in another repository.
fn commit() -> Option<String> {
    let root =
        PathBuf::from(env::var_os("CARGO_MANIFEST_DIR")?).join("../..").canonicalize().ok()?;
    if Path::new(&git(&root, &["rev-parse", "--show-toplevel"])?).canonicalize().ok()? != root {
        return None;
    }
    // Written at every commit and checkout.
    let log = root.join(git(&root, &["rev-parse", "--git-path", "logs/HEAD"])?);
    if log.exists() {
        println!("cargo:rerun-if-changed={}", log.display());
    }
    git(&root, &["rev-parse", "HEAD"])
}

fn git(root: &Path, args: &[&str]) -> Option<String> {
    let output = Command::new("git").arg("-C").arg(root).args(args).output().ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    output.status.success().then(|| text.trim().to_owned())
}
