//! The middle of frames, which pages with many pictures show.

use qudi_core::{Frame, Size};

/// Largest side of what is shown.
const MAX_SIDE: usize = 224;

/// Returns the size that [`cut`] cuts to.
pub(crate) fn cut_size(size: Size) -> Size {
    Size { height: size.height.min(MAX_SIDE), width: size.width.min(MAX_SIDE) }
}

/// Cuts a frame to its middle.
pub(crate) fn cut(frame: &Frame) -> Frame {
    let size = cut_size(frame.size);
    let (top, left) = ((frame.size.height - size.height) / 2, (frame.size.width - size.width) / 2);
    let rows = (top..top + size.height).flat_map(|y| &frame.row(y)[left..left + size.width]);
    Frame { size, data: rows.copied().collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cuts_the_middle_and_keeps_small_frames_whole() {
        let size = Size { height: 40, width: 300 };
        let frame = Frame::from_fn(size, |x, _| x as f32 / 300.0);
        let middle = cut(&frame);
        assert_eq!(middle.size, Size { height: 40, width: 224 });
        assert_eq!(middle.row(3)[0], frame.row(3)[38]);
        assert_eq!(cut(&middle), middle);
    }
}
