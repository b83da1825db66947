//! Pages: single files that fetch nothing, made of the templates in `templates/`.

use super::{Table, printable};
use crate::error::{CliError, Result};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use image::{ExtendedColorType, ImageEncoder};
use minijinja::value::Serde;
use minijinja::{AutoEscape, Environment};
use qudi_core::{Frame, Size};
use serde::Serialize;

/// The templates, by the names that they include each other under.
const TEMPLATES: [(&str, &str); 7] = [
    ("base.html", include_str!("templates/base.html")),
    ("demo.html", include_str!("templates/demo.html")),
    ("eval.html", include_str!("templates/eval.html")),
    ("look.html", include_str!("templates/look.html")),
    ("plot.html", include_str!("templates/plot.html")),
    ("table.html", include_str!("templates/table.html")),
    ("train.html", include_str!("templates/train.html")),
];

/// Fills in a template. All text of the context is escaped: none of it becomes markup.
pub(crate) fn render(template: &str, context: impl Serialize) -> Result<String> {
    let fill = || {
        let mut environment = Environment::new();
        environment.set_auto_escape_callback(|_| AutoEscape::Html);
        for (name, source) in TEMPLATES {
            environment.add_template(name, source)?;
        }
        environment.get_template(template)?.render(Serde(context))
    };
    fill().map_err(|e: minijinja::Error| {
        CliError::new(format!("cannot make the page: {e}"), template, "report this as a bug")
    })
}

/// A table as templates read it.
#[derive(Debug, Serialize)]
pub(crate) struct TableView {
    headings: Vec<String>,
    rows: Vec<Vec<String>>,
}

impl From<&Table> for TableView {
    fn from(table: &Table) -> Self {
        let (headings, rows) = table.shown();
        let escape =
            |row: Vec<String>| row.iter().map(|cell| printable(cell).into_owned()).collect();
        Self { headings, rows: rows.into_iter().map(escape).collect() }
    }
}

/// Encodes a PNG for the page.
pub(crate) fn data_url(png: &[u8]) -> String {
    format!("data:image/png;base64,{}", STANDARD.encode(png))
}

/// Returns the size of the crop that [`crop`] takes.
pub(crate) fn crop_size(size: Size, largest: usize) -> Size {
    Size { height: size.height.min(largest), width: size.width.min(largest) }
}

/// Crops the middle of a frame, at most `largest` pixels to a side, and encodes it as a data URL; 0 is black
/// and 1 is white.
pub(crate) fn crop(frame: &Frame, largest: usize) -> String {
    let Size { height, width } = crop_size(frame.size, largest);
    let (top, left) = ((frame.size.height - height) / 2, (frame.size.width - width) / 2);
    let mut bytes = Vec::with_capacity(height * width);
    for y in top..top + height {
        let row = &frame.row(y)[left..left + width];
        bytes.extend(row.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8));
    }
    let mut png = Vec::new();
    // Writing to memory does not fail; a missing picture would be seen on the page.
    let _ = image::codecs::png::PngEncoder::new(&mut png).write_image(
        &bytes,
        width as u32,
        height as u32,
        ExtendedColorType::L8,
    );
    data_url(&png)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn escapes_text_of_the_context() {
        let table = TableView::from(&crate::report::table::example());
        let context =
            json!({"title": "<script>alert(1)</script>", "about": "a & b", "table": table});
        let page = render("eval.html", context).unwrap_or_else(|e| panic!("{e:?}"));
        assert!(page.contains("&lt;script&gt;alert(1)") && page.contains("a &amp; b"));
        assert!(!page.contains("<script>alert") && !page.contains("<b>\u{1b}"), "{page}");
    }

    #[test]
    fn all_templates_are_self_contained() {
        for (name, source) in TEMPLATES {
            for fetched in ["http:", "https:", "url(", "@import", "<link", "src=\"/"] {
                assert!(!source.contains(fetched), "{name} fetches {fetched}");
            }
        }
    }

    #[test]
    fn crops_the_middle_and_keeps_small_frames_whole() {
        let size = Size { height: 40, width: 300 };
        assert_eq!(crop_size(size, 224), Size { height: 40, width: 224 });
        assert!(crop(&Frame::filled(size, 0.5), 224).starts_with("data:image/png;base64,iVBOR"));
    }
}
