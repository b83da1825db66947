//! Arrays of counts in any file: axes, packing, colour.

mod colour;
mod spool;

use crate::description::{
    Axes, BitOrder, CaptureInfo, PackAxis, Packing, ReadOptions, refuse_packing,
};
use crate::frames::CountFrames;
use crate::frames::frame_bytes::{Checksum, Fetch, FrameBytes, Opener, Segment, StreamEnd, strewn};
use crate::frames::packed::{PackedFrames, Placement, stored_bytes};
use crate::frames::pipe::{FIRST_WINDOW, Pipe};
use crate::frames::samples::{Channel, MONO, SampleFrames, Scale};
use crate::recognition::ByteKind;
use crate::sidecar::{self, BurstLayout};
use crate::writer::BurstFormat;
use colour::{Colours, Layout};
use qudi_core::Size;
use qudi_core::npy::Sample;
use qudi_core::{Error, Result};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::PathBuf;

/// The place of the data of an array.
pub(crate) enum Place {
    /// In place: `available` bytes from byte `start` on, with the container's checksum.
    File { start: u64, available: u64, checksum: Option<Checksum> },
    /// Compressed; the opener begins at the first byte of the data.
    Stream(Opener),
    /// Fetched in groups of frames.
    Fetch { fetch: Fetch, group: u64 },
    /// In an unnamed file, `available` bytes from byte `start` on.
    Spool { file: File, start: u64, available: u64 },
    /// Through a pipe, at the first byte of the data.
    Pipe(Pipe),
}

/// An array found in a file.
pub(crate) struct Array {
    pub(crate) path: PathBuf,
    pub(crate) sample: Sample,
    /// Extents, as the file's own language prints them.
    pub(crate) shape: Vec<usize>,
    /// True if the first axis is the fastest.
    pub(crate) fortran: bool,
    /// Axes of the array unless said otherwise.
    pub(crate) axes: Axes,
    pub(crate) place: Place,
}

/// Descriptions stored with an array.
#[derive(Default)]
pub(crate) struct Hints {
    pub(crate) stored: Stored,
    /// True frame size.
    pub(crate) size: Option<Size>,
    /// Layout in a record of ours.
    pub(crate) recorded: Option<BurstLayout>,
}

/// The meaning of samples.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Stored {
    /// Unknown.
    #[default]
    Unsaid,
    /// Counts.
    Counts,
    /// Eight pixels each.
    Bits(Packing),
}

impl From<Option<Packing>> for Stored {
    fn from(packing: Option<Packing>) -> Self {
        packing.map_or(Self::Counts, Self::Bits)
    }
}

/// Bytes read to tell packed bits from counts.
const SAMPLE_BYTES: usize = 1 << 20;

impl Array {
    /// Opens the frames of this array.
    pub(crate) fn open(
        mut self,
        options: &ReadOptions,
        hints: &Hints,
        info: &mut CaptureInfo,
    ) -> Result<Box<dyn CountFrames>> {
        let axes = options.axes.unwrap_or(self.axes);
        let axes = if self.fortran { axes.reversed() } else { axes };
        let at = axes.frame_position();
        let Layout { dims, colours, index } = self.layout(axes, options)?;
        info.full_colour |= options.takes_colours(colours.number());
        let volumes = matches!(colours, Colours::Volumes(n) if n > 1);
        if at != 0 || volumes {
            self.spool()?;
        }
        if volumes {
            self.choose_volume(dims, index);
        }
        let (channel, planes) = match colours {
            Colours::Interleaved(of) => (Channel { of, index }, 1),
            Colours::Planes(planes) => (MONO, planes),
            Colours::Volumes(_) => (MONO, 1),
        };
        let frames = dims[at];
        let ([rows, columns], layout) = axes.split(dims);
        if frames == 0 {
            return Err(self.fault("the array holds no frames", "save at least one frame"));
        }
        let stored = Size::new(rows, columns, &self.path.display().to_string())?;
        let plane_bytes = stored.pixels() * channel.of * self.sample.bytes();
        let frame_bytes = plane_bytes * planes;
        if let Place::Pipe(pipe) = &mut self.place {
            pipe.lay_out(frame_bytes, frames as u64);
        }
        self.check_record(hints, frames as u64, stored, options)?;
        let sample_bytes = self.sample_bytes(frames as u64, frame_bytes, info)?;
        let packing = self.packing(options, hints, stored, &sample_bytes)?;
        let known_size = options.size.or(hints.size);
        let size = self.true_size(stored, packing, known_size)?;
        let scale = if hints.stored != Stored::Unsaid && !asks_for_values(options) {
            Scale::Counts
        } else {
            self.scale(options, info, &sample_bytes)?
        };
        let (path, sample) = (self.path.clone(), self.sample);
        let mut bytes = self.bytes(at, layout, [channel.of, frame_bytes], options, info)?;
        if planes > 1 {
            bytes = bytes.part_of_frames(index * plane_bytes, plane_bytes);
        }
        info.packing = packing;
        if let Some(packing) = packing {
            refuse_values(options)?;
            if channel.of > 1 {
                bytes = bytes.every_byte(channel.index, channel.of);
            }
            if known_size.is_none() {
                info.notes.push(whole_bytes(size, packing.axis));
            }
            info.max_count = Some(1);
            let placement = Placement::packed(size, packing.axis, axes.transposed());
            return Ok(Box::new(PackedFrames::new(bytes, packing.order, size, placement)));
        }
        refuse_packing(options, "an array of counts")?;
        if sample == Sample::Bool {
            info.max_count = info.max_count.filter(|_| scale != Scale::Counts).or(Some(1));
            if frames == 1 {
                info.notes.push(
                    "a single boolean image: if it is a map of bad pixels, it belongs to `mask`"
                        .to_owned(),
                );
            }
        }
        let transposed = axes.transposed();
        let frames = SampleFrames::new(bytes, sample, size, transposed, channel, scale, &path);
        Ok(Box::new(frames))
    }

    fn fault(&self, what: impl Into<String>, help: impl Into<String>) -> Error {
        Error::data(what, &self.path, help)
    }

    fn packing(
        &self,
        options: &ReadOptions,
        hints: &Hints,
        stored: Size,
        sampled: &[u8],
    ) -> Result<Option<Packing>> {
        let order = options.bit_order.unwrap_or(BitOrder::Msb);
        let packing = match options.pack_axis {
            Some(PackAxis::None) => None,
            Some(axis) => Some(Packing { axis, order }),
            None => match hints.stored {
                Stored::Bits(packing) => {
                    let order = options.bit_order.unwrap_or(packing.order);
                    Some(Packing { order, ..packing })
                }
                Stored::Unsaid if self.sample == Sample::U8 && !asks_for_values(options) => {
                    // A size that fits only if eight pixels share a byte says that they do.
                    let implied = [PackAxis::Width, PackAxis::Height].into_iter().find(|&axis| {
                        options.size.is_some_and(|size| {
                            size != stored
                                && stored_bytes(size, axis) == (stored.height, stored.width)
                        })
                    });
                    if let Some(axis) = implied {
                        return Ok(Some(Packing { axis, order }));
                    }
                    let ask = "say what its bytes are: `pack_axis width` (8 pixels each), height, or none (one count each)";
                    match ByteKind::of(sampled) {
                        ByteKind::Packed if sampled.iter().all(|&byte| byte == 255) => {
                            return Err(self.fault(
                                "every byte of the array is 255, so that packed bits look like counts",
                                ask,
                            ));
                        }
                        ByteKind::Packed
                            if sampled.iter().all(|&byte| byte == 0 || byte == 255) =>
                        {
                            None
                        }
                        ByteKind::Packed => Some(Packing { axis: PackAxis::Width, order }),
                        ByteKind::Counts | ByteKind::WideCounts => None,
                        ByteKind::Unclear => {
                            return Err(self.fault(
                                "the array is nearly empty, so that packed bits look like counts",
                                ask,
                            ));
                        }
                    }
                }
                Stored::Counts | Stored::Unsaid => None,
            },
        };
        if packing.is_some() && self.sample != Sample::U8 {
            return Err(self.fault(
                "packed bits are bytes (uint8), and the array holds other samples",
                "use `pack_axis none`",
            ));
        }
        Ok(packing)
    }

    fn true_size(
        &self,
        stored: Size,
        packing: Option<Packing>,
        known: Option<Size>,
    ) -> Result<Size> {
        let axis = packing.map_or(PackAxis::None, |packing| packing.axis);
        let implied = match axis {
            PackAxis::Width => Size { width: stored.width * 8, ..stored },
            PackAxis::Height => Size { height: stored.height * 8, ..stored },
            PackAxis::None => stored,
        };
        let size = known.unwrap_or(implied);
        if stored_bytes(size, axis) != (stored.height, stored.width) {
            return Err(self.fault(
                format!("the array holds frames of {implied}, not of {size}"),
                "check the option `size`: give the true size, up to 7 pixels smaller on the packed axis",
            ));
        }
        Size::new(size.height, size.width, &self.path.display().to_string())
    }

    fn scale(
        &self,
        options: &ReadOptions,
        info: &mut CaptureInfo,
        sampled: &[u8],
    ) -> Result<Scale> {
        let full = self.sample.full_scale();
        match (self.sample, full) {
            (_, None) if options.levels.is_some() => Err(self.fault(
                "`levels` on wide integers, which have no full scale",
                "leave `levels` out, or save the means as float",
            )),
            (_, full) if asks_for_values(options) => {
                Ok(Scale::asked(options, full.unwrap_or(1.0), info).unwrap_or(Scale::Counts))
            }
            (Sample::U8 | Sample::U16 { .. }, Some(full)) => {
                let samples = sampled.chunks_exact(self.sample.bytes());
                let values = samples.map(|bytes| self.sample.decode(bytes) as u16);
                Ok(Scale::seen(values, full as u16, info))
            }
            _ => Ok(Scale::Counts),
        }
    }

    /// Refuses a record that belongs to another array, with the difference.
    fn check_record(
        &self,
        hints: &Hints,
        frames: u64,
        stored: Size,
        options: &ReadOptions,
    ) -> Result<()> {
        let Some(layout) = &hints.recorded else { return Ok(()) };
        let packed = layout.format == BurstFormat::NpyPacked;
        let axis = if packed { PackAxis::Width } else { PackAxis::None };
        if options.pack_axis.is_none()
            && stored_bytes(layout.size, axis) != (stored.height, stored.width)
        {
            let what = if packed { "packed frames" } else { "frames" };
            let found = format!("the array holds {} x {} bytes", stored.height, stored.width);
            return Err(sidecar::contradiction(
                &format!("{what} of {}", layout.size),
                &format!("{found} a frame"),
                &self.path,
            ));
        }
        if layout.frames != frames {
            return Err(sidecar::contradiction(
                &format!("{} frames", layout.frames),
                &format!("the array holds {frames}"),
                &self.path,
            ));
        }
        let bytes = if layout.format == BurstFormat::NpyU16 { 2 } else { 1 };
        if self.sample.bytes() != bytes {
            return Err(sidecar::contradiction(
                &format!("counts of {bytes} bytes"),
                &format!("the array holds samples of {} bytes", self.sample.bytes()),
                &self.path,
            ));
        }
        Ok(())
    }

    /// Reads some bytes of the data: from the middle where that is possible.
    fn sample_bytes(
        &mut self,
        frames: u64,
        frame_bytes: usize,
        info: &mut CaptureInfo,
    ) -> Result<Vec<u8>> {
        let io = |e| Error::io("read", &self.path, e);
        let mut bytes = Vec::new();
        match &mut self.place {
            Place::File { start, available, .. } => {
                let from = (*available / 2).saturating_sub(SAMPLE_BYTES as u64 / 2) & !63;
                let mut file = File::open(&self.path).map_err(io)?;
                file.seek(SeekFrom::Start(*start + from)).map_err(io)?;
                let there = (*available - from).min(SAMPLE_BYTES as u64);
                file.take(there).read_to_end(&mut bytes).map_err(io)?;
            }
            Place::Stream(opener) => {
                let read = opener()?.take(SAMPLE_BYTES as u64).read_to_end(&mut bytes);
                // Damage further on is found when it is read.
                if let Err(e) = read
                    && bytes.is_empty()
                {
                    return Err(self.fault(
                        format!("the compressed data are damaged: {e}"),
                        "copy or export the file again",
                    ));
                }
            }
            Place::Fetch { fetch, .. } => {
                let count = (SAMPLE_BYTES / frame_bytes).clamp(1, frames as usize) as u64;
                bytes = fetch((frames - count) / 2, count)?;
            }
            Place::Spool { file, start, available } => {
                let from = (*available / 2).saturating_sub(SAMPLE_BYTES as u64 / 2) & !63;
                file.seek(SeekFrom::Start(*start + from)).map_err(io)?;
                let there = (*available - from).min(SAMPLE_BYTES as u64);
                file.by_ref().take(there).read_to_end(&mut bytes).map_err(io)?;
            }
            Place::Pipe(pipe) => {
                pipe.wait_for(frames.min(FIRST_WINDOW), &mut info.notes)?;
                bytes = pipe.kept_bytes();
            }
        }
        Ok(bytes)
    }

    fn bytes(
        self,
        at: usize,
        layout: [usize; 3],
        [channels, frame_bytes]: [usize; 2],
        options: &ReadOptions,
        info: &mut CaptureInfo,
    ) -> Result<FrameBytes> {
        let frames = layout[1] as u64;
        let promised = frames.checked_mul(frame_bytes as u64);
        let available = match &self.place {
            Place::File { available, .. } | Place::Spool { available, .. } => *available,
            Place::Stream(opener) if options.lenient => {
                // What follows a damaged place is lost anyway.
                let mut counted = Counter(0);
                let mut stream = opener()?;
                let whole = promised.unwrap_or(0);
                let read = std::io::copy(&mut stream.by_ref().take(whole), &mut counted)
                    .and_then(|_| std::io::copy(&mut stream, &mut std::io::sink()));
                if let Err(e) = read {
                    info.notes.push(format!("the compressed data are damaged: {e}"));
                }
                counted.0
            }
            // The length of a pipe is unknown before its end.
            Place::Stream(_) | Place::Fetch { .. } | Place::Pipe(_) => promised.unwrap_or(0),
        };
        let whole = (available / frame_bytes as u64).min(frames);
        if promised.is_none_or(|promised| promised > available) {
            if !options.lenient || whole == 0 || at != 0 {
                return Err(self.fault(
                    format!(
                        "the file is truncated: its header promises {frames} frames, it holds {whole} whole ones"
                    ),
                    "copy or export it again, or read the whole frames with `lenient`",
                ));
            }
            info.notes.push(format!("truncated: {} of {frames} frames dropped", frames - whole));
        }
        let element = self.sample.bytes() * channels;
        Ok(match self.place {
            Place::File { start, checksum, .. } if at == 0 => {
                let segment = Segment { path: self.path, start, frames: whole };
                match checksum.filter(|_| !options.lenient) {
                    Some(checksum) => FrameBytes::checked(segment, frame_bytes, checksum),
                    None => FrameBytes::files(vec![segment], frame_bytes),
                }
            }
            Place::Spool { file, start, .. } if at == 0 => {
                let segment = Segment { path: self.path, start, frames: whole };
                FrameBytes::spool(segment, file, frame_bytes)
            }
            Place::File { start, .. } => strewn(&self.path, None, start, element, layout),
            Place::Spool { file, start, .. } => {
                strewn(&self.path, Some(file), start, element, layout)
            }
            Place::Stream(opener) if at == 0 => {
                let after = if options.lenient { StreamEnd::Ignored } else { StreamEnd::Verified };
                FrameBytes::stream(opener, whole, frame_bytes, after, &self.path)
            }
            Place::Fetch { fetch, group } if at == 0 => {
                FrameBytes::batched(fetch, whole, frame_bytes, group)
            }
            Place::Pipe(pipe) if at == 0 => FrameBytes::Pipe(pipe),
            Place::Stream(_) | Place::Fetch { .. } | Place::Pipe(_) => {
                // Spooled before.
                return Err(self.no_capture());
            }
        })
    }
}

/// Returns true if options give the meaning of stored values.
fn asks_for_values(options: &ReadOptions) -> bool {
    options.levels.is_some() || options.offset.is_some() || options.threshold.is_some()
}

/// Refuses options on the values of samples where samples are single bits.
fn refuse_values(options: &ReadOptions) -> Result<()> {
    let given = [
        (options.levels.is_some(), "levels"),
        (options.offset.is_some(), "offset"),
        (options.threshold.is_some(), "threshold"),
    ];
    let Some((_, name)) = given.into_iter().find(|(given, _)| *given) else { return Ok(()) };
    Err(Error::request(
        format!("`{name}` does not apply to packed bits"),
        name,
        "leave it out: single bits are no means and have no pedestal",
    ))
}

/// Returns the remedy where only whole bytes tell the length of packed rows.
fn whole_bytes(size: Size, axis: PackAxis) -> String {
    let (length, what) = match axis {
        PackAxis::Height => (size.height, "columns are"),
        PackAxis::Width | PackAxis::None => (size.width, "rows are"),
    };
    format!("packed {what} taken for {length} pixels; if fewer are used, say so with `size HxW`")
}

struct Counter(u64);

impl std::io::Write for Counter {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0 += bytes.len() as u64;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}
