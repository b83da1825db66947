//! How long something takes, in words.

/// Formats seconds for people.
pub(crate) fn duration(seconds: f64) -> String {
    if seconds < 1.5 {
        "1 second".to_owned()
    } else if seconds < 120.0 {
        format!("{seconds:.0} seconds")
    } else if seconds < 7200.0 {
        format!("{:.0} minutes", seconds / 60.0)
    } else {
        format!("{:.1} hours", seconds / 3600.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_have_a_fitting_unit() {
        let all = [1.4, 119.0, 150.0, 7100.0, 9000.0].map(duration);
        assert_eq!(all, ["1 second", "119 seconds", "2 minutes", "118 minutes", "2.5 hours"]);
    }
}
