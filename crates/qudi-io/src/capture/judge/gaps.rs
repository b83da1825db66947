//! Missing frames, across which nothing is followed if they are many.

use std::ops::Range;

/// Missing sums, times the sums of the shorter stretch beside them, from which on nothing is followed across
/// them: short stretches need their neighbours, and a few frames hardly matter in a long sum.
const MIN_GAP: u64 = 20;

/// Returns the frames after long gaps among `gaps`, frames of `range` with the number of frames that are
/// missing before each, where `sum` frames are summed.
pub(super) fn long_gaps(gaps: &[(u64, u64)], range: &Range<u64>, sum: u32) -> Vec<u64> {
    let edge = |n: Option<usize>, otherwise: u64| {
        n.and_then(|n| gaps.get(n)).map_or(otherwise, |(frame, _)| *frame)
    };
    let is_long = |&(n, (frame, missing)): &(usize, &(u64, u64))| {
        let before = frame - edge(n.checked_sub(1), range.start);
        let after = edge(Some(n + 1), range.end) - frame;
        let area = u128::from(*missing) * u128::from(before.min(after));
        area >= u128::from(MIN_GAP) * u128::from(sum).pow(2)
    };
    gaps.iter().enumerate().filter(is_long).map(|(_, (frame, _))| *frame).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_count_by_their_length_and_by_what_lies_beside() {
        assert_eq!(long_gaps(&[(9, 5)], &(0..25), 1), [9]);
        assert_eq!(long_gaps(&[(15, 1)], &(0..30), 1), [0_u64; 0]);
        assert_eq!(long_gaps(&[(200, 1), (205, 1), (400, 3)], &(100..500), 1), [400]);
        assert_eq!(long_gaps(&[(5000, 1)], &(0..10_000), 1), [5000]);
        assert_eq!(long_gaps(&[(5000, 1)], &(0..10_000), 100), [0_u64; 0]);
        assert_eq!(long_gaps(&[(5000, 100)], &(0..10_000), 100), [5000]);
    }
}
