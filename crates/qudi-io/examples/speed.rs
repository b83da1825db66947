//! Median nanoseconds per pixel of 3-bit exposures, one line per number of threads.
//! scripts/compare/simulator_speed.py compares it with NumPy.
#![allow(clippy::print_stdout)]

use qudi_core::sensor::Sensor;
use qudi_core::{Camera, Error, Frame, Light, Result, Size};
use std::time::Instant;

const SIZE: Size = Size { height: 512, width: 512 };
const FRAMES: u64 = 60;

fn main() -> Result<()> {
    let scene = Frame::from_fn(SIZE, |x, y| ((x * 31 + y * 17) % 256) as f32 / 255.0);
    let sensor = Sensor::load("qudi-paper")?;
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let mut threads = 1;
    while threads <= cores {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        let pool = pool.map_err(|e| Error::request(e.to_string(), "threads", "use fewer"))?;
        let mut camera = Camera::new(&sensor, SIZE, Light { ppp: 3.25, mean_level: 0.45 }, 1)?;
        let mut times = Vec::new();
        for t in 0..FRAMES {
            let start = Instant::now();
            pool.install(|| camera.expose(t, &[&scene]))?;
            times.push(start.elapsed().as_secs_f64());
        }
        times.sort_by(f64::total_cmp);
        let median = times[times.len() / 2] / SIZE.pixels() as f64 * 1e9;
        println!("{threads} {median:.3}");
        threads *= 2;
    }
    Ok(())
}
