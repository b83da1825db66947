//! Which network, and of which size.

use crate::emvd::Emvd;
use crate::flornn::FloRnn;
use crate::import::{Method, Network};
use crate::memdeblur::MemDeblur;
use crate::quiver::Quiver;
use crate::rvrt::Rvrt;
use crate::spk2imgnet::Spk2ImgNet;
use crate::student_teacher::KernelPrediction;
use crate::{emvd, flornn, memdeblur, quiver, rvrt, spk2imgnet, student_teacher};
use burn::tensor::Device;
use qudi_core::Size;
use serde::{Deserialize, Serialize};

/// Most channels, blocks or frames that a file or a recipe may ask for.
pub(crate) const MOST: usize = 4096;

/// The sizes of a network; recipes name the method beside them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "method")]
pub enum Sizes {
    /// Of QUIVER.
    #[serde(rename = "quiver")]
    Quiver(quiver::Sizes),
    /// Of EMVD.
    #[serde(rename = "emvd")]
    Emvd(emvd::Sizes),
    /// Of FloRNN.
    #[serde(rename = "flornn")]
    FloRnn(flornn::Sizes),
    /// Of Spk2ImgNet.
    #[serde(rename = "spk2imgnet")]
    Spk2ImgNet(spk2imgnet::Sizes),
    /// Of MemDeblur.
    #[serde(rename = "memdeblur")]
    MemDeblur(memdeblur::Sizes),
    /// Of RVRT.
    #[serde(rename = "rvrt")]
    Rvrt(rvrt::Sizes),
    /// Of a student of two teachers.
    #[serde(rename = "student-teacher")]
    StudentTeacher(student_teacher::Sizes),
}

impl Sizes {
    /// The method.
    pub fn method(self) -> Method {
        match self {
            Self::Quiver(_) => Method::Quiver,
            Self::Emvd(_) => Method::Emvd,
            Self::FloRnn(_) => Method::FloRnn,
            Self::Spk2ImgNet(_) => Method::Spk2ImgNet,
            Self::MemDeblur(_) => Method::MemDeblur,
            Self::Rvrt(_) => Method::Rvrt,
            Self::StudentTeacher(_) => Method::StudentTeacher,
        }
    }

    /// The network of these sizes, without weights: it takes no memory yet.
    pub fn network(self, device: &Device) -> Network {
        match self {
            Self::Quiver(sizes) => Network::Quiver(Quiver::zeros(sizes, device)),
            Self::Emvd(sizes) => Network::Emvd(Emvd::zeros(sizes.width, device)),
            Self::FloRnn(sizes) => Network::FloRnn(FloRnn::zeros(sizes, device)),
            Self::Spk2ImgNet(sizes) => Network::Spk2ImgNet(Spk2ImgNet::zeros(sizes, device)),
            Self::MemDeblur(sizes) => Network::MemDeblur(MemDeblur::zeros(sizes, device)),
            Self::Rvrt(sizes) => Network::Rvrt(Rvrt::zeros(sizes, device)),
            Self::StudentTeacher(sizes) => {
                Network::StudentTeacher(KernelPrediction::zeros(sizes, device))
            }
        }
    }

    /// What is wrong with sizes that a network cannot have.
    pub fn problem(self) -> Option<&'static str> {
        match self {
            Self::Quiver(s) if !s.features.is_multiple_of(16) || s.blocks < 2 => {
                Some("QUIVER has features in multiples of 16, and two blocks or more")
            }
            Self::Quiver(s) if s.past == 0 || s.future == 0 => {
                Some("QUIVER sees frames before and after the one that it restores")
            }
            Self::FloRnn(s) if s.channels != 3 => Some("FloRNN has images of three channels"),
            Self::Spk2ImgNet(s) if s.groups == 0 || !s.features.is_multiple_of(s.groups) => {
                Some("groups of Spk2ImgNet divide its features")
            }
            Self::MemDeblur(s) if !s.features.is_multiple_of(8) || s.bottlenecks == 0 => {
                Some("MemDeblur has features in multiples of 8, and a bottleneck or more")
            }
            Self::Rvrt(s) if !s.features.is_multiple_of(12) || ![1, 3].contains(&s.channels) => {
                Some("RVRT has features in multiples of 12, and images of one or three channels")
            }
            Self::StudentTeacher(s) if s.kernel.is_multiple_of(2) => Some("kernels have odd sides"),
            _ => None,
        }
    }

    /// What is wrong with the sizes of a recipe: files of what it trains must tell them.
    pub fn problem_of_recipe(self) -> Option<&'static str> {
        if self.numbers().iter().any(|number| !(1..=MOST).contains(number)) {
            return Some("sizes are from 1 to 4096");
        }
        match self {
            Self::Quiver(s) if s.past != s.future && s.past != s.future + 1 => Some(
                "QUIVER sees as many frames before the one that it restores as after it, or one more",
            ),
            _ => self.problem(),
        }
    }

    /// All numbers of channels, blocks and frames.
    fn numbers(self) -> Vec<usize> {
        match self {
            Self::Quiver(s) => vec![s.features, s.blocks, s.past, s.future],
            Self::Emvd(s) => vec![s.width],
            Self::FloRnn(s) => vec![s.channels, s.features, s.blocks],
            Self::Spk2ImgNet(s) => vec![s.features, s.stem, s.blocks, s.groups],
            Self::MemDeblur(s) => {
                let blocks = [s.forward_blocks, s.backward_blocks, s.memory_blocks, s.bottlenecks];
                [&[s.channels, s.features], &blocks[..]].concat()
            }
            Self::Rvrt(s) => vec![s.channels, s.features, s.blocks],
            Self::StudentTeacher(s) => vec![s.frames, s.features, s.kernel],
        }
    }

    /// Sides of images are multiples of this.
    pub fn multiple(self) -> usize {
        match self {
            Self::Quiver(_) => quiver::MULTIPLE,
            Self::Emvd(_) => emvd::MULTIPLE,
            Self::FloRnn(_) => 1,
            Self::Spk2ImgNet(_) => spk2imgnet::MULTIPLE,
            Self::MemDeblur(_) => memdeblur::MULTIPLE,
            Self::Rvrt(_) => rvrt::MULTIPLE,
            Self::StudentTeacher(_) => student_teacher::MULTIPLE,
        }
    }

    /// Bytes that restoring a window of frames of `size` takes on the processor at most, about: per pixel and feature
    /// what the sizes of the authors took at 256 x 256 (docs/notes/engineering/learned-methods.md).
    pub fn memory(self, size: Size) -> u64 {
        let per_feature = match self {
            Self::Quiver(_) => 1150,
            Self::Emvd(_) => 72,
            Self::FloRnn(_) => 176,
            Self::Spk2ImgNet(_) => 650,
            Self::MemDeblur(_) => 205,
            Self::Rvrt(_) => 170,
            Self::StudentTeacher(_) => 195,
        };
        (size.pixels() * self.features() * per_feature) as u64
    }

    /// The channels of the widest layers at full size.
    fn features(self) -> usize {
        match self {
            Self::Quiver(s) => s.features,
            Self::Emvd(s) => s.width,
            Self::FloRnn(s) => s.features,
            Self::Spk2ImgNet(s) => s.features,
            Self::MemDeblur(s) => s.features,
            Self::Rvrt(s) => s.features,
            Self::StudentTeacher(s) => s.features,
        }
    }

    /// What is wrong with bursts of so many frames to learn from.
    pub fn problem_of_bursts(self, frames: usize) -> Option<String> {
        let wanted = match self {
            Self::Quiver(s) => {
                let least = s.past + 1 + s.future;
                (frames < least).then(|| format!("{least} or more"))
            }
            Self::Emvd(_) => (frames < 2).then(|| "2 or more".to_owned()),
            Self::FloRnn(s) => {
                let least = s.ahead + 2;
                (frames < least).then(|| format!("{least} or more"))
            }
            Self::Spk2ImgNet(_) => {
                (frames != spk2imgnet::FRAMES).then(|| spk2imgnet::FRAMES.to_string())
            }
            Self::MemDeblur(_) => {
                let step = memdeblur::EVERY_BACK;
                (frames <= step || frames % step != 1)
                    .then(|| format!("a multiple of {step} and one more"))
            }
            Self::Rvrt(_) => {
                let clip = rvrt::CLIP;
                (frames < 2 * clip || !frames.is_multiple_of(clip))
                    .then(|| format!("a multiple of {clip}, {} or more", 2 * clip))
            }
            Self::StudentTeacher(s) => (frames != s.frames).then(|| s.frames.to_string()),
        };
        wanted.map(|wanted| {
            format!("bursts of {frames} frames: {} learns from {wanted}", self.method().name())
        })
    }
}

impl std::fmt::Display for Sizes {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Quiver(s) => {
                let frames = s.past + 1 + s.future;
                write!(f, "{} features, {} blocks, {frames} frames", s.features, s.blocks)
            }
            Self::Emvd(s) => write!(f, "{} channels", s.width),
            Self::FloRnn(s) => {
                let flow = if s.flow { "" } else { ", no flow" };
                write!(f, "{} features, {} blocks{flow}", s.features, s.blocks)
            }
            Self::Spk2ImgNet(s) => {
                let frames = spk2imgnet::FRAMES;
                write!(f, "{} features, {} blocks, {frames} frames", s.features, s.blocks)
            }
            Self::MemDeblur(s) => write!(f, "{} features, {} blocks", s.features, s.forward_blocks),
            Self::Rvrt(s) => {
                write!(f, "{} features, {} blocks, {} channels", s.features, s.blocks, s.channels)
            }
            Self::StudentTeacher(s) => write!(
                f,
                "{} features, kernels of {} x {}, {} frames",
                s.features, s.kernel, s.kernel, s.frames
            ),
        }
    }
}
