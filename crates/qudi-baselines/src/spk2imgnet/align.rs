//! Alignment of features by deformable convolutions on three levels, each refining the one below (Wang et
//! al., "EDVR", CVPR workshops 2019).

use super::conv;
use crate::parts::{deform_conv, leaky, renamed};
use burn::module::{Module, Param};
use burn::tensor::activation::sigmoid;
use burn::tensor::{Device, Tensor};
use qudi_layers::resample::upsample2;
use qudi_layers::{Conv2d, zeros};
use std::slice::from_ref;

/// Features on three levels, the finest first.
pub(super) type Levels = [Tensor<4>; 3];

/// Features of two levels below the first, and the cascade.
#[derive(Module, Debug)]
#[allow(clippy::struct_field_names)] // as in the authors' files
pub(super) struct Align {
    fea_l2_conv1: Conv2d,
    fea_l2_conv2: Conv2d,
    fea_l3_conv1: Conv2d,
    fea_l3_conv2: Conv2d,
    pcd_align: Cascade,
}

#[derive(Module, Debug)]
struct Cascade {
    l3: Level,
    l2: Level,
    l1: Level,
    cas: Level,
}

/// What one level, or the last step, is made of.
#[derive(Module, Debug)]
struct Level {
    offset_conv1: Conv2d,
    offset_conv2: Conv2d,
    offset_conv3: Option<Conv2d>,
    dcnpack: Deformable,
    fea_conv: Option<Conv2d>,
}

/// A deformable convolution with offsets and mask from a guide.
#[derive(Module, Debug)]
struct Deformable {
    /// `[outputs, inputs, 3, 3]`
    weight: Param<Tensor<4>>,
    /// `[outputs]`
    bias: Param<Tensor<1>>,
    conv_offset_mask: Conv2d,
}

impl Align {
    pub(super) fn zeros(features: usize, groups: usize, device: &Device) -> Self {
        let same = || conv([features, features], device);
        let level = |alone: bool| Level {
            offset_conv1: conv([2 * features, features], device),
            offset_conv2: conv([if alone { features } else { 2 * features }, features], device),
            offset_conv3: (!alone).then(same),
            dcnpack: Deformable {
                weight: zeros([features, features, 3, 3], device),
                bias: zeros([features], device),
                conv_offset_mask: conv([features, 27 * groups], device),
            },
            fea_conv: (!alone).then(|| conv([2 * features, features], device)),
        };
        Self {
            fea_l2_conv1: same(),
            fea_l2_conv2: same(),
            fea_l3_conv1: same(),
            fea_l3_conv2: same(),
            pcd_align: Cascade {
                l3: level(true),
                l2: level(false),
                l1: level(false),
                cas: level(true),
            },
        }
    }

    pub(super) fn authors_name(name: &str) -> String {
        let mut name = renamed(name, &[("fea_l2_", "fea_L2_"), ("fea_l3_", "fea_L3_")]);
        for level in ["1", "2", "3"] {
            let from = format!("pcd_align.pcd_align.l{level}.");
            let Some(rest) = name.strip_prefix(&from) else { continue };
            // The number of the module stands after its name.
            let (part, rest) = rest.split_once('.').unwrap_or((rest, ""));
            name = format!("pcd_align.pcd_align.L{level}_{part}_1.{rest}");
        }
        name.replace("pcd_align.cas.", "pcd_align.cas_")
    }

    /// Computes features on all levels.
    pub(super) fn levels(&self, features: Tensor<4>) -> Levels {
        let below = |x: &Tensor<4>, first: &Conv2d, second: &Conv2d| {
            leaky(second.linear(&[leaky(first.stride2(from_ref(x)))]))
        };
        let middle = below(&features, &self.fea_l2_conv1, &self.fea_l2_conv2);
        let coarse = below(&middle, &self.fea_l3_conv1, &self.fea_l3_conv2);
        [features, middle, coarse]
    }

    /// Aligns the features of a neighbour with the key's.
    pub(super) fn forward(&self, neighbour: Levels, key: Levels) -> Tensor<4> {
        let Cascade { l3, l2, l1, cas } = &self.pcd_align;
        let mut below: Option<(Tensor<4>, Tensor<4>)> = None;
        for (number, level) in [l1, l2, l3].into_iter().enumerate().rev() {
            let (n, k) = (&neighbour[number], &key[number]);
            let offset = level.offset(n, k, below.as_ref().map(|(offset, _)| offset));
            let aligned = level.dcnpack.forward(n.clone(), offset.clone());
            let aligned = match (&level.fea_conv, below) {
                (Some(fea_conv), Some((_, coarser))) => {
                    fea_conv.linear(&[aligned, upsample2(coarser)])
                }
                _ => aligned,
            };
            // No activation on the finest level.
            below = Some((offset, if number > 0 { leaky(aligned) } else { aligned }));
        }
        let (_, aligned) = below.expect("three levels");
        let offset = cas.offset(&aligned, &key[0], None);
        leaky(cas.dcnpack.forward(aligned, offset))
    }
}

impl Level {
    fn offset(&self, n: &Tensor<4>, k: &Tensor<4>, coarser: Option<&Tensor<4>>) -> Tensor<4> {
        let own = leaky(self.offset_conv1.linear(&[n.clone(), k.clone()]));
        let mut inputs = vec![own];
        // Places are twice as far away on a grid twice as fine.
        inputs.extend(coarser.map(|offset| upsample2(offset.clone()) * 2.0));
        let offset = leaky(self.offset_conv2.linear(&inputs));
        match &self.offset_conv3 {
            Some(conv) => leaky(conv.linear(&[offset])),
            None => offset,
        }
    }
}

impl Deformable {
    fn forward(&self, x: Tensor<4>, guide: Tensor<4>) -> Tensor<4> {
        let both = self.conv_offset_mask.linear(&[guide]);
        let thirds = both.dims()[1] / 3;
        let offset = both.clone().narrow(1, 0, 2 * thirds);
        let mask = sigmoid(both.narrow(1, 2 * thirds, thirds));
        deform_conv(x, offset, mask, self.weight.val(), self.bias.val())
    }
}
