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
use qudi_core::{Frame, Size};

/// The most blocks in a group of the first and of the second pass (table I).
const MOST: [usize; 2] = [16, 32];

/// Settings of the search for similar blocks.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SearchSettings {
    /// Largest displacement of similar blocks, in pixels.
    pub(crate) radius: usize,
    /// Pixels between the blocks that are looked for, in the first and in the second pass.
    pub(crate) step: [usize; 2],
}

impl SearchSettings {
    /// Windows of 39 x 39 (table I, "normal profile"). The second pass looks for a block every 2 pixels
    /// instead of 3: 0.02 dB for half as much time again (docs/notes/burst/bm3d.md).
    pub(crate) const NORMAL: Self = Self { radius: 19, step: [3, 2] };
}

/// Cut of the first pass, in deviations of the noise (table I).
const LAMBDA: f32 = 2.7;

/// Similar blocks differ by less than this mean square, of images in [0, 255] (table I: 3000 and
/// 400). The paper's 3000 is for noise of deviation 25 to 30; for both blocks are noisy in the first
/// pass, which alone makes for twice the variance, the threshold follows the noise: three times
/// its variance and this.
const SIMILAR: [f32; 2] = [500.0, 400.0];

/// Removes white noise of deviation `sigma` from an image whose contents span about [0, 1]. Of any
/// size: below a block's 8 pixels the border is repeated. Without noise the image comes back as
/// it is.
pub fn bm3d(image: &Frame, sigma: f32) -> Frame {
    bm3d_with(SearchSettings::NORMAL, image, sigma)
}

/// [`bm3d`] in another search_settings.
pub(crate) fn bm3d_with(search_settings: SearchSettings, image: &Frame, sigma: f32) -> Frame {
    // Also where sigma is no number.
    if !(sigma > 0.0 && sigma.is_finite()) {
        return image.clone();
    }
    let Size { height, width } = image.size;
    let size = Size { height: height.max(block::BLOCK), width: width.max(block::BLOCK) };
    if size != image.size {
        let inside = |x: usize, y: usize| image.row(y.min(height - 1))[x.min(width - 1)];
        let whole = bm3d_with(search_settings, &Frame::from_fn(size, inside), sigma);
        return Frame::from_fn(image.size, |x, y| whole.row(y)[x]);
    }
    let variance = sigma * sigma;
    let search = |pass: usize, noise: f32| Search {
        step: search_settings.step[pass],
        radius: search_settings.radius,
        most: MOST[pass],
        threshold: noise + SIMILAR[pass] / (255.0 * 255.0),
    };
    let basic = pass(image, image, search(0, 3.0 * variance), Filter::Cut(LAMBDA * sigma));
    pass(image, &basic, search(1, 0.0), Filter::Wiener(variance))
}
