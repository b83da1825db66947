//! Accuracy of QBP's motion on procedural scenes with known motion.
//!
//!     cargo test --release -p qudi-burst --test flow -- --nocapture
#![allow(clippy::unwrap_used, clippy::print_stdout)]

use qudi_burst::PatchFlow;
use qudi_core::restorer::{Acquisition, BurstView};
use qudi_core::sensor::Sensor;
use qudi_core::{Camera, Light, Size};
use qudi_sim::scene::{Motion, Procedural, ProceduralScene, Scene};

const SIZE: Size = Size { height: 192, width: 192 };

fn exposed(scene: &Scene, ppp: f64, frames: usize) -> (Vec<Vec<u16>>, Acquisition) {
    let sensor = Sensor::load("qudi-paper").unwrap();
    let light = Light { ppp, mean_level: scene.render(0.0).mean() };
    let mut camera = Camera::new(&sensor, scene.size, light, 3).unwrap();
    let expose = |t: usize| camera.expose(t as u64, &[&scene.render(t as f64)]).unwrap();
    let counts = (0..frames).map(expose).collect();
    (counts, Acquisition::new(sensor, ppp, light.mean_level).unwrap())
}

/// Returns the end-point errors from `reference` to `other` of all patches that stay inside the image.
fn errors(scene: &Scene, ppp: f64, reference: usize, others: &[usize]) -> Vec<f64> {
    let (counts, acquisition) = exposed(scene, ppp, 11);
    let burst = BurstView { size: scene.size, frames: &counts };
    let PatchFlow { corners, flow } = PatchFlow::find(burst, &acquisition, reference).unwrap();
    let mut errors = Vec::new();
    for &other in others {
        let truth = scene.flow(reference as f64, other as f64);
        for (corner, found) in corners.iter().zip(&flow[other]) {
            // The centre of the patch lies between four pixels.
            let at = (corner[1] + 8) * scene.size.width + corner[0] + 8;
            let whole = [0, 15].into_iter().all(|dy| {
                [0, 15]
                    .into_iter()
                    .all(|dx| truth.visible[(corner[1] + dy) * scene.size.width + corner[0] + dx])
            });
            if whole {
                let (dx, dy) = (found[0] - truth.dx[at], found[1] - truth.dy[at]);
                errors.push(f64::from(dx).hypot(f64::from(dy)));
            }
        }
    }
    errors
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

fn leaves(seed: u64, speed: f64) -> Scene {
    Procedural { kind: ProceduralScene::DeadLeaves, size: SIZE, seed, speed }.scene()
}

/// Checks global shifts of up to 8 pixels per frame, or 40 pixels over five frames.
#[test]
fn shifts_up_to_8_pixels_per_frame_are_found_to_half_a_pixel() {
    for velocity in [[0.0, 0.0], [0.4, 0.3], [2.5, -1.0], [-5.5, 3.2], [8.0, 0.0], [-4.5, -6.5]] {
        let mut all = Vec::new();
        let mut nearest = Vec::new();
        for seed in 0..2 {
            let mut scene = leaves(seed, 0.0);
            for layer in &mut scene.layers {
                layer.motion = Motion::pan(velocity);
            }
            let errors_to = |others: &[usize]| errors(&scene, 9.75, 5, others);
            all.extend(errors_to(&[0, 2, 3, 4, 6, 7, 8, 10]));
            nearest.extend(errors_to(&[4, 6]));
        }
        println!(
            "{velocity:?} px/frame: next frame {:.3} px, up to 5 frames {:.3} px",
            mean(&nearest),
            mean(&all)
        );
        assert!(mean(&nearest) < 0.5, "{velocity:?}: {}", mean(&nearest));
        assert!(mean(&all) < 0.5, "{velocity:?}: {}", mean(&all));
    }
}

/// Checks a scene that pans and turns about its centre, so that every patch moves differently.
#[test]
fn turning_is_found_to_half_a_pixel() {
    let centre = [96.0, 96.0];
    for (pan, degrees) in [(1.0, 0.5), (3.0, 1.5)] {
        let mut scene = leaves(0, 0.0);
        for layer in &mut scene.layers {
            let velocity = [pan, 0.0];
            let rotation = f64::to_radians(degrees);
            layer.motion = Motion { rotation, centre, ..Motion::pan(velocity) };
        }
        let found = mean(&errors(&scene, 9.75, 5, &[3, 4, 6, 7]));
        println!("pan {pan} px, turn {degrees} degrees per frame: up to 2 frames {found:.3} px");
        assert!(found < 0.5, "{degrees}: {found}");
    }
}

/// Checks leaves that move independently, most of them smaller than a patch. Few patches have a single
/// motion, so the bound only asks for less error than zero motion has.
#[test]
fn occluders_stay_distinct_at_small_scale() {
    for speed in [2.0, 8.0] {
        let found = mean(&errors(&leaves(1, speed), 9.75, 5, &[4, 6]));
        println!("leaves up to {speed} px/frame, each on its own: next frame {found:.3} px");
        assert!(found < 2.0 / 3.0 * speed, "{speed}: {found}");
    }
}
