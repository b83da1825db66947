//! Similarity motion: translation, rotation and zoom about a centre.

/// Motion of a layer: at time t, a local point q is at
/// `shift + centre + t * velocity + zoom^t * R(t * rotation) (q - centre)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// Pixels per frame.
    pub velocity: [f64; 2],
    /// Radians per frame, clockwise on the screen.
    pub rotation: f64,
    /// Magnification per frame; 1 for none.
    pub zoom: f64,
    /// Fixed point of rotation and zoom, in local coordinates.
    pub centre: [f64; 2],
    /// Position of the local origin in the frame at time 0, before rotation and zoom.
    pub shift: [f64; 2],
}

impl Motion {
    /// Creates a motion by translation only.
    pub fn pan(velocity: [f64; 2]) -> Self {
        Self { velocity, rotation: 0.0, zoom: 1.0, centre: [0.0; 2], shift: [0.0; 2] }
    }

    /// Returns the placement at time `t`.
    pub fn at(&self, t: f64) -> Placement {
        let (sin, cos) = (self.rotation * t).sin_cos();
        Placement {
            sin,
            cos,
            scale: self.zoom.powf(t),
            centre: self.centre,
            origin: [
                self.shift[0] + self.centre[0] + t * self.velocity[0],
                self.shift[1] + self.centre[1] + t * self.velocity[1],
            ],
        }
    }
}

/// A motion at one time: a similarity between local coordinates and the frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    sin: f64,
    cos: f64,
    /// Magnification since time 0.
    pub scale: f64,
    centre: [f64; 2],
    /// Position of the centre in the frame.
    origin: [f64; 2],
}

impl Placement {
    /// Maps the local point `q` into the frame.
    pub fn to_scene(&self, q: [f64; 2]) -> [f64; 2] {
        let (dx, dy) = (self.scale * (q[0] - self.centre[0]), self.scale * (q[1] - self.centre[1]));
        [
            self.origin[0] + self.cos * dx - self.sin * dy,
            self.origin[1] + self.sin * dx + self.cos * dy,
        ]
    }

    /// Maps the point `p` of the frame to a local point.
    pub fn to_local(&self, p: [f64; 2]) -> [f64; 2] {
        let (dx, dy) = ((p[0] - self.origin[0]) / self.scale, (p[1] - self.origin[1]) / self.scale);
        [
            self.centre[0] + self.cos * dx + self.sin * dy,
            self.centre[1] - self.sin * dx + self.cos * dy,
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warp_and_its_adjoint_are_consistent() {
        let motion = Motion {
            velocity: [1.5, -2.0],
            rotation: 0.1,
            zoom: 1.02,
            centre: [30.0, 20.0],
            shift: [4.0, -3.0],
        };
        for t in [0.0, 0.4, 7.0] {
            let placement = motion.at(t);
            let p = placement.to_scene(placement.to_local([12.0, 34.0]));
            assert!((p[0] - 12.0).abs() < 1e-9 && (p[1] - 34.0).abs() < 1e-9);
        }
    }
}
