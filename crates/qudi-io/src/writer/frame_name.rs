//! The names of frames in a folder: `frame_000000.png`, `frame_000001.png`, and so on.

/// Returns the name of frame `number`.
pub(crate) fn frame_name(number: u64) -> String {
    format!("frame_{number:06}.png")
}

/// Returns true if `name` is one that [`frame_name`] returns.
pub(crate) fn is_frame_name(name: &str) -> bool {
    let number = name.strip_prefix("frame_").and_then(|rest| rest.strip_suffix(".png"));
    number.is_some_and(|n| n.len() >= 6 && n.chars().all(|c| c.is_ascii_digit()))
}

/// Returns true if `name` is of one of the first `count` frames.
pub(crate) fn is_frame_below(name: &str, count: u64) -> bool {
    let number = name.strip_prefix("frame_").and_then(|rest| rest.strip_suffix(".png"));
    let number = number.and_then(|number| number.parse::<u64>().ok());
    number.is_some_and(|number| number < count && name == frame_name(number))
}
