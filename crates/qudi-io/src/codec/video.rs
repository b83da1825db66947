//! Videos through ffmpeg. Lossy compression leaves no photon counts.

use super::{Format, Recognition};
use crate::description::{CaptureInfo, Certainty, FormatOption, ReadOptions};
use crate::frames::CountFrames;
use crate::frames::frame_bytes::{FrameBytes, Segment};
use crate::frames::reordered::reordered;
use crate::frames::samples::{MONO, SampleFrames, Scale};
use crate::recognition::Probe;
use qudi_core::Transfer;
use qudi_core::npy::Sample;
use qudi_core::{Error, Result};
use qudi_sim::clip::{FrameReader, Video};
use std::io::{BufWriter, Write};

pub(crate) const FORMAT: Format = Format {
    name: "video",
    title: "video, decoded by ffmpeg",
    options: &[
        FormatOption::Axes,
        FormatOption::Levels,
        FormatOption::Offset,
        FormatOption::Threshold,
    ],
    probe: |probe| {
        let found = probe.has_extension(&["mp4", "avi", "mkv", "mov", "webm", "m4v"]);
        Ok(found.then(|| Recognition::new(Certainty::Likely, &["the name"])))
    },
    open,
};

/// Decodes the video once into an unnamed temporary file, 8 bits per pixel.
fn open(
    probe: &Probe,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<Box<dyn CountFrames>> {
    let path = &probe.path;
    let mut video = Video::open(path, Transfer::AsIs)?;
    let size = video.size();
    let spool = |e| Error::io("store the decoded frames of", path, e);
    let mut file = BufWriter::with_capacity(1 << 18, tempfile::tempfile().map_err(spool)?);
    let mut frames = 0;
    while let Some(frame) = video.next()? {
        let bytes: Vec<u8> = frame.data.iter().map(|v| (v * 255.0).round() as u8).collect();
        file.write_all(&bytes).map_err(spool)?;
        frames += 1;
    }
    let file = file.into_inner().map_err(|e| spool(e.into_error()))?;
    info.notes.push(
        "video is stored with loss: its values are not photon counts, and no figure made from them means much"
            .to_owned(),
    );
    let scale = Scale::asked(options, 255.0, info).unwrap_or(Scale::Counts);
    let segment = Segment { path: path.clone(), start: 0, frames };
    let bytes = FrameBytes::spool(segment, file, size.pixels());
    let frames = SampleFrames::new(bytes, Sample::U8, size, false, MONO, scale, path);
    reordered(Box::new(frames), options.axes, path)
}
