//! Tests that the program takes every command in the documentation, also those that no test runs.

#![allow(clippy::unwrap_used)]

use super::Args;
use clap::Parser;
use std::path::{Path, PathBuf};

/// Returns the pages of the documentation.
fn pages() -> Vec<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let mut pages: Vec<_> =
        ["README.md", "CONTRIBUTING.md", "SECURITY.md"].map(|name| root.join(name)).into();
    let mut folders = vec![root.join("docs")];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.ends_with("docs/notes") {
                // Notes have commands of the commits that they name.
                continue;
            }
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "md") {
                pages.push(path);
            }
        }
    }
    pages
}

/// Returns the shell lines of a page: blocks of `sh`, and rows of tables that compare programs.
fn shell(page: &Path, text: &str) -> String {
    let mut lines = String::new();
    let mut is_shell = None;
    let compares = page.ends_with("docs/coming-from.md");
    for line in text.lines() {
        if let Some(info) = line.trim_start().strip_prefix("```") {
            is_shell = is_shell.is_none().then(|| info.split(' ').next() == Some("sh"));
        } else if is_shell == Some(true) {
            lines += line;
            lines.push('\n');
        } else if compares && line.starts_with('|') {
            for code in line.split('`').skip(1).step_by(2) {
                if code.starts_with("qudi ") {
                    lines += code;
                    lines.push('\n');
                }
            }
        }
    }
    lines
}

/// Splits shell text into its simple commands, without quotes, comments and redirections.
fn commands(text: &str) -> Vec<Vec<String>> {
    let mut commands = vec![Vec::new()];
    let mut word: Option<String> = None;
    let mut quote = None;
    let mut characters = text.chars().peekable();
    while let Some(c) = characters.next() {
        if quote == Some(c) {
            quote = None;
        } else if quote.is_some() {
            word.get_or_insert_default().push(c);
        } else if c == '\'' || c == '"' {
            quote = Some(c);
            word.get_or_insert_default();
        } else if c == '\\' {
            characters.next_if_eq(&'\n');
        } else if c == '#' && word.is_none() {
            while characters.next_if(|&c| c != '\n').is_some() {}
        } else if c.is_whitespace() || "|;&<>".contains(c) {
            commands.last_mut().unwrap().extend(word.take());
            if c == '\n' || !c.is_whitespace() {
                commands.push(Vec::new());
            }
        } else {
            word.get_or_insert_default().push(c);
        }
    }
    commands.last_mut().unwrap().extend(word);
    commands.retain(|words| !words.is_empty());
    commands
}

/// Returns the command lines of `qudi` in shell text, also behind another program and in quotes.
fn calls(text: &str) -> Vec<Vec<String>> {
    let mut calls = Vec::new();
    for words in commands(text) {
        for quoted in words.iter().filter(|word| word.starts_with("qudi ")) {
            calls.extend(self::calls(quoted));
        }
        if let Some(start) = words.iter().position(|word| word == "qudi") {
            calls.push(words[start..].to_vec());
        }
    }
    calls
}

#[test]
fn every_documented_command_is_taken() {
    let (mut count, mut faults) = (0, String::new());
    for page in pages() {
        let text = std::fs::read_to_string(&page).unwrap();
        let text = shell(&page, &text).replace("$SLURM_ARRAY_TASK_ID", "1").replace("{}", "1");
        for words in calls(&text) {
            count += 1;
            if let Err(error) = Args::try_parse_from(&words) {
                faults += &format!("{}: {}\n{error}\n", page.display(), words.join(" "));
            }
        }
    }
    assert!(faults.is_empty(), "{faults}");
    assert!(count > 80, "{count} commands: the pages lie elsewhere");
}

#[test]
fn splits_shell_text_into_commands() {
    let text = "camera | qudi restore - \\\n  -o 'a b' > c  # no qudi\nseq 2 | parallel 'qudi info {}' && qudi demo\n";
    let found: Vec<_> = calls(text).iter().map(|words| words.join("+")).collect();
    assert_eq!(found, ["qudi+restore+-+-o+a b", "qudi+info+{}", "qudi+demo"]);
}
