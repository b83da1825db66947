//! Rows, columns and clumps of pixels that never fire.

use super::neighbours;
use crate::frame::Size;

/// Count that the pixels around a dead line or clump exceed: chance leaves none of them empty.
const MIN_COUNT: f64 = 60.0;

/// Thickness of a dead line, and side of a dead clump, at most.
const MAX_THICKNESS: usize = 3;

/// Share of the pixels around that are bright.
const BRIGHT_SHARE: f64 = 0.75;

/// Finds empty pixels in lines and small clumps among bright ones. Black parts of a scene are thicker, and
/// optics leave a rim around them.
pub(super) fn dead_lines_and_clumps(detections: &[f64], size: Size) -> Vec<usize> {
    let mut known = vec![false; size.pixels()];
    let mut dead = Vec::new();
    for start in 0..size.pixels() {
        if known[start] || detections[start] > 0.0 {
            continue;
        }
        let group = group(start, detections, size, &mut known);
        if is_thin(&group, size) && has_bright_rim(&group, detections, size) {
            dead.extend(group);
        }
    }
    dead
}

/// Returns all empty pixels that touch each other, `start` among them.
fn group(start: usize, detections: &[f64], size: Size, known: &mut [bool]) -> Vec<usize> {
    let mut group = vec![start];
    known[start] = true;
    let mut at = 0;
    while at < group.len() {
        neighbours(group[at], size, 1, |j| {
            if !known[j] && detections[j] <= 0.0 {
                known[j] = true;
                group.push(j);
            }
        });
        at += 1;
    }
    group
}

/// Returns true if the pixels lie in few rows or few columns.
fn is_thin(group: &[usize], size: Size) -> bool {
    let extent = |place: fn(usize, usize) -> usize| {
        let places = || group.iter().map(|&i| place(i, size.width));
        places().max().unwrap_or(0) - places().min().unwrap_or(0) + 1
    };
    extent(|i, width| i / width).min(extent(|i, width| i % width)) <= MAX_THICKNESS
}

/// Returns true if most pixels around are bright.
fn has_bright_rim(group: &[usize], detections: &[f64], size: Size) -> bool {
    let (mut all, mut bright) = (0, 0);
    for &i in group {
        neighbours(i, size, 1, |j| {
            if detections[j] > 0.0 {
                all += 1;
                bright += usize::from(detections[j] > MIN_COUNT);
            }
        });
    }
    all > 0 && bright as f64 >= BRIGHT_SHARE * f64::from(all)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_and_clumps_are_dead_and_black_things_are_not() {
        let size = Size { height: 40, width: 50 };
        let mut light = vec![98.0; size.pixels()];
        let mut set = |y: std::ops::Range<usize>, x: std::ops::Range<usize>, value: f64| {
            y.for_each(|y| x.clone().for_each(|x| light[y * size.width + x] = value));
        };
        set(20..21, 0..50, 0.0);
        set(23..40, 31..32, 0.0);
        set(3..5, 3..6, 0.0);
        // A black square, and a wire with soft edges.
        set(26..38, 4..16, 0.0);
        set(5..7, 12..25, 20.0);
        set(6..7, 13..24, 0.0);
        let dead = dead_lines_and_clumps(&light, size);
        assert_eq!(dead.len(), 50 + 17 + 6);
        assert!(dead.contains(&(20 * 50 + 7)) && dead.contains(&(3 * 50 + 3)));
    }
}
