//! A TIFF of several pages, frame by frame.

use super::FrameReader;
use super::image_file::{AssumedWhite, check_values};
use qudi_core::limits::{FOLDER_FILES, IMAGE_PIXELS};
use qudi_core::regular_file::open_regular;
use qudi_core::{Error, Frame, Result, Size, Transfer};
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};
use tiff::ColorType;
use tiff::decoder::{Decoder, DecodingResult};

/// Returns true if the name ends like a TIFF's.
pub(super) fn is_tiff(path: &Path) -> bool {
    path.extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("tif") || e.eq_ignore_ascii_case("tiff"))
}

pub(super) struct TiffPages {
    decoder: Decoder<BufReader<File>>,
    size: Size,
    /// Pages that were read, and all.
    read: u64,
    pages: u64,
    path: PathBuf,
    transfer: Transfer,
    white: Option<f32>,
}

impl TiffPages {
    /// Opens a TIFF and counts its pages.
    pub(super) fn open(path: &Path, transfer: Transfer, white: Option<f32>) -> Result<Self> {
        let mut decoder = decoder(path)?;
        let (width, height) = decoder.dimensions().map_err(|e| fault(path, &e))?;
        let size = Size::new(height as usize, width as usize, &path.display().to_string())?;
        let mut pages = 1;
        while decoder.more_images() {
            decoder.next_image().map_err(|e| fault(path, &e))?;
            pages += 1;
            if pages > FOLDER_FILES as u64 {
                let what = format!("more than {FOLDER_FILES} pages");
                return Err(Error::data(what, path, "split it into several files"));
            }
        }
        let decoder = self::decoder(path)?;
        Ok(Self { decoder, size, read: 0, pages, path: path.to_owned(), transfer, white })
    }

    /// Returns the number of pages.
    pub(super) fn pages(&self) -> u64 {
        self.pages
    }

    /// Decodes the current page.
    fn page(&mut self) -> Result<Frame> {
        let fault = |e| fault(&self.path, &e);
        let (width, height) = self.decoder.dimensions().map_err(fault)?;
        if u64::from(width) * u64::from(height) > IMAGE_PIXELS {
            let what =
                format!("a page of {height} x {width} is over the limit of {IMAGE_PIXELS} pixels");
            return Err(Error::data(what, &self.path, "cut it into smaller images"));
        }
        let size = Size { height: height as usize, width: width as usize };
        if size != self.size {
            return Err(Error::data(
                format!("a page of {size} among pages of {}", self.size),
                &self.path,
                "frames of one clip have one size",
            ));
        }
        let colour = self.decoder.colortype().map_err(fault)?;
        let unsupported = || {
            let help = "save it as 8- or 16-bit gray or RGB, or as gray float";
            Error::data(format!("pages of type {colour:?}"), &self.path, help)
        };
        let (channels, colours) = match colour {
            ColorType::Gray(8 | 16 | 32) => (1, 1),
            ColorType::GrayA(8 | 16) => (2, 1),
            ColorType::RGB(8 | 16 | 32) => (3, 3),
            ColorType::RGBA(8 | 16) => (4, 3),
            _ => return Err(unsupported()),
        };
        let of = |full: f32| self.white.unwrap_or(full);
        let samples: Vec<f32> = match self.decoder.read_image().map_err(fault)? {
            DecodingResult::U8(v) => v.into_iter().map(|v| f32::from(v) / of(255.0)).collect(),
            DecodingResult::U16(v) => v.into_iter().map(|v| f32::from(v) / of(65535.0)).collect(),
            DecodingResult::F32(v) => v.into_iter().map(|v| v / of(1.0)).collect(),
            _ => return Err(unsupported()),
        };
        if samples.len() != size.pixels() * channels {
            return Err(unsupported());
        }
        let transfer = self.transfer;
        let gray = |p: &[f32]| {
            if colours == 1 { transfer.decode(p[0]) } else { transfer.gray([p[0], p[1], p[2]]) }
        };
        let data: Vec<f32> = samples.chunks_exact(channels).map(gray).collect();
        check_values(&data, &self.path)?;
        Ok(Frame { size, data })
    }
}

impl FrameReader for TiffPages {
    fn size(&self) -> Size {
        self.size
    }

    fn frames(&self) -> Option<u64> {
        Some(self.pages)
    }

    fn assumed_white(&mut self) -> Result<AssumedWhite> {
        let colour = self.decoder.colortype().map_err(|e| fault(&self.path, &e))?;
        Ok((colour.bit_depth() == 16 && self.white.is_none()).then_some(65535.0))
    }

    fn next(&mut self) -> Result<Option<Frame>> {
        if self.read == self.pages {
            return Ok(None);
        }
        if self.read > 0 {
            self.decoder.next_image().map_err(|e| fault(&self.path, &e))?;
        }
        self.read += 1;
        self.page().map(Some)
    }
}

fn decoder(path: &Path) -> Result<Decoder<BufReader<File>>> {
    let file = open_regular(path, "open the TIFF")?;
    Decoder::new(BufReader::with_capacity(1 << 16, file)).map_err(|e| fault(path, &e))
}

fn fault(path: &Path, e: &tiff::TiffError) -> Error {
    Error::data(
        format!("not a readable TIFF: {e}"),
        path,
        "open it in a viewer to see whether it is damaged, and save it again",
    )
}
