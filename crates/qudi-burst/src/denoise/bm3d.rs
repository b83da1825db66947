//! BM3D: similar blocks of an image, filtered together (Dabov, Foi, Katkovnik and Egiazarian, "Image
//! denoising by sparse 3-D transform-domain collaborative filtering", IEEE TIP 16(8), 2007).
//!
//! The input is `[height][width]` with white Gaussian noise of known standard deviation. The first pass
//! (section III-A) groups similar blocks of the noisy image and hard-thresholds their coefficients. The
//! second pass (III-B) groups blocks of that estimate and applies a Wiener filter to the noisy blocks.
//! Written from the paper.

mod block;
mod filter;
mod matching;
mod pass;

use filter::Filter;
use matching::Search;
use pass::pass;
use qudi_core::{Frame, Size};

/// Maximum number of blocks per group in the first and in the second pass (table I).
const MAX_GROUP_SIZES: [usize; 2] = [16, 32];

/// Settings of the search for similar blocks.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SearchSettings {
    /// Maximum displacement of similar blocks, in pixels.
    pub(crate) radius: usize,
    /// Step between reference blocks in the first and in the second pass, in pixels.
    pub(crate) step: [usize; 2],
}

impl SearchSettings {
    /// Search windows of 39 x 39 pixels (table I, "normal profile"). The second pass has a reference block
    /// every 2 pixels instead of 3, which gains 0.02 dB for half as much time again
    /// (docs/notes/burst/bm3d.md).
    pub(crate) const NORMAL: Self = Self { radius: 19, step: [3, 2] };
}

/// Hard threshold of the first pass, in standard deviations of the noise (`lambda_3D`, table I).
const LAMBDA: f32 = 2.7;

/// Threshold of the mean squared difference of similar blocks, for images in [0, 255] (table I: 3000 and
/// 400). The paper's 3000 is for noise with a standard deviation of 25 to 30. In the first pass both blocks
/// are noisy, and the difference has twice the variance of the noise. The first threshold therefore is this
/// constant plus three times the noise variance.
const SIMILARITY_THRESHOLDS: [f32; 2] = [500.0, 400.0];

/// Removes white noise of standard deviation `sigma` from an image with values in about [0, 1]. Images
/// smaller than a block (8 pixels) are padded by repeating their border. Without noise the image is returned
/// unchanged.
pub fn bm3d(image: &Frame, sigma: f32) -> Frame {
    bm3d_with(SearchSettings::NORMAL, image, sigma)
}

/// Applies [`bm3d`] with the given search settings.
pub(crate) fn bm3d_with(search_settings: SearchSettings, image: &Frame, sigma: f32) -> Frame {
    // Also covers NaN.
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
        max_blocks: MAX_GROUP_SIZES[pass],
        threshold: noise + SIMILARITY_THRESHOLDS[pass] / (255.0 * 255.0),
    };
    let basic = pass(image, image, search(0, 3.0 * variance), Filter::Cut(LAMBDA * sigma));
    pass(image, &basic, search(1, 0.0), Filter::Wiener(variance))
}
