//! The flags of `qudi simulate` that set keys, made from the table of keys.

use super::keys::{Key, keys};
use super::toml_text;
use clap::{Arg, ArgMatches, Command, ValueHint};
use serde_json::Value;

/// The keys that flags set, with their text.
#[derive(Clone, Debug, Default)]
pub(crate) struct KeyFlags(pub(super) Vec<(&'static Key, String)>);

impl KeyFlags {
    /// Returns the first flag on the command line, with its dashes.
    pub(crate) fn first(&self) -> Option<String> {
        self.0.first().and_then(|(key, _)| key.flag).map(|flag| format!("--{}", flag.long))
    }
}

impl clap::FromArgMatches for KeyFlags {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        let given = keys().iter().filter_map(|key| {
            let text = matches.get_one::<String>(key.flag?.long)?;
            Some((key, text.clone()))
        });
        Ok(Self(given.collect()))
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

impl clap::Args for KeyFlags {
    fn augment_args(command: Command) -> Command {
        command.args(keys().iter().filter_map(argument))
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

/// Makes the argument of a key that has a flag.
fn argument(key: &'static Key) -> Option<Arg> {
    let flag = key.flag?;
    let default = match &key.documented.default {
        Value::Null => String::new(),
        Value::String(text) => format!(" [default: {text}]"),
        other => format!(" [default: {}]", toml_text(other)),
    };
    let help = key.documented.doc.replace('`', "");
    let argument = Arg::new(flag.long)
        .long(flag.long)
        .value_name(flag.value)
        .allow_hyphen_values(true)
        .help(help + &default)
        .help_heading(flag.heading);
    Some(match key.name() {
        "simulate.sensor" => argument.value_hint(ValueHint::AnyPath),
        _ => argument,
    })
}
