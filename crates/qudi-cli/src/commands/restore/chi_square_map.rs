//! Chi-square of the counts given the restored frames, and frames next to their counts.

use super::page::RestoredPage;
use crate::error::Result;
use qudi_core::atomic_file::Overwrite;
use qudi_core::colour::ColourFilter;
use qudi_core::metrics::Consistency;
use qudi_core::restorer::Acquisition;
use qudi_core::{Error, Frame, Size};
use qudi_io::writer::{ArrayWriter, Picture};
use std::path::Path;

/// The misfit of restored frames: chi-square of all frames, three of them next to their counts, and the page
/// that shows many.
pub(super) struct ChiSquareMap {
    consistency: Consistency,
    acquisition: Acquisition,
    /// Frames to show; for a pipe of unknown length, the first.
    shown: Vec<u64>,
    /// Frames that are shown: number, counts, restored.
    pictures: Vec<(u64, [Frame; 2])>,
    /// True if the latest frame is kept, which may be the last.
    keep_latest: bool,
    /// Frames measured so far.
    measured: u64,
    /// The colour filter in front of the pixels, if there is one.
    filter: Option<ColourFilter>,
    /// The page, if one is written.
    page: Option<RestoredPage>,
}

impl ChiSquareMap {
    /// Creates the map of `pictures` pictures, if their number is known.
    pub(super) fn new(size: Size, pictures: Option<u64>, acquisition: &Acquisition) -> Self {
        let mut shown = vec![0];
        shown.extend(
            pictures.into_iter().flat_map(|n| [n.saturating_sub(1) / 2, n.saturating_sub(1)]),
        );
        shown.dedup();
        Self {
            consistency: Consistency::new(size, acquisition),
            acquisition: acquisition.clone(),
            shown,
            pictures: Vec::new(),
            keep_latest: pictures.is_none(),
            measured: 0,
            filter: None,
            page: None,
        }
    }

    /// Sets the colour filter of the capture. Luma alone says nothing of counts behind it: it has no
    /// chi-square.
    pub(super) fn behind(self, filter: Option<ColourFilter>) -> Self {
        Self { filter, ..self }
    }

    /// Adds the page that shows the frames.
    pub(super) fn with_page(self, page: Option<RestoredPage>) -> Self {
        Self { page, ..self }
    }

    /// Takes the page, with all frames that were added.
    pub(super) fn take_page(&mut self) -> Option<RestoredPage> {
        self.page.take()
    }

    /// Adds the next frame.
    pub(super) fn add(&mut self, restored: &Frame, counts: &[u16]) -> qudi_core::Result<()> {
        if let Some(page) = &mut self.page {
            page.add(restored, counts);
        }
        self.show(restored, counts);
        if self.filter.is_some() {
            return Ok(());
        }
        self.consistency.add(restored, counts, &self.acquisition).map(drop)
    }

    /// Adds the colours of the next frame.
    pub(super) fn add_colour(
        &mut self,
        restored: &[Frame; 3],
        counts: &[u16],
    ) -> qudi_core::Result<()> {
        if let Some(page) = &mut self.page {
            page.add_colour(restored, counts);
        }
        // The counts of three full planes are the ones of green.
        let (seen, luma) = match &self.filter {
            Some(filter) => (filter.mosaic(restored), filter.luma(restored)),
            None => (restored[1].clone(), restored[1].clone()),
        };
        self.show(&luma, counts);
        self.consistency.add(&seen, counts, &self.acquisition).map(drop)
    }

    /// Keeps the frame for the picture, if it is one of those shown.
    fn show(&mut self, restored: &Frame, counts: &[u16]) {
        if self.keep_latest || self.shown.contains(&self.measured) {
            if self.keep_latest {
                self.pictures.truncate(self.shown.len());
            }
            let full = f32::from(self.acquisition.sensor.max_count());
            let data = counts.iter().map(|&count| f32::from(count) / full).collect();
            let counts = Frame { size: restored.size, data };
            self.pictures.push((self.measured, [counts, restored.clone()]));
        }
        self.measured += 1;
    }

    /// Adds the uncertainty of the frame that was added last to the page.
    pub(super) fn add_uncertainty(&mut self, sigma: &Frame) {
        if let Some(page) = &mut self.page {
            page.add_uncertainty(sigma);
        }
    }

    pub(super) fn chi_square(&self) -> Option<f64> {
        self.consistency.chi_square()
    }

    /// Returns the chi-square of every pixel, if frames were measured.
    pub(super) fn map(&self) -> Option<Frame> {
        self.chi_square().map(|_| self.consistency.map())
    }

    /// Composes counts above and restored frames (of colours, their luma) below: the first, the middle (not
    /// for a pipe without length) and the last.
    pub(super) fn side_by_side(&self) -> Option<Picture> {
        let size = self.pictures.first()?.1[0].size;
        let mut picture = Picture::new(size, 2, self.pictures.len(), 1);
        for (column, (frame, pair)) in self.pictures.iter().enumerate() {
            picture.place(0, column, &[&format!("COUNTS {frame}")], &pair[0]);
            picture.place(1, column, &[&format!("RESTORED {frame}")], &pair[1]);
        }
        Some(picture)
    }

    /// Saves the chi-square of every pixel: values in `.npy`, or a picture in which 2 is white.
    pub(super) fn save(&self, path: &Path, overwrite: Overwrite) -> Result<()> {
        let mut map = self.consistency.map();
        match path.extension().map(|e| e.to_string_lossy().to_lowercase()).as_deref() {
            Some("npy") => {
                let mut array = ArrayWriter::create(path, overwrite, "<f4", &[map.size.width])?;
                for row in map.data.chunks(map.size.width) {
                    array.push_f32(row.iter().copied())?;
                }
                Ok(array.finish()?)
            }
            Some("png") => {
                for value in &mut map.data {
                    *value *= 0.5;
                }
                Ok(Picture::single(&map).save(path, overwrite)?)
            }
            _ => Err(Error::data("maps are .npy or .png", path, "choose one of the two").into()),
        }
    }
}
