//! Arrays of counts, whatever file they lie in: axes, packing, colour.

use crate::capture::byte_kind::ByteKind;
use crate::capture::format_options::refuse_packing;
use crate::capture::info::{CaptureInfo, Packing};
use crate::capture::options::{Axes, BitOrder, PackAxis, ReadOptions};
use crate::capture::pipe::{FIRST_WINDOW, Pipe};
use crate::frames::CountFrames;
use crate::frames::frame_bytes::{Checksum, Fetch, FrameBytes, Opener, Segment, StreamEnd, strewn};
use crate::frames::packed::{PackedFrames, Placement, stored_bytes};
use crate::frames::samples::{Channel, MONO, SampleFrames, Scale};
use crate::sidecar::{self, BurstLayout};
use crate::writer::BurstFormat;
use qudi_core::Size;
use qudi_core::npy::Sample;
use qudi_core::{Error, Result};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::PathBuf;

/// Where the data of an array lie.
pub(crate) enum Place {
    /// In place, `available` bytes from byte `start` on, with the checksum that the container notes.
    File { start: u64, available: u64, checksum: Option<Checksum> },
    /// Compressed; the opener stands at the first byte of the data.
    Stream(Opener),
    /// Fetched in groups of frames.
    #[cfg_attr(not(feature = "hdf5"), expect(dead_code, reason = "only HDF5 is read so"))]
    Fetch { fetch: Fetch, group: u64 },
    /// Through a pipe, at the first byte of the data.
    Pipe(Pipe),
}

/// An array found in a file.
pub(crate) struct Array {
    pub(crate) path: PathBuf,
    pub(crate) sample: Sample,
    /// Extents as the file's own language prints them.
    pub(crate) shape: Vec<usize>,
    /// Whether the first axis is the fastest.
    pub(crate) fortran: bool,
    /// Axes of the array unless said otherwise.
    pub(crate) axes: Axes,
    pub(crate) place: Place,
}

/// What lies beside an array and describes it.
#[derive(Default)]
pub(crate) struct Hints {
    pub(crate) stored: Stored,
    /// True frame size.
    pub(crate) size: Option<Size>,
    /// What a record of ours says.
    pub(crate) recorded: Option<BurstLayout>,
}

/// What samples are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Stored {
    /// Nobody says.
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
    /// The frames of this array.
    pub(crate) fn open(
        mut self,
        options: &ReadOptions,
        hints: &Hints,
        info: &mut CaptureInfo,
    ) -> Result<Box<dyn CountFrames>> {
        let (dims, channels) = self.dims()?;
        let axes = options.axes.unwrap_or(self.axes);
        let (axes, dims) = if self.fortran {
            (axes.reversed(), [dims[2], dims[1], dims[0]])
        } else {
            (axes, dims)
        };
        let channel = self.channel(channels, axes, options)?;
        let at = axes.frame_position();
        let frames = dims[at];
        let mut rest = dims.iter().enumerate().filter(|(i, _)| *i != at).map(|(_, &d)| d);
        let (slow, fast) = (rest.next().unwrap_or(1), rest.next().unwrap_or(1));
        let (rows, columns) = if axes.transposed() { (fast, slow) } else { (slow, fast) };
        if frames == 0 {
            return Err(self.fault("the array holds no frames", "save at least one frame"));
        }
        let stored = Size::new(rows, columns, &self.path.display().to_string())?;
        let frame_bytes = stored.pixels() * channel.of * self.sample.bytes();
        if let Place::Pipe(pipe) = &mut self.place {
            pipe.lay_out(frame_bytes, frames as u64);
        }
        self.check_record(hints, frames as u64, stored, options)?;
        let sample_bytes = self.sample_bytes(frames as u64, frame_bytes, info)?;
        let packing = self.packing(options, hints, channel, stored, &sample_bytes)?;
        let size = self.true_size(stored, packing, options.size.or(hints.size))?;
        let scale = if hints.stored != Stored::Unsaid && options.levels.is_none() {
            Scale::Counts
        } else {
            self.scale(options, info, &sample_bytes)?
        };
        let (path, sample) = (self.path.clone(), self.sample);
        let bytes = self.bytes(axes, dims, frame_bytes, options, info)?;
        info.packing = packing;
        if let Some(packing) = packing {
            if options.levels.is_some() {
                return Err(Error::request(
                    "`levels` does not apply to packed bits",
                    "levels",
                    "leave it out: single bits are no means",
                ));
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

    /// Three extents, and the channels of a fourth axis.
    fn dims(&self) -> Result<([usize; 3], usize)> {
        match *self.shape.as_slice() {
            [h, w] if self.axes.frame_position() == 2 => Ok(([h, w, 1], 1)),
            [h, w] => Ok(([1, h, w], 1)),
            [a, b, c] => Ok(([a, b, c], 1)),
            [t, 1, h, w] if !matches!(w, 3 | 4) => Ok(([t, h, w], 1)),
            [a, b, c, d] if d <= 4 => Ok(([a, b, c], d.max(1))),
            _ => Err(self.fault(
                format!("an array of shape {:?} is no capture", self.shape),
                "captures have the axes frames, height, width, and perhaps colour",
            )),
        }
    }

    fn channel(&self, channels: usize, axes: Axes, options: &ReadOptions) -> Result<Channel> {
        if channels == 1 {
            return match options.channel {
                None | Some(0) => Ok(MONO),
                Some(index) => Err(Error::request(
                    format!("channel {index} of a gray capture, shape {:?}", self.shape),
                    "channel",
                    "leave it out: there is no colour to choose from",
                )),
            };
        }
        let Some(index) = options.channel else {
            return Err(self.fault(
                format!("a colour capture of {channels} channels, shape {:?}", self.shape),
                "colour is not supported yet; read one channel as gray with `channel 0`, 1 or 2",
            ));
        };
        if index >= channels || axes.frame_position() != 0 || self.fortran {
            return Err(self.fault(
                format!("channel {index} of an array of shape {:?}", self.shape),
                format!("channels count from 0 to {} and lie on the last axis", channels - 1),
            ));
        }
        Ok(Channel { of: channels, index })
    }

    fn packing(
        &self,
        options: &ReadOptions,
        hints: &Hints,
        channel: Channel,
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
                Stored::Unsaid if self.sample == Sample::U8 && options.levels.is_none() => {
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
                    match ByteKind::of(sampled) {
                        ByteKind::Packed if sampled.iter().all(|&byte| byte == 0 || byte == 255) => None,
                        ByteKind::Packed => Some(Packing { axis: PackAxis::Width, order }),
                        ByteKind::Counts | ByteKind::WideCounts => None,
                        ByteKind::Unclear => return Err(self.fault(
                            "the array is nearly empty, so that packed bits look like counts",
                            "say what its bytes are: `pack_axis width` (8 pixels each), height, or none (one count each)",
                        )),
                    }
                }
                Stored::Counts | Stored::Unsaid => None,
            },
        };
        if packing.is_some() && (self.sample != Sample::U8 || channel.of != 1) {
            return Err(self.fault(
                if channel.of == 1 {
                    "packed bits are bytes (uint8), and the array holds other samples"
                } else {
                    "a packed colour capture"
                },
                if channel.of == 1 {
                    "use `pack_axis none`"
                } else {
                    "colour is not supported yet; in Python, save one channel: numpy.save(NAME, cube[..., 0])"
                },
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
            (_, Some(full)) if options.levels.is_some() => {
                Ok(Scale::asked(options.levels, full, info).unwrap_or(Scale::Counts))
            }
            (_, None) if options.levels.is_some() => Err(self.fault(
                "`levels` on wide integers, which have no full scale",
                "leave `levels` out, or save the means as float",
            )),
            (Sample::U8 | Sample::U16 { .. }, Some(full)) => {
                let samples = sampled.chunks_exact(self.sample.bytes());
                let values = samples.map(|bytes| self.sample.decode(bytes) as u16).collect();
                Ok(Scale::seen(values, full as u16, info))
            }
            _ => Ok(Scale::Counts),
        }
    }

    /// Refuses a record that belongs to another array, with what both say.
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

    /// Some bytes of the data: from the middle where that is possible.
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
                // What is damaged further on shows when it is read.
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
            Place::Pipe(pipe) => {
                pipe.wait_for(frames.min(FIRST_WINDOW), &mut info.notes)?;
                bytes = pipe.kept_bytes();
            }
        }
        Ok(bytes)
    }

    fn bytes(
        self,
        axes: Axes,
        dims: [usize; 3],
        frame_bytes: usize,
        options: &ReadOptions,
        info: &mut CaptureInfo,
    ) -> Result<FrameBytes> {
        let at = axes.frame_position();
        let frames = dims[at] as u64;
        let promised = frames.checked_mul(frame_bytes as u64);
        let available = match &self.place {
            Place::File { available, .. } => *available,
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
            // Of a pipe, nobody knows before its end.
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
        Ok(match self.place {
            Place::File { start, checksum, .. } if at == 0 => {
                let segment = Segment { path: self.path, start, frames: whole };
                match checksum.filter(|_| !options.lenient) {
                    Some(checksum) => FrameBytes::checked(segment, frame_bytes, checksum),
                    None => FrameBytes::files(vec![segment], frame_bytes),
                }
            }
            Place::File { start, .. } => {
                let outer = dims[..at].iter().product();
                let inner = dims[at + 1..].iter().product();
                let layout = [outer, dims[at], inner];
                strewn(&self.path, start, self.sample.bytes(), layout)
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
                return Err(self.fault(
                    "a compressed or piped array whose frame axis is not the first",
                    "save it as .npy; then its frames are gathered in place",
                ));
            }
        })
    }
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
