//! Rendering and optical flow of layers from back to front.

use super::{Motion, Paint, Placement, Shape};
use qudi_core::flow::Flow;
use qudi_core::{Frame, Size};
use rayon::prelude::*;

/// One moving surface.
#[derive(Clone, Debug)]
pub struct Layer {
    /// Motion.
    pub motion: Motion,
    /// Outline in the layer's own coordinates, equal to the frame's at time 0.
    pub shape: Shape,
    /// Surface in the layer's own coordinates.
    pub paint: Paint,
}

/// Layers from back to front; the first one covers everything.
#[derive(Clone, Debug)]
pub struct Scene {
    /// Size of rendered frames.
    pub size: Size,
    /// Back to front.
    pub layers: Vec<Layer>,
}

impl Scene {
    /// Renders the scene at time `t`.
    pub fn render(&self, t: f64) -> Frame {
        let mut frame = Frame::filled(self.size, 0.0);
        let placed = self.placed(t);
        frame.data.par_chunks_mut(self.size.width).enumerate().for_each(|(y, row)| {
            for Placed { layer, placement, reach } in &placed {
                for x in columns(*reach, y, self.size.width) {
                    let local = placement.to_local([x as f64, y as f64]);
                    let alpha = layer.shape.coverage(local, placement.scale);
                    if alpha > 0.0 {
                        row[x] += alpha * (layer.paint.value(local, placement.scale) - row[x]);
                    }
                }
            }
        });
        frame
    }

    /// Computes the displacement of the visible surfaces from time `from` to time `to`, on the pixels of
    /// `from`.
    pub fn flow(&self, from: f64, to: f64) -> Flow {
        let Size { height, width } = self.size;
        let (seen, later) = (self.labels(from), self.labels(to));
        let places =
            |t: f64| self.layers.iter().map(|layer| layer.motion.at(t)).collect::<Vec<_>>();
        let (before, after) = (places(from), places(to));
        let mut flow = Flow {
            size: self.size,
            dx: vec![0.0; self.size.pixels()],
            dy: vec![0.0; self.size.pixels()],
            visible: vec![false; self.size.pixels()],
        };
        for (i, &label) in seen.iter().enumerate() {
            let here = [(i % width) as f64, (i / width) as f64];
            let there = after[label as usize].to_scene(before[label as usize].to_local(here));
            flow.dx[i] = (there[0] - here[0]) as f32;
            flow.dy[i] = (there[1] - here[1]) as f32;
            let (x, y) = (there[0].round(), there[1].round());
            let inside = x >= 0.0 && y >= 0.0 && x < width as f64 && y < height as f64;
            flow.visible[i] = inside && later[y as usize * width + x as usize] == label;
        }
        flow
    }

    /// Returns the index of the frontmost layer at every pixel.
    fn labels(&self, t: f64) -> Vec<u32> {
        let placed = self.placed(t);
        let mut labels = vec![0u32; self.size.pixels()];
        labels.par_chunks_mut(self.size.width).enumerate().for_each(|(y, row)| {
            for (index, Placed { layer, placement, reach }) in placed.iter().enumerate() {
                for x in columns(*reach, y, self.size.width) {
                    let local = placement.to_local([x as f64, y as f64]);
                    if layer.shape.coverage(local, placement.scale) >= 0.5 {
                        row[x] = index as u32;
                    }
                }
            }
        });
        labels
    }

    fn placed<'a>(&'a self, t: f64) -> Vec<Placed<'a>> {
        let place = |layer: &'a Layer| {
            let Layer { motion, shape, .. } = layer;
            let placement = motion.at(t);
            let reach = shape.bounds().map(|(centre, radius)| {
                (placement.to_scene(centre), radius * placement.scale + 1.0)
            });
            Placed { layer, placement, reach }
        };
        self.layers.iter().map(place).collect()
    }
}

/// A layer at one time.
struct Placed<'a> {
    layer: &'a Layer,
    placement: Placement,
    reach: Reach,
}

/// Centre and radius of a circle around a layer; `None` if it is unbounded.
type Reach = Option<([f64; 2], f64)>;

/// Returns the columns of row `y` that a circle covers.
fn columns(reach: Reach, y: usize, width: usize) -> std::ops::Range<usize> {
    let Some(([cx, cy], radius)) = reach else { return 0..width };
    let dy = y as f64 - cy;
    if dy.abs() > radius {
        return 0..0;
    }
    let half = (radius * radius - dy * dy).sqrt();
    let first = (cx - half).floor().clamp(0.0, width as f64) as usize;
    let last = ((cx + half).ceil() + 1.0).clamp(0.0, width as f64) as usize;
    first..last.max(first)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{PROCEDURAL, Procedural};

    fn scenes() -> Vec<Scene> {
        let size = Size { height: 64, width: 80 };
        PROCEDURAL
            .iter()
            .map(|&kind| Procedural { kind, size, seed: 3, speed: 2.5 }.scene())
            .collect()
    }

    #[test]
    fn rendered_values_are_display_values_and_scenes_move() {
        for scene in scenes() {
            let (now, later) = (scene.render(0.0), scene.render(1.0));
            assert!(now.data.iter().chain(&later.data).all(|v| (0.0..=1.0).contains(v)));
            let change: f32 = now.data.iter().zip(&later.data).map(|(a, b)| (a - b).abs()).sum();
            assert!(change / now.data.len() as f32 > 1e-3);
        }
    }

    /// Following the flow finds the same surface: backward warping has only the error of bilinear
    /// interpolation, far below the error without warping.
    #[test]
    fn flow_leads_to_the_same_surface() {
        for scene in scenes() {
            let (now, later, flow) = (scene.render(2.0), scene.render(3.0), scene.flow(2.0, 3.0));
            let (mut warped, mut still, mut n) = (0.0, 0.0, 0);
            for i in (0..now.data.len()).filter(|&i| flow.visible[i]) {
                let (x, y) = ((i % 80) as f64, (i / 80) as f64);
                let there = later.bilinear(x + f64::from(flow.dx[i]), y + f64::from(flow.dy[i]));
                warped += f64::from((there - now.data[i]).powi(2));
                still += f64::from((later.data[i] - now.data[i]).powi(2));
                n += 1;
            }
            assert!(n > now.data.len() / 2, "most surfaces stay visible: {n}");
            assert!(warped < 0.25 * still, "{warped} {still}");
        }
    }

    #[test]
    fn hidden_surfaces_are_marked() {
        let size = Size { height: 20, width: 40 };
        let disc = Layer {
            motion: Motion::pan([4.0, 0.0]),
            shape: Shape::Disc { centre: [10.0, 10.0], radius: 5.0 },
            paint: Paint::Flat(0.9),
        };
        let ground = Layer {
            motion: Motion::pan([0.0, 0.0]),
            shape: Shape::Everything,
            paint: Paint::Flat(0.1),
        };
        let flow = Scene { size, layers: vec![ground, disc] }.flow(0.0, 1.0);
        let at = |x: usize, y: usize| (flow.dx[y * 40 + x], flow.visible[y * 40 + x]);
        assert_eq!(at(10, 10), (4.0, true)); // on the disc
        assert_eq!(at(17, 10), (0.0, false)); // ground that the disc is about to cover
        assert_eq!(at(30, 10), (0.0, true)); // free ground
    }
}
