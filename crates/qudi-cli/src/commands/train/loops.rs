//! Loops of a validation for the page of a run: counts, restored frames and truth of some clips, encoded.

use crate::report::middle::{cut, cut_size};
use crate::report::player::{Kind, Layer, Player, QUALITY, Scene, counts_url, picture_url};
use qudi_core::metrics::best_gain;
use qudi_core::{Frame, Size};
use qudi_train::{Validation, ValidationClip};
use serde::{Deserialize, Serialize};

/// Bytes of all loops of a page at most.
const MAX_BYTES: usize = 2_200_000;

/// Frames of a loop at most, around the middle one: at this number, one loop of noise fits.
const MAX_FRAMES: usize = 11;

/// The frames of a clip.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Loop {
    clip: String,
    ppp: f64,
    /// Training steps of the validation.
    step: u64,
    /// Gain-aligned PSNR in dB, mean over all frames.
    psnr_a: f64,
    height: usize,
    width: usize,
    /// Data URLs, one a frame.
    counts: Vec<String>,
    restored: Vec<String>,
    truth: Vec<String>,
}

/// Encodes the first clips at the first light level, as many as a small page can hold.
pub(super) fn loops(validation: &Validation) -> Vec<Loop> {
    let first = validation.clips.first().map_or(0.0, |clip| clip.ppp);
    let (mut loops, mut bytes) = (Vec::new(), 0);
    for clip in validation.clips.iter().filter(|clip| clip.ppp == first) {
        let encoded = Loop::new(clip, validation.step);
        bytes += encoded.bytes();
        if bytes > MAX_BYTES {
            break;
        }
        loops.push(encoded);
    }
    loops
}

impl Loop {
    fn new(clip: &ValidationClip, step: u64) -> Self {
        let frames = clip.pictures.len();
        let length = frames.min(MAX_FRAMES);
        let shown = &clip.pictures[(frames - length) / 2..][..length];
        let Size { height, width } = cut_size(clip.middle()[0].size);
        let restored = |[_, restored, truth]: &[Frame; 3]| {
            // As measured: after the best gain, since counts do not tell the exposure.
            let gain = best_gain(restored, truth) as f32;
            let data = restored.data.iter().map(|value| value * gain).collect();
            picture_url(&cut(&Frame { size: restored.size, data }), QUALITY)
        };
        Self {
            clip: clip.name.clone(),
            ppp: clip.ppp,
            step,
            psnr_a: clip.psnr_a,
            height,
            width,
            counts: shown.iter().map(|[counts, ..]| counts_url(&cut(counts), QUALITY)).collect(),
            restored: shown.iter().map(restored).collect(),
            truth: shown.iter().map(|[.., truth]| picture_url(&cut(truth), QUALITY)).collect(),
        }
    }

    fn bytes(&self) -> usize {
        [&self.counts, &self.restored, &self.truth].into_iter().flatten().map(String::len).sum()
    }

    /// Returns the loop as the template plays it.
    pub(super) fn player(self) -> Player {
        let Self { clip, ppp, step, psnr_a, .. } = self;
        let size = Size { height: self.height, width: self.width };
        let title = format!("{clip}, {ppp} photons per pixel and frame");
        let mut scene = Scene::new(title, size, self.restored.len() as u64);
        let note = format!("{psnr_a:.2} dB");
        scene.layers = vec![
            Layer::new("counts", Kind::Counts, self.counts),
            Layer::new("restored", Kind::Restored, self.restored).with_note(note),
            Layer::new("truth", Kind::Truth, self.truth).with_note("without noise"),
        ];
        scene.right = 1;
        scene.notes = vec![format!(
            "After {step} steps: PSNR {psnr_a:.2} dB after the best gain, mean over all frames. Pictures are at the \
             truth's brightness."
        )];
        scene.player()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Counts and restorations that no format makes smaller.
    fn noisy_clip(side: usize, frames: usize) -> ValidationClip {
        let mut state = 1u64;
        let mut noise = || {
            let size = Size { height: side, width: side };
            Frame::from_fn(size, |_, _| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                (state >> 40) as f32 / (1u64 << 24) as f32
            })
        };
        ValidationClip {
            name: "noise".to_owned(),
            ppp: 3.25,
            psnr_a: 5.0,
            psnr: 5.0,
            ssim: 0.0,
            pictures: (0..frames).map(|_| [noise(), noise(), noise()]).collect(),
        }
    }

    #[test]
    fn loops_are_small_however_large_the_clips_are() {
        let clips = vec![noisy_clip(300, 20); 3];
        let found = loops(&Validation { step: 7, clips });
        assert_eq!(found.len(), 1, "one of noise fits, and not two");
        assert_eq!((found[0].counts.len(), found[0].width), (MAX_FRAMES, 224));
        assert!(found[0].bytes() > MAX_BYTES / 2);
        let clips = vec![noisy_clip(32, 3); 3];
        assert_eq!(loops(&Validation { step: 7, clips }).len(), 3);
    }

    #[test]
    fn loops_are_of_the_first_light_level() {
        let mut brighter = noisy_clip(16, 1);
        brighter.ppp = 26.0;
        let clips = vec![noisy_clip(16, 3), brighter];
        let found = loops(&Validation { step: 7, clips });
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].ppp, 3.25);
        assert!(loops(&Validation { step: 0, clips: Vec::new() }).is_empty());
    }
}
