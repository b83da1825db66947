//! Synthetic scenes with known motion: opaque layers, each moving rigidly, front ones hiding others.
//!
//! A scene can be rendered at any time and knows its optical flow, occlusions included.
//! Time is in output frames, positions in pixels, `(x, y)` with the first pixel's centre at (0, 0).

mod font;
mod layers;
mod motion;
mod paint;
mod procedural;
mod shape;
mod still;

pub use font::{GLYPH_HEIGHT, GLYPH_WIDTH, Line, draw_text};
pub use layers::{Layer, Scene};
pub use motion::{Motion, Placement};
pub use paint::Paint;
pub use procedural::{PROCEDURAL, Procedural, ProceduralScene};
pub use shape::Shape;
pub use still::{StillMotion, still_scene};
