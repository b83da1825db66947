//! Parts of the work, for several machines.

use qudi_io::restore::Share;

/// One of several equal parts of the work.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Shard {
    number: u64,
    of: u64,
}

impl Shard {
    /// Returns what it locks in the folder that the parts share.
    pub(crate) fn share(self) -> Share {
        Share::Part { number: self.number, of: self.of }
    }

    /// Returns its part of `frames`.
    pub(crate) fn range(self, frames: u64) -> std::ops::Range<u64> {
        let start = |n: u64| (u128::from(frames) * u128::from(n) / u128::from(self.of)) as u64;
        start(self.number - 1)..start(self.number)
    }
}

impl std::str::FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts =
            text.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
        match parts {
            Some((number, of)) if (1..=of).contains(&number) => Ok(Self { number, of }),
            _ => Err("expected I/N with I from 1 to N, as in 3/8".to_owned()),
        }
    }
}
