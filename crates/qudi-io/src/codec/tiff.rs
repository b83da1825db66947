//! TIFF stacks: one image file directory per frame, or ImageJ's single directory before one block
//! of frames (which is how it goes beyond 4 GiB).

mod description;
mod pages;

use super::npy::described;
use super::{Format, Recognition};
use crate::description::{CaptureInfo, Certainty, ReadOptions};
use crate::frames::CountFrames;
use crate::frames::chain::Chain;
use crate::frames::channel_pages::ChannelPages;
use crate::frames::frame_bytes::{FrameBytes, Segment};
use crate::frames::reordered::reordered;
use crate::frames::samples::{MONO, SampleFrames, Scale};
use crate::recognition::Probe;
use crate::sidecar::{self, BurstLayout};
use description::Description;
use pages::{TiffPages, bits_reversed, decoder, fault, photometric};
use qudi_core::Size;
use qudi_core::npy::Sample;
use qudi_core::{Error, Result};
use std::path::{Path, PathBuf};
use tiff::ColorType;
use tiff::tags::{ByteOrder, Tag};

pub(crate) const FORMAT: Format = Format {
    name: "tiff",
    title: "TIFF stack",
    options: super::PICTURE_OPTIONS,
    probe: |probe| {
        let magic = [&b"II*\0"[..], b"MM\0*", b"II+\0", b"MM\0+"];
        let found = magic.iter().any(|magic| probe.head.starts_with(magic));
        Ok(found.then(|| Recognition::new(Certainty::Certain, &["TIFF's magic number"])))
    },
    open,
};

/// Returns true if a TIFF holds several frames. One that cannot be read is none.
pub(super) fn is_stack(path: &Path) -> bool {
    let Ok(decoder) = decoder(path) else { return false };
    let images = || describe(path).ok().flatten().and_then(|description| description.images);
    decoder.more_images() || images().is_some_and(|images| images > 1)
}

/// A stack in one block, as ImageJ writes it.
struct Block {
    start: u64,
    frames: u64,
    size: Size,
    sample: Sample,
}

fn open(
    probe: &Probe,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<Box<dyn CountFrames>> {
    let path = &probe.path;
    if probe.is_folder {
        return Err(Error::data("a folder", path, "use `format images`, or name one file"));
    }
    let recorded = described(&sidecar::beside(path), info);
    let description = describe(path)?;
    let files = set(path, description.as_ref());
    let frames = match files.len() {
        0 => stack(probe, description.as_ref(), recorded.as_ref(), options, info)?,
        _ => stacks(files, options, info)?,
    };
    if let Some(description) = &description {
        info.fps = info.fps.or(description.fps);
    }
    let frames = channel_of(frames, description, options, info, path)?;
    reordered(frames, options.axes, path)
}

/// Returns the files of the set that a TIFF belongs to, as OME describes it; none if it stands alone.
fn set(path: &Path, description: Option<&Description>) -> Vec<PathBuf> {
    let names = description.map_or(&[][..], |description| &description.files);
    let own = path.file_name().unwrap_or_default().to_string_lossy();
    if names.len() < 2 || !names.iter().any(|name| *name == own) {
        return Vec::new();
    }
    names.iter().map(|name| path.with_file_name(name)).collect()
}

/// Returns true if a TIFF belongs to a set that is read with each of its files.
pub(super) fn is_of_set(path: &Path) -> bool {
    let description = describe(path).ok().flatten();
    !set(path, description.as_ref()).is_empty()
}

/// Opens the stacks of a set, one after the other.
fn stacks(
    mut files: Vec<PathBuf>,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<Box<dyn CountFrames>> {
    if let Some(missing) = files.iter().find(|file| !file.is_file()).cloned() {
        if !options.lenient {
            return Err(Error::data(
                format!("not there, though it is one of {} files of one stack (OME)", files.len()),
                &missing,
                "copy it next to the others, or read those that are there with `lenient`",
            ));
        }
        info.notes.push(format!("{} of the set is missing", missing.display()));
        files.retain(|file| file.is_file());
    }
    let open = |file: &PathBuf, options: &ReadOptions, info: &mut CaptureInfo| {
        let probe = Probe::new(file, None)?;
        stack(&probe, describe(file)?.as_ref(), None, options, info)
    };
    let mut lengths = Vec::new();
    let mut size = None;
    for file in &files {
        let part = open(file, options, &mut info.clone())?;
        if *size.get_or_insert(part.size()) != part.size() {
            return Err(Error::data(
                format!("frames of {} in a set with other ones", part.size()),
                file,
                "frames of one capture have one size",
            ));
        }
        lengths.push(part.frames());
    }
    let first = open(&files[0], options, info)?;
    info.notes
        .push(format!("{} files of one stack (OME) are read one after the other", files.len()));
    let (options, about) = (options.clone(), info.clone());
    let opener = move |part: usize| open(&files[part], &options, &mut about.clone());
    Ok(Box::new(Chain::new(first.size(), &lengths, Box::new(opener))))
}

/// Reads the description of the stack by ImageJ or OME.
fn describe(path: &Path) -> Result<Option<Description>> {
    let text = decoder(path)?.find_tag(Tag::ImageDescription).ok().flatten();
    Ok(text.and_then(|value| value.into_string().ok()).as_deref().and_then(Description::parse))
}

/// Selects the frames of one channel, where channels are pages of their own.
fn channel_of(
    frames: Box<dyn CountFrames>,
    description: Option<Description>,
    options: &ReadOptions,
    info: &mut CaptureInfo,
    path: &Path,
) -> Result<Box<dyn CountFrames>> {
    let pages = frames.frames();
    if let Some(about) = &description {
        refuse_other_axes(about, path)?;
    }
    let Some(Description { channels, run, program, .. }) = description.filter(|d| d.channels > 1)
    else {
        return Ok(frames);
    };
    if channels == pages && options.channel.is_none() {
        // Some programs call the frames of a plain stack channels.
        info.notes.push(format!(
            "{program}'s description says {channels} channels of one image: taken for frames; `channel` reads one"
        ));
        return Ok(frames);
    }
    info.reasons.push(format!("{program}'s description: {channels} channels"));
    let Some(channel) = options.channel else {
        return Err(Error::data(
            format!(
                "a stack of {channels} channels, {pages} pages, as {program}'s description says"
            ),
            path,
            format!("read one channel as gray with `channel 0` to {}", channels - 1),
        ));
    };
    match ChannelPages::new(frames, channels, channel as u64, run) {
        Some(pages) => Ok(Box::new(pages)),
        None => Err(Error::data(
            format!("channel {channel} of {channels} in {pages} pages"),
            path,
            format!("channels count from 0 to {}, and every one has as many pages", channels - 1),
        )),
    }
}

/// Refuses stacks whose pages are more than instants and channels.
fn refuse_other_axes(about: &Description, path: &Path) -> Result<()> {
    let Description { slices, series, program, .. } = about;
    let (what, index) = match (*slices, *series) {
        (2.., _) => {
            (format!("a stack of {slices} slices at every instant"), "tifffile.imread(NAME)[:, 0]")
        }
        (_, 2..) => (
            format!("{series} images, each with frames of its own"),
            "tifffile.imread(NAME, series=0)",
        ),
        _ => return Ok(()),
    };
    Err(Error::data(
        format!("{what}, as {program}'s description says"),
        path,
        format!("save the frames of one, as in Python: tifffile.imwrite('one.tif', {index})"),
    ))
}

/// Opens the pages in the order of the file.
fn stack(
    probe: &Probe,
    description: Option<&Description>,
    recorded: Option<&BurstLayout>,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<Box<dyn CountFrames>> {
    let path = &probe.path;
    let of_pages = description.is_some_and(|d| d.channels > 1);
    let Some(block) = block(probe)? else {
        let pages = TiffPages::open(path, options, recorded.is_some(), of_pages, info)?;
        check_record(recorded, &pages, options, path)?;
        return Ok(Box::new(pages));
    };
    if !of_pages {
        refuse_channel(options, path)?;
    }
    info.reasons.push(format!("ImageJ's description: {} images", block.frames));
    let frame_bytes = (block.size.pixels() * block.sample.bytes()) as u64;
    let whole = (probe.length.saturating_sub(block.start) / frame_bytes).min(block.frames);
    if whole < block.frames {
        if !options.lenient || whole == 0 {
            return Err(Error::data(
                format!(
                    "the stack is truncated: {} frames promised, {whole} whole ones there",
                    block.frames
                ),
                path,
                "copy or export it again, or read the whole frames with `lenient`",
            ));
        }
        info.notes.push(format!("truncated: {} frames dropped", block.frames - whole));
    }
    let segment = Segment { path: path.clone(), start: block.start, frames: whole };
    let bytes = FrameBytes::files(vec![segment], frame_bytes as usize);
    let full = block.sample.full_scale().unwrap_or(1.0);
    let scale = Scale::asked(options, full, info).unwrap_or(Scale::Counts);
    let frames = SampleFrames::new(bytes, block.sample, block.size, false, MONO, scale, path);
    check_record(recorded, &frames, options, path)?;
    Ok(Box::new(frames))
}

/// Refuses a channel of a gray stack.
fn refuse_channel(options: &ReadOptions, path: &Path) -> Result<()> {
    match options.channel {
        Some(channel) if channel > 0 => Err(Error::data(
            format!("channel {channel} of a gray stack"),
            path,
            "leave `channel` out: there is no colour to choose from",
        )),
        _ => Ok(()),
    }
}

/// Refuses a record that belongs to another stack, with the difference.
pub(super) fn check_record(
    recorded: Option<&BurstLayout>,
    frames: &dyn CountFrames,
    options: &ReadOptions,
    path: &Path,
) -> Result<()> {
    let Some(layout) = recorded else { return Ok(()) };
    let found = (frames.frames(), frames.size());
    let shorter = options.lenient && found.0 < layout.frames;
    if (layout.frames, layout.size) == found || (shorter && layout.size == found.1) {
        return Ok(());
    }
    Err(sidecar::contradiction(
        &format!("{} frames of {}", layout.frames, layout.size),
        &format!("it holds {} frames of {}", found.0, found.1),
        path,
    ))
}

/// Returns ImageJ's block of frames, if this is one.
fn block(probe: &Probe) -> Result<Option<Block>> {
    let path = &probe.path;
    let mut decoder = decoder(path)?;
    if decoder.more_images() {
        return Ok(None);
    }
    let tag = |decoder: &mut tiff::decoder::Decoder<_>, tag| decoder.find_tag(tag).ok().flatten();
    let text = tag(&mut decoder, Tag::ImageDescription).and_then(|v| v.into_string().ok());
    let images = text.as_deref().and_then(Description::parse).and_then(|d| d.images);
    let Some(frames) = images.filter(|&n| n > 1) else { return Ok(None) };
    let compression = tag(&mut decoder, Tag::Compression).and_then(|v| v.into_u16().ok());
    let inverted = photometric(&mut decoder, path)? == 0;
    if compression.unwrap_or(1) != 1 || inverted || bits_reversed(&mut decoder, path)? {
        return Ok(None);
    }
    let (width, height) = decoder.dimensions().map_err(|e| fault(path, e))?;
    let big_endian = decoder.byte_order() == ByteOrder::BigEndian;
    let sample = match decoder.colortype().map_err(|e| fault(path, e))? {
        ColorType::Gray(8) => Sample::U8,
        ColorType::Gray(16) => Sample::U16 { big_endian },
        _ => return Ok(None),
    };
    let strips = tag(&mut decoder, Tag::StripOffsets).and_then(|v| v.into_u64_vec().ok());
    let Some(start) = strips.and_then(|strips| strips.first().copied()) else { return Ok(None) };
    let size = Size::new(height as usize, width as usize, &path.display().to_string())?;
    Ok(Some(Block { start, frames, size, sample }))
}
