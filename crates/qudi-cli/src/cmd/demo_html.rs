//! The page of `qudi demo`: the picture, the figures, and what they mean. Nothing is fetched.

use crate::cmd::demo::Shown;
use crate::cmd::eval_html::escape;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use std::fmt::Write;

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;max-width:100rem;margin:2rem auto;padding:0 1rem;color:#222;\
background:#fff}img{width:100%;image-rendering:pixelated}table{border-collapse:collapse}th,td{padding:.2rem .9rem;\
text-align:right;border-bottom:1px solid #ddd}th:first-child,td:first-child{text-align:left}\
@media(prefers-color-scheme:dark){body{color:#ddd;background:#151515}th,td{border-color:#444}}";

/// The whole page around a PNG.
pub(crate) fn html(png: &[u8], shown: &[Shown], foot: &str) -> String {
    let mut page = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>qudi demo</title>\n<style>{STYLE}</style></head><body>\n\
<h1>Seeing in the dark, photon by photon</h1>\n\
<p>Above: what the sensor counted in one frame, and the middle frame that each method made of eleven such frames, at the \
truth's brightness. Below: errors, four times brighter, and the uncertainty of the last method: the deviation of its \
errors that it expects, or, if it tells none, how its result varies where photons are drawn again from that result.</p>\n\
<img alt=\"counts, methods, truth; errors and uncertainty\" src=\"data:image/png;base64,{}\">\n<table><thead><tr>",
        STANDARD.encode(png)
    );
    for title in ["method", "psnr-a", "psnr", "ssim", "seconds"] {
        let _ = write!(page, "<th>{title}</th>");
    }
    page += "</tr></thead><tbody>\n";
    for Shown { name, psnr_a, psnr, ssim, seconds, .. } in shown {
        let _ = writeln!(
            page,
            "<tr><td>{}</td><td>{psnr_a:.2}</td><td>{psnr:.2}</td><td>{ssim:.3}</td><td>{seconds:.2}</td></tr>",
            escape(name)
        );
    }
    let _ = writeln!(page, "</tbody></table>\n<p>{}</p>\n</body></html>", escape(foot));
    page
}
