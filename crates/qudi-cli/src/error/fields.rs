//! The command-line flags of the fields that library errors name.

use crate::args::{Args, Global};
use crate::commands::info::args::Info;
use crate::commands::restore::args::Restore;
use crate::settings::keys;
use clap::{Args as _, Command, CommandFactory};

/// Returns the place of an error as the user knows it: `--ppp-def` for the field `ppp_def`, anything else
/// unchanged.
pub(crate) fn flags(place: &str) -> String {
    let args = Args::command();
    let flag = |part: &str| match args.get_subcommands().find_map(|command| flag(command, part)) {
        Some(flag) => flag,
        None => part.to_owned(),
    };
    place.split(", ").map(flag).collect::<Vec<_>>().join(", ")
}

/// Returns the text of a library with flags for the quoted fields in it: `--size HxW` for `size HxW`. A name
/// alone may be a key of sensors instead: `bits` is one, `bits 3` is a flag.
pub(crate) fn flags_in_text(text: &str) -> String {
    let augment = [Global::augment_args, Info::augment_args, Restore::augment_args];
    let commands = augment.map(|augment| augment(Command::new("")));
    let parts: Vec<_> = text.split('`').collect();
    let mut out = String::new();
    for (i, part) in parts.iter().enumerate() {
        let quoted = i % 2 == 1 && i + 1 < parts.len();
        let (name, value) = part.split_once(' ').unwrap_or((part, ""));
        let is_key = keys().iter().any(|key| key.name().strip_prefix("sensor.") == Some(name));
        let assigns = value.starts_with('=') || value.is_empty() && is_key;
        let flag = commands.iter().find_map(|command| flag(command, name));
        if let Some(flag) = flag.filter(|_| quoted && !assigns) {
            out += &flag;
            out += &part[name.len()..];
            continue;
        }
        out += if i % 2 == 1 { "`" } else { "" };
        out += part;
        out += if quoted { "`" } else { "" };
    }
    out
}

/// Returns the flag of `command` for a field, with its dashes.
fn flag(command: &Command, field: &str) -> Option<String> {
    let long = field.replace('_', "-");
    let is_flag = command.get_arguments().any(|argument| argument.get_long() == Some(&long));
    is_flag.then(|| format!("--{long}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_in_text_become_flags() {
        assert_eq!(
            flags_in_text("use `pack_axis none`, or `size`"),
            "use --pack-axis none, or --size"
        );
        assert_eq!(flags_in_text("raise `bits` or say `bits 3`"), "raise `bits` or say --bits 3");
        assert_eq!(flags_in_text("set `bits = 1`"), "set `bits = 1`");
        assert_eq!(
            flags_in_text("`qudi info --formats` lists `size"),
            "`qudi info --formats` lists `size"
        );
    }

    #[test]
    fn fields_become_flags_and_paths_stay() {
        assert_eq!(flags("ppp_def"), "--ppp-def");
        assert_eq!(flags("start, end"), "--start, --end");
        assert_eq!(flags("captures/a.npy"), "captures/a.npy");
    }
}
