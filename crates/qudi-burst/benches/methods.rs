//! Benchmarks of BM3D on one image and of every method on windows of 11 frames.

use criterion::{Criterion, criterion_group, criterion_main};
use qudi_burst::bm3d;
use qudi_burst::{PostFilter, Qbp, Transform, TransformDenoise};
use qudi_core::restorer::{Acquisition, BurstView, Restorer};
use qudi_core::sensor::Sensor;
use qudi_core::{Camera, Light, Size};
use qudi_sim::scene::{Procedural, ProceduralScene};
use std::hint::black_box;

const SIZE: Size = Size { height: 256, width: 256 };

fn methods(c: &mut Criterion) {
    let scene =
        Procedural { kind: ProceduralScene::DeadLeaves, size: SIZE, seed: 1, speed: 2.0 }.scene();
    let sensor = Sensor::load("qudi-paper").expect("a preset");
    let light = Light { ppp: 9.75, mean_level: 0.45 };
    let mut camera = Camera::new(&sensor, SIZE, light, 1).expect("a camera");
    let counts: Vec<Vec<u16>> = (0..11)
        .map(|t| camera.expose(t, &[&scene.render(t as f64)]).expect("an exposure"))
        .collect();
    let acquisition =
        Acquisition::new(sensor, light.ppp, light.mean_level).expect("a gain").with_seed(1);
    let burst = BurstView { size: SIZE, frames: &counts };
    let image = scene.render(0.0);

    let mut group = c.benchmark_group("256 x 256");
    group.sample_size(10);
    group.bench_function("bm3d, one image", |b| b.iter(|| bm3d(black_box(&image), 0.1)));
    let methods: [Box<dyn Restorer>; 4] = [
        Box::new(TransformDenoise::new(Transform::Integral, 1)),
        Box::new(TransformDenoise::new(Transform::Identity, 1)),
        Box::new(Qbp::new(PostFilter::None)),
        Box::new(Qbp::new(PostFilter::Bm3d)),
    ];
    for mut method in methods {
        group.bench_function(format!("{}, 11 frames", method.name()), |b| {
            b.iter(|| method.restore(black_box(burst), &acquisition).expect("a result"));
        });
    }
    group.finish();
}

criterion_group!(benches, methods);
criterion_main!(benches);
