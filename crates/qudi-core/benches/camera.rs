//! Nanoseconds per pixel of the camera, compared with drawing one random word per pixel, the lower bound.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use qudi_core::sensor::Sensor;
use qudi_core::{Camera, Frame, Light, Size};
use rand::rngs::ChaCha8Rng;
use rand::{Rng, SeedableRng};
use std::hint::black_box;

const SIZE: Size = Size { height: 512, width: 512 };

fn scene() -> Frame {
    Frame::from_fn(SIZE, |x, y| ((x * 31 + y * 17) % 256) as f32 / 255.0)
}

fn camera(c: &mut Criterion) {
    let single = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a thread");
    let mut group = c.benchmark_group("one thread");
    group.throughput(Throughput::Elements(SIZE.pixels() as u64));
    group.bench_function("floor: one ChaCha8 word per pixel", |b| {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut words = vec![0u8; 4 * SIZE.pixels()];
        b.iter(|| rng.fill_bytes(black_box(&mut words)));
    });
    let mut spad = Sensor::load("spad512s").expect("a preset");
    for (name, sensor) in [
        ("3-bit qudi-paper", Sensor::load("qudi-paper").expect("a preset")),
        ("1-bit spad512s", spad.clone()),
        ("3-bit sum of 7 spad512s", {
            spad.frames_summed = 7;
            spad
        }),
        ("12-bit qis16-gj", Sensor::load("qis16-gj").expect("a preset")),
    ] {
        let light = Light { ppp: 3.25, mean_level: 0.45 };
        let mut camera = Camera::new(&sensor, SIZE, light, 1).expect("a camera");
        let scene = scene();
        let mut t = 0;
        group.bench_function(name, |b| {
            single.install(|| {
                b.iter(|| {
                    t += 1;
                    camera.expose(t, &[black_box(&scene)]).expect("an exposure")
                });
            });
        });
    }
    group.finish();
}

criterion_group!(benches, camera);
criterion_main!(benches);
