//! Noise that moves with the scene.

use super::motion::paths::Paths;
use qudi_core::{Result, Size};
use qudi_layers::tensor::read;

/// Replaces the noise of every frame by the middle frame's, sampled along the motion at the nearest pixel. It
/// stays white. Pixels that the middle frame does not show keep their own.
///
/// Predicted frames are merged along the motion. Noise of every frame's own makes them guess differently what
/// the counts do not show, and merging averages the guesses: draws would spread less than the network errs.
///
/// # Shapes
/// - noise: `[bursts * frames, height, width]`
///
/// # Errors
/// [`Error`](qudi_core::Error) if the device fails.
pub(super) fn move_noise(paths: &Paths, size: Size, noise: &mut [f32]) -> Result<()> {
    let frames = paths.frames();
    let middle = frames / 2;
    let length = frames * size.pixels();
    for frame in (0..frames).filter(|&frame| frame != middle) {
        let distance = frame.abs_diff(middle);
        let flows = read(paths.between(distance, frame < middle).clone())?;
        // Flow to later frames is listed by its frame, flow to earlier ones by the neighbour.
        let place = frame.min(middle);
        let per_burst = (frames - distance) * size.pixels() / 2;
        for (burst, flows) in noise.chunks_exact_mut(length).zip(flows.chunks_exact(per_burst)) {
            let flow = &flows[place * size.pixels() / 2..][..size.pixels() / 2];
            let (own, shown) = frame_and_middle(burst, frame, middle, size.pixels());
            sample(own, shown, flow, size);
        }
    }
    Ok(())
}

/// Splits a burst into one frame, to change, and the middle one.
fn frame_and_middle(
    burst: &mut [f32],
    frame: usize,
    middle: usize,
    pixels: usize,
) -> (&mut [f32], &[f32]) {
    let (before, after) = burst.split_at_mut(frame.max(middle) * pixels);
    let other = &mut before[frame.min(middle) * pixels..][..pixels];
    if frame < middle { (other, &after[..pixels]) } else { (&mut after[..pixels], other) }
}

/// Samples the nearest pixels along the flow of cells of 2 x 2 pixels, `[2, height / 2, width / 2]` in cells.
fn sample(own: &mut [f32], shown: &[f32], flow: &[f32], size: Size) {
    let cells = flow.len() / 2;
    for (i, value) in own.iter_mut().enumerate() {
        let [x, y] = [i % size.width, i / size.width];
        let cell = y / 2 * (size.width / 2) + x / 2;
        let along = |at: usize, axis: usize, length: usize| {
            let at = (at as f32 + 2.0 * flow[axis * cells + cell]).round();
            (0.0..length as f32).contains(&at).then_some(at as usize)
        };
        if let (Some(x), Some(y)) = (along(x, 0, size.width), along(y, 1, size.height)) {
            *value = shown[y * size.width + x];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::motion::flow::WindowFlow;
    use super::*;
    use burn::tensor::{Device, Tensor};

    const SIZE: Size = Size { height: 8, width: 12 };
    const FRAMES: usize = 5;

    /// Two bursts whose scenes move in other directions: the noise of the middle frame moves with them.
    #[test]
    fn noise_moves_with_the_scene() {
        let device = Device::flex();
        let speeds = [[2i64, 0], [-1, 1]];
        let plane = |v: i64| {
            let shape = [FRAMES - 1, 1, SIZE.height / 2, SIZE.width / 2];
            Tensor::<4>::full(shape, v as f32 / 2.0, &device)
        };
        let pairs = |sign: i64| {
            let of = |speed: [i64; 2]| Tensor::cat(speed.map(|v| plane(sign * v)).to_vec(), 1);
            Tensor::cat(speeds.map(of).to_vec(), 0)
        };
        let flow = WindowFlow { pairs: Tensor::cat(vec![pairs(1), pairs(-1)], 0), scale: 2 };
        let own: Vec<f32> = (0..2 * FRAMES * SIZE.pixels()).map(|i| i as f32).collect();
        let mut moved = own.clone();
        move_noise(&Paths::new(&flow, FRAMES), SIZE, &mut moved).unwrap_or_else(|e| panic!("{e}"));
        for (i, &value) in moved.iter().enumerate() {
            let [burst, frame] = [i / (FRAMES * SIZE.pixels()), i / SIZE.pixels() % FRAMES];
            let time = (FRAMES / 2) as i64 - frame as i64;
            let [x, y] = [i % SIZE.width, i / SIZE.width % SIZE.height].map(|at| at as i64);
            let [x, y] = [x + time * speeds[burst][0], y + time * speeds[burst][1]];
            let inside =
                (0..SIZE.width as i64).contains(&x) && (0..SIZE.height as i64).contains(&y);
            let middle = ((burst * FRAMES + FRAMES / 2) * SIZE.height) as i64;
            let expected =
                if inside { ((middle + y) * SIZE.width as i64 + x) as f32 } else { own[i] };
            assert_eq!(value, expected, "burst {burst}, frame {frame}");
        }
    }
}
