//! `qudi restore SET --challenge`: the last picture of every cube of the Single Photon Challenge, in colour,
//! as the archive that its site takes; scored where the truth is next to a cube.
//!
//! The law of the cubes is known: a pixel of linear value `v` fires in a bit plane with the probability
//! `1 - exp(-0.5 v)`. So the brightness of the result is absolute, and each colour is restored with an ideal
//! binary sensor.

mod cube;
mod perceptual;
mod progress;
mod scores;
mod submission;

use super::args::Restore;
use super::plan::Plan;
use super::run::{Job, network_settings};
use crate::args::{Global, Sum};
use crate::capture::{Input, Source};
use crate::error::{CliError, Result};
use crate::interrupt;
use crate::methods::{Method, QUDI};
use crate::report::{Report, counted};
use crate::settings::Settings;
use cube::{COLOURS, Cube};
use image::{Rgb, RgbImage};
use perceptual::Perceptual;
use progress::Progress;
use qudi_core::{Frame, linear_to_srgb};
use qudi_io::capture::Capture;
use qudi_io::description::{BitOrder, MaskChoice, PackAxis, ReadOptions};
use qudi_io::restore::RestoreSink;
use scores::Score;
use serde_json::{Value, json};
use std::path::Path;
use std::rc::Rc;
use submission::{MAX_BYTES, Submission};

/// Photons of white in a bit plane.
const WHITE: f64 = 0.5;

/// Sensor of the cubes.
const SENSOR: &str = "ideal-binary";

/// Green first: it is the brightest of most scenes, and decides the method and the sums of all.
const ORDER: [usize; COLOURS] = [1, 0, 2];

pub(super) fn run(
    args: &Restore,
    settings: &Settings,
    global: &Global,
    report: &Report,
) -> Result<()> {
    let mut plan = Plan::new(args, global, report.json())?;
    plan.sensor = Some(SENSOR.to_owned());
    plan.light.white = Some(WHITE);
    let cubes = Cube::find(&plan.capture)?;
    let perceptual = args.backbones.as_deref();
    let perceptual =
        perceptual.map(|folder| Perceptual::load(folder, &plan.network.device)).transpose()?;
    let mut archive = Submission::create(Path::new(&plan.output), plan.overwrite)?;
    let mut progress = Progress::open(
        Path::new(&plan.output),
        &plan.capture,
        &cubes,
        run_settings(&plan, &cubes)?,
        plan.overwrite,
    )?;
    let (mut scores, mut bar) = (Vec::new(), report.bar());
    let resumed = progress.finished();
    for (number, cube) in cubes.iter().enumerate() {
        bar.update("restoring", number as u64, Some(cubes.len() as u64));
        let truth = cube.truth()?;
        let picture = if number < resumed {
            progress.read(number, cube.size())?
        } else {
            let (picture, method) = restored(cube, &mut plan, settings)?;
            progress.push(number, &picture, method)?;
            picture
        };
        archive.add(&cube.name, &picture)?;
        if let Some(truth) = truth {
            scores.push(Score::new(&cube.name, &picture, &truth, perceptual.as_ref())?);
        }
        if interrupt::check().is_break() {
            return Err(CliError::Interrupted);
        }
    }
    drop(bar);
    let bytes = archive.finish()?;
    let methods: Vec<String> = progress.methods.iter().cloned().collect();
    progress.remove();
    if bytes > MAX_BYTES {
        report.warning(&format!("{bytes} bytes: the site takes at most {MAX_BYTES}"));
    }
    let made = counted(cubes.len() as u64, "picture");
    let mut text = format!("{}   {made} by {}\n", plan.output, methods.join(", "));
    if resumed > 0 {
        text +=
            &format!("  {:<12}{} there already\n", "resumed", counted(resumed as u64, "picture"));
    }
    if !scores.is_empty() {
        text += &format!("  {:<12}of {} of them\n", "truth", scores.len());
    }
    text += &scores::describe(&scores);
    report.result(&text, || {
        json!({
            "output": plan.output,
            "pictures": cubes.iter().map(|cube| format!("{}.png", cube.name)).collect::<Vec<_>>(),
            "methods": methods,
            "resumed_pictures": resumed,
            "bytes": bytes,
            "scores": scores::document(&scores),
        })
    })
}

/// Returns the settings that the pictures depend on.
fn run_settings(plan: &Plan, cubes: &[Cube]) -> Result<Value> {
    let network: Option<&Method> = plan.method.or(Method::by_name(QUDI.name));
    let network = network.map(|method| network_settings(method, &plan.network)).transpose()?;
    Ok(json!({
        "pictures": cubes.iter().map(|cube| &cube.name).collect::<Vec<_>>(),
        "sensor": SENSOR,
        "white": WHITE,
        "method": plan.method.map(|method| method.name),
        "network": network,
        "sum": plan.sum.map(|sum| format!("{sum:?}")),
        "seed": plan.light.seed,
        "overlap": plan.overlap,
    }))
}

/// Restores the picture of a cube, colour by colour, and returns it with its method; none for a dark one. The
/// first colour that is not dark decides the method, and the sums where they are not aligned.
fn restored(
    cube: &Cube,
    plan: &mut Plan,
    settings: &Settings,
) -> Result<(RgbImage, Option<String>)> {
    let given = (plan.method, plan.sum);
    let mut planes = [const { None }; COLOURS];
    let mut decided = None;
    for colour in ORDER {
        if cube.is_dark(colour)? {
            continue;
        }
        plan.read = ReadOptions {
            bit_order: Some(BitOrder::Msb),
            pack_axis: Some(PackAxis::Width),
            mask: MaskChoice::None,
            sum: match plan.sum {
                Some(Sum::Frames(sum)) => Some(sum),
                _ => None,
            },
            ..ReadOptions::default()
        };
        let mut job = Job::prepare(plan, &source(cube, colour, plan), settings, &silent())?;
        let mut sink = First(None);
        job.run(0..1, &mut sink, &plan.network, &silent())?;
        planes[colour] = sink.0;
        if decided.is_none() {
            decided = Some(job.method_text());
            (plan.method, plan.sum) =
                (Some(job.method), job.plain_sum().map(Sum::Frames).or(plan.sum));
        }
    }
    (plan.method, plan.sum) = given;
    let size = cube.size();
    let sample = |plane: &Option<Frame>, at: usize| {
        let value = plane.as_ref().map_or(0.0, |plane| plane.data[at]);
        (255.0 * linear_to_srgb(value.clamp(0.0, 1.0))).round() as u8
    };
    let picture = RgbImage::from_fn(size.width as u32, size.height as u32, |x, y| {
        let at = y as usize * size.width + x as usize;
        Rgb([0, 1, 2].map(|colour: usize| sample(&planes[colour], at)))
    });
    Ok((picture, decided))
}

/// Returns a colour of a cube as a capture that the plan reads.
fn source<'a>(cube: &Cube, colour: usize, plan: &'a Plan) -> Source<'a> {
    let cube = cube.clone();
    let open = move |options: &ReadOptions, sensor: Option<&_>| {
        Capture::from_array(cube.reversed_planes(colour)?, options, sensor)
    };
    Source {
        input: Input::array(open),
        options: &plan.read,
        sum: plan.sum,
        sensor: plan.sensor.as_deref(),
        judged: 0,
    }
}

/// Makes a report that drops the remarks of single colours.
fn silent() -> Report {
    Report::to(Rc::new(|_| ()))
}

/// A sink that keeps the first frame.
struct First(Option<Frame>);

impl RestoreSink for First {
    fn frame(&mut self, _: u64, restored: &Frame, _: &[u16]) -> qudi_core::Result<()> {
        self.0.get_or_insert_with(|| restored.clone());
        Ok(())
    }
}
