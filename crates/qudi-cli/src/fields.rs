//! The command-line flags of the fields that library errors name.

/// Fields of the libraries that have a flag of the same name.
const FIELDS: &[&str] = &[
    "array",
    "axes",
    "backbones",
    "bits",
    "bitorder",
    "bursts",
    "channel",
    "crop",
    "data",
    "dcr",
    "device",
    "end",
    "exposure",
    "fps",
    "format",
    "frames",
    "frames_per_file",
    "gain",
    "header",
    "instants",
    "levels",
    "mask",
    "motion",
    "orient",
    "overlap",
    "pack_axis",
    "ppp",
    "ppp_def",
    "samples",
    "seed",
    "sensor",
    "set",
    "size",
    "speed",
    "start",
    "steps",
    "sum",
    "tile",
    "trailer",
    "transfer",
    "white",
    "window",
    "workers",
];

/// The place of an error as the user knows it: `--ppp-def` for the field `ppp_def`, anything else unchanged.
pub(crate) fn flags(place: &str) -> String {
    let flag = |part: &str| {
        if FIELDS.contains(&part) {
            format!("--{}", part.replace('_', "-"))
        } else {
            part.to_owned()
        }
    };
    place.split(", ").map(flag).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_become_flags_and_paths_stay() {
        assert_eq!(flags("ppp_def"), "--ppp-def");
        assert_eq!(flags("start, end"), "--start, --end");
        assert_eq!(flags("captures/a.npy"), "captures/a.npy");
    }
}
