//! The files of LPIPS's weights, and the folders where they are looked for.

use super::backbone::Net;
use qudi_core::{Error, Result};
use std::path::{Path, PathBuf};

/// Returns the names that the files may have: of the backbone (torchvision's, Burn's), and of the heads
/// (Burn's, the authors').
fn names(net: Net) -> [[&'static str; 2]; 2] {
    match net {
        Net::Vgg => [["vgg16-397923af.pth", "vgg_backbone.pth"], ["vgg_lpips.pth", "vgg.pth"]],
        Net::Alex => {
            [["alexnet-owt-7be5be79.pth", "alex_backbone.pth"], ["alex_lpips.pth", "alex.pth"]]
        }
    }
}

/// Returns the name of the SafeTensors file that `scripts/convert/lpips.py` writes, with backbone and heads.
fn converted(net: Net) -> &'static str {
    match net {
        Net::Vgg => "vgg16.safetensors",
        Net::Alex => "alexnet.safetensors",
    }
}

/// Returns the paths of backbone and heads, which may be one file, in `folder` or in [`cache_folder`].
///
/// # Errors
/// [`Error::Request`] that names the missing files, where they were looked for, and the script that makes
/// them.
pub(super) fn find(net: Net, folder: Option<&Path>) -> Result<[PathBuf; 2]> {
    let folders: Vec<PathBuf> =
        folder.map(Path::to_owned).into_iter().chain(cache_folder()).collect();
    locate(net, &folders)
}

fn locate(net: Net, folders: &[PathBuf]) -> Result<[PathBuf; 2]> {
    let first = |names: &[&str]| {
        let mut paths =
            folders.iter().flat_map(|folder| names.iter().map(move |name| folder.join(name)));
        paths.find(|path| path.is_file())
    };
    let both = converted(net);
    if let Some(path) = first(&[both]) {
        return Ok([path.clone(), path]);
    }
    let names = names(net);
    let found = names.map(|names| first(&names));
    let missing = names.iter().zip(&found).filter(|(_, path)| path.is_none());
    let missing: Vec<_> = missing.map(|(names, _)| names.join(" (or ") + ")").collect();
    if let [Some(backbone), Some(heads)] = found {
        return Ok([backbone, heads]);
    }
    let places: Vec<_> = folders.iter().map(|folder| folder.display().to_string()).collect();
    Err(Error::request(
        format!("LPIPS needs {both}, or {}: not found", missing.join(" and ")),
        if places.is_empty() { "no folder given".into() } else { places.join(", ") },
        format!(
            "make {both} with scripts/convert/lpips.py FOLDER, or set train.loss.term to \"none\""
        ),
    ))
}

/// Returns the folder of Burn's own LPIPS downloads, which is searched after a given one; none if the system
/// names no home.
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
        let error = locate(Net::Alex, &folders).unwrap_err();
        let text = format!("{error} {} {}", error.place().unwrap(), error.help().unwrap());
        let place = given.path().display().to_string();
        for word in
            ["alexnet-owt-7be5be79.pth", "alex_lpips.pth", "lpips.py", "train.loss.term", &place]
        {
            assert!(text.contains(word), "{word} is not in: {text}");
        }
        std::fs::write(cached.path().join("alex_backbone.pth"), b"").unwrap();
        let error = locate(Net::Alex, &folders).unwrap_err().to_string();
        assert!(!error.contains("alexnet-owt") && error.contains("alex_lpips.pth"), "{error}");
        std::fs::write(given.path().join("alex.pth"), b"").unwrap();
        let found = locate(Net::Alex, &folders).unwrap();
        assert_eq!(found, [cached.path().join("alex_backbone.pth"), given.path().join("alex.pth")]);
        let both = cached.path().join("alexnet.safetensors");
        std::fs::write(&both, b"").unwrap();
        assert_eq!(locate(Net::Alex, &folders).unwrap(), [both.clone(), both]);
    }
}
