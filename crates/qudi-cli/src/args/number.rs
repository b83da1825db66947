//! Numbers on the command line: every one has a range.

use clap::builder::TypedValueParser;
use std::fmt::Display;
use std::ops::RangeInclusive;
use std::str::FromStr;

/// The most threads that are started: several times the cores of large machines.
pub(crate) const MAX_THREADS: u64 = 256;

/// The most photons per pixel and frame: a million times what a picture needs.
pub(crate) const PPP: RangeInclusive<f64> = 1e-9..=1e9;

/// Gains in DN per electron.
pub(crate) const GAIN: RangeInclusive<f64> = 1e-9..=1e9;

/// Mean image values.
pub(crate) const EXPOSURE: RangeInclusive<f64> = 1e-6..=1.0;

/// Numbers of frames summed into one.
pub(crate) const SUM: RangeInclusive<u64> = 1..=1 << 24;

/// Frames per second of what plays.
pub(crate) const PLAYED_FPS: RangeInclusive<f64> = 0.01..=1000.0;

/// Sample values in DN.
pub(crate) const DN: RangeInclusive<f64> = 0.0..=65_535.0;

/// Seconds that a command may take.
pub(crate) const SECONDS: RangeInclusive<f64> = 1.0..=1e7;

/// Numbers of frames, or of bytes.
pub(crate) const COUNT: RangeInclusive<u64> = 1..=1 << 40;

/// Reads a finite number in a range.
pub(crate) fn real(range: RangeInclusive<f64>) -> impl TypedValueParser<Value = f64> {
    move |text: &str| in_range(text, &range)
}

/// Reads a whole number in a range.
pub(crate) fn whole<T>(range: RangeInclusive<u64>) -> impl TypedValueParser<Value = T>
where
    T: TryFrom<u64> + Clone + Send + Sync + 'static,
{
    move |text: &str| {
        let number = in_range::<u64>(text, &range)?;
        T::try_from(number).map_err(|_| wanted(&range))
    }
}

fn in_range<T: FromStr + PartialOrd + Display>(
    text: &str,
    range: &RangeInclusive<T>,
) -> Result<T, String> {
    let number = text.parse::<T>().ok().filter(|number| range.contains(number));
    number.ok_or_else(|| wanted(range))
}

fn wanted<T: Display>(range: &RangeInclusive<T>) -> String {
    format!("give a number from {} to {}", range.start(), range.end())
}

#[cfg(test)]
mod tests {
    use crate::args::Args;
    use clap::{CommandFactory, Parser};
    use std::any::TypeId;

    /// What every command needs besides its numbers.
    const NEEDED_ARGUMENTS: &[(&str, &str)] = &[
        ("simulate", "scene:text -o o.npy"),
        ("restore", "c.npy -o o"),
        ("train", "tiny -o o"),
        ("publish", "w.safetensors -o o.safetensors"),
        ("eval", "c.npy --capture"),
        ("bench", ""),
        ("selftest", ""),
        ("convert", "c.npy -o o.npy"),
        ("calibrate", "c.npy -o o.toml"),
        ("demo", ""),
        ("light", ""),
        ("info", "c.npy"),
        ("look", "c.npy"),
    ];

    #[test]
    fn every_number_of_every_command_has_a_range() {
        let numbers = [
            TypeId::of::<f64>(),
            TypeId::of::<f32>(),
            TypeId::of::<usize>(),
            TypeId::of::<u64>(),
            TypeId::of::<u32>(),
            TypeId::of::<u16>(),
            TypeId::of::<u8>(),
            TypeId::of::<std::num::NonZeroUsize>(),
        ];
        let mut seen = 0;
        let mut command = Args::command();
        command.build();
        for verb in command.get_subcommands() {
            let Some((name, needed)) =
                NEEDED_ARGUMENTS.iter().find(|(name, _)| *name == verb.get_name())
            else {
                continue;
            };
            for argument in verb.get_arguments() {
                let kind = argument.get_value_parser().type_id();
                let Some(long) = argument.get_long() else { continue };
                if !numbers.iter().any(|number| kind == *number) {
                    continue;
                }
                seen += 1;
                for text in ["nan", "inf", "-inf", "1e300", "-1e300", "99999999999999999999", "-1"]
                {
                    let flag = format!("--{long}={text}");
                    let words = ["qudi", name].into_iter().chain(needed.split_whitespace());
                    let mut words: Vec<&str> = words.collect();
                    // One of these stands in for the light.
                    if *name == "light" && !["lux", "ppp", "scene-lux"].contains(&long) {
                        words.push("--lux=1");
                    }
                    words.push(&flag);
                    // Psnr may be negative.
                    let possible = long == "min-psnr" && text == "-1";
                    let parsed = Args::try_parse_from(&words);
                    assert_eq!(parsed.is_ok(), possible, "{words:?}");
                }
            }
        }
        assert!(seen > 40, "{seen} numbers");
    }

    #[test]
    fn says_the_range_of_a_number() {
        let words = ["qudi", "restore", "c.npy", "-o", "o", "--exposure", "2"];
        let refused = Args::try_parse_from(words).err().map(|e| e.to_string());
        assert!(refused.is_some_and(|text| text.contains("give a number from 0.000001 to 1")));
    }
}
