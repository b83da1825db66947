//! The plotter: curves with axes, which `templates/plot.html` draws as SVG.

use serde::Serialize;

/// Size in pixels, and the margins for numbers and labels: left, right, top, bottom.
const SIZE: [f64; 2] = [640.0, 320.0];
const MARGIN: [f64; 4] = [58.0, 18.0, 28.0, 48.0];

/// Colours of curves; after them they begin again, dashed.
const COLOURS: usize = 7;

/// Curves of fewer points show them.
const MAX_MARKED_POINTS: usize = 40;

/// Ticks of an axis at most.
const MAX_TICKS: usize = 7;

/// Pixels between marks of different curves, where these have error bars.
const MIN_SEPARATION: f64 = 3.0;

/// Curves in one coordinate system.
#[derive(Clone, Debug)]
pub(crate) struct Plot {
    pub(crate) title: String,
    /// Description in a sentence.
    pub(crate) caption: String,
    pub(crate) x: Axis,
    pub(crate) y: Axis,
    pub(crate) curves: Vec<Curve>,
}

/// One axis.
#[derive(Clone, Debug)]
pub(crate) struct Axis {
    pub(crate) label: &'static str,
    pub(crate) scale: Scale,
    /// Values to mark; empty for round numbers.
    pub(crate) ticks: Vec<f64>,
}

/// Scale of an axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Scale {
    Linear,
    Logarithmic,
}

/// A named curve, sorted by x.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Curve {
    pub(crate) name: String,
    pub(crate) points: Vec<Point>,
}

/// A point and the half height of its error bar; 0 for none.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Point {
    pub(crate) x: f64,
    pub(crate) y: f64,
    pub(crate) error: f64,
}

/// A plot as the template reads it, in pixels.
#[derive(Debug, Serialize)]
pub(crate) struct Drawing {
    title: String,
    caption: String,
    width: f64,
    height: f64,
    left: f64,
    right: f64,
    bottom: f64,
    x_label: &'static str,
    y_label: &'static str,
    x_ticks: Vec<Tick>,
    y_ticks: Vec<Tick>,
    curves: Vec<Drawn>,
}

#[derive(Debug, Serialize)]
struct Tick {
    at: f64,
    label: String,
}

#[derive(Debug, Serialize)]
struct Drawn {
    class: String,
    dashed: bool,
    name: String,
    /// The last value, of curves that have no error bars.
    last: Option<String>,
    points: String,
    marks: Vec<Mark>,
}

#[derive(Debug, Serialize)]
struct Mark {
    x: f64,
    y: f64,
    low: f64,
    high: f64,
}

impl Axis {
    pub(crate) fn linear(label: &'static str) -> Self {
        Self { label, scale: Scale::Linear, ticks: Vec::new() }
    }

    pub(crate) fn logarithmic(label: &'static str) -> Self {
        Self { label, scale: Scale::Logarithmic, ticks: Vec::new() }
    }
}

impl Scale {
    fn place(self, value: f64) -> f64 {
        match self {
            Self::Linear => value,
            Self::Logarithmic => value.log10(),
        }
    }

    /// Returns true if the axis has a place for a value.
    fn holds(self, value: f64) -> bool {
        value.is_finite() && (self == Self::Linear || value > 0.0)
    }

    /// Returns round numbers from the last one below `low` to the first one above `high`.
    fn ticks(self, low: f64, high: f64) -> Vec<f64> {
        match self {
            Self::Linear => linear_ticks(low, high),
            Self::Logarithmic => logarithmic_ticks(low, high),
        }
    }
}

impl Plot {
    /// Computes the layout; none if there is nothing to draw.
    pub(crate) fn draw(&self) -> Option<Drawing> {
        let drawable = |p: &&Point| self.x.scale.holds(p.x) && self.y.scale.holds(p.y);
        let points = || self.curves.iter().flat_map(|curve| &curve.points).filter(drawable);
        let [left, right] = extent(points().map(|p| p.x))?;
        let ends = points().flat_map(|p| [p.y - p.error, p.y, p.y + p.error]);
        let [low, high] = extent(ends.filter(|&y| self.y.scale.holds(y)))?;

        let y_ticks = self.y.scale.ticks(low, high);
        let rows = extent(y_ticks.iter().copied())?.map(|y| self.y.scale.place(y));
        let columns = [left, right].map(|x| self.x.scale.place(x));
        let x_ticks = match &self.x.ticks[..] {
            [] => self.x.scale.ticks(left, right),
            given => given.to_vec(),
        };
        let [start, end] = [MARGIN[0] + 12.0, SIZE[0] - MARGIN[1] - 12.0];
        let bottom = SIZE[1] - MARGIN[3];
        let across = |x: f64| between(self.x.scale.place(x), columns, [start, end]);
        let down = |y: f64| between(self.y.scale.place(y), rows, [bottom, MARGIN[2]]);

        let has_bars = points().any(|p| p.error > 0.0);
        let middle = (self.curves.len() as f64 - 1.0) / 2.0;
        let curves = self.curves.iter().enumerate().map(|(i, curve)| {
            let shift = if has_bars { MIN_SEPARATION * (i as f64 - middle) } else { 0.0 };
            let points: Vec<&Point> = curve.points.iter().filter(drawable).collect();
            let mark = |p: &&Point| {
                let y = |y: f64| if self.y.scale.holds(y) { tenth(down(y)) } else { bottom };
                Mark {
                    x: tenth(across(p.x) + shift),
                    y: y(p.y),
                    low: y(p.y - p.error),
                    high: y(p.y + p.error),
                }
            };
            let marks: Vec<Mark> = points.iter().map(mark).collect();
            let line: Vec<String> = marks.iter().map(|m| format!("{},{}", m.x, m.y)).collect();
            Drawn {
                class: format!("s{}", i % COLOURS),
                dashed: i / COLOURS % 2 == 1,
                name: curve.name.clone(),
                last: points.last().filter(|_| !has_bars).map(|p| number(p.y)),
                points: line.join(" "),
                marks: if marks.len() < MAX_MARKED_POINTS { marks } else { Vec::new() },
            }
        });
        let in_sight = |&x: &f64| x >= left && x <= right;
        let tick = |at: f64, value: f64| Tick { at: tenth(at), label: label(value) };
        Some(Drawing {
            title: self.title.clone(),
            caption: self.caption.clone(),
            width: SIZE[0],
            height: SIZE[1],
            left: MARGIN[0],
            right: SIZE[0] - MARGIN[1],
            bottom,
            x_label: self.x.label,
            y_label: self.y.label,
            x_ticks: x_ticks.iter().copied().filter(in_sight).map(|x| tick(across(x), x)).collect(),
            y_ticks: y_ticks.iter().map(|&y| tick(down(y), y)).collect(),
            curves: curves.collect(),
        })
    }
}

/// Returns the least and the greatest value; none without values.
fn extent(values: impl Iterator<Item = f64>) -> Option<[f64; 2]> {
    values.fold(None, |extent, v| {
        let [low, high] = extent.unwrap_or([v, v]);
        Some([low.min(v), high.max(v)])
    })
}

/// Maps a range onto another; a range of one value onto the middle.
fn between(value: f64, [low, high]: [f64; 2], [start, end]: [f64; 2]) -> f64 {
    let part = if high > low { (value - low) / (high - low) } else { 0.5 };
    start + part * (end - start)
}

/// Rounds to tenths of a pixel.
fn tenth(pixels: f64) -> f64 {
    (pixels * 10.0).round() / 10.0
}

/// Returns multiples of 1, 2 or 5 times a power of ten around the range.
fn linear_ticks(low: f64, high: f64) -> Vec<f64> {
    // A constant lies in the middle of a range as large as itself.
    let span = if high > low { high - low } else { low.abs().max(1e-9) };
    let decade = 10f64.powf((span / MAX_TICKS as f64).log10().floor());
    // Rounding outwards adds up to two steps, so that ten times the decade may still be too fine.
    for multiple in [1.0, 2.0, 5.0, 10.0, 20.0] {
        let step = multiple * decade;
        let (mut first, mut last) = ((low / step).floor(), (high / step).ceil());
        if first == last {
            (first, last) = (first - 1.0, last + 1.0);
        }
        if last - first < MAX_TICKS as f64 {
            return (0..=(last - first) as usize).map(|n| (first + n as f64) * step).collect();
        }
    }
    vec![low, high]
}

/// Returns powers of ten around the range, with their doubles and fivefolds if that leaves few enough.
fn logarithmic_ticks(low: f64, high: f64) -> Vec<f64> {
    let (first, last) = (low.log10().floor() as i32, high.log10().ceil() as i32);
    let all: Vec<f64> = (first..=last)
        .flat_map(|power| [1.0, 2.0, 5.0].map(|multiple| multiple * 10f64.powi(power)))
        .collect();
    let begin = all.iter().rposition(|&tick| tick <= low * (1.0 + 1e-9)).unwrap_or(0);
    let end = all.iter().position(|&tick| tick >= high * (1.0 - 1e-9)).unwrap_or(all.len() - 1);
    if end.saturating_sub(begin) < MAX_TICKS {
        // One value lies in the middle of its neighbours.
        let widened = if begin == end {
            begin.saturating_sub(1)..=(end + 1).min(all.len() - 1)
        } else {
            begin..=end
        };
        return all[widened].to_vec();
    }
    let every = ((last - first) as usize).div_ceil(MAX_TICKS - 1).max(1);
    let powers = (first..).step_by(every).map(|power| 10f64.powi(power));
    let mut ticks = Vec::new();
    for tick in powers {
        ticks.push(tick);
        if tick >= high * (1.0 - 1e-9) {
            break;
        }
    }
    ticks
}

/// Formats a tick without the noise of its last digits: 0.3, not 0.30000000000000004.
fn label(value: f64) -> String {
    let size = value.abs();
    if size == 0.0 {
        return "0".to_owned();
    }
    if !(1e-3..1e7).contains(&size) {
        return format!("{value:.1e}").replace(".0e", "e");
    }
    let unit = 10f64.powf(5.0 - size.log10().floor());
    ((value * unit).round() / unit).to_string()
}

/// Formats a number with about four digits.
pub(crate) fn number(value: f64) -> String {
    let size = value.abs();
    if size == 0.0 || !size.is_finite() {
        return value.to_string();
    }
    if !(1e-3..1e5).contains(&size) {
        return format!("{value:.2e}");
    }
    let digits = (3.0 - size.log10().floor()).max(0.0) as usize;
    format!("{value:.digits$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plot(scale: Scale, values: &[[f64; 3]]) -> Plot {
        let points = values.iter().map(|&[x, y, error]| Point { x, y, error }).collect();
        Plot {
            title: "title".to_owned(),
            caption: "caption".to_owned(),
            x: Axis::linear("x"),
            y: Axis { label: "y", scale, ticks: Vec::new() },
            curves: vec![Curve { name: "curve".to_owned(), points }],
        }
    }

    fn labels(ticks: &[f64]) -> Vec<String> {
        ticks.iter().map(|&tick| label(tick)).collect()
    }

    #[test]
    fn linear_ticks_are_round_and_enclose_the_range() {
        assert_eq!(labels(&linear_ticks(21.3, 28.9)), ["20", "22", "24", "26", "28", "30"]);
        assert_eq!(labels(&linear_ticks(-0.3, 0.2)), ["-0.3", "-0.2", "-0.1", "0", "0.1", "0.2"]);
        assert_eq!(linear_ticks(5.0, 5.0).len(), 3, "around a constant");
        assert_eq!(labels(&linear_ticks(14.9001, 20.9851)), ["14", "16", "18", "20", "22"]);
        for n in 1..2000 {
            let (low, high) =
                (f64::from(n) * 0.37, f64::from(n) * 0.37 + f64::from(n % 97) * 0.013 + 0.001);
            let ticks = linear_ticks(low, high);
            assert!(
                ticks[0] <= low + 1e-9 && ticks[ticks.len() - 1] >= high - 1e-9,
                "{low} {high}: {ticks:?}"
            );
            assert!(ticks.iter().all(|&tick| label(tick).len() <= 7), "{low} {high}: {ticks:?}");
        }
    }

    #[test]
    fn logarithmic_ticks_are_powers_of_ten_or_parts_of_them() {
        assert_eq!(labels(&logarithmic_ticks(0.03, 0.4)), ["0.02", "0.05", "0.1", "0.2", "0.5"]);
        assert_eq!(
            labels(&logarithmic_ticks(2e-4, 30.0)).first().map(String::as_str),
            Some("1e-4")
        );
        let wide = logarithmic_ticks(1e-12, 1e9);
        assert!(
            wide.len() <= MAX_TICKS + 1 && wide[0] <= 1e-12 && wide[wide.len() - 1] >= 1e9,
            "{wide:?}"
        );
        assert!(logarithmic_ticks(1.0, 1.0).len() > 1);
    }

    #[test]
    fn all_marks_lie_inside_the_axes() {
        let values = [[1.0, 20.0, 3.0], [2.0, 1e3, 0.5], [3.0, 0.2, 1.0]];
        for scale in [Scale::Linear, Scale::Logarithmic] {
            let Some(drawing) = plot(scale, &values).draw() else { panic!("nothing drawn") };
            for mark in &drawing.curves[0].marks {
                assert!((drawing.left..=drawing.right).contains(&mark.x), "{mark:?}");
                for y in [mark.low, mark.y, mark.high] {
                    assert!((0.0..=drawing.bottom).contains(&y), "{mark:?}");
                }
            }
        }
    }

    #[test]
    fn draws_nothing_of_no_finite_point() {
        assert!(plot(Scale::Linear, &[]).draw().is_none());
        assert!(plot(Scale::Linear, &[[1.0, f64::NAN, 0.0]]).draw().is_none());
        assert!(plot(Scale::Logarithmic, &[[1.0, -1.0, 0.0]]).draw().is_none());
    }

    #[test]
    fn single_point_lies_in_the_middle() {
        let mut plot = plot(Scale::Linear, &[[3.25, 25.0, 0.0]]);
        plot.x.ticks = vec![3.25];
        let Some(drawing) = plot.draw() else { panic!("nothing drawn") };
        let mark = &drawing.curves[0].marks[0];
        assert_eq!(mark.x, tenth(f64::midpoint(drawing.left, drawing.right)));
        assert_eq!(drawing.x_ticks[0].label, "3.25");
    }

    #[test]
    fn numbers_have_about_four_digits() {
        let shown = [0.0, 0.012_345, 1.23456, 12345.6, 1e-5, -250.0].map(number);
        assert_eq!(shown, ["0", "0.01235", "1.235", "12346", "1.00e-5", "-250.0"]);
    }
}
