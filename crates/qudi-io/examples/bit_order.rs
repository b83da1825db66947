//! Evidence for the right bit order of simulated packed bursts, in standard errors, by length.
#![allow(clippy::print_stdout)]

use qudi_core::sensor::Sensor;
use qudi_core::{Camera, Light, Size};
use qudi_io::recognition::bit_order_z_score;
use qudi_sim::clip::{Input, Sampling};

fn main() -> qudi_core::Result<()> {
    let size = Size::new(128, 256, "example")?;
    let sensor = Sensor::load("swissspad2")?;
    println!("{:<20}{:>10}  frames: 16 32 64 128 256 512 1024", "scene", "detected");
    for scene in ["scene:dead-leaves", "scene:text", "scene:chart", "scene:gratings"] {
        for detected in [0.02, 0.06, 0.5] {
            let input = Input::parse(scene, None, Some(size), 1, 0.02)?;
            let Some(mean_level) = input.open(&Sampling::default())?.next()? else { continue };
            let light = Light { ppp: detected / sensor.quantum_efficiency, mean_level: 0.4 };
            let mut camera = Camera::new(&sensor, size, light, 1)?;
            let instants: Vec<_> = mean_level.instants.iter().collect();
            let mut sums = vec![0u32; size.pixels()];
            let mut line = format!("{scene:<20}{detected:>10}         ");
            for frame in 0..1024u64 {
                for (sum, count) in sums.iter_mut().zip(camera.expose(frame, &instants)?) {
                    *sum += u32::from(count);
                }
                if frame >= 15 && (frame + 1).is_power_of_two() {
                    line += &format!(" {:.1}", bit_order_z_score(&sums, size));
                }
            }
            println!("{line}");
        }
    }
    Ok(())
}
