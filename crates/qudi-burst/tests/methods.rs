//! All methods on moving scenes, on different numbers of threads, and on degenerate input.
#![allow(clippy::unwrap_used, clippy::print_stdout)]

use qudi_burst::Average;
use qudi_burst::{
    AlignedBurst, AlignedFrame, Alignments, PostFilter, Qbp, QbpRefined, ReferenceEstimate,
    Transform, TransformDenoise,
};
use qudi_core::metrics::gain_aligned_psnr;
use qudi_core::restorer::{Acquisition, BurstView, Restorer};
use qudi_core::sensor::Sensor;
use qudi_core::{Camera, Frame, Light, Size};
use qudi_sim::scene::{Procedural, ProceduralScene};

fn methods() -> Vec<Box<dyn Restorer>> {
    vec![
        Box::new(TransformDenoise::new(Transform::Integral, 1)),
        Box::new(TransformDenoise::new(Transform::Anscombe, 5)),
        Box::new(TransformDenoise::new(Transform::Identity, 1)),
        Box::new(Qbp::new(PostFilter::None)),
        Box::new(Qbp::new(PostFilter::Bm3d)),
        Box::new(QbpRefined),
    ]
}

fn acquisition(sensor: Sensor, ppp: f64) -> Acquisition {
    Acquisition::new(sensor, ppp, 0.45).unwrap()
}

/// Simulates a window of a moving scene. Returns it with its ground truth.
fn exposed(size: Size, sensor: &Sensor, ppp: f64, frames: usize) -> (Vec<Vec<u16>>, Vec<Frame>) {
    let scene = Procedural { kind: ProceduralScene::Text, size, seed: 2, speed: 2.0 }.scene();
    let mut camera = Camera::new(sensor, size, Light { ppp, mean_level: 0.45 }, 5).unwrap();
    let truth: Vec<Frame> = (0..frames).map(|t| scene.render(t as f64)).collect();
    let counts =
        truth.iter().enumerate().map(|(t, f)| camera.expose(t as u64, &[f]).unwrap()).collect();
    (counts, truth)
}

fn mean_psnr(images: &[Frame], truth: &[Frame]) -> f64 {
    let total: f64 = images.iter().zip(truth).map(|(i, t)| gain_aligned_psnr(i, t)).sum();
    total / truth.len() as f64
}

#[test]
fn every_method_beats_the_average_of_a_moving_scene() {
    let size = Size { height: 96, width: 112 };
    let mut spad = Sensor::load("spad512s").unwrap();
    spad.frames_summed = 7;
    for sensor in [Sensor::load("qudi-paper").unwrap(), spad] {
        let (counts, truth) = exposed(size, &sensor, 6.0, 11);
        let acquisition = acquisition(sensor, 6.0);
        let burst = BurstView { size, frames: &counts };
        let naive = mean_psnr(&Average.restore(burst, &acquisition).unwrap().frames, &truth);
        for mut method in methods() {
            let restored = method.restore(burst, &acquisition).unwrap().frames;
            let found = mean_psnr(&restored, &truth);
            let name = method.name();
            println!("{} {name}: {found:.2} dB, average {naive:.2} dB", acquisition.sensor.name);
            // A sum of 11 frames is no better than the average where everything moves.
            let margin = if name == "transform-denoise" { 0.0 } else { 0.5 };
            assert!(found > naive + margin, "{name}: {found} dB, average {naive} dB");
        }
    }
}

#[test]
fn second_pass_beats_the_first() {
    let size = Size { height: 96, width: 112 };
    // Single binary frames at this light level gain nothing from the second pass.
    let cases = [("qudi-paper", 3.25, 0.1), ("qudi-paper", 26.0, 1.0), ("swissspad2", 0.5, -0.1)];
    for (name, ppp, margin) in cases {
        let sensor = Sensor::load(name).unwrap();
        let (counts, truth) = exposed(size, &sensor, ppp, 11);
        let acquisition = acquisition(sensor, ppp);
        let burst = BurstView { size, frames: &counts };
        let first = Qbp::new(PostFilter::Bm3d).restore(burst, &acquisition).unwrap().frames;
        let reference = ReferenceEstimate::compute(burst, &acquisition).unwrap();
        let alignment = AlignedBurst::new(reference);
        let aligned: Vec<AlignedFrame> = (0..truth.len())
            .map(|frame| alignment.frame(frame, 10, Alignments::Selected))
            .collect();
        let merged: Vec<Frame> = aligned.iter().map(|aligned| aligned.merged.clone()).collect();
        let clean: Vec<Frame> = aligned.iter().map(|aligned| aligned.reference.clone()).collect();
        let [first, second, merged] =
            [&first, &clean, &merged].map(|frames| mean_psnr(frames, &truth));
        println!("{name} at {ppp} PPP: {first:.2} dB, {second:.2} dB, merged {merged:.2} dB");
        assert!(second > first + margin, "{name}: {first} dB, then {second} dB");
        assert!(second > merged, "{name}: BM3D makes {second} dB of {merged} dB");
        // Half of all normal errors lie within 0.6745 standard deviations; few are ghosts, which noise cannot
        // explain.
        let errors = aligned.iter().zip(&truth).flat_map(|(aligned, truth)| {
            let AlignedFrame { merged, noise_sigma, .. } = aligned;
            let pixels = merged.data.iter().zip(&noise_sigma.data).zip(&truth.data);
            pixels.map(|((m, s), t)| ((m - t) / s).abs()).collect::<Vec<_>>()
        });
        let mut errors: Vec<f32> = errors.collect();
        errors.sort_unstable_by(f32::total_cmp);
        let deviation = errors[errors.len() / 2] / 0.6745;
        println!("errors of the merged frames: {deviation:.2} of the stated deviation");
        assert!((0.8..1.4).contains(&deviation), "{name}: {deviation}");
    }
}

/// Checks the standardized counts of a static scene: minus the reference estimate's prediction they are noise
/// of sigma one, for the frame itself and for its neighbours. The predictions for neighbours hardly differ.
/// Frames outside the window are zero.
#[test]
fn neighbours_are_standardized() {
    let size = Size { height: 48, width: 64 };
    let sensor = Sensor::load("qudi-paper").unwrap();
    let still =
        Frame::from_fn(size, |x, y| 0.25 + 0.4 * (x as f32 / 64.0) + 0.2 * (y as f32 / 48.0));
    let light = Light { ppp: 3.25, mean_level: still.mean() };
    let mut camera = Camera::new(&sensor, size, light, 9).unwrap();
    let counts: Vec<_> = (0..7).map(|i| camera.expose(i, &[&still]).unwrap()).collect();
    let acquisition = Acquisition { mean_level: still.mean(), ..acquisition(sensor, 3.25) };
    let burst = BurstView { size, frames: &counts };
    let reference = ReferenceEstimate::compute(burst, &acquisition).unwrap();
    let aligned = AlignedBurst::new(reference).frame(2, 8, Alignments::Selected);
    assert_eq!((aligned.counts.len(), aligned.expected.len()), (9, 8));
    let deviation = |frame: &Frame| {
        let squares = frame.data.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>();
        (squares / frame.data.len() as f64).sqrt()
    };
    let own = deviation(&aligned.counts[0]);
    assert!((0.9..1.1).contains(&own), "{own}");
    for (seen, expected) in aligned.counts[1..7].iter().zip(&aligned.expected) {
        // Interpolation between pixels averages out some of the noise.
        let (seen, expected) = (deviation(seen), deviation(expected));
        assert!((0.55..1.1).contains(&seen) && expected < 0.2, "{seen}, expected {expected}");
    }
    assert!(aligned.counts[7..].iter().chain(&aligned.expected[6..]).all(|f| deviation(f) == 0.0));

    // The truth replaces the reference estimate: its prediction is what the camera counts.
    let reference = ReferenceEstimate::compute(burst, &acquisition).unwrap();
    let aligned = AlignedBurst::new(reference).realign(vec![still.clone(); 7]).frame(
        2,
        8,
        Alignments::Selected,
    );
    assert_eq!(aligned.reference, still);
    let thrice = AlignedBurst::new(ReferenceEstimate::compute(burst, &acquisition).unwrap())
        .realign(vec![still.clone(); 7])
        .frame(2, 8, Alignments::WithPerPixel);
    assert_eq!((thrice.counts.len(), thrice.expected.len()), (25, 24));
    assert_eq!(
        (&thrice.counts[..9], &thrice.expected[..8]),
        (&aligned.counts[..], &aligned.expected[..])
    );
    for (seen, expected) in thrice.counts[17..23].iter().zip(&thrice.expected[16..]) {
        let (seen, expected) = (deviation(seen), deviation(expected));
        assert!((0.55..1.1).contains(&seen) && expected < 0.1, "{seen}, expected {expected}");
    }
    assert!(thrice.counts[23..].iter().chain(&thrice.expected[22..]).all(|f| deviation(f) == 0.0));
    // Frames of another method take the place of the estimate, which is not computed then.
    let frames = vec![still.clone(); 7];
    let given = AlignedBurst::on_frames(burst, &acquisition, frames).unwrap();
    let given = given.frame(2, 8, Alignments::WithPerPixel);
    assert_eq!((&given.counts, &given.expected), (&thrice.counts, &thrice.expected));
    assert_eq!((&given.merged, &given.noise_sigma), (&thrice.merged, &thrice.noise_sigma));
    assert_eq!(given.reference, still);
    let own = deviation(&aligned.counts[0]);
    assert!((0.95..1.05).contains(&own), "{own}");
    let mean = aligned.counts[0].mean();
    assert!(mean.abs() < 0.06, "{mean}");
    let differences = aligned.expected[..6].iter().map(deviation).fold(0.0, f64::max);
    // A path may be slightly off on a smooth slope.
    assert!(differences < 0.02, "{differences}");
}

#[test]
fn result_does_not_depend_on_threads() {
    let size = Size { height: 48, width: 64 };
    let sensor = Sensor::load("qudi-paper").unwrap();
    let (counts, _) = exposed(size, &sensor, 9.75, 5);
    let acquisition = acquisition(sensor, 9.75);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let burst = BurstView { size, frames: &counts };
        pool.install(|| -> Vec<Vec<Frame>> {
            methods().iter_mut().map(|m| m.restore(burst, &acquisition).unwrap().frames).collect()
        })
    };
    assert_eq!(on(1), on(2));
}

/// Checks that every pixel is a number for one frame, tiny frames, no light and full light.
#[test]
fn odd_values_give_valid_pictures() {
    for name in ["qudi-paper", "swissspad2", "qis4-gj"] {
        let sensor = Sensor::load(name).unwrap();
        let most = sensor.max_count();
        let acquisition = acquisition(sensor, 3.25);
        for (height, width) in [(1, 1), (5, 9), (16, 16), (17, 40)] {
            let size = Size { height, width };
            for (count, frames) in [(0, 1), (most, 1), (0, 3), (most, 3), (most / 2, 12)] {
                let counts = vec![vec![count; size.pixels()]; frames];
                for mut method in methods() {
                    let burst = BurstView { size, frames: &counts };
                    let restored = method.restore(burst, &acquisition).unwrap().frames;
                    assert_eq!(restored.len(), frames);
                    for frame in restored {
                        assert_eq!(frame.size, size);
                        let (least, largest) = frame
                            .data
                            .iter()
                            .fold((f32::MAX, f32::MIN), |(a, b), &v| (a.min(v), b.max(v)));
                        let case = format!("{name} {} {size} {count} x {frames}", method.name());
                        assert!(frame.data.iter().all(|v| v.is_finite() && *v >= 0.0), "{case}");
                        assert!(
                            largest - least < 0.02 * largest.max(1e-3),
                            "{case}: {least} {largest}"
                        );
                    }
                }
            }
        }
    }
}
