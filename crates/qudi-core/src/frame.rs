//! One gray image, `[height][width]`, in the unit of the scene (0 is black, 1 is white).

use crate::error::{Error, Result};
use crate::limits::FRAME_PIXELS;

/// Width and height of an image in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
pub struct Size {
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
}

impl Size {
    /// Creates a size, checking that its pixel count is positive and below 2^29.
    ///
    /// # Errors
    /// [`Error::Request`] naming `place` otherwise.
    pub fn new(height: usize, width: usize, place: &str) -> Result<Self> {
        match height.checked_mul(width) {
            Some(1..=FRAME_PIXELS) => Ok(Self { height, width }),
            _ => Err(Error::request(
                format!("a frame of {height} x {width} pixels is not possible"),
                place,
                format!("frames hold between 1 and {FRAME_PIXELS} pixels"),
            )),
        }
    }

    /// Returns the number of pixels.
    pub fn pixels(self) -> usize {
        self.height * self.width
    }
}

impl std::fmt::Display for Size {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} x {}", self.height, self.width)
    }
}

impl std::str::FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts: Vec<_> = text.split('x').map(|p| p.trim().parse::<usize>()).collect();
        match parts.as_slice() {
            [Ok(height), Ok(width)] => Self::new(*height, *width, text).map_err(|e| e.to_string()),
            _ => Err("expected height x width, as in 256x512".to_owned()),
        }
    }
}

/// A gray image, row-major, `data[y * width + x]`.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Rows and columns.
    pub size: Size,
    /// `height * width` samples.
    pub data: Vec<f32>,
}

impl Frame {
    /// Scales the frame so that its 99.5th percentile becomes white, 1; brighter pixels are clipped.
    #[must_use]
    pub fn with_white_at_highlights(mut self) -> Self {
        let mut sorted = self.data.clone();
        sorted.sort_by(f32::total_cmp);
        let at = sorted.len().saturating_sub(1) * 995 / 1000;
        let white = sorted.get(at).copied().unwrap_or(1.0).max(f32::MIN_POSITIVE);
        for value in &mut self.data {
            *value = (*value / white).min(1.0);
        }
        self
    }

    /// Creates a frame of one value.
    pub fn filled(size: Size, value: f32) -> Self {
        Self { size, data: vec![value; size.pixels()] }
    }

    /// Creates a frame from a function of the pixel position `(x, y)`.
    pub fn from_fn(size: Size, mut f: impl FnMut(usize, usize) -> f32) -> Self {
        let mut data = Vec::with_capacity(size.pixels());
        for y in 0..size.height {
            data.extend((0..size.width).map(|x| f(x, y)));
        }
        Self { size, data }
    }

    /// Returns row `y`.
    #[inline]
    pub fn row(&self, y: usize) -> &[f32] {
        &self.data[y * self.size.width..(y + 1) * self.size.width]
    }

    /// Returns the mean of all samples, in f64.
    pub fn mean(&self) -> f64 {
        self.data.iter().map(|&v| f64::from(v)).sum::<f64>() / self.data.len() as f64
    }

    /// Interpolates bilinearly at pixel coordinates; outside, the border is repeated.
    pub fn bilinear(&self, x: f64, y: f64) -> f32 {
        let (w, h) = (self.size.width, self.size.height);
        let x = x.clamp(0.0, (w - 1) as f64);
        let y = y.clamp(0.0, (h - 1) as f64);
        let (x0, y0) = (x as usize, y as usize);
        let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
        let (fx, fy) = ((x - x0 as f64) as f32, (y - y0 as f64) as f32);
        let top = self.row(y0)[x0] * (1.0 - fx) + self.row(y0)[x1] * fx;
        let bottom = self.row(y1)[x0] * (1.0 - fx) + self.row(y1)[x1] * fx;
        top * (1.0 - fy) + bottom * fy
    }
}
