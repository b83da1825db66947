//! Pages: single files that fetch nothing, made of the templates in `templates/`. Their policy forbids every
//! script except ours, whose checksum it names.

use super::{Table, printable};
use crate::error::{CliError, Result};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use minijinja::value::{Serde, Value};
use minijinja::{AutoEscape, Environment};
use serde::Serialize;
use sha2::{Digest, Sha256};

/// Style of all pages.
const STYLE: &str = include_str!("templates/page.css");

/// Script of pages with pictures that play.
const SCRIPT: &str = include_str!("templates/player.js");

/// The templates, by the names that they include each other under.
const TEMPLATES: [(&str, &str); 11] = [
    ("base.html", include_str!("templates/base.html")),
    ("demo.html", include_str!("templates/demo.html")),
    ("eval.html", include_str!("templates/eval.html")),
    ("keys.html", include_str!("templates/keys.html")),
    ("look.html", include_str!("templates/look.html")),
    ("player.html", include_str!("templates/player.html")),
    ("plot.html", include_str!("templates/plot.html")),
    ("restore.html", include_str!("templates/restore.html")),
    ("table.html", include_str!("templates/table.html")),
    ("train.html", include_str!("templates/train.html")),
    ("view.html", include_str!("templates/view.html")),
];

/// Fills in a template. All text of the context is escaped: none of it becomes markup.
pub(crate) fn render(template: &str, context: impl Serialize) -> Result<String> {
    let fill = || {
        let mut environment = Environment::new();
        environment.set_auto_escape_callback(|_| AutoEscape::Html);
        for (name, source) in TEMPLATES {
            environment.add_template(name, source)?;
        }
        environment.add_global("style", Value::from_safe_string(STYLE.to_owned()));
        environment.add_global("script", Value::from_safe_string(SCRIPT.to_owned()));
        environment.add_global("policy", policy());
        environment.get_template(template)?.render(Serde(context))
    };
    fill().map_err(|e: minijinja::Error| {
        CliError::new(format!("cannot make the page: {e}"), template, "report this as a bug")
    })
}

/// Returns the content security policy of pages: pictures are in the page, or come from the program that
/// serves it; no other script runs, and nothing else is fetched.
pub(crate) fn policy() -> String {
    let script = STANDARD.encode(Sha256::digest(SCRIPT));
    format!(
        "default-src 'none'; img-src data: blob:; connect-src 'self'; style-src 'unsafe-inline'; script-src 'sha256-{script}'; base-uri 'none'; form-action 'none'"
    )
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

/// Encodes a picture for the page; `kind` is its format, as in `png`.
pub(crate) fn data_url(kind: &str, picture: &[u8]) -> String {
    format!("data:image/{kind};base64,{}", STANDARD.encode(picture))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::player::{Kind, Layer, Scene};
    use crate::report::svg::{Axis, Curve, Plot, Point};
    use qudi_core::Size;
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

    /// Every text of every page is markup here, and stays text.
    #[test]
    fn no_page_takes_text_for_markup() {
        const MARKUP: &str = "<img src=x onerror=alert(1)></script><script>alert(2)</script>";
        let size = Size { height: 4, width: 4 };
        let table =
            || TableView { headings: vec![MARKUP.to_owned()], rows: vec![vec![MARKUP.to_owned()]] };
        let player = || {
            let mut scene = Scene::new(MARKUP, size, 1);
            (scene.caption, scene.notes) = (vec![MARKUP.to_owned()], vec![MARKUP.to_owned()]);
            let layer = Layer::new(MARKUP, Kind::Restored, vec![MARKUP.to_owned()]);
            scene.layers = vec![layer.with_note(MARKUP).into_map(1.0, MARKUP)];
            scene.table = Some(table());
            scene.player()
        };
        let point = |at| Point { x: at, y: at, error: 0.5 };
        let plot = || {
            Plot {
                title: MARKUP.to_owned(),
                caption: MARKUP.to_owned(),
                x: Axis::linear(MARKUP),
                y: Axis::linear(MARKUP),
                curves: vec![Curve {
                    name: MARKUP.to_owned(),
                    points: vec![point(1.0), point(2.0)],
                }],
            }
            .draw()
        };
        for page in
            ["demo.html", "eval.html", "look.html", "restore.html", "train.html", "view.html"]
        {
            let context = json!({
                "title": MARKUP,
                "about": MARKUP,
                "documents": [{"title": MARKUP, "text": MARKUP}],
                "frames": MARKUP,
                "has_truth": true,
                "lead": MARKUP,
                "light": MARKUP,
                "looks": [{"title": MARKUP, "table": table()}],
                "made": [MARKUP],
                "picture": "data:,",
                "players": [player(), player()],
                "plots": [plot()],
                "quality": plot(),
                "settings": MARKUP,
                "summary": [MARKUP],
                "table": table(),
                "text": MARKUP,
                "warnings": [MARKUP],
            });
            let rendered = render(page, context).unwrap_or_else(|e| panic!("{page}: {e:?}"));
            assert_eq!(rendered.matches("<script").count(), 3, "{page}: two scenes and the player");
            assert!(
                !rendered.contains("<img src=x") && rendered.contains("&lt;img src=x"),
                "{page}"
            );
        }
    }

    #[test]
    fn all_templates_are_self_contained() {
        for (name, source) in TEMPLATES.into_iter().chain([("style", STYLE), ("script", SCRIPT)]) {
            for fetched in ["http:", "https:", "url(", "@import", "<link", "src=\"/"] {
                assert!(!source.contains(fetched), "{name} fetches {fetched}");
            }
        }
    }

    #[test]
    fn policy_allows_the_script_of_the_page_alone() {
        let context = json!({"title": "t", "players": [{"data": "{}"}]});
        let page = render("look.html", context).unwrap_or_else(|e| panic!("{e:?}"));
        let parts: Vec<&str> = page.split("<script>").collect();
        assert_eq!(parts.len(), 2, "one script");
        let script = parts[1].split("</script>").next().unwrap_or_default();
        let sum = STANDARD.encode(Sha256::digest(script));
        assert!(policy().contains(&format!("'sha256-{sum}'")));
        let written = policy().replace('\'', "&#x27;").replace('/', "&#x2f;");
        assert!(page.contains(&written), "{written}");
    }
}
