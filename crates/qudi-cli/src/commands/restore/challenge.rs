//! `qudi restore SET --challenge`: the last picture of every cube of the Single Photon Challenge, in colour,
//! as the archive that its site takes; scored where the truth is next to a cube.
//!
//! The law of the cubes is known: a pixel of linear value `v` fires in a bit plane with the probability
//! `1 - exp(-0.5 v)`. So the brightness of the result is absolute, and each colour is restored with an ideal
//! binary sensor.

mod cube;
mod scores;
mod submission;

use super::args::Restore;
use super::plan::Plan;
use super::run::Job;
use crate::args::{Global, Sum};
use crate::capture::{Input, Source};
use crate::error::{CliError, Result};
use crate::interrupt;
use crate::report::Report;
use crate::settings::Settings;
use cube::{COLOURS, Cube};
use image::{Rgb, RgbImage};
use qudi_core::{Frame, linear_to_srgb};
use qudi_io::capture::Capture;
use qudi_io::description::{BitOrder, MaskChoice, PackAxis, ReadOptions};
use qudi_io::restore::RestoreSink;
use scores::Score;
use serde_json::json;
use std::collections::BTreeSet;
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
    let mut archive = Submission::create(Path::new(&plan.output), plan.overwrite)?;
    let (mut scores, mut methods, mut bar) = (Vec::new(), BTreeSet::new(), report.bar());
    for (done, cube) in (0..).zip(&cubes) {
        bar.update("restoring", done, Some(cubes.len() as u64));
        let truth = cube.truth()?;
        let picture = restored(cube, &mut plan, settings, &mut methods)?;
        archive.add(&cube.name, &picture)?;
        scores.extend(truth.map(|truth| Score::new(&cube.name, &picture, &truth)));
        if interrupt::check().is_break() {
            return Err(CliError::Interrupted);
        }
    }
    drop(bar);
    let bytes = archive.finish()?;
    if bytes > MAX_BYTES {
        report.warning(&format!("{bytes} bytes: the site takes at most {MAX_BYTES}"));
    }
    let methods: Vec<_> = methods.into_iter().collect();
    let (count, method) = (cubes.len(), methods.join(", "));
    let noun = if count == 1 { "picture" } else { "pictures" };
    let mut text = format!("{}   {count} {noun} by {method}\n", plan.output);
    if !scores.is_empty() {
        text += &format!("  {:<12}of {} of them\n", "truth", scores.len());
    }
    text += &scores::describe(&scores);
    report.result(&text, || {
        json!({
            "output": plan.output,
            "pictures": cubes.iter().map(|cube| format!("{}.png", cube.name)).collect::<Vec<_>>(),
            "methods": methods,
            "bytes": bytes,
            "scores": scores::document(&scores),
        })
    })
}

/// Restores the picture of a cube, colour by colour. The first colour that is not dark decides the method,
/// and the sums where they are not aligned.
fn restored(
    cube: &Cube,
    plan: &mut Plan,
    settings: &Settings,
    methods: &mut BTreeSet<String>,
) -> Result<RgbImage> {
    let given = (plan.method, plan.sum);
    let mut planes = [const { None }; COLOURS];
    let mut is_decided = false;
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
        if !is_decided {
            is_decided = true;
            methods.insert(job.method_text());
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
    Ok(RgbImage::from_fn(size.width as u32, size.height as u32, |x, y| {
        let at = y as usize * size.width + x as usize;
        Rgb([0, 1, 2].map(|colour: usize| sample(&planes[colour], at)))
    }))
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
