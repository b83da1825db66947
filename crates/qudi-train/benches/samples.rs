//! Samples of the recipe `window` drawn per second, by source on one thread, and as batches on threads.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use image::{GrayImage, Luma};
use qudi_core::atomic_file::Overwrite;
use qudi_model::window::Window;
use qudi_train::dataset::{Dataset, Pack, SourceKind, write_pack};
use qudi_train::{BurstSampler, Learner, Prefetcher, Recipe};
use std::hint::black_box;
use std::ops::ControlFlow;
use std::path::Path;

/// Returns an image with detail of all sizes.
fn picture(width: u32, height: u32, shift: u32) -> GrayImage {
    GrayImage::from_fn(width, height, |x, y| {
        let (x, y) = (f64::from(x + shift), f64::from(y));
        let waves = (x * 0.05).sin() + (y * 0.11).cos() + (0.7 * x - 0.4 * y).sin();
        Luma([(128.0 + 36.0 * waves) as u8])
    })
}

/// Packs synthetic files under the names of a recipe's sources.
fn pack(recipe: &Recipe, folder: &Path) -> Pack {
    let sources = recipe.data.packed_sources();
    for (place, source) in sources.iter().flat_map(|s| s.from.iter().map(move |from| (from, s))) {
        let path = folder.join(place);
        std::fs::create_dir_all(&path).expect("a folder");
        let frames = if source.kind == SourceKind::Clips { 16 } else { 4 };
        for frame in 0..frames {
            let image = picture(640, 360, 3 * frame);
            image.save(path.join(format!("{frame}.png"))).expect("an image");
        }
    }
    let path = folder.join("pack.zip");
    write_pack(&sources, folder, &path, Overwrite::No, None, &mut |_| ControlFlow::Continue(()))
        .expect("a pack");
    Pack::open(&path, &sources).expect("the pack")
}

/// Returns the recipe with three clips only.
fn recipe() -> Recipe {
    let mut recipe = Recipe::load("window", &[]).expect("a recipe");
    recipe.data.source[0].from = ["a", "b", "c"].map(str::to_owned).to_vec();
    recipe.validation = None;
    recipe
}

fn samples(c: &mut Criterion) {
    let folder = tempfile::tempdir().expect("a folder");
    let recipe = recipe();
    let pack = pack(&recipe, folder.path());
    let mut group = c.benchmark_group("one thread");
    group.throughput(Throughput::Elements(1));
    let single = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a thread");
    for source in &recipe.data.source {
        let mut data = recipe.data.clone();
        data.source = vec![source.clone()];
        let dataset = Dataset::new(&data, Some(pack.clone())).expect("a dataset");
        let mut number = 0;
        group.bench_function(&source.name, |b| {
            single.install(|| {
                b.iter(|| {
                    number += 1;
                    black_box(dataset.sample(1, number)).expect("a sample")
                });
            });
        });
    }
    let dataset = Dataset::new(&recipe.data, Some(pack)).expect("a dataset");
    let bursts = BurstSampler::new(&recipe, dataset, None);
    group.throughput(Throughput::Elements(recipe.train.batch as u64));
    let (mut own, mut number) = (bursts.clone(), 0);
    group.bench_function("batch", |b| {
        single.install(|| {
            b.iter(|| {
                number += 1;
                black_box(Window::draw(&recipe, &mut own, number)).expect("a batch")
            });
        });
    });
    group.finish();

    let mut group = c.benchmark_group("prefetcher");
    group.throughput(Throughput::Elements(recipe.train.batch as u64));
    for workers in [1, std::thread::available_parallelism().map_or(1, Into::into)] {
        let mut prefetcher =
            Prefetcher::<Window>::new(&recipe, &bursts, 0, workers).expect("threads");
        group.bench_function(format!("batch, workers {workers}"), |b| {
            b.iter(|| black_box(prefetcher.next_batch()).expect("a batch"));
        });
    }
    group.finish();
}

criterion_group!(benches, samples);
criterion_main!(benches);
