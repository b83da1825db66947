//! Names of outputs that say what is written.

use crate::args::Command;
use crate::error::{CliError, Result};
use std::path::PathBuf;

/// Refuses outputs whose names promise another format than the one that is written.
///
/// # Errors
/// A [`CliError`] that names the output and the extensions that fit.
pub(super) fn check(command: &Command) -> Result<()> {
    let named: Vec<(&str, Option<&PathBuf>, &[&str])> = match command {
        Command::Eval(args) => vec![
            ("--csv", args.csv.as_ref(), &["csv", "txt"]),
            ("--markdown", args.markdown.as_ref(), &["md", "markdown", "txt"]),
            ("--html", args.html.as_ref(), &["html", "htm"]),
        ],
        Command::Demo(args) => vec![("--output", args.output.as_ref(), &["png"])],
        Command::Restore(args) => vec![
            ("--side-by-side", args.side_by_side.as_ref(), &["png"]),
            ("--html", args.html.as_ref(), &["html", "htm"]),
        ],
        Command::Simulate(args) => vec![
            ("--flow", args.flow.as_ref(), &["npy"]),
            ("--preview", args.preview.as_ref(), &["gif"]),
        ],
        _ => Vec::new(),
    };
    for (option, path, extensions) in named {
        let Some(path) = path else { continue };
        let own = path.extension().map(|e| e.to_string_lossy().to_lowercase());
        if !own.is_some_and(|own| extensions.contains(&own.as_str())) {
            let list = extensions.iter().map(|e| format!(".{e}")).collect::<Vec<_>>().join(" or ");
            return Err(CliError::new(
                format!("{option} writes {}", extensions[0].to_uppercase()),
                path.display(),
                format!("use a name that ends in {list}"),
            ));
        }
    }
    Ok(())
}
