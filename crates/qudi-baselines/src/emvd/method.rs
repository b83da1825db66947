//! EMVD among the learned methods.

use super::{Emvd, MULTIPLE, Sizes};
use crate::import::Shapes;
use crate::learning::{Bursts, Law, NetworkLosses};
use crate::method::LearnedMethod;
use crate::restorer::Window;
use burn::tensor::{Device, Tensor};
use qudi_core::Result;
use std::f32::consts::FRAC_1_SQRT_2;

/// Frames before the first one that the recurrence begins at: the authors' protocol scores the last of
/// eleven.
const HISTORY: usize = 10;

/// Initial colour transform: four orthonormal rows.
const COLOURS: [[f32; 4]; 4] = [
    [0.5, 0.5, 0.5, 0.5],
    [-0.5, 0.5, 0.5, -0.5],
    [0.65, 0.2784, -0.2784, -0.65],
    [-0.2784, 0.65, -0.65, 0.2784],
];

impl LearnedMethod for Emvd {
    type Sizes = Sizes;

    const RECIPE: &'static str = include_str!("../../recipes/emvd.toml");
    const MARK: &'static str = "vd.fusion.net1.weight";
    const MULTIPLE: usize = MULTIPLE;
    const BYTES: usize = 72;
    // The recurrence starts anew with every window.
    const FRAMES: usize = 64;

    fn init(sizes: Sizes, device: &Device) -> Self {
        Self::zeros(sizes.width, device)
    }

    fn sizes(shapes: &Shapes<'_>) -> Result<Sizes> {
        Ok(Sizes { width: shapes.side("vd.fusion.net1.weight", 0)? })
    }

    fn describe(s: Sizes) -> String {
        format!("{} channels", s.width)
    }

    fn numbers(s: Sizes) -> Vec<usize> {
        vec![s.width]
    }

    fn features(s: Sizes) -> usize {
        s.width
    }

    fn other_lengths(_: Sizes, frames: usize) -> Option<String> {
        (frames < 2).then(|| "2 or more".to_owned())
    }

    fn initial_law(_: Sizes, name: &str, _: &[usize]) -> Option<Law> {
        let s = FRAC_1_SQRT_2;
        match name {
            "ct.net1.weight" => Some(Law::These(COLOURS.concat())),
            "cti.net1.weight" => {
                let at = |place: usize| COLOURS[place % 4][place / 4];
                Some(Law::These((0..16).map(at).collect()))
            }
            "ft.net1.weight" => Some(Law::These(vec![s, s, s, -s])),
            "fti.net1.weight" => Some(Law::These(vec![s, s])),
            "fti.net2.weight" => Some(Law::These(vec![s, -s])),
            _ => None,
        }
    }

    fn context(&self) -> [usize; 2] {
        [HISTORY, 0]
    }

    fn restore(&self, window: Window<'_>) -> Result<Vec<Tensor<4>>> {
        let images = Emvd::restore(self, window.around(self.context()));
        Ok(images.into_iter().skip(HISTORY).collect())
    }

    fn losses(&self, _: &[&Self], bursts: &Bursts, _: u64) -> NetworkLosses {
        let [counts, truth] = [&bursts.counts, &bursts.truth].map(|x| bursts.each(x));
        vec![("image", self.error(counts, &truth)), ("transforms", self.transform_loss())].into()
    }
}
