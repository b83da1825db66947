//! A 5 x 7 dot-matrix font for moving text and for the labels of pictures.

use qudi_core::Frame;

/// Columns of a glyph.
pub const GLYPH_WIDTH: usize = 5;
/// Rows of a glyph.
pub const GLYPH_HEIGHT: usize = 7;

/// One byte per column, bit 0 on top.
const GLYPHS: &[(char, [u8; GLYPH_WIDTH])] = &[
    ('%', [0x23, 0x13, 0x08, 0x64, 0x62]),
    ('(', [0x00, 0x1c, 0x22, 0x41, 0x00]),
    (')', [0x00, 0x41, 0x22, 0x1c, 0x00]),
    ('+', [0x08, 0x08, 0x3e, 0x08, 0x08]),
    (',', [0x00, 0x50, 0x30, 0x00, 0x00]),
    ('-', [0x08, 0x08, 0x08, 0x08, 0x08]),
    ('.', [0x00, 0x60, 0x60, 0x00, 0x00]),
    ('/', [0x20, 0x10, 0x08, 0x04, 0x02]),
    ('0', [0x3e, 0x51, 0x49, 0x45, 0x3e]),
    ('1', [0x00, 0x42, 0x7f, 0x40, 0x00]),
    ('2', [0x42, 0x61, 0x51, 0x49, 0x46]),
    ('3', [0x21, 0x41, 0x45, 0x4b, 0x31]),
    ('4', [0x18, 0x14, 0x12, 0x7f, 0x10]),
    ('5', [0x27, 0x45, 0x45, 0x45, 0x39]),
    ('6', [0x3c, 0x4a, 0x49, 0x49, 0x30]),
    ('7', [0x01, 0x71, 0x09, 0x05, 0x03]),
    ('8', [0x36, 0x49, 0x49, 0x49, 0x36]),
    ('9', [0x06, 0x49, 0x49, 0x29, 0x1e]),
    (':', [0x00, 0x36, 0x36, 0x00, 0x00]),
    ('=', [0x14, 0x14, 0x14, 0x14, 0x14]),
    ('A', [0x7e, 0x11, 0x11, 0x11, 0x7e]),
    ('B', [0x7f, 0x49, 0x49, 0x49, 0x36]),
    ('C', [0x3e, 0x41, 0x41, 0x41, 0x22]),
    ('D', [0x7f, 0x41, 0x41, 0x22, 0x1c]),
    ('E', [0x7f, 0x49, 0x49, 0x49, 0x41]),
    ('F', [0x7f, 0x09, 0x09, 0x09, 0x01]),
    ('G', [0x3e, 0x41, 0x49, 0x49, 0x7a]),
    ('H', [0x7f, 0x08, 0x08, 0x08, 0x7f]),
    ('I', [0x00, 0x41, 0x7f, 0x41, 0x00]),
    ('J', [0x20, 0x40, 0x41, 0x3f, 0x01]),
    ('K', [0x7f, 0x08, 0x14, 0x22, 0x41]),
    ('L', [0x7f, 0x40, 0x40, 0x40, 0x40]),
    ('M', [0x7f, 0x02, 0x0c, 0x02, 0x7f]),
    ('N', [0x7f, 0x04, 0x08, 0x10, 0x7f]),
    ('O', [0x3e, 0x41, 0x41, 0x41, 0x3e]),
    ('P', [0x7f, 0x09, 0x09, 0x09, 0x06]),
    ('Q', [0x3e, 0x41, 0x51, 0x21, 0x5e]),
    ('R', [0x7f, 0x09, 0x19, 0x29, 0x46]),
    ('S', [0x46, 0x49, 0x49, 0x49, 0x31]),
    ('T', [0x01, 0x01, 0x7f, 0x01, 0x01]),
    ('U', [0x3f, 0x40, 0x40, 0x40, 0x3f]),
    ('V', [0x1f, 0x20, 0x40, 0x20, 0x1f]),
    ('W', [0x3f, 0x40, 0x38, 0x40, 0x3f]),
    ('X', [0x63, 0x14, 0x08, 0x14, 0x63]),
    ('Y', [0x07, 0x08, 0x70, 0x08, 0x07]),
    ('Z', [0x61, 0x51, 0x49, 0x45, 0x43]),
];

/// Returns true if the dot at (column, row) of `c` is set; characters without a glyph are blank.
fn dot(c: char, column: usize, row: usize) -> bool {
    GLYPHS
        .binary_search_by_key(&c.to_ascii_uppercase(), |glyph| glyph.0)
        .is_ok_and(|i| GLYPHS[i].1[column] >> row & 1 == 1)
}

/// Draws `text` with its upper left corner at `(x, y)`, each dot `scale` pixels wide.
pub fn draw_text(frame: &mut Frame, (x, y): (usize, usize), scale: usize, value: f32, text: &str) {
    for (n, c) in text.chars().enumerate() {
        for i in 0..GLYPH_WIDTH * scale {
            for j in 0..GLYPH_HEIGHT * scale {
                let (px, py) = (x + n * (GLYPH_WIDTH + 1) * scale + i, y + j);
                if px < frame.size.width && py < frame.size.height && dot(c, i / scale, j / scale) {
                    frame.data[py * frame.size.width + px] = value;
                }
            }
        }
    }
}

/// A line of text at any size, with smooth strokes.
#[derive(Clone, Debug)]
pub struct Line {
    /// Characters.
    pub text: Vec<char>,
    /// Left end and top, in pixels.
    pub origin: [f64; 2],
    /// Pixels per dot.
    pub dot: f64,
}

impl Line {
    fn is_set(&self, column: i64, row: i64) -> f64 {
        let cell = (GLYPH_WIDTH + 1) as i64;
        let known = column >= 0
            && (0..GLYPH_HEIGHT as i64).contains(&row)
            && column % cell < GLYPH_WIDTH as i64;
        let set = known
            && self
                .text
                .get((column / cell) as usize)
                .is_some_and(|&c| dot(c, (column % cell) as usize, row as usize));
        f64::from(u8::from(set))
    }

    /// Returns the signed distance to the stroke's edge in pixels, positive inside: the half-way level of the
    /// bilinearly interpolated dots.
    pub(super) fn inside(&self, [x, y]: [f64; 2]) -> f64 {
        let u = (x - self.origin[0]) / self.dot - 0.5;
        let v = (y - self.origin[1]) / self.dot - 0.5;
        let (u0, v0) = (u.floor(), v.floor());
        let (fu, fv) = (u - u0, v - v0);
        let (c, r) = (u0 as i64, v0 as i64);
        let top = self.is_set(c, r) * (1.0 - fu) + self.is_set(c + 1, r) * fu;
        let bottom = self.is_set(c, r + 1) * (1.0 - fu) + self.is_set(c + 1, r + 1) * fu;
        (top * (1.0 - fv) + bottom * fv - 0.45) * self.dot
    }

    pub(super) fn bounds(&self) -> ([f64; 2], f64) {
        let half = [
            0.5 * self.dot * (self.text.len() * (GLYPH_WIDTH + 1)) as f64,
            0.5 * self.dot * GLYPH_HEIGHT as f64,
        ];
        let centre = [self.origin[0] + half[0], self.origin[1] + half[1]];
        (centre, half[0].hypot(half[1]) + self.dot)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn glyphs_are_sorted_for_binary_search() {
        assert!(GLYPHS.windows(2).all(|pair| pair[0].0 < pair[1].0));
        assert!(dot('t', 2, 6) && !dot('t', 0, 6) && !dot('~', 2, 2));
    }
}
