//! The published files of weights of LPIPS, and where they are looked for.

use super::backbone::Net;
use qudi_core::{Error, Result};
use std::path::{Path, PathBuf};

/// A published file of weights.
#[derive(Clone, Copy, Debug)]
pub(super) struct WeightFile {
    /// The name that it is fetched under, and another that it may have.
    pub(super) names: [&'static str; 2],
    /// The publisher's folder.
    pub(super) base: &'static str,
    /// The name in that folder.
    pub(super) remote: &'static str,
    /// The SHA-256 in hexadecimal, or its first digits.
    pub(super) sha256: &'static str,
}

/// The address of torchvision's backbones.
const BACKBONES: &str = "https://download.pytorch.org/models";

/// The address of the heads by the authors of LPIPS.
const HEADS: &str =
    "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1";

/// The files of backbone and heads. Their second names are those of the framework's own LPIPS, and of the
/// authors.
pub(super) fn files(net: Net) -> [WeightFile; 2] {
    let backbone = |name, cached, sha256| WeightFile {
        names: [name, cached],
        base: BACKBONES,
        remote: name,
        sha256, // torchvision puts its first digits into the name
    };
    let heads =
        |name, remote, sha256| WeightFile { names: [name, remote], base: HEADS, remote, sha256 };
    match net {
        Net::Vgg => [
            backbone("vgg16-397923af.pth", "vgg_backbone.pth", "397923af"),
            heads(
                "vgg_lpips.pth",
                "vgg.pth",
                "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868",
            ),
        ],
        Net::Alex => [
            backbone("alexnet-owt-7be5be79.pth", "alex_backbone.pth", "7be5be79"),
            heads(
                "alex_lpips.pth",
                "alex.pth",
                "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
            ),
        ],
    }
}

/// The name of the SafeTensors file that `scripts/convert/lpips.py` writes: backbone and heads in one.
pub(super) fn converted(net: Net) -> &'static str {
    match net {
        Net::Vgg => "vgg16.safetensors",
        Net::Alex => "alexnet.safetensors",
    }
}

/// The paths of backbone and heads, which may be one file: in `folder`, if one is given, or else where Burn keeps
/// them.
///
/// # Errors
/// [`Error::Request`] that names the missing files, where they were looked for, and how to get them.
pub(super) fn find(net: Net, folder: Option<&Path>) -> Result<[PathBuf; 2]> {
    let folders: Vec<PathBuf> =
        folder.map(Path::to_owned).into_iter().chain(cache_folder()).collect();
    let one = folders.iter().map(|folder| folder.join(converted(net))).find(|path| path.is_file());
    match one {
        Some(path) => Ok([path.clone(), path]),
        None => locate(&files(net), &folders),
    }
}

fn locate(files: &[WeightFile; 2], folders: &[PathBuf]) -> Result<[PathBuf; 2]> {
    let found = files.map(|file| {
        let mut paths =
            folders.iter().flat_map(|folder| file.names.iter().map(|name| folder.join(name)));
        paths.find(|path| path.is_file())
    });
    let missing: Vec<&WeightFile> =
        files.iter().zip(&found).filter(|(_, path)| path.is_none()).map(|(file, _)| file).collect();
    if let [Some(backbone), Some(heads)] = found {
        return Ok([backbone, heads]);
    }
    let places: Vec<_> = folders.iter().map(|folder| folder.display().to_string()).collect();
    let names: Vec<_> = missing.iter().map(|file| file.names.join(" (or ") + ")").collect();
    let urls: Vec<_> = missing
        .iter()
        .map(|file| format!("{}/{} as {}", file.base, file.remote, file.names[0]))
        .collect();
    Err(Error::request(
        format!("LPIPS needs {}, not found", names.join(" and ")),
        if places.is_empty() { "no folder given".into() } else { places.join(", ") },
        format!(
            "fetch them, or download {} into that folder; or set train.loss.term to \"none\"",
            urls.join(" and ")
        ),
    ))
}

/// The folder where weights are looked for if none is given: where Burn's own LPIPS keeps its downloads. None
/// if the system names no home.
pub fn cache_folder() -> Option<PathBuf> {
    let variable =
        |name| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let home = std::env::home_dir;
    let base = if cfg!(target_os = "macos") {
        home()?.join("Library/Caches")
    } else if cfg!(windows) {
        variable("LOCALAPPDATA")?
    } else {
        variable("XDG_CACHE_HOME").or_else(|| Some(home()?.join(".cache")))?
    };
    Some(base.join("burn-dataset").join("lpips"))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[test]
    fn finds_files_by_either_name_and_names_missing_ones() {
        let [given, cached] = [(); 2].map(|()| tempfile::tempdir().unwrap());
        let folders = [given.path().to_owned(), cached.path().to_owned()];
        let files = files(Net::Alex);
        let error = locate(&files, &folders).unwrap_err();
        let text = format!("{error} {} {}", error.place().unwrap(), error.help().unwrap());
        let place = given.path().display().to_string();
        for word in
            ["alexnet-owt-7be5be79.pth", "alex_lpips.pth", "https://", "train.loss.term", &place]
        {
            assert!(text.contains(word), "{word} is not in: {text}");
        }
        std::fs::write(cached.path().join("alex_backbone.pth"), b"").unwrap();
        let error = locate(&files, &folders).unwrap_err().to_string();
        assert!(!error.contains("alexnet-owt") && error.contains("alex_lpips.pth"), "{error}");
        std::fs::write(given.path().join("alex.pth"), b"").unwrap();
        let found = locate(&files, &folders).unwrap();
        assert_eq!(found, [cached.path().join("alex_backbone.pth"), given.path().join("alex.pth")]);
    }
}
