//! The page of a training run: curves, the last validation as loops and as pictures, recipe, environment.

use super::loops::Loop;
use crate::error::Result;
use crate::report::html::{TableView, data_url, render};
use crate::report::player::Player;
use crate::report::svg::{Axis, Curve, Drawing, Plot, Point};
use crate::report::{Cell, Column, Table};
use serde::Serialize;
use serde_json::Value;

/// Points of a curve at most: single steps jump, means of neighbours show where it goes.
const MAX_POINTS: usize = 120;

/// Parts of the loss, by their keys in the metrics.
const LOSSES: [(&str, &str); 15] = [
    ("total", "total"),
    ("prediction", "prediction"),
    ("pre", "pre-denoiser"),
    ("merged", "merged frames"),
    ("perceptual", "perceptual"),
    ("flow", "flow"),
    // Of learned baselines.
    ("image", "image"),
    ("half", "half the size"),
    ("quarter", "a quarter of the size"),
    ("frames", "filtered frames"),
    ("estimates", "estimates of blocks"),
    ("transforms", "transforms"),
    ("teachers", "distance from teachers"),
    ("motion", "teacher of motion"),
    ("denoising", "teacher of denoising"),
];

/// Parts of a step whose time is measured, by their keys in the metrics.
const TIMES: [(&str, &str); 4] = [
    ("data_s", "waiting for data"),
    ("forward_s", "forward"),
    ("backward_s", "backward"),
    ("optimizer_s", "optimizer"),
];

/// The files of a run that its page is made of.
pub(crate) struct Source<'a> {
    /// One JSON document a line.
    pub(crate) metrics: &'a str,
    pub(crate) recipe: &'a str,
    pub(crate) environment: &'a str,
    /// The last validation's PNG.
    pub(crate) picture: Option<&'a [u8]>,
    /// The last validation's loops.
    pub(crate) loops: Vec<Loop>,
}

/// The context of the template.
#[derive(Serialize)]
struct Page<'a> {
    title: &'a str,
    summary: Vec<String>,
    /// Quality over the steps, next to the loops.
    quality: Option<Drawing>,
    players: Vec<Player>,
    plots: Vec<Drawing>,
    table: Option<TableView>,
    picture: Option<String>,
    /// Description of how frames were restored.
    made: String,
    documents: [Document<'a>; 2],
}

#[derive(Serialize)]
struct Document<'a> {
    title: &'a str,
    text: &'a str,
}

/// Renders the page.
pub(crate) fn page(source: Source<'_>) -> Result<String> {
    let lines = source.metrics.lines();
    let lines: Vec<Value> = lines.filter_map(|line| serde_json::from_str(line).ok()).collect();
    let of_kind = |kind: &str| lines.iter().filter(|line| line["kind"] == kind).collect();
    let (steps, validations): (Vec<_>, Vec<_>) = (of_kind("step"), of_kind("validation"));
    render(
        "train.html",
        Page {
            title: "Training run",
            summary: summary(&steps),
            quality: psnr(&validations).draw(),
            players: source.loops.into_iter().map(Loop::player).collect(),
            plots: plots(&steps, &validations).iter().filter_map(Plot::draw).collect(),
            table: validations.last().map(|last| TableView::from(&clips(last))),
            picture: source.picture.map(|png| data_url("png", png)),
            made: made(source.recipe),
            documents: [
                Document { title: "Recipe", text: source.recipe },
                Document { title: "Environment", text: source.environment },
            ],
        },
    )
}

/// Summarizes the number of steps and their time.
fn summary(steps: &[&Value]) -> Vec<String> {
    let Some(last) = steps.last() else { return Vec::new() };
    let sum = |key: &str| steps.iter().filter_map(|line| line[key].as_f64()).sum::<f64>();
    let times = TIMES.map(|(key, name)| (name, sum(key)));
    let total: f64 = times.iter().map(|time| time.1).sum();
    let share =
        |(name, time): &(&str, f64)| format!("{name} {:.1} %", 100.0 * time / total.max(1e-9));
    vec![
        format!("{} steps took {:.1} minutes.", last["step"], total / 60.0),
        format!("Time: {}.", times.iter().map(share).collect::<Vec<_>>().join(", ")),
    ]
}

/// Describes how the recipe's validation restores frames.
fn made(recipe: &str) -> String {
    let recipe: Option<toml::Table> = recipe.parse().ok();
    let steps =
        recipe.as_ref().and_then(|recipe| recipe.get("validation")?.get("steps")?.as_integer());
    match steps {
        Some(0) => "Restored by regression.".to_owned(),
        Some(1) => "Restored by diffusion in 1 step.".to_owned(),
        Some(steps) => format!("Restored by diffusion in {steps} steps."),
        None => String::new(),
    }
}

/// Creates a plot over the steps.
fn plot(title: &str, caption: &str, y: Axis, curves: Vec<Curve>) -> Plot {
    let (title, caption) = (title.to_owned(), caption.to_owned());
    Plot { title, caption, x: Axis::linear("step"), y, curves }
}

/// Plots the quality of validations.
fn psnr(validations: &[&Value]) -> Plot {
    plot(
        "Validation: PSNR",
        "PSNR after the best gain, mean over validation clips, at each light level. Higher is better.",
        Axis::linear("dB"),
        quality(validations, "psnr_a"),
    )
}

fn plots(steps: &[&Value], validations: &[&Value]) -> Vec<Plot> {
    // With predicted uncertainty, whose term is a logarithm, the total may be negative.
    let on_log_axis = |curve: &Curve| {
        curve.points.iter().all(|p| p.y >= 0.0) && curve.points.iter().any(|p| p.y > 0.0)
    };
    let losses = LOSSES.map(|(key, name)| curve(steps, key, name)).into_iter().filter(on_log_axis);
    let uncertainty = curve(steps, "uncertainty", "uncertainty");
    let has_uncertainty = uncertainty.points.iter().any(|p| p.y != 0.0);
    let mut plots = vec![plot(
        "Loss",
        "The loss and its terms, each the mean over neighbouring steps. Lower is better.",
        Axis::logarithmic("loss"),
        losses.collect(),
    )];
    if has_uncertainty {
        plots.push(plot(
            "Loss of the predicted uncertainty",
            "Negative log-likelihood of the errors under the predicted uncertainty. Lower is better.",
            Axis::linear("nats"),
            vec![uncertainty],
        ));
    }
    plots.push(plot(
        "Validation: SSIM",
        "Structural similarity, mean over validation clips, at each light level. Higher is better.",
        Axis::linear("SSIM"),
        quality(validations, "ssim"),
    ));
    plots.push(plot(
        "Gradient",
        "Norm of the gradient before clipping.",
        Axis::logarithmic("norm"),
        vec![curve(steps, "norm", "norm")],
    ));
    plots.push(plot(
        "Learning rate",
        "The rate that each step was taken with.",
        Axis::linear("rate"),
        vec![curve(steps, "rate", "learning rate")],
    ));
    plots
}

/// Returns a curve of a number of every step.
fn curve(steps: &[&Value], key: &str, name: &str) -> Curve {
    let point = |line: &&Value| {
        Some(Point { x: line["step"].as_f64()?, y: line[key].as_f64()?, error: 0.0 })
    };
    let points: Vec<Point> = steps.iter().filter_map(point).collect();
    Curve { name: name.to_owned(), points: thinned(&points) }
}

/// Averages neighbouring points, so that the trend is visible.
fn thinned(points: &[Point]) -> Vec<Point> {
    let run = points.len().div_ceil(MAX_POINTS).max(1);
    let mean = |part: &[Point]| {
        let n = part.len() as f64;
        let (x, y) = part.iter().fold((0.0, 0.0), |(x, y), p| (x + p.x, y + p.y));
        Point { x: x / n, y: y / n, error: 0.0 }
    };
    points.chunks(run).map(mean).collect()
}

/// Returns a curve of means over clips for every light level.
fn quality(validations: &[&Value], key: &str) -> Vec<Curve> {
    let mut curves: Vec<Curve> = Vec::new();
    for validation in validations {
        let mut sums: Vec<(String, f64, f64)> = Vec::new();
        for clip in validation["clips"].as_array().into_iter().flatten() {
            let name = format!("{} PPP", clip["ppp"]);
            let value = clip[key].as_f64().unwrap_or(f64::NAN);
            match sums.iter_mut().find(|sum| sum.0 == name) {
                Some(sum) => (sum.1, sum.2) = (sum.1 + value, sum.2 + 1.0),
                None => sums.push((name, value, 1.0)),
            }
        }
        for (name, sum, count) in sums {
            let x = validation["step"].as_f64().unwrap_or(0.0);
            let point = Point { x, y: sum / count, error: 0.0 };
            match curves.iter_mut().find(|curve| curve.name == name) {
                Some(curve) => curve.points.push(point),
                None => curves.push(Curve { name, points: vec![point] }),
            }
        }
    }
    curves
}

/// Returns a validation, clip by clip.
fn clips(validation: &Value) -> Table {
    let mut table = Table::new(vec![
        Column::new("clip", "clip"),
        Column::new("ppp", "PPP"),
        Column::new("psnr_a", "psnr-a").with_unit("dB"),
        Column::new("psnr", "psnr").with_unit("dB"),
        Column::new("ssim", "ssim"),
    ]);
    for clip in validation["clips"].as_array().into_iter().flatten() {
        let number = |key: &str| clip[key].as_f64();
        table.rows.push(vec![
            Cell::text(clip["name"].as_str().unwrap_or_default()),
            number("ppp").map_or(Cell::Unknown, Cell::Exact),
            Cell::number(number("psnr_a"), 2),
            Cell::number(number("psnr"), 2),
            Cell::number(number("ssim"), 3),
        ]);
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;

    const METRICS: &str = "\
{\"kind\":\"step\",\"step\":1,\"rate\":0.001,\"total\":0.5,\"prediction\":0.4,\"norm\":2.0,\"data_s\":1.0,\"forward_s\":3.0}
{\"kind\":\"step\",\"step\":2,\"rate\":0.001,\"total\":0.4,\"prediction\":0.3,\"norm\":1.5,\"data_s\":1.0,\"forward_s\":3.0}
{\"kind\":\"validation\",\"step\":2,\"clips\":[{\"name\":\"<dog>\",\"ppp\":3.25,\"psnr_a\":21.5,\"psnr\":20.0,\"ssim\":0.7}]}
not json
";

    /// A loop whose clip is named like markup.
    const LOOPS: &str = r#"[{"clip": "</script><b>dog", "ppp": 3.25, "step": 2, "psnr_a": 21.5, "height": 8,
        "width": 8, "counts": ["data:,\"><script>"], "restored": ["data:,r"], "truth": ["data:,t"]}]"#;

    fn made_of(metrics: &str, recipe: &str) -> String {
        let loops = serde_json::from_str(LOOPS).unwrap_or_else(|e| panic!("{e}"));
        page(Source { metrics, recipe, environment: "{}", picture: Some(b"png"), loops })
            .unwrap_or_else(|e| panic!("{e:?}"))
    }

    #[test]
    fn shows_curves_clips_and_time() {
        let page = made_of(METRICS, "[validation]\nsteps = 4\n");
        for part in [
            "2 steps took 0.1 minutes.",
            "waiting for data 25.0 %",
            "Loss",
            "3.25 PPP",
            "&lt;dog&gt;",
            "21.50",
            "Restored by diffusion in 4 steps.",
            "&lt;&#x2f;script&gt;&lt;b&gt;dog, 3.25 photons",
            "After 2 steps: PSNR 21.50 dB",
            r#"data:,\"\u003e\u003cscript\u003e"#,
        ] {
            assert!(page.contains(part), "{part}");
        }
        assert_eq!(page.matches("<script").count(), 2, "ours: the data and the player");
        let [curve, loops] = ["Validation: PSNR", "class=\"player\""].map(|part| page.find(part));
        assert!(curve < loops && loops < page.find("<h2>Loss"), "next to their curve");
    }

    #[test]
    fn makes_a_page_of_a_run_that_has_not_taken_a_step() {
        let page = made_of("", "");
        assert!(page.contains("Recipe") && !page.contains("<polyline"));
    }

    #[test]
    fn names_regression() {
        assert!(made_of("", "[validation]\nsteps = 0\n").contains("Restored by regression."));
    }

    #[test]
    fn curves_are_thinned_to_means() {
        let points: Vec<_> =
            (0..1000).map(|n| Point { x: f64::from(n), y: 2.0, error: 0.0 }).collect();
        let thinned = thinned(&points);
        assert!(thinned.len() <= MAX_POINTS && thinned.iter().all(|p| p.y == 2.0));
        assert_eq!(thinned[0].x, 4.0, "the mean of steps 0 to 8");
    }
}
