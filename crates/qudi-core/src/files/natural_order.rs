//! Natural order of file names: numbers in them are compared by value.

use std::cmp::Ordering;

/// Compares names with runs of digits as numbers: `frame2` before `frame10`.
pub fn natural_order(a: &str, b: &str) -> Ordering {
    let (mut a, mut b) = (a, b);
    loop {
        let digits = |s: &str| s.len() - s.trim_start_matches(|c: char| c.is_ascii_digit()).len();
        let (da, db) = (digits(a), digits(b));
        let order = if da > 0 && db > 0 {
            let (na, nb) = (a[..da].trim_start_matches('0'), b[..db].trim_start_matches('0'));
            let order = na.len().cmp(&nb.len()).then_with(|| na.cmp(nb)).then_with(|| da.cmp(&db));
            (a, b) = (&a[da..], &b[db..]);
            order
        } else {
            let (ca, cb) = (a.chars().next(), b.chars().next());
            let (Some(ca), Some(cb)) = (ca, cb) else { return ca.cmp(&cb) };
            (a, b) = (&a[ca.len_utf8()..], &b[cb.len_utf8()..]);
            ca.cmp(&cb)
        };
        if order != Ordering::Equal {
            return order;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn natural_order_sorts_numbers_by_value() {
        let mut names = ["f10.png", "f9.png", "f1.png", "f01.png", "e100.png", "f.png"];
        names.sort_by(|a, b| natural_order(a, b));
        assert_eq!(names, ["e100.png", "f.png", "f1.png", "f01.png", "f9.png", "f10.png"]);
    }
}
