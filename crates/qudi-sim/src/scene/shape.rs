//! Outlines of layers, with edges one pixel soft.

use super::font::Line;

/// Outline of a layer in its own coordinates; it is opaque inside.
#[derive(Clone, Debug)]
pub enum Shape {
    /// No outline: the layer covers the plane.
    Everything,
    /// A disc.
    Disc {
        /// Centre in pixels.
        centre: [f64; 2],
        /// Radius in pixels.
        radius: f64,
    },
    /// An axis-parallel rectangle.
    Rectangle {
        /// Centre in pixels.
        centre: [f64; 2],
        /// Half the width and height in pixels.
        half: [f64; 2],
    },
    /// A line of text.
    Text(Line),
}

impl Shape {
    /// Returns the opacity in [0, 1] at a local point, seen at magnification `scale`.
    pub(super) fn coverage(&self, [x, y]: [f64; 2], scale: f64) -> f32 {
        let inside = match self {
            Self::Everything => return 1.0,
            Self::Disc { centre, radius } => radius - (x - centre[0]).hypot(y - centre[1]),
            Self::Rectangle { centre, half } => {
                (half[0] - (x - centre[0]).abs()).min(half[1] - (y - centre[1]).abs())
            }
            Self::Text(line) => line.inside([x, y]),
        };
        (0.5 + inside * scale).clamp(0.0, 1.0) as f32
    }

    /// Returns centre and radius of a circle around it; `None` if unbounded.
    pub(super) fn bounds(&self) -> Option<([f64; 2], f64)> {
        match self {
            Self::Everything => None,
            Self::Disc { centre, radius } => Some((*centre, *radius + 1.0)),
            Self::Rectangle { centre, half } => Some((*centre, half[0].hypot(half[1]) + 1.0)),
            Self::Text(line) => Some(line.bounds()),
        }
    }
}
