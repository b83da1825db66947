//! Restoration of captures behind a colour filter array, or of three full planes, with a method for gray
//! captures.
//!
//! Counts behind a filter are gray counts of another light: the light of luma, times the share of the pixel's
//! colour. Motion is found on sums of 2 x 2 counts ([`QuadMotion`]). Along it, counts of all frames are added
//! for each colour by itself, without demosaicing ([`MergedColours`]), which gives a first luma and the
//! chroma: the ratios of the colours to luma. They turn the counts of every pixel into counts that a gray
//! pixel would have there ([`GrayCounts`]), which the method restores like any others. The chroma is then
//! smoothed again, guided by the restored luma ([`Chroma`]), which is corrected by the counts behind the
//! filter and multiplied with it. A network can correct both ([`ColourCorrector`]).

mod chroma;
mod corrector;
mod evidence;
mod exposures;
mod gray_counts;
mod guided;
mod luma;
mod merged;
mod motion;
mod response;
mod restorer;
mod shrinkage;

use chroma::Chroma;
pub use corrector::{ColourCorrector, ColourEvidence, CorrectedColours};
use evidence::Evidence;
use exposures::Exposures;
use gray_counts::GrayCounts;
use merged::MergedColours;
use motion::QuadMotion;
use response::CountResponse;
pub use restorer::{ColourRestorer, PlaneFrames};
