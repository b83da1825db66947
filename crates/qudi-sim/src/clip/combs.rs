//! Combs: lines of two instants in one frame, as interlaced films have them.

use qudi_core::Frame;

/// Side of the blocks that are looked at.
const BLOCK: usize = 16;

/// Factor by which neighbouring lines differ more than every other line does, in a comb.
const FACTOR: f32 = 3.0;

/// Least mean difference of neighbouring lines in a comb.
const MIN_DIFFERENCE: f32 = 0.02;

/// Share of all blocks that are combs, in an interlaced film in which something moves.
const MIN_SHARE: f64 = 0.01;

/// Counts combs in the frames of a clip.
#[derive(Debug, Default)]
pub(crate) struct Combs {
    blocks: u64,
    combs: u64,
}

impl Combs {
    /// Looks at a frame.
    pub(crate) fn add(&mut self, frame: &Frame) {
        let width = frame.size.width;
        let row = |y: usize, left: usize| &frame.data[y * width + left..][..BLOCK];
        let difference = |a: &[f32], b: &[f32]| -> f32 {
            a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum::<f32>() / BLOCK as f32
        };
        for top in (0..frame.size.height.saturating_sub(BLOCK + 1)).step_by(BLOCK) {
            for left in (0..width.saturating_sub(BLOCK - 1)).step_by(BLOCK) {
                let (mut near, mut far) = (0.0, 0.0);
                for y in top..top + BLOCK {
                    near += difference(row(y, left), row(y + 1, left));
                    far += difference(row(y, left), row(y + 2, left));
                }
                self.blocks += 1;
                let is_comb = near > FACTOR * far && near > MIN_DIFFERENCE * BLOCK as f32;
                self.combs += u64::from(is_comb);
            }
        }
    }

    /// Describes the combs of the clip at `place`, if there are many.
    pub(crate) fn note(&self, place: &str) -> Option<String> {
        let share = self.combs as f64 / self.blocks.max(1) as f64;
        (share > MIN_SHARE).then(|| {
            format!(
                "neighbouring lines differ like two instants in {:.0} % of the picture, as in interlaced films: {place}; deinterlace it first, as with `ffmpeg -i FILE -vf bwdif OUT.mkv`",
                100.0 * share
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_core::Size;

    /// Looks at a texture that moves by `speed` pixels a frame; odd lines are half a frame late if `combed`.
    fn note(speed: f32, combed: bool) -> Option<String> {
        let size = Size { height: 64, width: 96 };
        let mut combs = Combs::default();
        for t in 0..5u8 {
            let value = |i: usize| {
                let (x, y) = ((i % size.width) as f32, i / size.width);
                let late = if combed && y % 2 == 1 { 0.5 } else { 0.0 };
                let x = x - speed * (f32::from(t) + late);
                0.5 + 0.4 * (0.4 * x).sin() * (0.1 * y as f32).cos()
            };
            let data = (0..size.pixels()).map(value).collect();
            combs.add(&Frame { size, data });
        }
        combs.note("film.mkv")
    }

    #[test]
    fn combs_of_moving_films_are_named() {
        assert!(note(8.0, true).unwrap().contains("film.mkv"));
        assert_eq!(note(0.0, true), None);
        assert_eq!(note(8.0, false), None);
    }
}
