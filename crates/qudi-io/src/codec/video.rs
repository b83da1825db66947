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
use qudi_sim::clip::{FrameReader, Video, VideoStream, video_stream};
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

/// Codecs that keep every value of 8-bit gray frames.
const LOSSLESS: [&str; 6] = ["ffv1", "rawvideo", "huffyuv", "ffvhuff", "png", "utvideo"];

/// Decodes the video once into an unnamed temporary file, 8 bits per pixel. Deeper videos are refused.
fn open(
    probe: &Probe,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<Box<dyn CountFrames>> {
    let path = &probe.path;
    let stream = video_stream(path)?;
    if let Some(stream) = stream.as_ref().filter(|stream| stream.bits() > 8) {
        return Err(Error::data(
            format!("a video of {} bits per sample ({})", stream.bits(), stream.pixels),
            path,
            "videos are read with 8 bits; write its frames with `ffmpeg -i FILE frame_%06d.png` and read the folder",
        ));
    }
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
    let keeps_all = |stream: &VideoStream| {
        LOSSLESS.contains(&&*stream.codec) && stream.pixels.starts_with("gray")
    };
    if !stream.as_ref().is_some_and(keeps_all) {
        info.notes.push(
            "video is stored with loss: its values are not photon counts, and no figure made from them means much"
                .to_owned(),
        );
    }
    let scale = Scale::asked(options, 255.0, info).unwrap_or(Scale::Counts);
    let segment = Segment { path: path.clone(), start: 0, frames };
    let bytes = FrameBytes::spool(segment, file, size.pixels());
    let frames = SampleFrames::new(bytes, Sample::U8, size, false, MONO, scale, path);
    reordered(Box::new(frames), options.axes, path)
}
