//! The report of `qudi eval` as one HTML file: table, plot, pictures side by side. Nothing is fetched.

use crate::cmd::eval_score::Row;
use crate::cmd::eval_table::summary;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use image::{ExtendedColorType, ImageEncoder};
use qudi_core::Frame;
use std::fmt::Write;

/// Largest side of the pictures: a crop from the middle.
const CROP: usize = 224;

/// Errors are shown this many times larger, zero at middle gray.
const ERROR_GAIN: f32 = 2.0;

/// What a clip looks like at one light level, apart from methods.
pub(crate) struct Pictures {
    pub(crate) clip: String,
    pub(crate) ppp: f64,
    /// Counts of the middle frame, full scale for 1.
    pub(crate) counts: Frame,
    pub(crate) truth: Option<Frame>,
}

/// The whole page.
pub(crate) fn html(rows: &[Row], pictures: &[Pictures], about: &str) -> String {
    let mut page = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>qudi eval</title>\n<style>{STYLE}</style></head><body>\n<h1>qudi eval</h1>\n<p>{}</p>\n",
        escape(about)
    );
    page += &table(rows);
    page += &plot(rows);
    page += "<h2>Pictures</h2>\n<p>Middle frame of each clip";
    if pictures.iter().any(|clip| clip.truth.is_some()) {
        page += ", after the best gain; errors are doubled, none is middle gray";
    }
    page += ". Choose what lies on either side, and drag the slider.</p>\n";
    for clip in pictures {
        page += &figure(rows, clip);
    }
    page + "<script>" + SCRIPT + "</script>\n</body></html>\n"
}

/// Text that holds no markup.
pub(crate) fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

fn table(rows: &[Row]) -> String {
    let mut text = "<table><thead><tr>".to_owned();
    let (headings, lines) = summary(rows).shown();
    for title in headings {
        let _ = write!(text, "<th>{}</th>", escape(&title));
    }
    text += "</tr></thead><tbody>\n";
    for line in lines {
        text += "<tr>";
        for cell in line {
            let _ = write!(text, "<td>{}</td>", escape(&cell));
        }
        text += "</tr>\n";
    }
    text + "</tbody></table>\n"
}

/// Gain-aligned PSNR against light, with 95 % confidence.
fn plot(rows: &[Row]) -> String {
    const WIDTH: f64 = 640.0;
    const HEIGHT: f64 = 320.0;
    const MARGIN: f64 = 48.0;
    let points: Vec<(&str, f64, f64, f64)> = rows
        .iter()
        .filter_map(|row| {
            let of = row.over_clips(|f| f.psnr_a).filter(|of| of.mean.is_finite())?;
            Some((row.method.as_str(), row.ppp, of.mean, of.ci95.unwrap_or(0.0)))
        })
        .collect();
    let extent = |values: &mut dyn Iterator<Item = f64>| {
        values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)))
    };
    let (left, right) = extent(&mut points.iter().map(|p| p.1.ln()));
    let (low, high) = extent(&mut points.iter().flat_map(|p| [p.2 - p.3, p.2 + p.3]));
    let (low, high) = (low.floor(), high.ceil().max(low.floor() + 1.0));
    if !(left.is_finite() && low.is_finite() && high.is_finite()) {
        return String::new();
    }
    // A single light level lies in the middle.
    let span = (right - left).max(1e-9);
    let x = |ppp: f64| {
        let part = if right > left { (ppp.ln() - left) / span } else { 0.5 };
        MARGIN + part * (WIDTH - 2.0 * MARGIN)
    };
    let y = |db: f64| HEIGHT - MARGIN - (db - low) / (high - low) * (HEIGHT - 2.0 * MARGIN);
    let mut svg = format!(
        "<h2>PSNR after the best gain</h2>\n<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" width=\"{WIDTH}\" role=\"img\" aria-label=\"PSNR against photons per pixel\">\n"
    );
    let step = ((high - low) / 6.0).ceil().max(1.0);
    let mut db = low;
    while db <= high {
        let (y, end) = (y(db), WIDTH - MARGIN);
        let _ = writeln!(
            svg,
            "<line class=\"grid\" x1=\"{MARGIN}\" x2=\"{end}\" y1=\"{y:.1}\" y2=\"{y:.1}\"/><text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{db}</text>",
            MARGIN - 6.0,
            y + 4.0
        );
        db += step;
    }
    let mut levels: Vec<f64> = points.iter().map(|p| p.1).collect();
    levels.sort_by(f64::total_cmp);
    levels.dedup();
    for ppp in levels {
        let _ = writeln!(
            svg,
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{ppp}</text>",
            x(ppp),
            HEIGHT - MARGIN + 18.0
        );
    }
    let _ = writeln!(
        svg,
        "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">incident photons per pixel and frame</text><text x=\"{:.1}\" y=\"16\">dB</text>",
        WIDTH / 2.0,
        HEIGHT - 8.0,
        MARGIN - 24.0
    );
    let mut methods: Vec<&str> = points.iter().map(|p| p.0).collect();
    methods.dedup();
    let mut seen: Vec<&str> = Vec::new();
    for method in methods {
        if seen.contains(&method) {
            continue;
        }
        let colour = COLOURS[seen.len() % COLOURS.len()];
        let mut own: Vec<_> = points.iter().filter(|p| p.0 == method).collect();
        own.sort_by(|a, b| a.1.total_cmp(&b.1));
        let line: Vec<_> = own.iter().map(|p| format!("{:.1},{:.1}", x(p.1), y(p.2))).collect();
        let _ = writeln!(
            svg,
            "<polyline points=\"{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"2\"/>",
            line.join(" ")
        );
        // Bars of different methods lie side by side.
        let shift = 4.0 * seen.len() as f64;
        for &&(_, ppp, mean, ci) in &own {
            let at = x(ppp) + shift;
            let _ = writeln!(
                svg,
                "<line x1=\"{at:.1}\" x2=\"{at:.1}\" y1=\"{:.1}\" y2=\"{:.1}\" stroke=\"{colour}\"/><circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"3\" fill=\"{colour}\"/>",
                y(mean - ci),
                y(mean + ci),
                x(ppp),
                y(mean)
            );
        }
        let _ = writeln!(
            svg,
            "<text x=\"{:.1}\" y=\"{:.1}\" style=\"fill:{colour}\">{}</text>",
            MARGIN + 10.0,
            MARGIN + 16.0 * seen.len() as f64,
            escape(method)
        );
        seen.push(method);
    }
    svg + "</svg>\n"
}

/// One clip at one light level: two pictures under a slider.
fn figure(rows: &[Row], clip: &Pictures) -> String {
    let mut names = vec![("counts".to_owned(), picture(&clip.counts))];
    let mut figures = Vec::new();
    for row in rows.iter().filter(|row| row.ppp == clip.ppp) {
        let Some(score) = row.scores.iter().find(|score| score.clip == clip.clip) else { continue };
        let middle = score.frames.get(score.frames.len() / 2).copied().unwrap_or_default();
        let mut figure = row.method.clone();
        if let (Some(psnr_a), Some(ssim)) = (middle.psnr_a, middle.ssim) {
            let _ = write!(figure, " {psnr_a:.2} dB, SSIM {ssim:.3}");
        } else if let Some(chi_square) = middle.chi_square {
            let _ = write!(figure, " chi-square {chi_square:.3}");
        }
        figures.push(figure);
        names.push((row.method.clone(), picture(&score.picture)));
        let Some(truth) = &clip.truth else { continue };
        let error = Frame {
            size: truth.size,
            data: score
                .picture
                .data
                .iter()
                .zip(&truth.data)
                .map(|(image, truth)| 0.5 + ERROR_GAIN * 0.5 * (image - truth))
                .collect(),
        };
        names.push((format!("{}: error", row.method), picture(&error)));
    }
    names.extend(clip.truth.iter().map(|truth| ("truth".to_owned(), picture(truth))));
    let options = |chosen: usize| -> String {
        let option = |(i, (name, _)): (usize, &(String, String))| {
            let selected = if i == chosen { " selected" } else { "" };
            format!("<option value=\"{i}\"{selected}>{}</option>", escape(name))
        };
        names.iter().enumerate().map(option).collect()
    };
    // Each picture is in the page once; the script puts two of them under the slider.
    let pictures: Vec<&str> = names.iter().map(|(_, data)| data.as_str()).collect();
    // The last method against the truth; without one, what was seen against it.
    let right = names.len() - 1;
    let left = if clip.truth.is_some() { right.saturating_sub(2) } else { 0 };
    let size = clip.counts.size;
    let (width, height) = (size.width.min(CROP) * 2, size.height.min(CROP) * 2);
    format!(
        "<figure data-pictures=\"{}\"><figcaption><b>{}</b>, {} PPP<br>{}</figcaption>\n<div class=\"pair\" style=\"width:{width}px;height:{height}px\"><img class=\"left\" alt=\"left picture\"><img class=\"right\" alt=\"right picture\"></div>\n<input type=\"range\" min=\"0\" max=\"100\" value=\"50\" aria-label=\"where the pictures meet\" style=\"width:{width}px\"><br><select class=\"l\" aria-label=\"left\">{}</select> <select class=\"r\" aria-label=\"right\">{}</select></figure>\n",
        pictures.join(" "),
        escape(&clip.clip),
        (clip.ppp * 1e4).round() / 1e4,
        escape(&figures.join("; ")),
        options(left),
        options(right)
    )
}

/// A crop from the middle as a data URL.
fn picture(frame: &Frame) -> String {
    let (height, width) = (frame.size.height.min(CROP), frame.size.width.min(CROP));
    let (top, left) = ((frame.size.height - height) / 2, (frame.size.width - width) / 2);
    let mut bytes = Vec::with_capacity(height * width);
    for y in top..top + height {
        let row = &frame.row(y)[left..left + width];
        bytes.extend(row.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8));
    }
    let mut png = Vec::new();
    // Writing to memory does not fail; an empty picture would say so to the eye.
    let _ = image::codecs::png::PngEncoder::new(&mut png).write_image(
        &bytes,
        width as u32,
        height as u32,
        ExtendedColorType::L8,
    );
    format!("data:image/png;base64,{}", STANDARD.encode(png))
}

/// Colours of lines, told apart also by those who see few (Okabe and Ito 2008).
const COLOURS: [&str; 7] =
    ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000"];

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:1500px;padding:0 1rem;color:#222}\
table{border-collapse:collapse}td,th{padding:.2rem .7rem;text-align:right;border-bottom:1px solid #ddd}td:first-child,th:first-child{text-align:left}\
figure{display:inline-block;margin:.5rem 1rem 1.5rem 0}figcaption{margin-bottom:.3rem;max-width:448px}\
.pair{position:relative}.pair img{position:absolute;inset:0;width:100%;height:100%;image-rendering:pixelated}.right{clip-path:inset(0 0 0 50%)}\
.grid{stroke:#ddd}svg text{font-size:12px;fill:#444}";

const SCRIPT: &str = "for(const f of document.querySelectorAll('figure')){\
const p=f.dataset.pictures.split(' '),q=s=>f.querySelector(s);\
const show=()=>{q('.left').src=p[q('.l').value];q('.right').src=p[q('.r').value]};\
q('input').oninput=e=>q('.right').style.clipPath=`inset(0 0 0 ${e.target.value}%)`;\
q('.l').onchange=q('.r').onchange=show;show();}";
