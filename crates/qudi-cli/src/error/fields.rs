//! The command-line flags of the fields that library errors name.

/// Fields of the libraries that have a flag of the same name.
const FIELDS: &[&str] = &[
    "array",
    "axes",
    "backbones",
    "bits",
    "bitorder",
    "bursts",
    "cfa",
    "channel",
    "crop",
    "data",
    "dcr",
    "device",
    "end",
    "every",
    "exposure",
    "fps",
    "format",
    "frames",
    "frames_per_file",
    "frames_per_image",
    "gain",
    "header",
    "instants",
    "levels",
    "mask",
    "method",
    "motion",
    "offset",
    "orient",
    "overlap",
    "pack_axis",
    "ppp",
    "ppp_def",
    "preset",
    "samples",
    "seed",
    "sensor",
    "set",
    "size",
    "speed",
    "start",
    "steps",
    "sum",
    "threshold",
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

/// Fields that messages name in backquotes, alone or with a value, and that are no keys of sensor files.
const IN_TEXT: &[&str] = &[
    "array",
    "axes",
    "bitorder",
    "cfa",
    "channel",
    "crop",
    "dcr",
    "end",
    "force",
    "format",
    "frames_per_file",
    "header",
    "lenient",
    "offset",
    "levels",
    "mask",
    "orient",
    "pack_axis",
    "preview",
    "sensor",
    "size",
    "start",
    "steps",
    "sum",
    "threshold",
    "tile",
    "trailer",
];

/// The text of a library with flags for the fields in it: `--size HxW` for a quoted `size HxW`.
pub(crate) fn flags_in_text(text: &str) -> String {
    let parts: Vec<_> = text.split('`').collect();
    let mut out = String::new();
    for (i, part) in parts.iter().enumerate() {
        let quoted = i % 2 == 1 && i + 1 < parts.len();
        let (name, value) = part.split_once(' ').unwrap_or((part, ""));
        // With a value, `bits` is the depth of a capture; alone, a key of sensors.
        if quoted && (IN_TEXT.contains(&name) || (name == "bits" && !value.is_empty())) {
            out += &format!("--{}", name.replace('_', "-"));
            out += &part[name.len()..];
            continue;
        }
        out += if i % 2 == 1 { "`" } else { "" };
        out += part;
        out += if quoted { "`" } else { "" };
    }
    out
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
