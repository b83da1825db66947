//! Captures of real (and simulated) single-photon cameras, in every format of the field.
//!
//! A path is recognised ([`FORMATS`](crate::codec::FORMATS)) and opened as native frames ([`CountFrames`]). A [`Capture`]
//! turns, crops and sums them and repairs bad pixels, so that nothing downstream sees a raw file. Memory
//! holds a few frames, however long the capture is.

mod auto_sum;
mod calibrate;
mod depth;
mod filter;
mod frame_axis;
mod held_sums;
mod judge;
mod mosaic;
mod open;
mod parts;
mod pedestal;
mod piped_frames;
mod pixel_map;
mod reading;
mod summary;
mod view;

pub use auto_sum::{SUFFICIENT_DETECTIONS, SumChoice, SumLimit, choose_sum};
pub use calibrate::{Calibration, calibrate};
pub use judge::{FrameFindings, Stretch};
pub use mosaic::MosaicContrast;
pub use pedestal::Pedestal;
pub use summary::{BitOrderCheck, Summary};

use crate::description::{CaptureInfo, ReadOptions};
use crate::frames::CountFrames;
use crate::frames::depth::DepthChecked;
use crate::frames::pipe::FIRST_WINDOW;
use depth::{check_sum, depth_source, state_depth};
use filter::{contradiction, filter_of, recorded_filter};
use held_sums::HeldSums;
use mosaic::{MosaicPart, mosaic_part};
use piped_frames::PipedFrames;
use qudi_core::Size;
use qudi_core::bad_pixels::{self, BadPixels, Repair};
use qudi_core::colour::ColourFilter;
use qudi_core::limits::SAMPLE_FRAMES;
use qudi_core::sensor::{Response, Sensor};
use qudi_core::{Error, Result};
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};
use view::View;

/// A capture, read as output frames: turned, cropped, summed, repaired.
pub struct Capture {
    path: PathBuf,
    info: CaptureInfo,
    native: Box<dyn CountFrames>,
    view: View,
    /// The view without turn and crop by the user, which maps are of.
    usual: View,
    /// Native frames in use; for a pipe, those that have arrived.
    range: Range<u64>,
    /// One past the last requested native frame.
    end: Option<u64>,
    /// True if no more frames arrive.
    complete: bool,
    sum: u32,
    repair: Repair,
    bad: BadPixels,
    findings: FrameFindings,
    /// Broken native frames, and the good ones that are read instead.
    stand_ins: BTreeMap<u64, u64>,
    /// Native frames before which others are missing, and how many.
    gaps: Vec<(u64, u64)>,
    /// Native frames before which the scene or the light changes suddenly, or many frames are missing, in
    /// rising order.
    boundaries: Vec<u64>,
    timeline: Vec<Stretch>,
    /// Stored pixels that hold a frame counter.
    counter: Vec<usize>,
    /// Dark electrons per native frame and pixel of the view, if known.
    dark: Option<Vec<f32>>,
    /// The colour filter, of captures whose colours are read.
    filter: Option<ColourFilter>,
    /// How the filter in use contradicts the one that the capture records.
    filter_contradiction: Option<String>,
    /// True if the capture records the filter in use.
    filter_is_recorded: bool,
    stored: Vec<u16>,
    stored_sums: Vec<u32>,
    held: HeldSums,
    /// Frames of a pipe that are judged when they are read.
    piped: Option<PipedFrames>,
}

impl std::fmt::Debug for Capture {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Capture")
            .field("path", &self.path)
            .field("info", &self.info)
            .finish_non_exhaustive()
    }
}

impl Capture {
    /// Creates a capture of the native frames `range` whose frames and pixels nothing is known of yet.
    fn unjudged(
        path: &Path,
        native: Box<dyn CountFrames>,
        info: CaptureInfo,
        [view, usual]: [View; 2],
        range: Range<u64>,
    ) -> Self {
        Self {
            path: path.to_owned(),
            info,
            view,
            usual,
            range,
            end: None,
            complete: false,
            sum: 1,
            repair: Repair::default(),
            bad: BadPixels::default(),
            findings: FrameFindings::default(),
            stand_ins: BTreeMap::new(),
            gaps: Vec::new(),
            boundaries: Vec::new(),
            timeline: Vec::new(),
            counter: Vec::new(),
            dark: None,
            filter: None,
            filter_contradiction: None,
            filter_is_recorded: false,
            stored: vec![0; native.size().pixels()],
            stored_sums: Vec::new(),
            held: HeldSums::default(),
            piped: None,
            native,
        }
    }

    /// Turns, crops and sums native frames as `options` say, and plans their repair.
    fn assemble(
        path: &Path,
        mut native: Box<dyn CountFrames>,
        mut info: CaptureInfo,
        options: &ReadOptions,
        sensor: Option<&Sensor>,
    ) -> Result<Self> {
        if let Some(bits) = options.bits {
            state_depth(&mut info, bits)?;
        }
        info.binary |= info.max_count == Some(1);
        if let Some(max) = info.max_count.filter(|_| info.packing.is_none()) {
            native = Box::new(DepthChecked::new(native, max, depth_source(options, &info), path));
        }
        let stored = native.size();
        let recorded = recorded_filter(&info);
        let part = mosaic_part(&mut info, options, sensor)?;
        let plane = match &part {
            Some(MosaicPart::Plane(plane)) => Some(*plane),
            _ => None,
        };
        let usual = View::new(stored, plane, info.orient, info.vendor, None)?;
        if let Some(orient) = options.orient {
            info.orient = orient;
        }
        let view = View::new(stored, plane, info.orient, info.vendor, options.crop)?;
        let filter = match &part {
            Some(MosaicPart::Whole(choice)) => {
                let sensor = sensor.or(info.sensor.as_ref());
                Some(filter_of(choice, sensor, stored, &usual, &view)?)
            }
            _ => None,
        };
        let filter_is_recorded = recorded.is_some() && recorded == info.cfa;
        let filter_contradiction = recorded.and_then(|recorded| {
            let of_sensor = || sensor?.colour.as_ref()?.cfa.as_ref();
            let given = options.cfa.as_ref().or_else(of_sensor);
            contradiction(&recorded, given, info.cfa.as_ref(), stored, &usual)
        });
        let sum = options.sum.unwrap_or(1);
        let start = options.start.unwrap_or(0);
        native.discard_before(start);
        let window = start.saturating_add(FIRST_WINDOW.saturating_mul(sum.max(1).into()));
        let there = native.wait_for(window.min(options.end.unwrap_or(window)), &mut info.notes)?;
        let frames = native.length().unwrap_or(u64::MAX);
        let range = start..options.end.unwrap_or(frames).min(there);
        if range.start >= range.end || options.end.is_some_and(|end| end > frames) {
            let range = start..options.end.unwrap_or(frames);
            return Err(Error::request(
                format!("frames {} to {} of {frames}", range.start, range.end),
                "start, end",
                format!("frames count from 0; `end` is one past the last, at most {frames}"),
            ));
        }
        check_sum(sum, range.end - range.start, &info)?;
        let mut capture = Self {
            end: options.end,
            sum,
            filter,
            filter_contradiction,
            filter_is_recorded,
            ..Self::unjudged(path, native, info, [view, usual], range)
        };
        capture.note_end();
        pixel_map::plan(&mut capture, options, sensor)?;
        Ok(capture)
    }

    /// Sums `sum` native frames into each output frame. `options` and `sensor` are the ones it was opened
    /// with: they say which pixels are repaired.
    ///
    /// # Errors
    /// [`Error`] if so many frames do not fit, or the capture cannot be read.
    pub fn summed_by(
        mut self,
        sum: u32,
        options: &ReadOptions,
        sensor: Option<&Sensor>,
    ) -> Result<Self> {
        self.boundaries = self.boundaries_for(&self.findings, sum);
        let longest = self.longest_part();
        check_sum(sum, longest.end - longest.start, &self.info)?;
        self.sum = sum;
        self.held.clear();
        self.complete = false;
        self.wait_for(FIRST_WINDOW)?;
        pixel_map::plan(&mut self, options, sensor)?;
        Ok(self)
    }

    /// Returns the description of the capture.
    pub fn info(&self) -> &CaptureInfo {
        &self.info
    }

    /// Returns the path of the capture.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the size of the turned and cropped frames.
    pub fn size(&self) -> Size {
        self.view.size
    }

    /// Returns the number of output frames; for a pipe, of those that have arrived.
    pub fn frames(&self) -> u64 {
        self.sums()
    }

    /// Returns the number of all output frames; `None` while the length of a pipe is unknown.
    pub fn length(&self) -> Option<u64> {
        if self.complete {
            return Some(self.sums());
        }
        let end = match (self.native.length(), self.end) {
            (Some(length), Some(end)) => length.min(end),
            (length, _) => length?,
        };
        Some((end - self.range.start) / u64::from(self.sum))
    }

    /// Waits until `frames` output frames have arrived or the input ends, and returns how many have arrived.
    /// A file has all its frames from the start; a pipe blocks.
    ///
    /// # Errors
    /// [`Error`] if a pipe fails, or ends inside a frame.
    pub fn wait_for(&mut self, frames: u64) -> Result<u64> {
        if !self.complete {
            let native = frames.saturating_mul(self.sum.into()).saturating_add(self.range.start);
            let native = native.min(self.end.unwrap_or(native));
            let there = self.native.wait_for(native, &mut self.info.notes)?;
            self.range.end = there.min(self.end.unwrap_or(there));
            self.note_end();
        }
        Ok(self.frames())
    }

    /// Drops the output frames of a pipe before `frame`, which cannot be read again. Files are not changed.
    pub fn discard_before(&mut self, frame: u64) {
        self.native.discard_before(self.range.start + frame * u64::from(self.sum));
    }

    /// Records whether the end has been reached, with notes for the user.
    fn note_end(&mut self) {
        let ended = self.native.length() == Some(self.range.end);
        self.complete = ended || self.end == Some(self.range.end);
        if !self.complete {
            return;
        }
        if let Some(end) = self.end.filter(|&end| end > self.range.end) {
            let text =
                format!("the pipe ended after {} frames, before `end {end}`", self.range.end);
            self.info.notes.push(text);
        }
        let left_over = self.native_frames() - self.sums() * u64::from(self.sum);
        if left_over > 0 {
            let place = if self.boundaries.is_empty() { "the last" } else { "at ends of parts," };
            let text = format!("{place} {left_over} frames fill no sum of {}", self.sum);
            self.info.notes.push(text);
        }
    }

    /// Returns the number of native frames in use.
    pub fn native_frames(&self) -> u64 {
        self.range.end - self.range.start
    }

    /// Returns the number of native frames summed into each output frame.
    pub fn summed(&self) -> u32 {
        self.sum
    }

    /// Returns the largest possible count of an output frame, if known.
    pub fn max_count(&self) -> Option<u16> {
        self.info.max_count.map(|max| (u32::from(max) * self.sum) as u16)
    }

    /// Returns the sensor of these output frames: `sensor`, summing as many binary frames as one count does
    /// here.
    ///
    /// # Errors
    /// [`Error::Mismatch`] if the depth is unknown or differs from the sensor's, or if frames of a linear
    /// sensor are summed, which no sensor does.
    pub fn output_sensor(&self, sensor: &Sensor) -> Result<Sensor> {
        let place = self.path.display();
        let linear = sensor.response == Response::Linear;
        if linear && self.sum > 1 {
            return Err(Error::mismatch(
                format!("sums of {} frames of `{}`, a linear sensor", self.sum, sensor.name),
                "sum",
                "only binary frames are summed: leave it out",
            ));
        }
        match self.max_count() {
            _ if linear && self.info.binary => Err(Error::mismatch(
                format!("binary frames, and `{}` is a linear sensor", sensor.name),
                place,
                "name the sensor that took them, as in `sensor swissspad2`",
            )),
            Some(max) if linear && max != sensor.max_count() => Err(Error::mismatch(
                format!(
                    "counts up to {max}, and those of `{}` reach {}",
                    sensor.name,
                    sensor.max_count()
                ),
                place,
                "name the sensor that took them, or the depth with `bits N`",
            )),
            Some(max) if !linear => Ok(Sensor { frames_summed: u32::from(max), ..sensor.clone() }),
            None if !linear => Err(Error::mismatch(
                "how many binary frames a count sums is not known",
                place,
                "say the depth of counts with `bits 3` (for sums of 7), or `levels` for scaled means",
            )),
            _ => Ok(sensor.clone()),
        }
    }

    /// Returns the output frames per second, if known.
    pub fn fps(&self) -> Option<f64> {
        self.info.fps.map(|fps| fps / f64::from(self.sum))
    }

    /// Returns the dark electrons per native frame of every pixel, if a map is known.
    pub fn dark(&self) -> Option<&[f32]> {
        self.dark.as_deref()
    }

    /// Returns the colour filter in front of the pixels, unless they are read as gray.
    pub fn filter(&self) -> Option<&ColourFilter> {
        self.filter.as_ref()
    }

    /// Returns true if its frames have colours: behind a filter, or in three full planes.
    pub fn has_colours(&self) -> bool {
        self.filter.is_some() || self.info.full_colour
    }

    /// Returns how the filter in use contradicts the one that the capture records, as a sentence.
    pub fn filter_contradiction(&self) -> Option<&str> {
        self.filter_contradiction.as_deref()
    }

    /// Returns the pixels that are repaired: named ones, or found ones.
    pub fn bad_pixels(&self) -> &BadPixels {
        &self.bad
    }

    /// Returns true if frames cannot be read again, or only by starting over.
    pub fn forward_only(&self) -> bool {
        self.native.forward_only()
    }

    /// Returns the output frames for statistics: one from each of equally long stretches, at varying places,
    /// since lamps flicker; or the first frames, where reading the whole file would take long.
    pub fn sample_frames(&self) -> Vec<u64> {
        let sampled = self.frames().min(SAMPLE_FRAMES);
        if self.forward_only() {
            return (0..sampled).collect();
        }
        let start =
            |i: u64| (u128::from(i) * u128::from(self.frames()) / u128::from(sampled)) as u64;
        (0..sampled)
            .map(|i| start(i) + bad_pixels::scramble(i) % (start(i + 1) - start(i)))
            .collect()
    }
}
