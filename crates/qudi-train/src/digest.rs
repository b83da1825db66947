//! Digests of files' contents, which show damage that their formats do not.

use sha2::{Digest as _, Sha256};

/// A digest of named contents, in their order.
#[derive(Debug, Default)]
pub(super) struct Digest(Sha256);

impl Digest {
    /// Adds content under a name; neither can be taken for a part of the other.
    pub(super) fn add(&mut self, name: &str, content: &[u8]) {
        for part in [name.as_bytes(), content] {
            self.0.update((part.len() as u64).to_le_bytes());
            self.0.update(part);
        }
    }

    /// Returns the digest in hexadecimal.
    pub(super) fn text(self) -> String {
        format!("{:x}", self.0.finalize())
    }
}
