//! The address of a served page: loopback, a port, and a token that nobody guesses.

use crate::error::{CliError, Result};
use std::fmt::Write;

/// Bytes of the token.
const TOKEN_BYTES: usize = 16;

/// The address that a page is served at.
#[derive(Clone, Debug)]
pub(super) struct Address {
    port: u16,
    token: String,
}

impl Address {
    /// Draws a new token for a port.
    pub(super) fn new(port: u16) -> Result<Self> {
        let mut bytes = [0u8; TOKEN_BYTES];
        getrandom::fill(&mut bytes).map_err(|e| {
            CliError::new(format!("no random numbers: {e}"), "the system", "try again later")
        })?;
        let mut token = String::new();
        for byte in bytes {
            let _ = write!(token, "{byte:02x}");
        }
        Ok(Self { port, token })
    }

    /// Returns the address for a browser.
    pub(super) fn url(&self) -> String {
        format!("http://127.0.0.1:{}/{}/", self.port, self.token)
    }

    /// Returns true if `host` is how a browser on this computer names the server. Other names may lead here,
    /// too, where another site has taught them to (DNS rebinding).
    pub(super) fn is_host(&self, host: &str) -> bool {
        let port = self.port;
        ["127.0.0.1", "localhost"]
            .iter()
            .any(|name| host.eq_ignore_ascii_case(&format!("{name}:{port}")))
    }

    /// Returns true if `origin` is a page of this server.
    pub(super) fn is_origin(&self, origin: &str) -> bool {
        origin.strip_prefix("http://").is_some_and(|host| self.is_host(host))
    }

    /// Returns what follows the token in a path; none for any other token.
    pub(super) fn strip_token<'a>(&self, path: &'a str) -> Option<&'a str> {
        let (token, rest) = path.strip_prefix('/')?.split_once('/')?;
        let (given, own) = (token.as_bytes(), self.token.as_bytes());
        // Compared in full, so that the time tells nothing.
        let differing = given.iter().zip(own).fold(0, |sum, (a, b)| sum | (a ^ b));
        (given.len() == own.len() && differing == 0).then_some(rest)
    }
}

#[cfg(test)]
impl Address {
    pub(super) fn known(port: u16, token: &str) -> Self {
        Self { port, token: token.to_owned() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_are_long_and_differ() {
        let draw = || Address::new(80).unwrap_or_else(|e| panic!("{e:?}")).token;
        let (first, second) = (draw(), draw());
        assert!(first.len() == 32 && first != second);
    }

    #[test]
    fn strips_the_whole_token_alone() {
        let address = Address::known(80, "abcd");
        assert_eq!(address.strip_token("/abcd/"), Some(""));
        assert_eq!(address.strip_token("/abcd/frame/x"), Some("frame/x"));
        for other in ["/abc/", "/abcde/", "/abcd", "abcd/", "//abcd/", "/ABCD/", "/", ""] {
            assert_eq!(address.strip_token(other), None, "{other}");
        }
    }
}
