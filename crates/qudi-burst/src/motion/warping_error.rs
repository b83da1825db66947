//! Warping error: the change of a clip along its true motion, a measure of flicker (Lai et al. 2018).

use qudi_core::Frame;
use qudi_core::flow::Flow;

/// Returns the mean squared difference between `now` and `next` sampled along `flow`, over visible pixels, or
/// `None` if no pixel is visible. The value of the ground truth is not 0, because surfaces turn, grow, and
/// are sampled between pixels. The excess over it is the flicker that a method adds.
pub fn warping_error(now: &Frame, next: &Frame, flow: &Flow) -> Option<f64> {
    let width = now.size.width;
    let (mut total, mut n) = (0.0, 0u64);
    for i in (0..now.data.len()).filter(|&i| flow.visible[i]) {
        let x = (i % width) as f64 + f64::from(flow.dx[i]);
        let y = (i / width) as f64 + f64::from(flow.dy[i]);
        total += f64::from(next.bilinear(x, y) - now.data[i]).powi(2);
        n += 1;
    }
    (n > 0).then(|| total / n as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_core::Size;

    #[test]
    fn shift_along_its_flow_has_no_flicker() {
        let size = Size { height: 6, width: 12 };
        let scene = |shift: usize| Frame::from_fn(size, |x, y| ((x + 12 - shift) * (y + 3)) as f32);
        let visible = (0..size.pixels()).map(|i| i % 12 < 9).collect();
        let flow = Flow { size, dx: vec![3.0; 72], dy: vec![0.0; 72], visible };
        assert_eq!(warping_error(&scene(0), &scene(3), &flow), Some(0.0));
        let mut brighter = scene(3);
        brighter.data.iter_mut().for_each(|v| *v += 0.5);
        let error = warping_error(&scene(0), &brighter, &flow).unwrap();
        assert!((error - 0.25).abs() < 1e-5, "{error}");
        let hidden = Flow { visible: vec![false; 72], ..flow };
        assert_eq!(warping_error(&scene(0), &scene(3), &hidden), None);
    }
}
