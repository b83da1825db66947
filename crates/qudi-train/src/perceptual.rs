//! Distances between images that follow what people see (docs/perceptual.md): terms of the training's
//! objective, and metrics.
//!
//! LPIPS compares features of a network trained to name things, and needs its weights from files; MS-SSIM and
//! the oriented filters need none. Nothing here is trained: gradients flow to the images alone.

mod backbone;
mod convolution;
mod fetch;
mod files;
#[cfg(test)]
mod golden_tests;
mod gray;
mod lpips;
mod ms_ssim;
mod oriented;
mod pth;

use burn::tensor::{Device, Tensor};
use lpips::{Lpips, Net};
use ms_ssim::MsSsim;
use oriented::Oriented;
use pth::StateDict;
use qudi_core::nearest::nearest;
use qudi_core::{Result, SimError, Size};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Which distance.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PerceptualKind {
    /// None: always zero.
    None,
    /// LPIPS on features of VGG16.
    LpipsVgg,
    /// LPIPS on features of AlexNet.
    LpipsAlex,
    /// LPIPS on features of SqueezeNet 1.1.
    LpipsSqueeze,
    /// One minus the multi-scale structural similarity.
    MsSsim,
    /// Normalised responses of oriented filters.
    Oriented,
}

/// All kinds.
pub const PERCEPTUAL_KINDS: &[PerceptualKind] = &[
    PerceptualKind::None,
    PerceptualKind::LpipsVgg,
    PerceptualKind::LpipsAlex,
    PerceptualKind::LpipsSqueeze,
    PerceptualKind::MsSsim,
    PerceptualKind::Oriented,
];

impl PerceptualKind {
    /// Name in configurations.
    pub fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::LpipsVgg => "lpips-vgg",
            Self::LpipsAlex => "lpips-alex",
            Self::LpipsSqueeze => "lpips-squeeze",
            Self::MsSsim => "ms-ssim",
            Self::Oriented => "oriented",
        }
    }

    /// The kind of this name.
    ///
    /// # Errors
    /// [`SimError::Request`] that lists the names.
    pub fn by_name(name: &str) -> Result<Self> {
        PERCEPTUAL_KINDS.iter().copied().find(|kind| kind.name() == name).ok_or_else(|| {
            let names: Vec<_> = PERCEPTUAL_KINDS.iter().map(|kind| kind.name()).collect();
            let hint = nearest(name, &names)
                .map_or(String::new(), |name| format!("did you mean `{name}`?  "));
            SimError::request(
                format!("no perceptual term named `{name}`"),
                "perceptual",
                format!("{hint}there are {}", names.join(", ")),
            )
        })
    }

    /// Pixels of the shortest side of an image that can be compared.
    pub fn smallest_side(self) -> usize {
        match self {
            Self::None => 1,
            Self::MsSsim => ms_ssim::WINDOW,
            Self::Oriented => oriented::SIDE,
            Self::LpipsVgg | Self::LpipsAlex | Self::LpipsSqueeze => {
                self.net().map_or(1, Net::smallest_side)
            }
        }
    }

    fn net(self) -> Option<Net> {
        match self {
            Self::LpipsVgg => Some(Net::Vgg),
            Self::LpipsAlex => Some(Net::Alex),
            Self::LpipsSqueeze => Some(Net::Squeeze),
            Self::None | Self::MsSsim | Self::Oriented => None,
        }
    }
}

/// A distance between images, with the constants it needs.
#[derive(Clone, Debug)]
pub struct Perceptual {
    kind: PerceptualKind,
    term: Term,
}

#[derive(Clone, Debug)]
enum Term {
    None,
    Lpips(Lpips),
    MsSsim(MsSsim),
    Oriented(Oriented),
}

impl Perceptual {
    /// Prepares a distance on `device`. LPIPS reads its weights from `folder`, if one is given, or else from where
    /// Burn keeps downloads; the others read nothing.
    ///
    /// # Errors
    /// [`SimError`] if weights are missing (it says which and where to get them), or do not fit.
    pub fn load(kind: PerceptualKind, folder: Option<&Path>, device: &Device) -> Result<Self> {
        let device = &device.clone().inner();
        let term = match kind.net() {
            Some(net) => {
                let [backbone, heads] = files::find(net, kind.name(), folder)?;
                let (mut backbone, mut heads) =
                    (StateDict::open(&backbone)?, StateDict::open(&heads)?);
                let mut weights = |name: &str, shape: &[usize]| {
                    let file = if name.starts_with("lin") { &mut heads } else { &mut backbone };
                    file.read(name, shape)
                };
                Term::Lpips(Lpips::new(net, &mut weights, device)?)
            }
            None => match kind {
                PerceptualKind::MsSsim => Term::MsSsim(MsSsim::new(device)),
                PerceptualKind::Oriented => Term::Oriented(Oriented::new(device)),
                _ => Term::None,
            },
        };
        Ok(Self { kind, term })
    }

    /// Which distance it is.
    pub fn kind(&self) -> PerceptualKind {
        self.kind
    }

    /// Whether images of this size can be compared.
    ///
    /// # Errors
    /// [`SimError::Request`] with both sizes if they are too small.
    pub fn check(&self, size: Size) -> Result<()> {
        let smallest = self.kind.smallest_side();
        if size.height.min(size.width) >= smallest {
            return Ok(());
        }
        Err(SimError::request(
            format!(
                "images of {} x {} pixels are too small for `{}`, which needs {smallest} on each side",
                size.height,
                size.width,
                self.kind.name()
            ),
            "perceptual",
            "take larger crops, or another perceptual term",
        ))
    }

    /// The distance of every image of `p` from that of `q`, averaged over the images.
    ///
    /// # Shapes
    /// `p`, `q`: `[images, 1, height, width]` in [0, 1], of a size that [`check`](Self::check) accepts, on the
    /// device that this was loaded on, with autodiff or without; result `[1]`.
    pub fn loss(&self, p: Tensor<4>, q: Tensor<4>) -> Tensor<1> {
        self.distances(p, q).mean()
    }

    /// The distance of every image of `p` from that of `q`: 0 for equal images.
    ///
    /// # Shapes
    /// As of [`loss`](Self::loss); result `[images]`.
    pub fn distances(&self, p: Tensor<4>, q: Tensor<4>) -> Tensor<1> {
        assert_eq!(p.dims(), q.dims(), "images to compare");
        match &self.term {
            Term::None => Tensor::zeros([p.dims()[0]], &p.device()),
            Term::Lpips(lpips) => lpips.distances(p, q),
            Term::MsSsim(ms_ssim) => ms_ssim.distances(p, q),
            Term::Oriented(oriented) => oriented.distances(p, q),
        }
    }
}

/// Where weights are looked for if no folder is given: where Burn's own LPIPS keeps its downloads. None if the
/// system names no home.
pub fn cache_folder() -> Option<PathBuf> {
    files::cache()
}

/// Downloads the weights of a kind into `folder`, by the `curl` program, and checks their hashes. Files that are
/// there already are checked and kept. Gives the paths: none for kinds without weights.
///
/// # Errors
/// [`SimError`] if curl is missing or fails, or a file is not the published one.
pub fn fetch(kind: PerceptualKind, folder: &Path) -> Result<Vec<PathBuf>> {
    let files = kind.net().map(files::files);
    let files = files.iter().flatten();
    files.map(|file| fetch::fetch(file, file.base, folder)).collect()
}

/// How many times sides of this length can be halved and still hold `window` pixels, and once more; at most
/// `most`, at least one.
fn scales([height, width]: [usize; 2], window: usize, most: usize) -> usize {
    (1..most).take_while(|&halvings| height.min(width) >> halvings >= window).count() + 1
}

/// `[images]` from `[images, 1, height, width]`.
fn image_means(planes: Tensor<4>) -> Tensor<1> {
    let [images, _, height, width] = planes.dims();
    planes.reshape([images, height * width]).mean_dim(1).reshape([images])
}
