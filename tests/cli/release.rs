//! Archives of a release: `cargo binstall` looks for what the workflow makes, and finds the program in it.

use crate::root;
use std::collections::BTreeMap;

/// One archive of the workflow.
struct Archive {
    name: String,
    target: String,
    /// True if it is made on Windows.
    on_windows: bool,
}

impl Archive {
    /// Returns the archive's stem, which is the folder in it.
    fn stem(&self) -> String {
        format!("{}-{}", self.name, self.target)
    }

    /// Returns the file that the workflow uploads.
    fn file(&self) -> String {
        format!("{}.{}", self.stem(), if self.on_windows { "zip" } else { "tgz" })
    }
}

fn read(path: &str) -> String {
    std::fs::read_to_string(root().join(path)).unwrap()
}

/// Reads the archives from the lines of the workflow's matrix.
fn archives(workflow: &str) -> Vec<Archive> {
    let lines = workflow.lines().filter_map(|line| line.trim().strip_prefix("- { name: "));
    let archive = |line: &str| {
        let fields = format!("name: {}", line.trim_end_matches(" }"));
        let fields: BTreeMap<&str, &str> =
            fields.split(", ").filter_map(|field| field.split_once(": ")).collect();
        Archive {
            name: fields["name"].to_owned(),
            target: fields["target"].to_owned(),
            on_windows: fields["runner"].starts_with("windows"),
        }
    };
    lines.map(archive).collect()
}

#[test]
fn binstall_looks_for_the_archives_of_the_workflow() {
    let workflow = read(".github/workflows/release.yml");
    // How the workflow names and packs them, which the rules above repeat.
    for line in [
        "ARCHIVE: ${{ matrix.name }}-${{ matrix.target }}",
        "if [ \"$RUNNER_OS\" = Windows ]; then",
        "7z a \"$ARCHIVE.zip\" \"$ARCHIVE\"",
        "tar -czf \"$ARCHIVE.tgz\" \"$ARCHIVE\"",
        "cp \"$program\" README.md CHANGELOG.md LICENSE-APACHE LICENSE-MIT \"$ARCHIVE\"",
        "tags: [\"v*\"]",
    ] {
        assert!(workflow.contains(line), "the workflow has no `{line}`");
    }
    let archives = archives(&workflow);
    assert!(archives.len() >= 7, "{} archives", archives.len());
    let manifest: toml::Table = read("crates/qudi-cli/Cargo.toml").parse().unwrap();
    let binstall = &manifest["package"]["metadata"]["binstall"];
    let text = |key: &str| binstall[key].as_str().unwrap();
    let plain: Vec<_> = archives.iter().filter(|archive| archive.name == "qudi").collect();
    assert_eq!(plain.len(), 4);
    for archive in plain {
        let own = binstall.get("overrides").and_then(|all| all.get(&archive.target));
        let format = own.map_or(text("pkg-fmt"), |own| own["pkg-fmt"].as_str().unwrap());
        let filled = |template: &str| {
            let binary = if archive.on_windows { ".exe" } else { "" };
            let suffix = format!(".{format}");
            [
                ("{ repo }", "https://forge.example/qudi"),
                ("{ version }", "1.2.3"),
                ("{ target }", archive.target.as_str()),
                ("{ archive-suffix }", suffix.as_str()),
                ("{ bin }", "qudi"),
                ("{ binary-ext }", binary),
            ]
            .into_iter()
            .fold(template.to_owned(), |text, (key, value)| text.replace(key, value))
        };
        assert_eq!(
            filled(text("pkg-url")),
            format!("https://forge.example/qudi/releases/download/v1.2.3/{}", archive.file())
        );
        let program = if archive.on_windows { "qudi.exe" } else { "qudi" };
        assert_eq!(filled(text("bin-dir")), format!("{}/{program}", archive.stem()));
    }
}

/// The address of the repository is written by the script that publishes, and by nobody else.
#[test]
fn manifests_have_no_address_until_they_are_published() {
    let manifest: toml::Table = read("crates/qudi-cli/Cargo.toml").parse().unwrap();
    assert!(manifest["package"].get("repository").is_none());
    assert!(read("scripts/package.sh").contains("nrepository = \\\"$url\\\""));
    assert!(read("CONTRIBUTING.md").contains("`repository`"));
}
