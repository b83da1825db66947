//! The page of `qudi demo`: the picture, the figures, and what they mean.

use super::shown::{ERROR_GAIN, FRAMES, Shown};
use crate::error::Result;
use crate::report::Table;
use crate::report::html::{TableView, data_url, render};
use serde::Serialize;

/// The context of the template.
#[derive(Serialize)]
struct Page<'a> {
    title: &'a str,
    frames: usize,
    /// Gain of the errors that are shown.
    error_gain: u32,
    picture: String,
    uncertainty: &'a str,
    table: TableView,
    made: Vec<String>,
    about: &'a str,
}

/// Renders the page around a PNG.
pub(crate) fn html(
    png: &[u8],
    shown: &[Shown],
    table: &Table,
    uncertainty: &str,
    about: &str,
) -> Result<String> {
    render(
        "demo.html",
        Page {
            title: "Video from single photons",
            frames: FRAMES,
            error_gain: ERROR_GAIN as u32,
            picture: data_url(png),
            uncertainty,
            table: table.into(),
            made: shown.iter().map(|method| format!("{}: {}", method.name, method.how)).collect(),
            about,
        },
    )
}
