//! Photons depend on the seed alone, not on threads or the length of the clip.
#![allow(clippy::unwrap_used)]

use proptest::prelude::*;
use qudi_core::sensor::{DarkRate, Sensor};
use qudi_core::{Camera, Frame, Light, Size};

fn expose(sensor: &Sensor, size: Size, seed: u64, threads: usize, frames: u64) -> Vec<Vec<u16>> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    pool.install(|| {
        let light = Light { ppp: 3.25, mean_level: 0.45 };
        let mut camera = Camera::new(sensor, size, light, seed).unwrap();
        let scene = Frame::from_fn(size, |x, y| ((x * 7 + y * 13) % 100) as f32 / 100.0);
        (0..frames).map(|t| camera.expose(t, &[&scene]).unwrap()).collect()
    })
}

/// Returns sensors for every path through the camera: tables, direct draws, single binary frames, echoes.
fn sensors() -> Vec<Sensor> {
    let mut uneven = Sensor::load("qudi-paper").unwrap();
    uneven.defects.dark_spread = 0.7;
    uneven.defects.hot_fraction = 0.01;
    uneven.defects.hot_dark = DarkRate::PerFrame(500.0);
    let mut deep = Sensor::load("qis16-gj").unwrap();
    deep.defects.crosstalk = 0.02;
    let mut echoing = Sensor::load("swissspad2").unwrap();
    echoing.frames_summed = 7;
    echoing.quantum_efficiency = 0.5;
    echoing.defects.afterpulse = 0.05;
    echoing.defects.crosstalk = 0.01;
    echoing.defects.dead_fraction = 0.01;
    let plain = ["qudi-paper", "cis-phone", "spad512s"].map(|name| Sensor::load(name).unwrap());
    plain.into_iter().chain([uneven, deep, echoing]).collect()
}

#[test]
fn photons_do_not_depend_on_threads() {
    let size = Size { height: 67, width: 91 };
    for sensor in sensors() {
        let alone = expose(&sensor, size, 7, 1, 3);
        assert_eq!(alone, expose(&sensor, size, 7, 8, 3), "{}", sensor.name);
        assert_ne!(alone, expose(&sensor, size, 8, 1, 3), "{}: the seed matters", sensor.name);
        assert_ne!(alone[0], alone[1], "{}: frames differ", sensor.name);
    }
}

/// Records rely on the photons of a seed: changing them needs a new major version. Checked only where the
/// mathematical library is known.
#[cfg(all(target_os = "linux", target_arch = "x86_64"))]
#[test]
fn photons_of_a_seed_do_not_change() {
    let size = Size { height: 67, width: 91 };
    let sums: Vec<u32> = sensors()
        .iter()
        .map(|sensor| {
            let frames = expose(sensor, size, 7, 2, 3);
            let bytes: Vec<u8> = frames.iter().flatten().flat_map(|c| c.to_le_bytes()).collect();
            crc32fast::hash(&bytes)
        })
        .collect();
    assert_eq!(sums, EXPECTED_CHECKSUMS);
}

/// CRC-32 of three frames of each of `sensors()`.
#[cfg(all(target_os = "linux", target_arch = "x86_64"))]
const EXPECTED_CHECKSUMS: [u32; 6] =
    [3_921_897_508, 2_884_552_629, 2_724_855_200, 3_641_929_682, 3_081_532_661, 3_851_747_618];

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn simulation_is_reproducible_for_any_size_and_seed(
        height in 1usize..40, width in 1usize..70, seed: u64, threads in 1usize..9, which in 0usize..6,
    ) {
        let size = Size { height, width };
        let sensor = &sensors()[which];
        let alone = expose(sensor, size, seed, 1, 2);
        prop_assert_eq!(&alone, &expose(sensor, size, seed, threads, 2));
        prop_assert!(alone.iter().flatten().all(|&c| c <= sensor.max_count()));
    }
}
