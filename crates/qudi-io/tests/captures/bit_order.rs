//! The picture tells the order of bits, or says that it cannot.

use qudi_core::sensor::Sensor;
use qudi_core::{Camera, Light, Size};
use qudi_io::recognition::{Z_SCORE_THRESHOLD, bit_order_z_score};
use qudi_sim::clip::{Input, Sampling};

/// Sums of simulated binary frames of a procedural scene, seen in either order.
fn sums(scene: &str, seed: u64, ppp: f64, lengths: &[u64]) -> Vec<(u64, Vec<u32>)> {
    let size = Size { height: 128, width: 256 };
    let sensor = Sensor::load("swissspad2").unwrap();
    let input = Input::parse(scene, None, Some(size), seed, 0.02).unwrap();
    let longest = *lengths.last().unwrap();
    let sampling = Sampling { frames: Some(longest), ..Sampling::default() };
    let mut source = input.open(&sampling).unwrap();
    let light = Light { ppp: ppp / sensor.quantum_efficiency, mean_level: 0.4 };
    let mut camera = Camera::new(&sensor, size, light, seed).unwrap();
    let mut total = vec![0u32; size.pixels()];
    let mut found = Vec::new();
    // One picture stands for all: the scene hardly moves, and rendering it is the slow part.
    let instants = source.next().unwrap().unwrap();
    let instants: Vec<_> = instants.instants.iter().collect();
    for frame in 0..longest {
        let counts = camera.expose(frame, &instants).unwrap();
        for (sum, count) in total.iter_mut().zip(counts) {
            *sum += u32::from(count);
        }
        if lengths.contains(&(frame + 1)) {
            found.push((frame + 1, total.clone()));
        }
    }
    found
}

/// Reverses the order of the bits of every byte.
fn reversed(sums: &[u32]) -> Vec<u32> {
    sums.chunks(8).flat_map(|eight| eight.iter().rev().copied()).collect()
}

#[test]
fn bit_order_of_16_to_1024_frames_is_right_or_unsure() {
    let size = Size { height: 128, width: 256 };
    let lengths = [16, 32, 64, 128, 256, 512, 1024];
    let (mut sure, mut all) = (0, 0);
    for (scene, seed) in
        [("scene:dead-leaves", 1), ("scene:dead-leaves", 2), ("scene:text", 3), ("scene:chart", 4)]
    {
        for ppp in [0.06, 0.5] {
            for (frames, sums) in sums(scene, seed, ppp, &lengths) {
                let right = bit_order_z_score(&sums, size);
                let wrong = bit_order_z_score(&reversed(&sums), size);
                assert!(right > -Z_SCORE_THRESHOLD, "{scene} {ppp} {frames}: {right}");
                assert!(wrong < Z_SCORE_THRESHOLD, "{scene} {ppp} {frames}: {wrong}");
                all += 2;
                sure += usize::from(right > Z_SCORE_THRESHOLD)
                    + usize::from(wrong < -Z_SCORE_THRESHOLD);
                if frames >= 256 {
                    assert!(
                        right > Z_SCORE_THRESHOLD && wrong < -Z_SCORE_THRESHOLD,
                        "{scene} {ppp} {frames}: {right} {wrong}"
                    );
                }
            }
        }
    }
    assert!(sure * 10 > all * 8, "sure of {sure} in {all}");
}

#[test]
fn noise_and_darkness_leave_the_bit_order_open() {
    let size = Size { height: 64, width: 64 };
    assert_eq!(bit_order_z_score(&vec![0; 64 * 64], size), 0.0);
    for seed in 0..20 {
        let noise = crate::scene(1, 64, 64, seed);
        // The light of the test scene, without its structure.
        let sums: Vec<u32> =
            noise[0].iter().enumerate().map(|(i, &c)| u32::from(c) * (i as u32 * 7 % 5)).collect();
        let shuffled: Vec<u32> = (0..64 * 64).map(|i| sums[i * 1531 % 4096]).collect();
        assert!(bit_order_z_score(&shuffled, size).abs() < Z_SCORE_THRESHOLD);
    }
    assert_eq!(bit_order_z_score(&[1, 2, 3], Size { height: 1, width: 3 }), 0.0);
}
