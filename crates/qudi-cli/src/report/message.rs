//! Messages of a command to the program that runs it.

use serde_json::Value;
use std::rc::Rc;

/// A message of a running command.
#[derive(Clone, Debug)]
pub enum Message {
    /// What the user should know.
    Note(String),
    /// What makes a result doubtful.
    Warning(String),
    /// How far some work has come.
    Progress {
        /// The work, in words.
        what: String,
        /// Frames or steps that are done.
        done: u64,
        /// Frames or steps in all, if known.
        total: Option<u64>,
    },
    /// The result, as `--json` prints it.
    Result(Value),
}

/// A receiver of messages.
pub type Listener = Rc<dyn Fn(Message)>;
