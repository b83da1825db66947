//! The picture of a validation: counts, restored frame and truth of every clip, side by side.

use qudi_core::Frame;
use qudi_core::metrics::best_gain;
use qudi_io::writer::Picture;
use qudi_train::ValidationClip;

/// Draws one row for every clip at the lowest light level.
pub(crate) fn strip(clips: &[ValidationClip]) -> Picture {
    let first = clips.first().map_or(0.0, |clip| clip.ppp);
    let clips: Vec<_> = clips.iter().filter(|clip| clip.ppp == first).collect();
    let size = clips[0].middle()[0].size;
    let mut picture = Picture::new(size, clips.len(), 3, 2);
    for (row, clip) in clips.iter().enumerate() {
        let [counts, restored, truth] = clip.middle();
        // As measured: after the best gain, since counts do not tell the exposure.
        let gain = best_gain(restored, truth) as f32;
        let shown = Frame { size, data: restored.data.iter().map(|value| value * gain).collect() };
        let quality = format!("{:.2} DB", clip.psnr_a);
        let name = clip.name.rsplit('-').next().unwrap_or_default().to_uppercase();
        let light = format!("{} PPP", clip.ppp);
        picture.place(row, 0, &[&name, &light], counts);
        picture.place(row, 1, &["RESTORED", &quality], &shown);
        picture.place(row, 2, &["TRUTH", ""], truth);
    }
    picture
}
