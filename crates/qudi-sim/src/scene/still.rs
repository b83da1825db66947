//! A still image set in motion: pan, rotation, zoom, and cut-outs moving before it.

use super::{Layer, Motion, Paint, Scene, Shape};
use qudi_core::random::{Domain, Streams, uniform};
use qudi_core::{Frame, Size};
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;

/// Motion of a still, as in `pan:2,0.5+rotate:0.3+zoom:1.01+layers:3`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct StillMotion {
    /// Pixels per frame to the right and down.
    pub pan: [f64; 2],
    /// Degrees per frame, clockwise.
    pub rotate: f64,
    /// Magnification per frame.
    pub zoom: f64,
    /// Discs cut from elsewhere in the image that move before it, hiding it.
    pub layers: u32,
}

impl Default for StillMotion {
    fn default() -> Self {
        Self { pan: [0.0; 2], rotate: 0.0, zoom: 1.0, layers: 0 }
    }
}

impl std::str::FromStr for StillMotion {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let mut motion = Self::default();
        let number = |text: &str, low: f64, high: f64| {
            let value = text.parse().map_err(|_| format!("`{text}` is not a number"))?;
            if (low..=high).contains(&value) {
                Ok(value)
            } else {
                Err(format!("{value} is not between {low} and {high}"))
            }
        };
        for part in text.split('+') {
            let (name, value) = part.split_once(':').unwrap_or((part, ""));
            match name.trim() {
                "pan" => {
                    let (x, y) =
                        value.split_once(',').ok_or("pan takes two numbers, as in pan:2,0.5")?;
                    motion.pan = [number(x.trim(), -1e4, 1e4)?, number(y.trim(), -1e4, 1e4)?];
                }
                "rotate" => motion.rotate = number(value, -180.0, 180.0)?,
                "zoom" => motion.zoom = number(value, 0.5, 2.0)?,
                "layers" => motion.layers = number(value, 0.0, 1000.0)? as u32,
                other => {
                    return Err(format!(
                        "`{other}` is no motion: pan:X,Y rotate:DEGREES zoom:FACTOR layers:COUNT"
                    ));
                }
            }
        }
        Ok(motion)
    }
}

/// Creates the scene of a still under `motion`, in frames of `size` around its centre.
///
/// Beyond its borders the image is mirrored. The cut-outs of `layers` are drawn from `seed`;
/// they move up to 2 pixels per frame faster than the pan.
pub fn still_scene(image: Frame, motion: StillMotion, size: Size, seed: u64) -> Scene {
    let centre = [0.5 * (image.size.width as f64 - 1.0), 0.5 * (image.size.height as f64 - 1.0)];
    let (w, h) = (size.width as f64, size.height as f64);
    // The frame shows the middle of the image: shift both so that (0, 0) is the frame's corner.
    let corner = [centre[0] - 0.5 * (w - 1.0), centre[1] - 0.5 * (h - 1.0)];
    let paint = Paint::image(image);
    let ground = Layer {
        motion: Motion {
            velocity: motion.pan,
            rotation: motion.rotate.to_radians(),
            zoom: motion.zoom,
            centre,
            shift: [-corner[0], -corner[1]],
        },
        shape: Shape::Everything,
        paint: paint.clone(),
    };
    let mut layers = vec![ground];
    let mut rng = Streams::new(seed).row(Domain::Scene, 64, 0);
    for _ in 0..motion.layers {
        let at = [corner[0] + w * uniform(&mut rng), corner[1] + h * uniform(&mut rng)];
        let radius = w.min(h) * (0.06 + 0.14 * uniform(&mut rng));
        let (angle, speed) = (TAU * uniform(&mut rng), 2.0 * uniform(&mut rng));
        let velocity = [motion.pan[0] + speed * angle.cos(), motion.pan[1] + speed * angle.sin()];
        // The disc shows another part of the image.
        let from = [w * (uniform(&mut rng) - 0.5), h * (uniform(&mut rng) - 0.5)];
        let source = [at[0] + from[0], at[1] + from[1]];
        layers.push(Layer {
            motion: Motion {
                velocity,
                rotation: 0.02 * (uniform(&mut rng) - 0.5),
                zoom: 1.0,
                centre: source,
                shift: [-(corner[0] + from[0]), -(corner[1] + from[1])],
            },
            shape: Shape::Disc { centre: source, radius },
            paint: paint.clone(),
        });
    }
    Scene { size, layers }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image() -> Frame {
        Frame::from_fn(Size { height: 48, width: 64 }, |x, y| {
            (0.5 + 0.4 * (x as f32 * 0.3).sin() * (y as f32 * 0.2).cos()).clamp(0.0, 1.0)
        })
    }

    #[test]
    fn still_without_motion_equals_the_image() {
        let still = still_scene(image(), StillMotion::default(), image().size, 1).render(3.0);
        for (a, b) in still.data.iter().zip(&image().data) {
            assert!((a - b).abs() < 1e-6);
        }
    }

    #[test]
    fn pan_shifts_the_image_along_its_flow() {
        let motion: StillMotion = "pan:3,-2".parse().unwrap();
        let scene = still_scene(image(), motion, image().size, 1);
        let moved = scene.render(1.0);
        assert!((moved.row(20)[30] - image().row(22)[27]).abs() < 1e-6);
        let flow = scene.flow(0.0, 1.0);
        assert!(flow.dx.iter().all(|&v| (v - 3.0).abs() < 1e-5));
        assert!(flow.dy.iter().all(|&v| (v + 2.0).abs() < 1e-5));
    }

    #[test]
    fn layers_hide_what_is_behind_them() {
        let motion: StillMotion = "pan:1,0+rotate:0.5+zoom:1.01+layers:4".parse().unwrap();
        let scene = still_scene(image(), motion, image().size, 5);
        assert_eq!(scene.layers.len(), 5);
        let flow = scene.flow(0.0, 1.0);
        let hidden = flow.visible.iter().filter(|v| !**v).count();
        assert!(hidden > 20 && hidden < flow.visible.len() / 2, "{hidden}");
    }

    #[test]
    fn rejects_invalid_motions() {
        for bad in ["spin:1", "pan:1", "zoom:0", "rotate:x", "pan:nan,0"] {
            assert!(bad.parse::<StillMotion>().is_err(), "{bad}");
        }
    }
}
