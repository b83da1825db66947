//! A folder of gray images, one per frame, or a single one.

use super::npy::described;
use super::parts::holds_stacks;
use super::{Format, Recognition};
use crate::description::{CaptureInfo, Certainty, ReadOptions};
use crate::frames::CountFrames;
use crate::frames::levels::infer_levels;
use crate::frames::reordered::reordered;
use crate::frames::samples::{Scale, no_count};
use crate::recognition::{Numbered, Probe, numbered};
use image::DynamicImage;
use qudi_core::Size;
use qudi_core::limits::IMAGE_FRAME_PIXELS;
use qudi_core::regular_file::require_regular;
use qudi_core::{Error, Result};
use qudi_sim::clip::decode_image;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

pub(crate) const FORMAT: Format = Format {
    name: "images",
    title: "folder of images",
    options: super::PICTURE_OPTIONS,
    probe: |probe| {
        if probe.path.join("burst.json").is_file() {
            return Ok(Some(Recognition::new(Certainty::Certain, &["burst.json in the folder"])));
        }
        let found = !files(probe)?.is_empty()
            && !holds_stacks(probe)?
            && (probe.is_folder || probe.has_extension(SINGLE_EXTENSIONS));
        Ok(found.then(|| Recognition::new(Certainty::Likely, &["image files"])))
    },
    open,
};

const EXTENSIONS: &[&str] = &["png", "tif", "tiff", "pgm", "pbm", "ppm", "pnm", "jpg", "jpeg"];
/// Extensions of a single image; a single TIFF is a stack.
const SINGLE_EXTENSIONS: &[&str] = &["png", "pgm", "pbm", "ppm", "pnm", "jpg", "jpeg"];

/// Lists the images of the folder; folders in it are captures of their own.
fn files(probe: &Probe) -> Result<Vec<PathBuf>> {
    let mut files = probe.files(EXTENSIONS)?;
    if probe.is_folder {
        files.retain(|file| file.parent() == Some(&probe.path));
    }
    Ok(files)
}

pub(crate) struct Images {
    files: Vec<PathBuf>,
    size: Size,
    scale: Scale,
    channel: Option<usize>,
    /// Largest sample that the first image can hold.
    full: u16,
}

fn open(
    probe: &Probe,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<Box<dyn CountFrames>> {
    let Numbered { files, notes, gaps } = numbered(files(probe)?);
    info.notes.extend(notes);
    info.gaps = gaps.into_iter().map(|(file, missing)| (file as u64, missing)).collect();
    let recorded = described(&probe.path.join("burst.json"), info);
    let frames = open_files(files, &probe.path, recorded.is_some(), options, info)?;
    match recorded {
        Some(layout) if (layout.frames, layout.size) != (frames.frames(), frames.size()) => {
            Err(Error::data(
                format!(
                    "burst.json in it describes {} frames of {}, and it holds {} of {}",
                    layout.frames,
                    layout.size,
                    frames.frames(),
                    frames.size()
                ),
                &probe.path,
                "copy the missing frames, or remove burst.json if it belongs to another burst",
            ))
        }
        _ => reordered(frames, options.axes, &probe.path),
    }
}

/// Opens images as frames, in the given order.
pub(crate) fn open_files(
    files: Vec<PathBuf>,
    place: &Path,
    recorded: bool,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<Box<dyn CountFrames>> {
    let Some(first) = files.first() else {
        return Err(Error::data(
            "the folder holds no images",
            place,
            "put frames into it as PNG, TIFF or PGM",
        ));
    };
    for file in &files {
        require_regular(file, "open the image")?;
    }
    info.full_colour |= options.takes_colours(colours_of(first));
    let channel = options.channel_of(colours_of(first));
    let (size, samples, full) = gray(first, channel)?;
    if lossy(first) {
        info.notes.push("JPEG is lossy: its values are not photon counts".to_owned());
    }
    let mut images = Images { files, size, scale: Scale::Counts, channel, full };
    if let Some(scale) = Scale::asked(options, f32::from(full), info) {
        images.scale = scale;
    } else if !recorded {
        images.infer_scale(samples, full, place, info)?;
    }
    Ok(Box::new(images))
}

impl Images {
    /// Reads the samples of one image, which is like the first.
    fn samples(&self, number: usize) -> Result<Vec<u16>> {
        let path = &self.files[number];
        let (size, samples, full) = gray(path, self.channel)?;
        if size != self.size {
            return Err(Error::data(
                format!("an image of {size} among images of {}", self.size),
                path,
                "frames of one capture have one size",
            ));
        }
        if full != self.full {
            return Err(Error::data(
                format!("samples up to {full} among images of samples up to {}", self.full),
                path,
                "frames of one capture have one depth: save all images alike",
            ));
        }
        Ok(samples)
    }

    /// Infers the scale from a few images: their values may be multiples of a step.
    fn infer_scale(
        &mut self,
        first: Vec<u16>,
        full: u16,
        place: &Path,
        info: &mut CaptureInfo,
    ) -> Result<()> {
        let distinct = |mut values: Vec<u16>| {
            values.sort_unstable();
            values.dedup();
            values
        };
        let mut values = distinct(first);
        let mut ladders = vec![infer_levels(&values, full)];
        for i in spread(self.files.len()) {
            let more = distinct(self.samples(i)?);
            ladders.push(infer_levels(&more, full));
            values.extend(more);
            values = distinct(values);
        }
        self.scale = Scale::seen(values, full, info);
        if self.scale == Scale::Counts
            && let Some(levels) = ladders[0].filter(|&n| n > 1)
            && ladders.iter().all(Option::is_some)
        {
            return Err(Error::data(
                format!(
                    "images of different scale: {full}/{levels} in the first, another step in others"
                ),
                place,
                "they were stretched one by one, and are no frames of one capture: name a single image",
            ));
        }
        Ok(())
    }
}

/// Returns a few frames spread over the capture.
fn spread(frames: usize) -> impl Iterator<Item = usize> {
    let sampled = frames.min(8);
    (0..sampled).map(move |i| i * frames / sampled)
}

/// Returns true if the file is a JPEG, whatever its name.
fn lossy(path: &Path) -> bool {
    let mut magic = [0; 3];
    let read = File::open(path).and_then(|mut file| file.read_exact(&mut magic));
    read.is_ok() && magic == [0xff, 0xd8, 0xff]
}

/// Returns 3 for images of red, green and blue that differ, and 1 for all others.
fn colours_of(image: &Path) -> usize {
    let is_coloured = gray(image, None).is_err() && gray(image, Some(2)).is_ok();
    if is_coloured { 3 } else { 1 }
}

/// Returns samples that a decoder has scaled from `most` to `full` as they are stored.
fn unscaled(mut samples: Vec<u16>, full: u16, most: u16) -> Vec<u16> {
    let (full, most) = (u32::from(full), u32::from(most));
    for sample in &mut samples {
        *sample = ((u32::from(*sample) * most + full / 2) / full) as u16;
    }
    samples
}

/// Returns the largest possible sample of a portable gray or colour map (PGM, PPM); none of other images.
///
/// # Errors
/// [`Error`] if the file cannot be read, or holds more than one image.
fn portable_maximum(path: &Path) -> Result<Option<u16>> {
    /// Bytes of the longest header that is looked at, comments included.
    const HEADER_BYTES: u64 = 1 << 12;
    let io = |e| Error::io("read", path, e);
    let file = File::open(path).map_err(io)?;
    let length = file.metadata().map_err(io)?.len();
    let mut header = Vec::new();
    file.take(HEADER_BYTES).read_to_end(&mut header).map_err(io)?;
    let (Some(b'P'), Some(kind @ (b'2' | b'3' | b'5' | b'6'))) = (header.first(), header.get(1))
    else {
        return Ok(None);
    };
    let mut at = 2;
    let mut number = || -> Option<u64> {
        loop {
            match header.get(at)? {
                b'#' => at += header[at..].iter().position(|&byte| byte == b'\n')?,
                byte if byte.is_ascii_whitespace() => at += 1,
                _ => break,
            }
        }
        let digits = header[at..].iter().take_while(|byte| byte.is_ascii_digit()).count();
        let text = std::str::from_utf8(&header[at..at + digits]).ok()?;
        at += digits;
        text.parse().ok()
    };
    let (Some(width), Some(height), Some(most)) = (number(), number(), number()) else {
        return Ok(None);
    };
    let samples = width.saturating_mul(height).saturating_mul(if *kind == b'6' { 3 } else { 1 });
    let bytes = samples.saturating_mul(if most > 255 { 2 } else { 1 });
    if matches!(kind, b'5' | b'6') && length > (at as u64 + 1).saturating_add(bytes) {
        return Err(Error::data(
            "a file of more than one image",
            path,
            "save each frame as a file of its own",
        ));
    }
    Ok(u16::try_from(most).ok().filter(|&most| most > 0))
}

/// Reads the gray samples of an image, or of one channel, with its size and full scale.
fn gray(path: &Path, channel: Option<usize>) -> Result<(Size, Vec<u16>, u16)> {
    let image = decode_image(path, IMAGE_FRAME_PIXELS)?;
    let size =
        Size::new(image.height() as usize, image.width() as usize, &path.display().to_string())?;
    let channels = usize::from(image.color().channel_count());
    let alpha = image.color().has_alpha();
    let (samples, full): (Vec<u16>, u16) = match image {
        DynamicImage::ImageLuma16(i) => (i.into_raw(), 65535),
        DynamicImage::ImageLumaA16(i) => (i.into_raw(), 65535),
        DynamicImage::ImageRgb16(i) => (i.into_raw(), 65535),
        DynamicImage::ImageRgba16(i) => (i.into_raw(), 65535),
        DynamicImage::ImageRgb32F(_) | DynamicImage::ImageRgba32F(_) => {
            return Err(Error::data(
                "a floating-point colour image",
                path,
                "save counts as 8- or 16-bit gray",
            ));
        }
        other => (other.into_bytes().into_iter().map(u16::from).collect(), 255),
    };
    let (samples, full) = match portable_maximum(path)? {
        Some(most) if most != full => (unscaled(samples, full, most), most),
        _ => (samples, full),
    };
    let colours = channels - usize::from(alpha);
    let coloured = samples.chunks_exact(channels).any(|p| p[..colours].iter().any(|&v| v != p[0]));
    let index = match channel {
        None if coloured => {
            return Err(Error::data(
                "a colour image",
                path,
                format!("read one channel as gray with `channel 0` to {}", colours - 1),
            ));
        }
        Some(channel) if channel >= colours => {
            let (what, help) = if colours == 1 {
                (
                    format!("a gray image, and channel {channel} is read"),
                    "frames of one capture are all gray or all in colour: leave `channel` out if they are gray"
                        .to_owned(),
                )
            } else {
                let help = format!("channels count from 0 to {}", colours - 1);
                (format!("channel {channel} of an image of {colours}"), help)
            };
            return Err(Error::data(what, path, help));
        }
        chosen => chosen.unwrap_or(0),
    };
    Ok((size, samples.into_iter().skip(index).step_by(channels).collect(), full))
}

impl CountFrames for Images {
    fn frames(&self) -> u64 {
        self.files.len() as u64
    }

    fn size(&self) -> Size {
        self.size
    }

    fn read(&mut self, frame: u64, counts: &mut [u16]) -> Result<()> {
        let path = &self.files[frame as usize];
        let samples = self.samples(frame as usize)?;
        for (count, &value) in counts.iter_mut().zip(&samples) {
            let value = f32::from(value);
            *count = self.scale.count(value).ok_or_else(|| no_count(value, frame, path))?;
        }
        Ok(())
    }
}
