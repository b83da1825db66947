//! The animated picture of `qudi demo --animate`: counts, the best classical method, QuDi and the truth, side
//! by side, from the first frame to the last and back.

use super::restored::{CENTRE, RestoredScene};
use super::scenes::{FRAMES, SIZE};
use crate::error::{CliError, Result};
use crate::report::grid::{Grid, Pixels};
use crate::report::player::counts_frame;
use qudi_core::{Frame, Size};
use rayon::prelude::*;

/// Largest size of the file in bytes.
const MAX_BYTES: usize = 2_000_000;

/// Sides of the panels in pixels: the largest one whose file is small enough is taken.
const SIDES: [usize; 6] = [232, 208, 192, 176, 160, 144];

/// Hundredths of a second that a frame is shown.
const DELAY: u16 = 9;

/// Pixels of which one is looked at for the colours of a frame.
const SPEED: i32 = 8;

/// Encodes the animation as a GIF.
pub(super) fn gif(scene: &RestoredScene) -> Result<Vec<u8>> {
    let mut smallest = Vec::new();
    for side in SIDES {
        smallest = encode(scene, side)?;
        if smallest.len() <= MAX_BYTES {
            break;
        }
    }
    Ok(smallest)
}

fn encode(scene: &RestoredScene, side: usize) -> Result<Vec<u8>> {
    let failed = |e: gif::EncodingError| {
        let what = format!("cannot encode the animation: {e}");
        CliError::new(what, "--animate", "report this as a bug")
    };
    let frames: Vec<gif::Frame<'_>> = (0..FRAMES)
        .into_par_iter()
        .map(|t| {
            let Pixels { size, rgb } = panels(scene, t, side);
            let (width, height) = (size.width as u16, size.height as u16);
            let mut frame = gif::Frame::from_rgb_speed(width, height, &rgb, SPEED);
            frame.delay = DELAY;
            frame.make_lzw_pre_encoded();
            frame
        })
        .collect();
    let mut bytes = Vec::new();
    let (width, height) = (frames[0].width, frames[0].height);
    let mut encoder = gif::Encoder::new(&mut bytes, width, height, &[]).map_err(failed)?;
    encoder.set_repeat(gif::Repeat::Infinite).map_err(failed)?;
    for frame in frames.iter().chain(frames[1..FRAMES - 1].iter().rev()) {
        encoder.write_lzw_pre_encoded_frame(frame).map_err(failed)?;
    }
    drop(encoder);
    Ok(bytes)
}

/// Composes the panels of a frame, each cut to the middle.
fn panels(scene: &RestoredScene, t: usize, side: usize) -> Pixels {
    let sensor = &scene.exposed.acquisition.sensor;
    let counts = counts_frame(SIZE, &scene.exposed.counts[t], sensor.max_count());
    let bits = format!("{} BIT", sensor.output_bits());
    let mut list = vec![("COUNTS", bits, [&counts; 3])];
    // The best classical method is the last but one where the network is the last.
    for method in &scene.methods[scene.methods.len().saturating_sub(2)..] {
        let psnr = format!("{:.1} DB", method.psnr_a[CENTRE]);
        list.push((method.label, psnr, method.planes(t)));
    }
    list.push(("TRUTH", String::new(), scene.exposed.truth(t)));
    let mut grid = Grid::new(Size { height: side, width: side }, 1, list.len(), 2);
    for (column, (label, below, planes)) in list.into_iter().enumerate() {
        let cut = planes.map(|plane| middle(plane, side));
        grid.place(0, column, &[label, &below], cut.each_ref());
    }
    grid.pixels()
}

/// Cuts out the middle of a frame.
pub(super) fn middle(frame: &Frame, side: usize) -> Frame {
    let (top, left) = ((frame.size.height - side) / 2, (frame.size.width - side) / 2);
    let rows = (top..top + side).flat_map(|y| &frame.row(y)[left..left + side]);
    Frame { size: Size { height: side, width: side }, data: rows.copied().collect() }
}
