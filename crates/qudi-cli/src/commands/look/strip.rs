//! The strip of a capture: light and change over time, with marks where something was found.

use qudi_io::capture::{FrameFindings, Stretch};
use std::fmt::Write as _;

/// Width and height in pixels, and the height of a lane below its title.
const SIZE: [f64; 2] = [960.0, 150.0];
const LANE: f64 = 44.0;

/// Baselines of the two lanes.
const BASELINES: [f64; 2] = [62.0, 124.0];

/// Marks of one kind that are drawn at most.
const MAX_MARKS: usize = 200;

/// Draws the strip as SVG; `None` where nothing was looked at.
pub(crate) fn strip(timeline: &[Stretch], findings: &FrameFindings) -> Option<String> {
    let (first, end) = (timeline.first()?.first, timeline.last()?.end());
    let x = |frame: u64| (frame - first) as f64 / (end - first).max(1) as f64 * SIZE[0];
    let lanes: [(&str, Values); 2] = [
        ("light: counts per pixel and frame", |stretch| stretch.light.clone()),
        ("change of the picture, over what chance explains", |stretch| {
            stretch.change.iter().map(|change| change.max(1.0).log10()).collect()
        }),
    ];
    let [width, height] = SIZE;
    let mut svg = format!(
        "<svg class=\"timeline\" viewBox=\"0 0 {width} {height}\" role=\"img\" aria-label=\"Light and change over time\" fill=\"none\" stroke=\"currentColor\">"
    );
    for ((title, values), base) in lanes.iter().zip(BASELINES) {
        let most = timeline.iter().flat_map(values).fold(f64::MIN_POSITIVE, f64::max);
        let _ = write!(svg, "{}", text(0.0, base - LANE - 5.0, "start", title));
        for stretch in timeline {
            let (from, to) = (x(stretch.first), x(stretch.end()));
            let _ = write!(
                svg,
                "<path stroke-opacity=\".3\" d=\"M{from:.1} {base}H{to:.1}\"/><polyline points=\""
            );
            for (n, value) in (0..).zip(values(stretch)) {
                let at = x(stretch.first + n * stretch.step);
                let next = x(stretch.first + (n + 1) * stretch.step);
                let y = base - value / most * LANE;
                let _ = write!(svg, "{at:.1},{y:.1} {next:.1},{y:.1} ");
            }
            svg += "\"/>";
        }
    }
    for (kind, colour, frames) in marks(findings) {
        for &frame in frames.iter().take(MAX_MARKS) {
            let at = x(frame.clamp(first, end));
            let _ = write!(
                svg,
                "<path stroke=\"{colour}\" stroke-width=\"2\" d=\"M{at:.1} {}V{}\"><title>{kind}: frame {frame}</title></path>",
                BASELINES[0] - LANE,
                BASELINES[1]
            );
        }
    }
    let mut along = 70.0;
    for (kind, colour, frames) in marks(findings) {
        if !frames.is_empty() {
            let label = text(along, height - 8.0, "start", &format!("{kind} ({})", frames.len()));
            svg += &label.replace("currentColor", colour);
            along += 40.0 + 7.0 * kind.len() as f64;
        }
    }
    svg += &text(0.0, height - 8.0, "start", &first.to_string());
    svg += &text(width, height - 8.0, "end", &format!("frame {end}"));
    svg += "</svg>";
    Some(svg)
}

/// Values of a lane.
type Values = fn(&Stretch) -> Vec<f64>;

/// Returns kinds of findings with their colours and frames.
fn marks(findings: &FrameFindings) -> [(&'static str, &'static str, &[u64]); 7] {
    [
        ("cut", "#d62728", &findings.cuts),
        ("step of the light", "#ff7f0e", &findings.light_steps),
        ("missing before", "#9467bd", &findings.missing),
        ("empty", "#1f77b4", &findings.empty),
        ("at one value", "#e377c2", &findings.saturated),
        ("out of family", "#8c564b", &findings.outlying),
        ("repeated", "#7f7f7f", &findings.repeated),
    ]
}

fn text(x: f64, y: f64, anchor: &str, words: &str) -> String {
    format!(
        "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\" font-size=\"12\" fill=\"currentColor\" stroke=\"none\">{words}</text>"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn marks_lie_where_something_was_found() {
        let stretch =
            Stretch { first: 10, step: 2, light: vec![1.0, 2.0, 1.0], change: vec![1.0; 3] };
        let findings =
            FrameFindings { cuts: vec![13], empty: vec![11, 12], ..FrameFindings::default() };
        let svg = strip(&[stretch], &findings).unwrap();
        // Half of six frames.
        assert!(svg.contains("d=\"M480.0 18V124\"><title>cut: frame 13</title>"), "{svg}");
        assert_eq!(svg.matches("<title>empty: frame").count(), 2);
        assert!(svg.contains("0.0,40.0 320.0,40.0 320.0,18.0"), "{svg}");
        assert!(svg.contains("empty (2)") && !svg.contains("repeated"), "{svg}");
        assert_eq!(strip(&[], &findings), None);
    }
}
