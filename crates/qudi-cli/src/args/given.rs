//! Flags that only some methods take: which of them are on the command line.

use clap::parser::ValueSource;
use clap::{ArgGroup, ArgMatches, Args, Command, Error, FromArgMatches, Id};

/// The group of flags that only networks of this project take.
pub(crate) const OWN: &str = "own";

/// The group of flags that only diffusion takes.
pub(crate) const DIFFUSION: &str = "diffusion";

/// The first flag of each group on the command line, with its dashes. Flatten it into a command before the
/// other arguments: clap takes their values out of the matches.
#[derive(Clone, Debug, Default)]
pub(crate) struct Given {
    pub(crate) own: Option<String>,
    pub(crate) diffusion: Option<String>,
}

impl FromArgMatches for Given {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, Error> {
        let first = |group: &str| {
            let ids = matches.get_many::<Id>(group)?;
            let is_given = |id: &&str| matches.value_source(id) == Some(ValueSource::CommandLine);
            let id = ids.map(Id::as_str).find(is_given)?;
            Some(format!("--{}", id.replace('_', "-")))
        };
        Ok(Self { own: first(OWN), diffusion: first(DIFFUSION) })
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

impl Args for Given {
    fn augment_args(command: Command) -> Command {
        let group = |name| ArgGroup::new(name).multiple(true);
        command.groups([OWN, DIFFUSION].map(group))
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}
