//! `qudi convert`: any capture into a format that everything reads.

use super::args::Convert;
use crate::args::{Global, Sum};
use crate::capture::{is_pipe, refuse_terminal, remarks, sum_by_itself};
use crate::error::{CliError, Result};
use crate::interrupt;
use crate::report::{Bar, Report, counted};
use qudi_core::atomic_file::refuse_taken;
use qudi_core::colour::FilterChoice;
use qudi_core::sensor::Sensor;
use qudi_core::{Error, Light};
use qudi_io::capture::{Capture, Summary};
use qudi_io::description::{MaskChoice, ReadOptions};
use qudi_io::sidecar::{BurstLayout, Conversion, VERSION};
use qudi_io::writer::{BurstFormat, BurstWriter};
use serde_json::Value;
use std::path::Path;

pub(crate) fn run(args: &Convert, global: &Global, report: &Report) -> Result<()> {
    let overwrite = global.overwrite();
    let options = args.reading.options(MaskChoice::None);
    refuse_taken(&args.output, overwrite)?;
    let mut capture = open(args, &options)?;
    check_filter(&mut capture, report)?;
    let max_count = largest_count(&mut capture, args)?;
    let format = BurstFormat::for_path(&args.output, max_count, !args.unpacked)?;
    if args.unpacked && !(format == BurstFormat::NpyU8 && max_count == 1) {
        return Err(CliError::new(
            format!("counts up to {max_count} in {} are not packed", args.output.display()),
            "--unpacked",
            "leave it out: only binary .npy bursts are packed",
        ));
    }
    refuse_taken(&format.record_path(&args.output), overwrite)?;
    let size = capture.size();
    let mut writer = BurstWriter::create(&args.output, format, size, max_count, overwrite)?;
    let mut counts = vec![0u16; size.pixels()];
    let mut bar = report.bar();
    let mut frame = copy_packed(&mut capture, format, &mut writer, &mut bar)?;
    // A pipe tells its length at its end.
    while frame < capture.wait_for(frame + 1)? {
        if interrupt::check().is_break() {
            return Err(CliError::Interrupted);
        }
        bar.update("converting", frame, capture.length());
        capture.read(frame, &mut counts)?;
        capture.discard_before(frame + 1);
        let largest = counts.iter().copied().max().unwrap_or(0);
        if largest > max_count {
            return Err(Error::data(
                format!(
                    "frame {frame} counts {largest}, beyond the {max_count} that its format allows"
                ),
                &args.capture,
                "check --format and --levels",
            )
            .into());
        }
        writer.push(&counts)?;
        frame += 1;
    }
    drop(bar);
    capture.verify()?;
    let frames = frame;
    let layout = BurstLayout::of_counts(format, frames, size, max_count, capture.fps());
    let record = conversion(args, &options, &capture, layout, report)?;
    let bytes = serde_json::to_vec_pretty(&record)
        .map_err(|e| CliError::new(e, args.output.display(), "report this as a bug"))?;
    writer.finish(&bytes, overwrite)?;
    remarks(&capture, report);
    let text = format!(
        "{}   {} of {size}, {} bit, from {}",
        args.output.display(),
        counted(frames, "frame"),
        record.burst.bits,
        capture.info().title
    );
    report.result(&text, || serde_json::to_value(&record).unwrap_or(Value::Null))
}

/// Opens the capture, from a file or a pipe, summed as requested. Noise below a recorded pedestal keeps its
/// sign, as the record says.
fn open(args: &Convert, options: &ReadOptions) -> Result<Capture> {
    let options = &ReadOptions { signed: true, ..options.clone() };
    let capture = if is_pipe(&args.capture) {
        refuse_terminal("cat burst.npy | qudi convert - -o out.tif")?;
        Capture::from_pipe(std::io::stdin(), options, None)?
    } else {
        Capture::open(&args.capture, options, None)?
    };
    match args.reading.sum() {
        Some(Sum::Auto) => Ok(sum_by_itself(capture, options, None, true)?.0),
        Some(Sum::Frames(_)) | None => Ok(capture),
    }
}

/// Copies frames without unpacking them: all, or none.
fn copy_packed(
    capture: &mut Capture,
    format: BurstFormat,
    writer: &mut BurstWriter,
    bar: &mut Bar,
) -> Result<u64> {
    /// Bytes copied at once.
    const PIECE_BYTES: usize = 1 << 20;
    if format != BurstFormat::NpyPacked || capture.length().is_none() {
        return Ok(0);
    }
    let frame_bytes = capture.size().height * capture.size().width.div_ceil(8);
    let at_once = (PIECE_BYTES / frame_bytes).max(1) as u64;
    let mut bytes = Vec::new();
    let mut frame = 0;
    while frame < capture.frames() {
        if interrupt::check().is_break() {
            return Err(CliError::Interrupted);
        }
        bar.update("converting", frame, Some(capture.frames()));
        let n = at_once.min(capture.frames() - frame);
        bytes.resize(n as usize * frame_bytes, 0);
        if !capture.copy_packed(frame, &mut bytes)? {
            return Ok(0);
        }
        writer.push_packed(&bytes)?;
        frame += n;
    }
    Ok(frame)
}

fn conversion(
    args: &Convert,
    options: &ReadOptions,
    capture: &Capture,
    burst: BurstLayout,
    report: &Report,
) -> Result<Conversion> {
    let about = capture.info();
    let sensor = converted_sensor(capture, options, report);
    let light = about.ppp.zip(about.mean_level).filter(|_| sensor.is_some());
    let absolute =
        |path: &Path| std::path::absolute(path).map_err(|e| Error::io("find the capture", path, e));
    Ok(Conversion {
        version: VERSION,
        program: format!("qudi {}", env!("CARGO_PKG_VERSION")),
        burst,
        binary: about.binary,
        preset: about.preset.map(str::to_owned),
        capture: absolute(&args.capture)?,
        format: about.format.to_owned(),
        read: options.clone(),
        cfa: converted_filter(capture),
        gain: about.gain.filter(|_| sensor.is_some()),
        light: light
            .map(|(ppp, mean_level)| Light { ppp: ppp * f64::from(capture.summed()), mean_level }),
        sensor,
    })
}

/// Returns the sensor of the converted frames, if the capture's record names one. Maps do not fit frames that
/// are turned, cropped, or of one colour.
fn converted_sensor(capture: &Capture, options: &ReadOptions, report: &Report) -> Option<Sensor> {
    let recorded = capture.info().sensor.as_ref()?;
    let Ok(mut sensor) = capture.output_sensor(recorded) else {
        report.warning(&format!(
            "the record of the converted frames names no sensor, since `{}` takes no such sums: name one with --sensor when they are read",
            recorded.name
        ));
        return None;
    };
    sensor.offset = capture.info().pedestal;
    let moved = options.orient.is_some() || options.crop.is_some() || options.channel.is_some();
    // A tile that is turned and cropped with the frames has an entry of its own.
    if let Some(colour) = &mut sensor.colour
        && (capture.filter().is_none() || moved)
    {
        colour.cfa = None;
    }
    let defects = &mut sensor.defects;
    let has_maps = defects.dark_map.is_some() || defects.bad_pixels.is_some();
    if has_maps && moved {
        (defects.dark_map, defects.bad_pixels) = (None, None);
        report.warning(
            "the record of the converted frames names no maps of dark rates and bad pixels, which do not fit turned or cropped frames: find them again with `qudi calibrate`",
        );
    }
    Some(sensor)
}

/// Returns the colour filter of the frames, turned and cropped as they are, if it is a tile that repeats.
fn converted_filter(capture: &Capture) -> Option<FilterChoice> {
    capture.filter()?.tile()?.parse().ok()
}

/// Refuses a colour filter that the picture contradicts, and warns of one that a record cannot hold.
fn check_filter(capture: &mut Capture, report: &Report) -> Result<()> {
    if capture.filter().is_none() {
        return Ok(());
    }
    Summary::measure(capture, None, None)?;
    if let Some(contradiction) = capture.filter_contradiction() {
        report.warning(contradiction);
    }
    if let (None, Some(cfa)) = (converted_filter(capture), &capture.info().cfa) {
        report.warning(&format!(
            "the record does not keep the colour filter {cfa}, which is no tile that repeats: when the converted frames are read, name a picture of it of their size with --cfa FILE"
        ));
    }
    Ok(())
}

/// Returns the largest count that can appear: known, or the limit of the sample type that the counts need.
fn largest_count(capture: &mut Capture, args: &Convert) -> Result<u16> {
    if let Some(max) = capture.max_count() {
        return Ok(max);
    }
    if is_pipe(&args.capture) {
        return Err(CliError::new(
            "the depth of the counts is unknown, and a pipe comes once",
            "--bits",
            "say how many bits a count has, as in --bits 8",
        ));
    }
    // Unknown depth: every frame decides.
    let mut counts = vec![0u16; capture.size().pixels()];
    let mut largest = 1;
    for frame in 0..capture.frames() {
        if interrupt::check().is_break() {
            return Err(CliError::Interrupted);
        }
        capture.read(frame, &mut counts)?;
        largest = largest.max(counts.iter().copied().max().unwrap_or(0));
    }
    let bits = 16 - largest.leading_zeros();
    Ok(((1u32 << bits) - 1) as u16)
}
