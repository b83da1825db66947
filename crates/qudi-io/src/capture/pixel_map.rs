//! Bad pixels and dark rates of a capture: from files, or from the capture itself.

use super::Capture;
use crate::codec::read_mat_map;
use crate::description::{CaptureInfo, MaskChoice, ReadOptions};
use qudi_core::Frame;
use qudi_core::Transfer;
use qudi_core::bad_pixels::{BadPixels, Repair};
use qudi_core::colour::ColourFilter;
use qudi_core::limits::SAMPLE_FRAMES;
use qudi_core::npy::read_image;
use qudi_core::regular_file::require_regular;
use qudi_core::sensor::Sensor;
use qudi_core::{Error, Result};
use qudi_sim::clip::read_still;
use std::path::Path;

/// Dark rate beyond which a pixel of a map is hot, if the map does not say (Ma et al. 2020 use 50 to 100).
const HOT_PER_SECOND: f32 = 100.0;

/// Determines the pixels to repair, and the dark rates.
pub(crate) fn plan(
    capture: &mut Capture,
    options: &ReadOptions,
    sensor: Option<&Sensor>,
) -> Result<()> {
    let calibrated = match &options.dcr {
        Some(path) if path.extension().is_some_and(|e| e == "toml") => {
            Some(Sensor::load(&path.to_string_lossy())?)
        }
        _ => None,
    };
    let sensor = calibrated.as_ref().or(sensor);
    let mut named = None;
    if let Some(sensor) = sensor {
        if let Some(map) = &sensor.defects.dark_map {
            capture.dark = Some(load_rates(capture, Path::new(map))?.data);
        }
        if let Some(map) = &sensor.defects.bad_pixels {
            named = Some(nonzero(&load(capture, Path::new(map))?));
        }
    }
    if let Some(path) = options.dcr.as_ref().filter(|_| calibrated.is_none()) {
        let rates = load_rates(capture, path)?;
        let hot = (0..rates.data.len()).filter(|&i| rates.data[i] > HOT_PER_SECOND).collect();
        named = Some(BadPixels { hot, ..BadPixels::default() });
        let rate = capture.info.exposure_rate();
        if let Some(fps) = rate.or(sensor.and_then(|sensor| sensor.fps)) {
            capture.dark = Some(rates.data.iter().map(|rate| rate / fps as f32).collect());
        } else {
            note_unknown_rate(&mut capture.info);
        }
    }
    let known = match &options.mask {
        MaskChoice::File(path) => Some(nonzero(&load(capture, path)?)),
        MaskChoice::Auto => named,
        MaskChoice::None => Some(BadPixels::default()),
    };
    if let Some(known) = &known {
        let mask = known.mask(capture.size());
        let stored = capture.view.stored(&mask, capture.native.size(), false);
        capture.native.ignore(&stored);
        capture.held.clear();
    }
    capture.bad = match known {
        Some(known) => known,
        None => find(capture)?,
    };
    let size = capture.size();
    add_counter(capture);
    let colours = capture.filter.as_ref().map(ColourFilter::colours);
    capture.repair = Repair::among(&capture.bad.mask(size), size, |i, j| {
        colours.is_none_or(|colours| colours[i] == colours[j])
    });
    if capture.repair.count() < capture.bad.len() {
        return Err(Error::request(
            "every pixel is bad",
            "mask",
            "a mask is nonzero at bad pixels only; use `mask none` to repair none",
        ));
    }
    Ok(())
}

/// Adds the pixels of a frame counter to the bad ones.
fn add_counter(capture: &mut Capture) {
    if capture.counter.is_empty() {
        return;
    }
    let mut stored = vec![false; capture.native.size().pixels()];
    for &pixel in &capture.counter {
        stored[pixel] = true;
    }
    let mut seen = capture.bad.mask(capture.size());
    let known = seen.clone();
    capture.view.apply(&stored, &mut seen);
    let new = (0..seen.len()).filter(|&i| seen[i] && !known[i]);
    capture.bad.hot.extend(new);
    capture.bad.hot.sort_unstable();
}

/// Notes once that dark rates are not subtracted; the maps are determined again when frames are summed.
fn note_unknown_rate(info: &mut CaptureInfo) {
    let note = "the frame rate is unknown: dark rates name hot pixels, but are not subtracted (a `sensor` knows its rate)";
    if !info.notes.iter().any(|earlier| earlier == note) {
        info.notes.push(note.to_owned());
    }
}

/// Finds hot and dead pixels in the capture itself.
fn find(capture: &mut Capture) -> Result<BadPixels> {
    let size = capture.size();
    let mut sums = vec![0u32; size.pixels()];
    let mut one = vec![0u32; size.pixels()];
    let sampled = capture.sample_frames();
    debug_assert!(sampled.len() as u64 <= SAMPLE_FRAMES);
    for &frame in &sampled {
        capture.stored_total(frame..frame + 1, &mut one)?;
        for (sum, one) in sums.iter_mut().zip(&one) {
            *sum += one;
        }
    }
    let native = sampled.len() as u64 * u64::from(capture.sum);
    Ok(BadPixels::find(&sums, size, native, capture.info.max_count))
}

fn nonzero(map: &Frame) -> BadPixels {
    let hot = (0..map.data.len()).filter(|&i| map.data[i] != 0.0).collect();
    BadPixels { hot, ..BadPixels::default() }
}

/// Loads a map of dark rates.
fn load_rates(capture: &Capture, path: &Path) -> Result<Frame> {
    let rates = load(capture, path)?;
    match rates.data.iter().position(|rate| !rate.is_finite()) {
        Some(at) => Err(Error::data(
            format!(
                "a dark rate of {} at row {}, column {}",
                rates.data[at],
                at / rates.size.width,
                at % rates.size.width
            ),
            path,
            "replace it by 0, and name the pixel in a mask if it is bad",
        )),
        None => Ok(rates),
    }
}

/// Loads a map of the frames as they are read without turn and crop, turned and cropped like them; or one of
/// the stored frames, or of the frames in use.
fn load(capture: &Capture, path: &Path) -> Result<Frame> {
    let map = read(path)?;
    let (size, stored) = (capture.size(), capture.native.size());
    if map.size == size && capture.view == capture.usual {
        return Ok(map);
    }
    let stored_map = if map.size == capture.usual.size {
        Some(capture.usual.stored(&map.data, stored, 0.0))
    } else {
        (map.size == stored).then(|| map.data.clone())
    };
    if let Some(stored_map) = stored_map {
        let mut turned = Frame::filled(size, 0.0);
        capture.view.apply(&stored_map, &mut turned.data);
        return Ok(turned);
    }
    if map.size == size {
        return Ok(map);
    }
    Err(Error::data(
        format!("a map of {} for frames of {size}, stored as {stored}", map.size),
        path,
        "use a map of the same camera and the same part of the array",
    ))
}

fn read(path: &Path) -> Result<Frame> {
    require_regular(path, "read the map")?;
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    match extension.as_str() {
        "npy" => read_image(path),
        "mat" => read_mat_map(path, "dcr"),
        "png" | "tif" | "tiff" => read_still(path, Transfer::AsIs),
        _ => Err(Error::data(
            "not a map of pixels",
            path,
            "maps are .npy, .mat (variable `dcr`), .png or .tif; a sensor file ends in .toml",
        )),
    }
}
