//! Scenes that need no file: dead leaves, moving text, gratings, a resolution chart.

use super::font::Line;
use super::{Layer, Motion, Paint, Scene, Shape};
use qudi_core::Size;
use qudi_core::random::{Domain, Streams, uniform};
use rand::Rng;
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;

/// Kinds of procedural scenes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ProceduralScene {
    /// Discs of all sizes over each other, flat or textured, each with a motion of its own
    /// (Lee, Mumford, Huang 2001).
    DeadLeaves,
    /// Lines of text passing before a soft background.
    Text,
    /// Sine gratings of several frequencies and directions, drifting.
    Gratings,
    /// A chart with star, bars, slanted edges and grey steps, panning and turning.
    Chart,
}

/// All kinds, in the order of their listing.
pub const PROCEDURAL: &[ProceduralScene] = &[
    ProceduralScene::DeadLeaves,
    ProceduralScene::Text,
    ProceduralScene::Gratings,
    ProceduralScene::Chart,
];

impl ProceduralScene {
    /// Returns the name on the command line, after `scene:`.
    pub fn name(self) -> &'static str {
        match self {
            Self::DeadLeaves => "dead-leaves",
            Self::Text => "text",
            Self::Gratings => "gratings",
            Self::Chart => "chart",
        }
    }

    /// Returns the kind of this name.
    pub fn by_name(name: &str) -> Option<Self> {
        PROCEDURAL.iter().copied().find(|kind| kind.name() == name)
    }
}

/// A procedural scene with all its parameters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Procedural {
    /// Kind of the scene.
    pub kind: ProceduralScene,
    /// Frame size.
    pub size: Size,
    /// Seed of its layout.
    pub seed: u64,
    /// Fastest motion in pixels per frame.
    pub speed: f64,
}

impl Procedural {
    /// Creates the layers.
    pub fn scene(&self) -> Scene {
        let mut rng = Streams::new(self.seed).row(Domain::Scene, self.kind as u64, 0);
        let layers = match self.kind {
            ProceduralScene::DeadLeaves => self.dead_leaves(&mut rng),
            ProceduralScene::Text => self.text(&mut rng),
            ProceduralScene::Gratings => self.gratings(&mut rng),
            ProceduralScene::Chart => self.chart(),
        };
        Scene { size: self.size, layers }
    }

    fn extent(&self) -> (f64, f64, f64) {
        let (w, h) = (self.size.width as f64, self.size.height as f64);
        (w, h, w.min(h))
    }

    /// Draws a velocity up to `self.speed`, in any direction.
    fn velocity(&self, rng: &mut impl Rng) -> [f64; 2] {
        let (angle, speed) = (TAU * uniform(rng), self.speed * uniform(rng).sqrt());
        [speed * angle.cos(), speed * angle.sin()]
    }

    fn dead_leaves(&self, rng: &mut impl Rng) -> Vec<Layer> {
        let (w, h, side) = self.extent();
        let margin = 0.25 * side;
        let (smallest, largest) = (3.0f64.min(0.2 * side), 0.25 * side);
        let ground = Layer {
            motion: Motion::pan(self.velocity(rng)),
            shape: Shape::Everything,
            paint: Paint::Grating {
                mean: 0.45,
                amplitude: 0.1,
                frequency: [0.03, 0.02],
                phase: 0.0,
            },
        };
        let mut layers = vec![ground];
        // Enough leaves to cover the plane several times; large ones dominate the area.
        let area = (w + 2.0 * margin) * (h + 2.0 * margin);
        let mut covered = 0.0;
        while covered < 8.0 * area && layers.len() < 6000 {
            // Radius with density proportional to r^-3: the scale-invariant law of natural images.
            let u = uniform(rng);
            let radius =
                (1.0 / (smallest.powi(-2) - u * (smallest.powi(-2) - largest.powi(-2)))).sqrt();
            covered += 0.5 * TAU * radius * radius;
            let centre = [
                -margin + uniform(rng) * (w + 2.0 * margin),
                -margin + uniform(rng) * (h + 2.0 * margin),
            ];
            let mean = (0.08 + 0.84 * uniform(rng)) as f32;
            let paint = if uniform(rng) < 0.5 {
                Paint::Flat(mean)
            } else {
                let (angle, period) = (TAU * uniform(rng), 4.0 + 12.0 * uniform(rng));
                Paint::Grating {
                    mean,
                    amplitude: (0.35 * uniform(rng)) as f32 * mean.min(1.0 - mean),
                    frequency: [angle.cos() / period, angle.sin() / period],
                    phase: uniform(rng),
                }
            };
            layers.push(Layer {
                motion: Motion::pan(self.velocity(rng)),
                shape: Shape::Disc { centre, radius },
                paint,
            });
        }
        layers
    }

    fn text(&self, rng: &mut impl Rng) -> Vec<Layer> {
        const LINES: &[&str] = &[
            "SINGLE PHOTONS",
            "QUANTA BURST 0123456789",
            "SPAD ARRAY",
            "3 BITS PER PIXEL",
            "MOTION",
            "E = H C / WAVELENGTH",
            "THE QUICK BROWN FOX",
            "JUMPS OVER THE LAZY DOG",
        ];
        let (w, h, side) = self.extent();
        let mut layers = vec![Layer {
            motion: Motion::pan(self.velocity(rng)),
            shape: Shape::Everything,
            paint: Paint::Grating {
                mean: 0.5,
                amplitude: 0.12,
                frequency: [0.7 / w, 1.1 / h],
                phase: 0.2,
            },
        }];
        let rows = 7;
        let first = (uniform(rng) * LINES.len() as f64) as usize;
        for row in 0..rows {
            let text = LINES[(first + row) % LINES.len()];
            // Strokes thinner than a pixel would alias.
            let dot = (side / 128.0).max(1.0) * (1.0 + 2.5 * uniform(rng));
            let dark = uniform(rng) < 0.5;
            let speed = self.speed * (2.0 * uniform(rng) - 1.0);
            layers.push(Layer {
                motion: Motion::pan([speed, 0.1 * speed]),
                shape: Shape::Text(Line {
                    text: text.chars().collect(),
                    origin: [w * (0.5 * uniform(rng) - 0.2), h * row as f64 / rows as f64],
                    dot,
                }),
                paint: Paint::Flat(if dark { 0.06 } else { 0.94 }),
            });
        }
        layers
    }

    fn gratings(&self, rng: &mut impl Rng) -> Vec<Layer> {
        let (w, h, _) = self.extent();
        let mut layers = vec![Layer {
            motion: Motion::pan([0.0; 2]),
            shape: Shape::Everything,
            paint: Paint::Flat(0.5),
        }];
        // Columns: 32 to 4 pixels per cycle; rows: four directions.
        let (columns, rows) = (4, 4);
        for row in 0..rows {
            for column in 0..columns {
                let angle = TAU * row as f64 / (2 * rows) as f64;
                let period = 32.0 / f64::from(1 << column);
                let direction = [angle.cos(), angle.sin()];
                let speed = self.speed * (2.0 * uniform(rng) - 1.0);
                let cell = [w / columns as f64, h / rows as f64];
                layers.push(Layer {
                    motion: Motion::pan([speed * direction[0], speed * direction[1]]),
                    shape: Shape::Rectangle {
                        centre: [
                            (column as f64 + 0.5) * cell[0] - 0.5,
                            (row as f64 + 0.5) * cell[1] - 0.5,
                        ],
                        half: [0.42 * cell[0], 0.42 * cell[1]],
                    },
                    paint: Paint::Grating {
                        mean: 0.5,
                        amplitude: 0.42,
                        frequency: [direction[0] / period, direction[1] / period],
                        phase: uniform(rng),
                    },
                });
            }
        }
        layers
    }

    fn chart(&self) -> Vec<Layer> {
        let (w, h, side) = self.extent();
        // Half of the speed pans, half turns the corners.
        let rotation = 0.5 * self.speed / (0.5 * side);
        vec![Layer {
            motion: Motion {
                velocity: [0.5 * self.speed, 0.0],
                rotation,
                zoom: 1.0,
                centre: [0.5 * (w - 1.0), 0.5 * (h - 1.0)],
                shift: [0.0; 2],
            },
            shape: Shape::Everything,
            paint: Paint::Chart(self.size),
        }]
    }
}
