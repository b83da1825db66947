//! `base = "data/open-clips.toml"` in a recipe: a file of tables that several recipes share.

use super::Recipe;
use qudi_core::limits::TEXT_BYTES;
use qudi_core::regular_file::read_text;
use qudi_core::{Error, Result};
use std::path::{Path, PathBuf};
use toml::{Table, Value};

/// Bases inside the program by name.
const BASES: &[(&str, &str)] = &[
    ("data/open-clips.toml", include_str!("../../recipes/data/open-clips.toml")),
    ("data/open-scenes.toml", include_str!("../../recipes/data/open-scenes.toml")),
];

/// Lays a recipe over the base that it names, if it names one: a file, relative to the recipe's folder, or
/// else one inside the program. Tables are joined; of everything else, the recipe's value stays.
///
/// # Errors
/// [`Error`] if there is no such base, or it cannot be read.
pub(super) fn over_base(mut recipe: Table, folder: Option<&Path>) -> Result<Table> {
    let Some(name) = recipe.remove("base") else { return Ok(recipe) };
    let known = BASES.iter().map(|(name, _)| *name).collect::<Vec<_>>().join(", ");
    let help = format!("name a file beside the recipe, or one inside the program: {known}");
    let Some(name) = name.as_str() else {
        return Err(Error::request("`base` is not a string", "base", help));
    };
    let file = beside(folder, name);
    let built_in = BASES.iter().find(|(base, _)| *base == name).map(|(_, text)| (*text).to_owned());
    let text = match (file, built_in) {
        (Some(path), _) => read_text(&path, TEXT_BYTES, "read the base of the recipe")?,
        (None, Some(text)) => text,
        (None, None) => return Err(Error::request(format!("no base `{name}`"), "base", help)),
    };
    let parsed: std::result::Result<Table, toml::de::Error> = text.parse();
    let fault =
        |e: toml::de::Error| Error::request(e.message().to_owned(), name, "correct the base");
    let mut base = parsed.map_err(fault)?;
    merge(&mut base, recipe);
    Ok(base)
}

/// Returns the base of this name in the recipe's folder, if it is there.
fn beside(folder: Option<&Path>, name: &str) -> Option<PathBuf> {
    folder.map(|folder| folder.join(name)).filter(|path| path.exists())
}

impl Recipe {
    /// Returns the file of the base that the recipe in a file names; none if the base is built in.
    pub fn base_file(path: &Path) -> Option<PathBuf> {
        let text = read_text(path, TEXT_BYTES, "read the recipe").ok()?;
        let recipe: Table = text.parse().ok()?;
        beside(path.parent(), recipe.get("base")?.as_str()?)
    }
}

/// Returns the tables of a built-in recipe, laid over its base.
pub fn recipe_table(name: &str) -> Option<Table> {
    let table = super::network::preset(name)?.parse().ok()?;
    over_base(table, None).ok()
}

/// Lays `upper` over `lower`, table by table.
fn merge(lower: &mut Table, upper: Table) {
    for (key, value) in upper {
        match (lower.get_mut(&key), value) {
            (Some(Value::Table(lower)), Value::Table(upper)) => merge(lower, upper),
            (_, value) => {
                lower.insert(key, value);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::super::Recipe;

    #[test]
    fn shipped_recipes_have_the_clips_of_their_base() {
        for (name, clips) in [("small", 29), ("paper-mini", 28), ("emvd", 28), ("quiver", 28)] {
            let recipe = Recipe::load(name, &[]).unwrap();
            let sources: Vec<_> = recipe
                .data
                .source
                .iter()
                .map(|s| (s.name.as_str(), s.from.len(), s.weight))
                .collect();
            let clips_of = |stills: &[(&'static str, usize, f64)]| {
                [&[("clips", clips, 5.0)], stills, &[("scenes", 2, 1.0)]].concat()
            };
            if name == "small" {
                assert_eq!(sources, clips_of(&[("stills", 3, 4.0)]));
            } else {
                assert_eq!(sources, clips_of(&[("stills", 3, 2.7), ("grocery", 1, 1.3)]));
            }
            // The pack of the base is smaller than its files; each sample shrinks the rest.
            let clips = &recipe.data.source[0];
            assert_eq!((clips.stride, clips.shrink * clips.max_downscale), (2, 1.5));
            assert_eq!(clips.from[0], "train/video/cups.mp4");
            assert_eq!(recipe.data.source[1].static_fraction, 0.25);
            let validation = recipe.validation.unwrap();
            assert_eq!(validation.from, ["val/video"]);
            assert_eq!(validation.ppp, [3.25, 9.75, 26.0]);
        }
        let small = Recipe::load("small", &[]).unwrap();
        assert!(small.data.source[0].from.contains(&"train/video/seeking.mp4".to_owned()));
        assert_eq!((small.data.frames, small.data.crop, small.data.sensor.len()), (11, 192, 3));
    }

    #[test]
    fn recipes_win_over_files_beside_them_and_these_over_the_program() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mine.toml");
        let text = super::super::network::preset("emvd").unwrap();
        std::fs::write(&path, text).unwrap();
        let load = || Recipe::load(&path.display().to_string(), &[]);
        assert_eq!(load().unwrap(), Recipe::load("emvd", &[]).unwrap());
        let base = folder.path().join("data/open-clips.toml");
        std::fs::create_dir(folder.path().join("data")).unwrap();
        let own =
            "[data]\ncrop = 1\nsource = [{ name = \"own\", kind = \"scenes\", from = [\"text\"] }]
[validation]\nfrom = [\"scene:text\"]\nsensor = \"ideal\"\n";
        std::fs::write(&base, own).unwrap();
        let recipe = load().unwrap();
        assert_eq!((recipe.data.source[0].name.as_str(), recipe.data.crop), ("own", 96));
        let validation = recipe.validation.unwrap();
        assert_eq!(
            (validation.from[0].as_str(), validation.sensor.as_str()),
            ("scene:text", "qudi-paper")
        );
        std::fs::write(&base, "base = \"data/open-clips.toml\"").unwrap();
        assert!(load().unwrap_err().to_string().contains("base"));
        std::fs::write(&path, text.replace("open-clips", "no-clips")).unwrap();
        let error = load().unwrap_err();
        assert!(error.help().unwrap().contains("data/open-clips.toml"), "{error}");
    }
}
