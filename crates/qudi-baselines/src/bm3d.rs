//! BM3D: similar blocks of an image, filtered together (Dabov, Foi, Katkovnik and Egiazarian, "Image
//! denoising by sparse 3-D transform-domain collaborative filtering", IEEE TIP 16(8), 2007).
//!
//! Two passes over `[height][width]` with white Gaussian noise of known deviation. The first
//! (section III-A) groups blocks of the noisy image and cuts small coefficients; the second (III-B)
//! groups blocks of that estimate and shrinks the noisy ones by Wiener's rule. Written from the paper.

mod block;
mod filter;
mod matching;
mod pass;

use filter::Filter;
use matching::Search;
use pass::pass;
use qudi_sim::{Frame, Size};

/// Parameters of the two passes: the paper's "normal profile" (table I), with the thresholds that
/// docs/results.md chooses on training images.
#[derive(Clone, Copy, Debug)]
pub struct Bm3d {
    /// Cut of the first pass, in deviations of the noise.
    pub lambda: f32,
    /// Similar blocks of the first pass: mean squared difference per squared deviation of the
    /// noise ...
    pub match_noise: f32,
    /// ... and in addition, of images in [0, 1].
    pub match_image: f32,
    /// The same for the second pass, whose images are clean.
    pub match_noise_2: f32,
    /// The same for the second pass.
    pub match_image_2: f32,
}

impl Default for Bm3d {
    fn default() -> Self {
        Self {
            lambda: 2.7,
            match_noise: 2.0,
            match_image: 2000.0 / 65025.0,
            match_noise_2: 0.0,
            match_image_2: 400.0 / 65025.0,
        }
    }
}

/// Largest displacement of similar blocks: a window of 39 x 39.
const RADIUS: usize = 19;

/// Blocks in a group of the first and of the second pass.
const MOST: [usize; 2] = [16, 32];

impl Bm3d {
    /// Removes white noise of deviation `sigma` from an image whose contents span about [0, 1]. Of
    /// any size: below a block's 8 pixels the border is repeated. An image without noise comes back as it is.
    pub fn denoise(&self, image: &Frame, sigma: f32) -> Frame {
        // Also where sigma is no number.
        if !(sigma > 0.0 && sigma.is_finite()) {
            return image.clone();
        }
        let size = Size {
            height: image.size.height.max(block::BLOCK),
            width: image.size.width.max(block::BLOCK),
        };
        if size != image.size {
            let inside = |x: usize, y: usize| {
                image.row(y.min(image.size.height - 1))[x.min(image.size.width - 1)]
            };
            let whole = self.denoise(&Frame::from_fn(size, inside), sigma);
            return Frame::from_fn(image.size, |x, y| whole.row(y)[x]);
        }
        let search = |most, noise: f32, image: f32| Search {
            radius: RADIUS,
            most,
            threshold: noise * sigma * sigma + image,
        };
        let first = search(MOST[0], self.match_noise, self.match_image);
        let basic = pass(image, image, first, Filter::Cut(self.lambda * sigma));
        let second = search(MOST[1], self.match_noise_2, self.match_image_2);
        pass(image, &basic, second, Filter::Wiener(sigma * sigma))
    }
}
