//! Runs a method over a capture of any length: windows, cross-fade, frames out in order.

use super::instants::{Instants, Schedule};
use crate::capture::Capture;
use qudi_core::Frame;
use qudi_core::restorer::{Acquisition, BurstView, Restorer};
use qudi_core::windows::CrossFade;
use qudi_core::{Error, Result};
use std::collections::VecDeque;
use std::ops::{ControlFlow, Range};
use std::path::Path;

/// A receiver of restored frames.
pub trait RestoreSink {
    /// Takes frame `number`, restored, with its counts. Frames arrive in order.
    ///
    /// # Errors
    /// The sink's own; the run ends with it.
    fn frame(&mut self, number: u64, restored: &Frame, counts: &[u16]) -> Result<()>;

    /// Takes red, green and blue of frame `number`, in place of a gray frame.
    ///
    /// # Errors
    /// The sink's own; the run ends with it.
    fn colour(&mut self, number: u64, restored: &[Frame; 3], counts: &[u16]) -> Result<()> {
        self.frame(number, &restored[1], counts)
    }

    /// Takes the uncertainty of frame `number`, right after the frame: the standard deviation over the
    /// samples of a method that draws several. Other methods have none.
    ///
    /// # Errors
    /// The sink's own; the run ends with it.
    fn uncertainty(&mut self, number: u64, uncertainty: &Frame) -> Result<()> {
        let _ = (number, uncertainty);
        Ok(())
    }

    /// Takes the uncertainties of red, green and blue of frame `number`, right after the one of its luma.
    ///
    /// # Errors
    /// The sink's own; the run ends with it.
    fn colour_uncertainty(&mut self, number: u64, uncertainty: &[Frame; 3]) -> Result<()> {
        let _ = (number, uncertainty);
        Ok(())
    }
}

/// Refuses restored frames that hold NaN or infinite values, and names the first.
fn refuse_not_finite(first: u64, frames: &[Frame], path: &Path) -> Result<()> {
    for (number, frame) in (first..).zip(frames) {
        if let Some(at) = frame.data.iter().position(|value| !value.is_finite()) {
            let (row, column) = (at / frame.size.width, at % frame.size.width);
            return Err(Error::data(
                format!(
                    "restored frame {number} holds {} at row {row}, column {column}",
                    frame.data[at]
                ),
                path,
                "check the light, the gain, dark maps and the weights for values that are not finite",
            ));
        }
    }
    Ok(())
}

/// Restores the pictures `numbers` of `capture`, scheduled by `schedule`, and hands them to `sink`. A picture
/// does not depend on which others are restored, nor on whether it came from a file or a pipe. Every part
/// between cuts is restored as if it were all of the capture. Memory holds two windows at most.
///
/// # Errors
/// [`Error`] if the capture cannot be read or the method or the sink fails; [`Error::Interrupted`] if `on`
/// says so, which is called with the number of finished pictures and of all (if known).
pub fn run(
    restorer: &mut dyn Restorer,
    capture: &mut Capture,
    schedule: &Schedule,
    numbers: Range<u64>,
    acquisition: &Acquisition,
    sink: &mut dyn RestoreSink,
    on: &mut dyn FnMut(u64, Option<u64>) -> ControlFlow<()>,
) -> Result<()> {
    let parts = schedule.instants.parts(capture);
    if parts.len() == 1 {
        return run_part(restorer, capture, schedule, numbers, acquisition, sink, on);
    }
    let mut first_frame = 0;
    for (part, pictures) in parts {
        let common = numbers.start.max(pictures.start)..numbers.end.min(pictures.end);
        let acquisition = Acquisition { first_frame, ..acquisition.clone() };
        first_frame += (part.end - part.start) / u64::from(capture.summed());
        if common.is_empty() {
            continue;
        }
        let before = common.start - numbers.start;
        let total = numbers.end.min(schedule.instants.pictures(capture).unwrap_or(numbers.end));
        let mut on = |done, _| on(before + done, Some(total - numbers.start));
        let mut sink = Renumbered { sink, first: pictures.start };
        let numbers_in_part = common.start - pictures.start..common.end - pictures.start;
        capture.in_part(&part, |capture| {
            let windows = schedule.windows.over(capture.frames());
            let schedule = Schedule { windows, ..*schedule };
            run_part(
                restorer,
                capture,
                &schedule,
                numbers_in_part,
                &acquisition,
                &mut sink,
                &mut on,
            )
        })?;
    }
    Ok(())
}

/// A sink of pictures that are counted from one of them on.
struct Renumbered<'a> {
    sink: &'a mut dyn RestoreSink,
    first: u64,
}

impl RestoreSink for Renumbered<'_> {
    fn frame(&mut self, number: u64, restored: &Frame, counts: &[u16]) -> Result<()> {
        self.sink.frame(self.first + number, restored, counts)
    }

    fn colour(&mut self, number: u64, restored: &[Frame; 3], counts: &[u16]) -> Result<()> {
        self.sink.colour(self.first + number, restored, counts)
    }

    fn uncertainty(&mut self, number: u64, uncertainty: &Frame) -> Result<()> {
        self.sink.uncertainty(self.first + number, uncertainty)
    }

    fn colour_uncertainty(&mut self, number: u64, uncertainty: &[Frame; 3]) -> Result<()> {
        self.sink.colour_uncertainty(self.first + number, uncertainty)
    }
}

/// The planes of colours in windows that overlap.
#[derive(Default)]
struct ColourFade([CrossFade; 3]);

impl ColourFade {
    fn push(&mut self, first: u64, colours: &[[Frame; 3]], weight: impl Fn(u64) -> f32 + Copy) {
        for (k, plane) in self.0.iter_mut().enumerate() {
            let frames = colours.iter().map(|colours| colours[k].clone()).collect();
            plane.push(first, frames, weight);
        }
    }

    /// Returns the next colours, if no later window changes them.
    fn pop(&mut self, until: u64) -> Option<[Frame; 3]> {
        let [red, green, blue] = &mut self.0;
        let (red, green, blue) = (red.pop(until)?, green.pop(until)?, blue.pop(until)?);
        Some([red.1, green.1, blue.1])
    }
}

/// Restores pictures of a capture without cuts.
fn run_part(
    restorer: &mut dyn Restorer,
    capture: &mut Capture,
    schedule: &Schedule,
    numbers: Range<u64>,
    acquisition: &Acquisition,
    sink: &mut dyn RestoreSink,
    on: &mut dyn FnMut(u64, Option<u64>) -> ControlFlow<()>,
) -> Result<()> {
    match schedule.instants {
        Instants::Frames { .. } => {
            run_windows(restorer, capture, schedule, numbers, acquisition, sink, on)
        }
        Instants::Centred { every } => {
            run_centred(restorer, capture, every, numbers, acquisition, sink, on)
        }
    }
}

/// Restores each picture in the middle of a window of its own, or as near to it as the ends of the capture
/// allow.
fn run_centred(
    restorer: &mut dyn Restorer,
    capture: &mut Capture,
    every: u64,
    numbers: Range<u64>,
    acquisition: &Acquisition,
    sink: &mut dyn RestoreSink,
    on: &mut dyn FnMut(u64, Option<u64>) -> ControlFlow<()>,
) -> Result<()> {
    let (size, sum) = (capture.size(), u64::from(capture.summed()));
    let sums_there = capture.native_frames() / sum;
    let length = (restorer.window() as u64).min(sums_there);
    for picture in numbers.clone() {
        if on(picture - numbers.start, Some(numbers.end - numbers.start)).is_break() {
            return Err(Error::Interrupted);
        }
        let instant = picture * every;
        let after = (capture.native_frames() - instant) / sum;
        let most_before = (instant / sum).min(length - 1);
        // Number of sums of the window before the picture's own.
        let before = (length / 2).max(length.saturating_sub(after)).min(most_before);
        let first = instant - before * sum;
        let length = length.min(before + after);
        let mut counts = vec![vec![0; size.pixels()]; length as usize];
        for (number, counts) in (0..).zip(&mut counts) {
            capture.read_from(first + number * sum, counts)?;
        }
        let first_frame = acquisition.first_frame + first / sum;
        let acquisition = Acquisition { first_frame, ..acquisition.clone() };
        let (view, at) = (BurstView { size, frames: &counts }, before as usize);
        let restored = restorer.restore_frames(view, &acquisition, &[at])?;
        refuse_not_finite(picture, &restored.frames, capture.path())?;
        match &restored.colour {
            Some(colour) => sink.colour(picture, &colour[0], &counts[at])?,
            None => sink.frame(picture, &restored.frames[0], &counts[at])?,
        }
        if let Some(uncertainty) = restored.std {
            sink.uncertainty(picture, &uncertainty[0])?;
        }
        if let Some(uncertainty) = restored.colour_std {
            sink.colour_uncertainty(picture, &uncertainty[0])?;
        }
    }
    Ok(())
}

/// Restores windows one after the other, and blends their pictures where they overlap.
fn run_windows(
    restorer: &mut dyn Restorer,
    capture: &mut Capture,
    &Schedule { windows, instants }: &Schedule,
    pictures: Range<u64>,
    acquisition: &Acquisition,
    sink: &mut dyn RestoreSink,
    on: &mut dyn FnMut(u64, Option<u64>) -> ControlFlow<()>,
) -> Result<()> {
    let (first, end) = (instants.frame_of(pictures.start), instants.frame_of(pictures.end));
    let size = capture.size();
    let mut counts: VecDeque<Vec<u16>> = VecDeque::new();
    let mut first_held = 0;
    let mut restored_until = 0;
    let mut fade = CrossFade::default();
    let mut planes = ColourFade::default();
    let mut uncertainties = CrossFade::default();
    let mut colour_uncertainties = ColourFade::default();
    for number in windows.first_with(first).. {
        // A pipe tells its length at its end. The place of this window and the next one is certain once the
        // next one is complete, or no more frames arrive.
        let windows = windows.over(capture.wait_for(windows.nominal_end(number + 1))?);
        if number >= windows.count() || windows.restored(number).start >= end {
            break;
        }
        let range = windows.range(number);
        let total = instants.pictures(capture).map(|all| pictures.end.min(all) - pictures.start);
        let done = instants.pictures_before(restored_until).saturating_sub(pictures.start);
        if on(done, total).is_break() {
            return Err(Error::Interrupted);
        }
        if counts.is_empty() {
            first_held = range.start;
        }
        while first_held < range.start {
            counts.pop_front();
            first_held += 1;
        }
        while first_held + (counts.len() as u64) < range.end {
            let mut frame = vec![0; size.pixels()];
            capture.read(first_held + counts.len() as u64, &mut frame)?;
            counts.push_back(frame);
        }
        capture.discard_before(range.end);
        let first_frame = acquisition.first_frame + range.start;
        let acquisition = Acquisition { first_frame, ..acquisition.clone() };
        let restored_here = windows.restored(number);
        let before = instants.pictures_before(restored_here.start);
        let here = before..instants.pictures_before(restored_here.end);
        let frames = here.map(|picture| (instants.frame_of(picture) - range.start) as usize);
        let frames: Vec<usize> = frames.collect();
        if !frames.is_empty() {
            let burst = BurstView { size, frames: counts.make_contiguous() };
            let restored = restorer.restore_frames(burst, &acquisition, &frames)?;
            refuse_not_finite(before, &restored.frames, capture.path())?;
            let weight = |picture| windows.weight(number, instants.frame_of(picture));
            fade.push(before, restored.frames, weight);
            if let Some(colours) = restored.colour {
                planes.push(before, &colours, weight);
            }
            if let Some(uncertainty) = restored.std {
                uncertainties.push(before, uncertainty, weight);
            }
            if let Some(uncertainty) = restored.colour_std {
                colour_uncertainties.push(before, &uncertainty, weight);
            }
        }
        restored_until = restored_here.end;
        let last = number + 1 == windows.count();
        let until = if last { range.end } else { windows.restored(number + 1).start };
        let until = instants.pictures_before(until);
        while let Some((picture, image)) = fade.pop(until) {
            let requested = pictures.contains(&picture);
            let frame = instants.frame_of(picture);
            let counts = &counts[(frame - first_held) as usize];
            match planes.pop(until) {
                _ if !requested => {}
                Some(colours) => sink.colour(picture, &colours, counts)?,
                None => sink.frame(picture, &image, counts)?,
            }
            if let Some((_, uncertainty)) = uncertainties.pop(until).filter(|_| requested) {
                sink.uncertainty(picture, &uncertainty)?;
            }
            if let Some(uncertainty) = colour_uncertainties.pop(until).filter(|_| requested) {
                sink.colour_uncertainty(picture, &uncertainty)?;
            }
        }
    }
    Ok(())
}
