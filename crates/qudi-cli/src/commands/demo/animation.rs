//! The animated picture of `qudi demo --animate`: counts, the best classical method, QuDi and the truth, side
//! by side, from the first frame to the last and back.

use super::restored::{CENTRE, RestoredScene};
use super::scenes::{FRAMES, SIZE};
use crate::error::{CliError, Result};
use crate::report::player::counts_frame;
use qudi_core::{Frame, Size};
use qudi_io::writer::Picture;

/// Largest size of the file in bytes.
const MAX_BYTES: usize = 2_000_000;

/// Sides of the panels in pixels: the largest one whose file is small enough is taken.
const SIDES: [usize; 5] = [256, 232, 208, 184, 160];

/// Gray levels: few enough to compress well, and enough that no bands are seen in noise.
const LEVELS: u8 = 64;

/// Hundredths of a second that a frame is shown.
const DELAY: u16 = 9;

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
        CliError::new(
            format!("cannot encode the animation: {e}"),
            "--animate",
            "report this as a bug",
        )
    };
    let first = panels(scene, 0, side);
    let (width, height) = (first.size.width as u16, first.size.height as u16);
    let palette: Vec<u8> = (0..LEVELS)
        .flat_map(|level| [(u16::from(level) * 255 / u16::from(LEVELS - 1)) as u8; 3])
        .collect();
    let mut bytes = Vec::new();
    let mut encoder = gif::Encoder::new(&mut bytes, width, height, &palette).map_err(failed)?;
    encoder.set_repeat(gif::Repeat::Infinite).map_err(failed)?;
    let level = |v: &f32| (v.clamp(0.0, 1.0) * f32::from(LEVELS - 1)).round() as u8;
    for t in (0..FRAMES).chain((1..FRAMES - 1).rev()) {
        let mut frame = gif::Frame {
            width,
            height,
            delay: DELAY,
            buffer: panels(scene, t, side).data.iter().map(level).collect(),
            ..gif::Frame::default()
        };
        frame.make_lzw_pre_encoded();
        encoder.write_lzw_pre_encoded_frame(&frame).map_err(failed)?;
    }
    drop(encoder);
    Ok(bytes)
}

/// Composes the panels of a frame, each cut to the middle.
fn panels(scene: &RestoredScene, t: usize, side: usize) -> Frame {
    let sensor = &scene.exposed.acquisition.sensor;
    let counts = counts_frame(SIZE, &scene.exposed.counts[t], sensor.max_count());
    let bits = format!("{} BIT", sensor.output_bits());
    let mut list = vec![("COUNTS", bits, counts)];
    // The best classical method is the last but one where the network is the last.
    let methods = &scene.methods[scene.methods.len().saturating_sub(2)..];
    for method in methods {
        let psnr = format!("{:.1} DB", method.psnr_a[CENTRE]);
        list.push((method.label, psnr, method.frames[t].clone()));
    }
    list.push(("TRUTH", String::new(), scene.exposed.truths[t].clone()));
    let mut picture = Picture::new(Size { height: side, width: side }, 1, list.len(), 2);
    for (column, (label, below, frame)) in list.iter().enumerate() {
        picture.place(0, column, &[label, below], &middle(frame, side));
    }
    picture.into_frame()
}

/// Cuts out the middle of a frame.
fn middle(frame: &Frame, side: usize) -> Frame {
    let (top, left) = ((frame.size.height - side) / 2, (frame.size.width - side) / 2);
    let rows = (top..top + side).flat_map(|y| &frame.row(y)[left..left + side]);
    Frame { size: Size { height: side, width: side }, data: rows.copied().collect() }
}
