//! A TIFF whose frames are image file directories.

use crate::description::{CaptureInfo, ReadOptions};
use crate::frames::CountFrames;
use crate::frames::samples::{Scale, no_count};
use qudi_core::Size;
use qudi_core::{Error, Result};
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};
use tiff::ColorType;
use tiff::decoder::{Decoder, DecodingResult};
use tiff::tags::Tag;

pub(crate) type TiffDecoder = Decoder<BufReader<File>>;

pub(crate) struct TiffPages {
    decoder: TiffDecoder,
    path: PathBuf,
    size: Size,
    frames: u64,
    scale: Scale,
    /// Number of samples of a pixel, and the one that is read.
    samples: (usize, usize),
    /// True for rows of single bits, padded to bytes.
    bits: bool,
    /// True if single bits are stored as they are, whatever the decoder makes of them.
    inverted: bool,
    /// True if the first pixel of a byte is its lowest bit.
    reversed: bool,
    /// Pixels that may hold anything; empty for none.
    ignored: Vec<bool>,
}

pub(crate) fn fault(path: &Path, e: tiff::TiffError) -> Error {
    match e {
        tiff::TiffError::IoError(e) if e.kind() != std::io::ErrorKind::UnexpectedEof => {
            Error::io("read", path, e)
        }
        other => Error::data(
            format!("not a readable TIFF: {other}"),
            path,
            "open it in ImageJ to see whether it is damaged, and save it again as 8- or 16-bit gray",
        ),
    }
}

pub(crate) fn decoder(path: &Path) -> Result<TiffDecoder> {
    let file = File::open(path).map_err(|e| Error::io("open", path, e))?;
    Decoder::new(BufReader::with_capacity(1 << 16, file)).map_err(|e| fault(path, e))
}

/// Returns true if the bits of each byte of the current page are stored lowest first (FillOrder 2, TIFF 6.0
/// section 8). The decoder ignores it, so that only uncompressed bytes can be reversed.
pub(super) fn bits_reversed(decoder: &mut TiffDecoder, path: &Path) -> Result<bool> {
    let mut tag = |tag| -> Result<Option<u16>> {
        let value = decoder.find_tag(tag).map_err(|e| fault(path, e))?;
        Ok(value.and_then(|value| value.into_u16().ok()))
    };
    if tag(Tag::FillOrder)?.unwrap_or(1) != 2 {
        return Ok(false);
    }
    let compression = tag(Tag::Compression)?.unwrap_or(1);
    let depth = decoder.colortype().map_err(|e| fault(path, e))?.bit_depth();
    if compression == 1 && depth <= 8 {
        return Ok(true);
    }
    Err(Error::data(
        format!(
            "bits stored lowest first (FillOrder 2) in samples of {depth} bits, compression {compression}"
        ),
        path,
        "save the stack again uncompressed, as 8-bit gray",
    ))
}

/// Returns the meaning of values: 0 if larger ones are darker, which the decoder inverts.
pub(super) fn photometric(decoder: &mut TiffDecoder, path: &Path) -> Result<u16> {
    let tag = decoder.find_tag(Tag::PhotometricInterpretation).map_err(|e| fault(path, e))?;
    Ok(tag.and_then(|value| value.into_u16().ok()).unwrap_or(1))
}

/// Returns the samples of a pixel, the bits of a sample, and whether one of the samples is opacity.
fn samples_of(color: ColorType) -> Option<(usize, u8, bool)> {
    match color {
        ColorType::Gray(bits) => Some((1, bits, false)),
        ColorType::GrayA(bits) => Some((2, bits, true)),
        ColorType::RGB(bits) => Some((3, bits, false)),
        ColorType::RGBA(bits) => Some((4, bits, true)),
        ColorType::Multiband { bit_depth, num_samples } => {
            Some((usize::from(num_samples), bit_depth, false))
        }
        _ => None,
    }
}

/// Returns the sample of a pixel that is read; `of_pages` is true if channels are pages, which are gray.
fn chosen_sample(
    color: ColorType,
    options: &ReadOptions,
    of_pages: bool,
    path: &Path,
) -> Result<(usize, usize)> {
    let Some((samples, _, opacity)) = samples_of(color) else {
        return Err(Error::data(
            format!("images of type {color:?}"),
            path,
            "save the stack as 8- or 16-bit gray or RGB",
        ));
    };
    let colours = samples - usize::from(opacity);
    match options.channel_of(colours).filter(|_| !of_pages) {
        None if colours == 1 => Ok((samples, 0)),
        None => Err(Error::data(
            format!("colour images of {colours} channels"),
            path,
            format!("read one channel as gray with `channel 0` to {}", colours - 1),
        )),
        Some(channel) if channel < colours => Ok((samples, channel)),
        Some(channel) => Err(Error::data(
            format!("channel {channel} of images of {colours}"),
            path,
            if colours == 1 {
                "leave `channel` out: there is no colour to choose from".to_owned()
            } else {
                format!("channels count from 0 to {}", colours - 1)
            },
        )),
    }
}

impl TiffPages {
    pub(crate) fn open(
        path: &Path,
        options: &ReadOptions,
        recorded: bool,
        of_pages: bool,
        info: &mut CaptureInfo,
    ) -> Result<Self> {
        let mut decoder = decoder(path)?;
        let color = decoder.colortype().map_err(|e| fault(path, e))?;
        let samples = chosen_sample(color, options, of_pages, path)?;
        let (number, bits, opacity) = samples_of(color).unwrap_or((1, 8, false));
        let takes_colours = options.takes_colours(number - usize::from(opacity));
        info.full_colour |= takes_colours && !of_pages;
        let planes = decoder.find_tag(Tag::PlanarConfiguration).map_err(|e| fault(path, e))?;
        if samples.0 > 1 && planes.and_then(|tag| tag.into_u16().ok()) == Some(2) {
            return Err(Error::data(
                "colour images whose channels lie apart (planar configuration 2)",
                path,
                "save the stack with interleaved channels, or one channel as gray",
            ));
        }
        let white_is_zero = photometric(&mut decoder, path)? == 0;
        if white_is_zero {
            let effect = if bits > 1 {
                "values are turned round"
            } else {
                "single bits are counts all the same, and taken as they are stored"
            };
            let text = format!("white is zero in it (photometric interpretation 0): {effect}");
            info.notes.push(text);
        }
        let (width, height) = decoder.dimensions().map_err(|e| fault(path, e))?;
        let size = Size::new(height as usize, width as usize, &path.display().to_string())?;
        let reversed = bits_reversed(&mut decoder, path)?;
        let mut frames = 1u64;
        while decoder.more_images() {
            if let Err(e) = decoder.next_image() {
                if options.lenient {
                    info.notes.push(format!("truncated after frame {}", frames - 1));
                    break;
                }
                return Err(fault(path, e));
            }
            frames += 1;
        }
        let path = path.to_owned();
        let scale = Scale::Counts;
        let bits_only = bits == 1 && samples.0 == 1;
        let mut pages = Self {
            decoder,
            path,
            size,
            frames,
            scale,
            samples,
            bits: bits_only,
            inverted: white_is_zero && bits_only,
            reversed,
            ignored: Vec::new(),
        };
        pages.drop_unreadable(options, info)?;
        pages.scale = pages.find_scale(bits, options, recorded, info)?;
        Ok(pages)
    }

    /// Drops a last frame that a truncated file cuts off.
    fn drop_unreadable(&mut self, options: &ReadOptions, info: &mut CaptureInfo) -> Result<()> {
        loop {
            match self.page(self.frames - 1) {
                Ok(_) => return Ok(()),
                Err(e) if !options.lenient || self.frames == 1 => return Err(e),
                Err(_) => {
                    self.frames -= 1;
                    info.notes.push(format!("frame {} is incomplete: dropped", self.frames));
                }
            }
        }
    }

    fn find_scale(
        &mut self,
        bits: u8,
        options: &ReadOptions,
        recorded: bool,
        info: &mut CaptureInfo,
    ) -> Result<Scale> {
        let full = if bits <= 8 { 255u16 } else { 65535 };
        if let Some(scale) = Scale::asked(options, f32::from(full), info) {
            return Ok(scale);
        }
        if bits == 1 {
            info.max_count = Some(1);
        }
        if recorded || !matches!(bits, 8 | 16) {
            return Ok(Scale::Counts);
        }
        let mut values = Vec::new();
        for frame in [0, self.frames / 2, self.frames - 1] {
            let (of, index) = self.samples;
            match self.page(frame)? {
                DecodingResult::U8(v) => {
                    values.extend(v.into_iter().skip(index).step_by(of).map(u16::from));
                }
                DecodingResult::U16(v) => values.extend(v.into_iter().skip(index).step_by(of)),
                _ => return Ok(Scale::Counts),
            }
        }
        Ok(Scale::seen(values, full, info))
    }

    fn page(&mut self, frame: u64) -> Result<DecodingResult> {
        let fault = |e| fault(&self.path, e);
        self.decoder.seek_to_image(frame as usize).map_err(fault)?;
        let (width, height) = self.decoder.dimensions().map_err(fault)?;
        if (height as usize, width as usize) != (self.size.height, self.size.width) {
            return Err(Error::data(
                format!("frame {frame} is {height} x {width} among frames of {}", self.size),
                &self.path,
                "frames of one capture have one size",
            ));
        }
        let samples = samples_of(self.decoder.colortype().map_err(fault)?);
        if samples.is_none_or(|(samples, ..)| samples != self.samples.0) {
            return Err(Error::data(
                format!("frame {frame} has other colours than the first"),
                &self.path,
                "frames of one capture are all gray, or all of the same channels",
            ));
        }
        if bits_reversed(&mut self.decoder, &self.path)? != self.reversed {
            return Err(Error::data(
                format!("frame {frame} has another order of bits (FillOrder) than the first"),
                &self.path,
                "save the stack again as 8- or 16-bit gray",
            ));
        }
        let mut image = self.decoder.read_image().map_err(fault)?;
        if let (true, DecodingResult::U8(bytes)) = (self.reversed, &mut image) {
            for byte in bytes.iter_mut() {
                *byte = byte.reverse_bits();
            }
        }
        Ok(image)
    }

    fn wrong_length(&self, frame: u64, length: usize) -> Error {
        Error::data(
            format!("frame {frame} holds {length} samples instead of {}", self.size.pixels()),
            &self.path,
            "save the stack again as 8- or 16-bit gray",
        )
    }
}

impl CountFrames for TiffPages {
    fn frames(&self) -> u64 {
        self.frames
    }

    fn size(&self) -> Size {
        self.size
    }

    fn read(&mut self, frame: u64, counts: &mut [u16]) -> Result<()> {
        let page = self.page(frame)?;
        let width = self.size.width;
        if self.bits {
            let DecodingResult::U8(bytes) = page else {
                return Err(self.wrong_length(frame, 0));
            };
            let row = width.div_ceil(8);
            if bytes.len() != row * self.size.height {
                return Err(self.wrong_length(frame, bytes.len() * 8));
            }
            for (counts, bytes) in counts.chunks_mut(width).zip(bytes.chunks(row)) {
                crate::writer::unpack_row(bytes, counts);
                if self.inverted {
                    for count in counts.iter_mut() {
                        *count = 1 - *count;
                    }
                }
            }
            return Ok(());
        }
        let values: Vec<f32> = match page {
            DecodingResult::U8(v) => v.into_iter().map(f32::from).collect(),
            DecodingResult::U16(v) => v.into_iter().map(f32::from).collect(),
            DecodingResult::U32(v) => v.into_iter().map(|v| v as f32).collect(),
            DecodingResult::I16(v) => v.into_iter().map(f32::from).collect(),
            DecodingResult::I32(v) => v.into_iter().map(|v| v as f32).collect(),
            DecodingResult::F32(v) => v,
            DecodingResult::F64(v) => v.into_iter().map(|v| v as f32).collect(),
            _ => {
                return Err(Error::data(
                    format!("frame {frame} has samples of an unusual type"),
                    &self.path,
                    "save the stack again as 8- or 16-bit gray",
                ));
            }
        };
        let (of, index) = self.samples;
        if values.len() != counts.len() * of {
            return Err(self.wrong_length(frame, values.len()));
        }
        let chosen = values.into_iter().skip(index).step_by(of);
        for (pixel, (count, value)) in counts.iter_mut().zip(chosen).enumerate() {
            *count = match self.scale.count(value) {
                Some(count) => count,
                None if self.ignored.get(pixel) == Some(&true) => 0,
                None => return Err(no_count(value, frame, &self.path)),
            };
        }
        Ok(())
    }

    fn ignore(&mut self, pixels: &[bool]) {
        self.ignored = pixels.to_vec();
    }
}
