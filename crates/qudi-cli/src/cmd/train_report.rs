//! A run's report as one HTML file: curves, the last pictures, recipe, environment. Nothing is fetched.

use crate::cmd::eval_html::escape;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::Value;
use std::fmt::Write;

/// Points of a curve at most: single steps jump, means of neighbours show where it goes.
const POINTS: usize = 120;

/// Curves of fewer points show them.
const FEW: usize = 40;

/// Size of a plot in pixels, and the margins for its numbers.
const SIZE: [f64; 2] = [680.0, 260.0];
const MARGIN: [f64; 2] = [64.0, 30.0];

const COLOURS: [&str; 6] = ["#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#8c564b"];

/// A named curve.
struct Curve {
    name: String,
    points: Vec<(f64, f64)>,
}

/// The page, from the run's metrics (one JSON document a line), its recipe and environment, and the last picture.
pub(crate) fn page(
    metrics: &str,
    recipe: &str,
    environment: &str,
    picture: Option<&[u8]>,
) -> String {
    let lines: Vec<Value> =
        metrics.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
    let of_kind = |kind: &'static str| lines.iter().filter(move |line| line["kind"] == kind);
    let steps: Vec<&Value> = of_kind("step").collect();
    let curve = |key: &str| {
        let points =
            steps.iter().filter_map(|line| Some((line["step"].as_f64()?, line[key].as_f64()?)));
        Curve { name: key.to_owned(), points: thinned(&points.collect::<Vec<_>>()) }
    };
    let losses = ["total", "prediction", "pre", "perceptual", "flow"].map(curve);
    // With errors told, whose term is a logarithm, the total may be negative.
    let shown = |curve: &Curve| {
        curve.points.iter().all(|p| p.1 >= 0.0) && curve.points.iter().any(|p| p.1 > 0.0)
    };
    let losses = losses.into_iter().filter(shown);
    let mut page = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>qudi train</title>\n<style>{STYLE}</style></head><body>\n<h1>qudi train</h1>\n"
    );
    if let Some(last) = steps.last() {
        let seconds: f64 = steps.iter().map(|line| seconds(line).iter().sum::<f64>()).sum();
        let _ = writeln!(
            page,
            "<p>{} steps in {:.1} minutes of learning.</p>",
            last["step"],
            seconds / 60.0
        );
        page += &shares(&steps);
    }
    page += &plot("Loss (logarithmic)", &losses.collect::<Vec<_>>(), true);
    let error = curve("error");
    if error.points.iter().any(|p| p.1 != 0.0) {
        page += &plot("Negative log-likelihood of the errors told", &[error], false);
    }
    let validations: Vec<&Value> = of_kind("validation").collect();
    for (key, title) in
        [("psnr_a", "Gain-aligned PSNR on the validation clips, dB"), ("ssim", "SSIM")]
    {
        page += &plot(title, &quality(&validations, key), false);
    }
    page += &plot("Norm of the gradient (logarithmic)", &[curve("norm")], true);
    page += &plot("Learning rate", &[curve("rate")], false);
    if let Some(last) = validations.last() {
        page += &table(last);
    }
    if let Some(picture) = picture {
        let _ = writeln!(
            page,
            "<h2>Validation clips: counts, restored, truth</h2>\n<img alt=\"validation clips\" src=\"data:image/png;base64,{}\">",
            STANDARD.encode(picture)
        );
    }
    for (title, text) in [("Recipe", recipe), ("Environment", environment)] {
        let _ = writeln!(page, "<h2>{title}</h2>\n<pre>{}</pre>", escape(text));
    }
    page + "</body></html>\n"
}

/// Seconds of data, forward, backward and optimizer in a step.
fn seconds(line: &Value) -> [f64; 4] {
    ["data_s", "forward_s", "backward_s", "optimizer_s"]
        .map(|key| line[key].as_f64().unwrap_or(0.0))
}

/// Where the time goes.
fn shares(steps: &[&Value]) -> String {
    let mut sums = [0.0; 4];
    for line in steps {
        for (sum, part) in sums.iter_mut().zip(seconds(line)) {
            *sum += part;
        }
    }
    let total: f64 = sums.iter().sum::<f64>().max(1e-9);
    let names = ["waiting for data", "forward", "backward", "optimizer"];
    let parts =
        names.iter().zip(sums).map(|(name, sum)| format!("{name} {:.1} %", 100.0 * sum / total));
    format!("<p>Time: {}.</p>\n", parts.collect::<Vec<_>>().join(", "))
}

/// Means of neighbouring points, so that the trend is seen.
fn thinned(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let run = points.len().div_ceil(POINTS).max(1);
    let mean = |part: &[(f64, f64)]| {
        let n = part.len() as f64;
        (part.iter().map(|p| p.0).sum::<f64>() / n, part.iter().map(|p| p.1).sum::<f64>() / n)
    };
    points.chunks(run).map(mean).collect()
}

/// A curve for every light, the mean over clips.
fn quality(validations: &[&Value], key: &str) -> Vec<Curve> {
    let mut curves: Vec<Curve> = Vec::new();
    for validation in validations {
        let mut sums: Vec<(String, f64, f64)> = Vec::new();
        for clip in validation["clips"].as_array().into_iter().flatten() {
            let (name, value) =
                (format!("{} PPP", clip["ppp"]), clip[key].as_f64().unwrap_or(f64::NAN));
            match sums.iter_mut().find(|sum| sum.0 == name) {
                Some(sum) => (sum.1, sum.2) = (sum.1 + value, sum.2 + 1.0),
                None => sums.push((name, value, 1.0)),
            }
        }
        for (name, sum, count) in sums {
            let point = (validation["step"].as_f64().unwrap_or(0.0), sum / count);
            match curves.iter_mut().find(|curve| curve.name == name) {
                Some(curve) => curve.points.push(point),
                None => curves.push(Curve { name, points: vec![point] }),
            }
        }
    }
    curves
}

/// Curves in one coordinate system, as SVG.
fn plot(title: &str, curves: &[Curve], logarithmic: bool) -> String {
    let scale = |value: f64| if logarithmic { value.max(1e-12).log10() } else { value };
    let all = || curves.iter().flat_map(|curve| &curve.points).filter(|p| p.1.is_finite());
    let bounds = |of: &dyn Fn(&(f64, f64)) -> f64| {
        all().map(of).fold([f64::INFINITY, f64::NEG_INFINITY], |[a, b], v| [a.min(v), b.max(v)])
    };
    let ([x0, x1], [y0, y1]) = (bounds(&|p| p.0), bounds(&|p| scale(p.1)));
    if !(x0.is_finite() && y0.is_finite()) {
        return String::new();
    }
    let place = |value: f64, [from, to]: [f64; 2], [low, high]: [f64; 2]| {
        low + (value - from) / (to - from).max(1e-12) * (high - low)
    };
    let across = |x: f64| place(x, [x0, x1], [MARGIN[0], SIZE[0] - 10.0]);
    let down = |y: f64| place(y, [y0, y1], [SIZE[1] - MARGIN[1], 10.0]);
    let mut svg = format!(
        "<h2>{}</h2>\n<svg viewBox=\"0 0 {} {}\" role=\"img\" aria-label=\"{0}\">\n",
        escape(title),
        SIZE[0],
        SIZE[1]
    );
    for i in 0..=4 {
        let share = f64::from(i) / 4.0;
        let (x, y) = (x0 + share * (x1 - x0), y0 + share * (y1 - y0));
        let value = if logarithmic { 10f64.powf(y) } else { y };
        let _ = writeln!(
            svg,
            "<line class=\"grid\" x1=\"{0}\" x2=\"{1}\" y1=\"{2:.1}\" y2=\"{2:.1}\"/><text x=\"4\" y=\"{2:.1}\">{5}</text><text x=\"{3:.1}\" y=\"{4}\" text-anchor=\"middle\">{x:.0}</text>",
            MARGIN[0],
            SIZE[0] - 10.0,
            down(y),
            across(x),
            SIZE[1] - 6.0,
            number(value)
        );
    }
    for (curve, colour) in curves.iter().zip(COLOURS.iter().cycle()) {
        let points = curve.points.iter().filter(|p| p.1.is_finite());
        let points: Vec<String> =
            points.map(|&(x, y)| format!("{:.1},{:.1}", across(x), down(scale(y)))).collect();
        let _ = writeln!(
            svg,
            "<polyline points=\"{}\" stroke=\"{colour}\"><title>{}</title></polyline>",
            points.join(" "),
            escape(&curve.name)
        );
        for &(x, y) in curve.points.iter().filter(|p| p.1.is_finite() && curve.points.len() < FEW) {
            let (x, y) = (across(x), down(scale(y)));
            let _ = write!(svg, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"3\" fill=\"{colour}\"/>");
        }
    }
    svg += "</svg>\n<p>";
    for (curve, colour) in curves.iter().zip(COLOURS.iter().cycle()) {
        let last = curve.points.last().map_or(f64::NAN, |p| p.1);
        let _ = write!(
            svg,
            "<span style=\"color:{colour}\">&#9632;</span> {} ({}) ",
            escape(&curve.name),
            number(last)
        );
    }
    svg + "</p>\n"
}

/// A number with about four digits.
fn number(value: f64) -> String {
    let size = value.abs();
    if size == 0.0 || !(1e-3..1e5).contains(&size) {
        return if size == 0.0 { "0".to_owned() } else { format!("{value:.2e}") };
    }
    let digits = (3.0 - size.log10().floor()).max(0.0) as usize;
    format!("{value:.digits$}")
}

/// The last validation, clip by clip.
fn table(validation: &Value) -> String {
    let mut text = "<h2>Validation clips</h2>\n<table><tr><th>clip</th><th>PPP</th><th>psnr-a</th><th>psnr</th><th>ssim</th></tr>\n".to_owned();
    for clip in validation["clips"].as_array().into_iter().flatten() {
        let number = |key: &str| clip[key].as_f64().unwrap_or(f64::NAN);
        let _ = writeln!(
            text,
            "<tr><td>{}</td><td>{}</td><td>{:.2}</td><td>{:.2}</td><td>{:.3}</td></tr>",
            escape(clip["name"].as_str().unwrap_or_default()),
            clip["ppp"],
            number("psnr_a"),
            number("psnr"),
            number("ssim")
        );
    }
    text + "</table>\n"
}

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;max-width:760px;margin:2em auto;padding:0 1em;color:#222}
svg{width:100%;background:#fafafa}polyline{fill:none;stroke-width:1.5}.grid{stroke:#ddd}text{font-size:11px;fill:#666}
img{max-width:100%}pre{background:#f4f4f4;padding:1em;overflow:auto}td,th{padding:.2em .8em;text-align:right}td:first-child,th:first-child{text-align:left}";
