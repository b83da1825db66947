//! The filter in front of every pixel of a frame.

use super::mosaic::Mosaic;
use crate::error::{Error, Result};
use crate::frame::{Frame, Size};
use serde::Serialize;

/// Colour of a filter.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Colour {
    /// Red.
    Red,
    /// Green.
    Green,
    /// Blue.
    Blue,
    /// White: all light.
    White,
}

impl Colour {
    /// All colours, in the order of their indices.
    pub const ALL: [Self; 4] = [Self::Red, Self::Green, Self::Blue, Self::White];

    /// Returns its name.
    pub fn name(self) -> &'static str {
        ["red", "green", "blue", "white"][self as usize]
    }

    /// Returns its letter in patterns.
    pub fn letter(self) -> char {
        ['r', 'g', 'b', 'w'][self as usize]
    }

    /// Returns the colour of a letter of a pattern; `None` for cyan, magenta and yellow.
    fn of_letter(letter: char) -> Option<Self> {
        Some(match letter {
            'r' => Self::Red,
            'g' => Self::Green,
            'b' => Self::Blue,
            'w' => Self::White,
            _ => return None,
        })
    }

    /// Returns the colour of a pixel of a picture of a filter.
    fn of_pixel(pixel: [u8; 3]) -> Option<Self> {
        Some(match pixel {
            [255, 0, 0] => Self::Red,
            [0, 255, 0] => Self::Green,
            [0, 0, 255] => Self::Blue,
            [255, 255, 255] => Self::White,
            _ => return None,
        })
    }
}

/// The colours of all pixels of a frame, and their efficiencies.
#[derive(Clone, Debug, PartialEq)]
pub struct ColourFilter {
    size: Size,
    colours: Vec<Colour>,
    /// Detections per detection without filter, by colour.
    efficiency: [f64; 4],
}

impl ColourFilter {
    /// Creates a filter whose tiles repeat over frames of `size`, all efficiencies 1.
    ///
    /// # Errors
    /// [`Error`] for cyan, magenta or yellow, or without red, green and blue.
    pub fn tiled(mosaic: &Mosaic, size: Size) -> Result<Self> {
        let colour = |i: usize| {
            let letter = mosaic.letter(i / size.width, i % size.width);
            Colour::of_letter(letter).ok_or(letter)
        };
        let colours = (0..size.pixels()).map(colour).collect::<Result<Vec<_>, char>>();
        let colours = colours.map_err(|letter| {
            Error::request(
                format!("the colour `{letter}` of the filter {mosaic}"),
                "cfa",
                "colours are made of r, g, b and w: read one plane, as in `channel 0`",
            )
        })?;
        Self { size, colours, efficiency: [1.0; 4] }.complete(&mosaic.to_string())
    }

    /// Creates a filter of one colour, as in front of one of three full planes.
    pub fn uniform(colour: Colour, size: Size) -> Self {
        Self { size, colours: vec![colour; size.pixels()], efficiency: [1.0; 4] }
    }

    /// Creates a filter from a picture of it: a pure red, green, blue or white pixel for each pixel.
    ///
    /// # Errors
    /// [`Error`] naming `place` for other colours, or without red, green and blue.
    pub fn from_picture(size: Size, pixels: &[[u8; 3]], place: &str) -> Result<Self> {
        let colours: Option<Vec<_>> = pixels.iter().map(|&pixel| Colour::of_pixel(pixel)).collect();
        let Some(colours) = colours else {
            let other = pixels.iter().position(|&pixel| Colour::of_pixel(pixel).is_none());
            let at = other.unwrap_or_default();
            let (row, column, value) = (at / size.width, at % size.width, pixels[at]);
            return Err(Error::request(
                format!("a filter of colour {value:?} at row {row}, column {column}"),
                place,
                "pixels of the picture are pure red, green, blue or white",
            ));
        };
        Self { size, colours, efficiency: [1.0; 4] }.complete(place)
    }

    /// Refuses filters that lack a colour.
    fn complete(self, place: &str) -> Result<Self> {
        let missing = Colour::ALL[..3].iter().find(|colour| !self.colours.contains(colour));
        let Some(missing) = missing else { return Ok(self) };
        Err(Error::request(
            format!("a filter without {} in frames of {}", missing.name(), self.size),
            place,
            "colours are made of red, green and blue: read the frames as gray, or a larger part of them",
        ))
    }

    /// Sets the efficiencies of red, green, blue and white.
    #[must_use]
    pub fn with_efficiency(self, efficiency: [f64; 4]) -> Self {
        Self { efficiency, ..self }
    }

    /// Returns the filter of turned and cropped frames, whose pixels are stored at `from`.
    ///
    /// # Errors
    /// [`Error`] if a colour is left out.
    pub fn seen(&self, size: Size, from: Option<&[u32]>) -> Result<Self> {
        let Some(from) = from else { return Ok(self.clone()) };
        let colours = from.iter().map(|&i| self.colours[i as usize]).collect();
        Self { size, colours, efficiency: self.efficiency }.complete("crop")
    }

    /// Returns the letters of the tile of 2 x 2 or 4 x 4 pixels that repeats over the frames from the first
    /// pixel on, if one does.
    pub fn tile(&self) -> Option<String> {
        let Size { height, width } = self.size;
        let repeats = |side: usize| {
            let within = |i: usize| i / width % side * width + i % width % side;
            side <= height.min(width)
                && (0..self.colours.len()).all(|i| self.colours[i] == self.colours[within(i)])
        };
        let side = [2, 4].into_iter().find(|&side| repeats(side))?;
        let letter = |i: usize| self.colours[i / side * width + i % side].letter();
        Some((0..side * side).map(letter).collect())
    }

    /// Returns the size of the frames.
    pub fn size(&self) -> Size {
        self.size
    }

    /// Returns the colour of every pixel.
    pub fn colours(&self) -> &[Colour] {
        &self.colours
    }

    /// Returns the share of the pixels behind each colour.
    pub fn shares(&self) -> [f64; 4] {
        let mut shares = [0.0; 4];
        for &colour in &self.colours {
            shares[colour as usize] += 1.0 / self.colours.len() as f64;
        }
        shares
    }

    /// Returns the efficiency of each colour.
    pub fn efficiency(&self) -> [f64; 4] {
        self.efficiency
    }

    /// Returns the weights of red, green and blue light in what a pixel behind `colour` sees.
    pub fn response(&self, colour: Colour) -> [f64; 3] {
        let efficiency = self.efficiency[colour as usize];
        match colour {
            Colour::White => [efficiency / 3.0; 3],
            other => std::array::from_fn(|k| if k == other as usize { efficiency } else { 0.0 }),
        }
    }

    /// Returns the weights of red, green and blue light in luma: the mean of what all pixels see.
    pub fn luma_weights(&self) -> [f64; 3] {
        let shares = self.shares();
        let mut weights = [0.0; 3];
        for colour in Colour::ALL {
            let response = self.response(colour);
            for (weight, response) in weights.iter_mut().zip(response) {
                *weight += shares[colour as usize] * response;
            }
        }
        weights
    }

    /// Returns the luma of a scene of red, green and blue.
    pub fn luma(&self, scene: &[Frame; 3]) -> Frame {
        let weights = self.luma_weights().map(|weight| weight as f32);
        let luma = |i: usize| (0..3).map(|k| weights[k] * scene[k].data[i]).sum();
        Frame { size: self.size, data: (0..self.size.pixels()).map(luma).collect() }
    }

    /// Returns the light that every pixel sees of a scene of red, green and blue.
    pub fn mosaic(&self, scene: &[Frame; 3]) -> Frame {
        let responses = Colour::ALL.map(|colour| self.response(colour).map(|v| v as f32));
        let seen = |(i, &colour): (usize, &Colour)| {
            let response = responses[colour as usize];
            (0..3).map(|k| response[k] * scene[k].data[i]).sum()
        };
        Frame { size: self.size, data: self.colours.iter().enumerate().map(seen).collect() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: Size = Size { height: 2, width: 4 };

    fn tiled(text: &str) -> Result<ColourFilter> {
        ColourFilter::tiled(&text.parse().unwrap(), SIZE)
    }

    #[test]
    fn pixels_see_their_colour_and_luma_is_the_mean() {
        let filter = tiled("rgbw").unwrap().with_efficiency([0.5, 1.0, 1.0, 1.0]);
        let scene = [0.2, 0.4, 0.6].map(|value| Frame::filled(SIZE, value));
        let mosaic = filter.mosaic(&scene);
        for (value, expected) in mosaic.data.iter().zip([0.1, 0.4, 0.1, 0.4, 0.6, 0.4, 0.6, 0.4]) {
            assert!((value - expected).abs() < 1e-6, "{value} {expected}");
        }
        let luma: f64 =
            filter.luma_weights().iter().zip([0.2, 0.4, 0.6]).map(|(weight, v)| weight * v).sum();
        assert!((luma - mosaic.mean()).abs() < 1e-6);
        assert!((luma - f64::from(filter.luma(&scene).data[5])).abs() < 1e-6);
    }

    #[test]
    fn filters_are_turned_with_the_frames() {
        let filter = tiled("rggb").unwrap();
        let flipped = filter.seen(SIZE, Some(&[3, 2, 1, 0, 7, 6, 5, 4])).unwrap();
        assert_eq!(flipped, tiled("grbg").unwrap());
        assert_eq!(flipped.tile().as_deref(), Some("grbg"));
        let irregular = filter.seen(SIZE, Some(&[0, 1, 2, 3, 4, 5, 5, 7])).unwrap();
        assert_eq!(irregular.tile(), None);
        let size = Size { height: 1, width: 2 };
        assert!(filter.seen(size, Some(&[0, 1])).is_err(), "no blue is left");
    }

    #[test]
    fn pictures_of_other_colours_are_refused() {
        let mut pixels = [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255; 3]].repeat(2);
        let filter = ColourFilter::from_picture(SIZE, &pixels, "f.png").unwrap();
        assert_eq!(filter.shares(), [0.25; 4]);
        pixels[5] = [1, 255, 0];
        let error = ColourFilter::from_picture(SIZE, &pixels, "f.png").unwrap_err().to_string();
        assert!(error.contains("[1, 255, 0] at row 1, column 1"), "{error}");
        assert!(tiled("rrgg").is_err() && tiled("cmyg").is_err());
    }
}
