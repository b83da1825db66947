//! Inputs in a form that can be recorded and opened again.

use super::gif::Gif;
use super::image_file::{EXTENSIONS, read_scaled};
use super::images::ImageFolder;
use super::npy::NpyFrames;
use super::recorded::{Recorded, Repeated};
use super::synthetic::Synthetic;
use super::tiff_pages::TiffPages;
use super::video::Video;
use super::y4m::Y4m;
use super::{ExposureSource, FrameReader};
use crate::scene::{PROCEDURAL, Procedural, ProceduralScene, StillMotion, still_scene};
use qudi_core::Size;
use qudi_core::Transfer;
use qudi_core::limits::EXPOSURE_INSTANTS;
use qudi_core::regular_file::open_regular;
use qudi_core::{Error, Result};
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom, Write};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

/// Source of a scene.
#[derive(Debug, Serialize, Deserialize)]
#[serde(tag = "type", rename_all = "kebab-case")]
pub enum Input {
    /// A folder of images.
    Images {
        /// The folder.
        path: PathBuf,
    },
    /// An animated GIF.
    Gif {
        /// The file.
        path: PathBuf,
    },
    /// A Y4M file.
    Y4m {
        /// The file.
        path: PathBuf,
    },
    /// A `.npy` array of frames.
    Npy {
        /// The file.
        path: PathBuf,
    },
    /// A TIFF of several pages.
    Tiff {
        /// The file.
        path: PathBuf,
    },
    /// Any video that ffmpeg decodes.
    Video {
        /// The file.
        path: PathBuf,
    },
    /// One image, set in motion.
    Still {
        /// The file.
        path: PathBuf,
        /// How it moves.
        motion: StillMotion,
        /// Frame size; the image's own if absent.
        size: Option<Size>,
        /// Seed of the cut-outs.
        seed: u64,
    },
    /// A procedural scene.
    Procedural(Procedural),
    /// Y4M from standard input, kept in an unnamed temporary file so that it can be read twice.
    Pipe {
        /// The spool, absent once written down.
        #[serde(skip)]
        spool: Option<File>,
    },
}

/// Sampling of a clip from its input.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sampling {
    /// Output frames at most; synthetic scenes need it.
    pub frames: Option<u64>,
    /// Instants per exposure; 1: nothing moves while a frame is exposed.
    pub instants: usize,
    /// Repetitions of every frame of a recorded clip: cameras of thousands of frames per second see the same
    /// image of a video many times.
    #[serde(default = "one")]
    pub frames_per_image: u64,
    /// Meaning of file values.
    pub transfer: Transfer,
    /// File value of white in arrays and images, if not the type's full scale.
    pub white: Option<f32>,
}

impl Default for Sampling {
    fn default() -> Self {
        Self {
            frames: None,
            instants: 1,
            frames_per_image: 1,
            transfer: Transfer::AsIs,
            white: None,
        }
    }
}

fn one() -> u64 {
    1
}

/// Returns true for a TIFF of several pages. One that cannot be read is a still, whose reader says why.
fn has_pages(path: &Path) -> bool {
    TiffPages::open(path, Transfer::AsIs, None).is_ok_and(|tiff| tiff.pages() > 1)
}

/// Length of synthetic clips unless said otherwise: one window of the paper's network.
const SYNTHETIC_FRAMES: u64 = 11;

impl Input {
    /// Finds the input that `text` names: a file, a folder, `scene:NAME`, or `-` for Y4M on standard input.
    /// `motion`, `size`, `seed` and `speed` are for the synthetic kinds.
    ///
    /// # Errors
    /// [`Error`] if there is no such file or scene, or an option does not go with it.
    pub fn parse(
        text: &str,
        motion: Option<StillMotion>,
        size: Option<Size>,
        seed: u64,
        speed: f64,
    ) -> Result<Self> {
        if let Some(name) = text.strip_prefix("scene:") {
            let Some(kind) = ProceduralScene::by_name(name) else {
                let names: Vec<_> = PROCEDURAL.iter().map(|kind| kind.name()).collect();
                return Err(Error::request(
                    format!("no procedural scene named `{name}`"),
                    text,
                    format!("there are {}", names.join(", ")),
                ));
            };
            let size = size.unwrap_or(Size { height: 256, width: 256 });
            return Ok(Self::Procedural(Procedural { kind, size, seed, speed }));
        }
        if text == "-" {
            return Ok(Self::Pipe { spool: None });
        }
        // Absolute, so that a record works from any folder.
        let path = std::path::absolute(text)
            .map_err(|e| Error::io("find the input", Path::new(text), e))?;
        let about = std::fs::metadata(&path).map_err(|e| Error::io("find the input", &path, e))?;
        let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
        let input = match extension.as_str() {
            _ if about.is_dir() => Self::Images { path },
            "gif" => Self::Gif { path },
            "y4m" => Self::Y4m { path },
            "npy" => Self::Npy { path },
            "tif" | "tiff" if motion.is_none() && has_pages(&path) => Self::Tiff { path },
            e if EXTENSIONS.contains(&e) => {
                let motion = motion.unwrap_or_default();
                return Ok(Self::Still { path, motion, size, seed });
            }
            _ => Self::Video { path },
        };
        if motion.is_some() || size.is_some() {
            return Err(Error::request(
                "`motion` and `size` shape synthetic scenes, and this is a recorded clip",
                text,
                "leave them out, or give a single image",
            ));
        }
        Ok(input)
    }

    /// Creates the input for a recorded clip: a folder of frames or a file.
    ///
    /// # Errors
    /// [`Error`] if there is none.
    pub fn clip(path: &Path) -> Result<Self> {
        Self::parse(&path.to_string_lossy(), None, None, 0, 0.0)
    }

    /// Creates the input for one image without motion.
    pub fn still(path: &Path) -> Self {
        let motion = StillMotion::default();
        Self::Still { path: path.to_owned(), motion, size: None, seed: 0 }
    }

    /// Copies standard input to a temporary file, so that the clip can be read twice.
    /// Does nothing for other kinds. `on` is called between pieces and may stop the copy.
    ///
    /// # Errors
    /// [`Error`] if it cannot be read or stored; [`Error::Interrupted`] if `on` breaks.
    pub fn spool(
        &mut self,
        from: &mut impl Read,
        on: &mut dyn FnMut() -> ControlFlow<()>,
    ) -> Result<()> {
        let Self::Pipe { spool } = self else { return Ok(()) };
        let stdin = Path::new("standard input");
        let mut file = tempfile::tempfile()
            .map_err(|e| Error::io("make a temporary file for the pipe", stdin, e))?;
        let mut piece = vec![0u8; 1 << 18];
        loop {
            let n = from.read(&mut piece).map_err(|e| Error::io("read the pipe", stdin, e))?;
            if n == 0 {
                break;
            }
            file.write_all(&piece[..n])
                .map_err(|e| Error::io("store the pipe's data", stdin, e))?;
            if on().is_break() {
                return Err(Error::Interrupted);
            }
        }
        *spool = Some(file);
        Ok(())
    }

    /// Opens the clip at its beginning.
    ///
    /// # Errors
    /// [`Error`] if it cannot be read or the sampling does not fit.
    pub fn open(&self, sampling: &Sampling) -> Result<Box<dyn ExposureSource>> {
        if !(1..=EXPOSURE_INSTANTS).contains(&sampling.instants) {
            return Err(Error::request(
                format!("{} instants per exposure", sampling.instants),
                "instants",
                format!("between 1 (no motion during an exposure) and {EXPOSURE_INSTANTS}"),
            ));
        }
        if sampling.frames_per_image == 0 || sampling.frames_per_image > 1 && self.is_synthetic() {
            return Err(Error::request(
                format!("{} frames of each image", sampling.frames_per_image),
                "frames_per_image",
                "give 1 or more; of scenes and stills 1, which move between frames: lower their motion",
            ));
        }
        if let Some(white) = sampling.white
            && !(white.is_finite() && white > 0.0)
        {
            return Err(Error::request(
                format!("white at {white}"),
                "white",
                "give a number above 0",
            ));
        }
        let has_white = matches!(
            self,
            Self::Images { .. } | Self::Npy { .. } | Self::Tiff { .. } | Self::Still { .. }
        );
        if sampling.white.is_some() && !has_white {
            let help = "leave it out: videos, GIF and scenes know their white";
            return Err(Error::request("white of a clip that has its own", "white", help));
        }
        let transfer = sampling.transfer;
        let synthetic_frames = sampling.frames.unwrap_or(SYNTHETIC_FRAMES);
        let reader: Box<dyn FrameReader> = match self {
            Self::Images { path } => Box::new(ImageFolder::open(path, transfer, sampling.white)?),
            Self::Tiff { path } => Box::new(TiffPages::open(path, transfer, sampling.white)?),
            Self::Gif { path } => Box::new(Gif::open(path, transfer)?),
            Self::Npy { path } => Box::new(NpyFrames::open(path, transfer, sampling.white)?),
            Self::Video { path } => Box::new(Video::open(path, transfer)?),
            Self::Y4m { path } => {
                let file = open_regular(path, "open the Y4M file")?;
                Box::new(Y4m::open(BufReader::with_capacity(1 << 18, file), path, transfer)?)
            }
            Self::Pipe { spool } => {
                let stdin = Path::new("standard input");
                let Some(spool) = spool else {
                    return Err(Error::request(
                        "the pipe is gone",
                        "standard input",
                        "pipe the clip in again",
                    ));
                };
                let again = |e| Error::io("reread the pipe's data", stdin, e);
                let mut file = spool.try_clone().map_err(again)?;
                file.seek(SeekFrom::Start(0)).map_err(again)?;
                Box::new(Y4m::open(BufReader::with_capacity(1 << 18, file), stdin, transfer)?)
            }
            Self::Still { path, motion, size, seed } => {
                let (image, assumed) = read_scaled(path, transfer, sampling.white)?;
                let size = size.unwrap_or(image.size);
                let scene = still_scene(image, *motion, size, *seed);
                let instants = sampling.instants;
                return Ok(Box::new(Synthetic::new(scene, synthetic_frames, instants, assumed)));
            }
            Self::Procedural(procedural) => {
                let size = procedural.size;
                Size::new(size.height, size.width, "size")?;
                if !(procedural.speed.is_finite() && procedural.speed >= 0.0) {
                    return Err(Error::request(
                        format!("a speed of {}", procedural.speed),
                        "speed",
                        "give pixels per frame, 0 or more",
                    ));
                }
                return Ok(Box::new(Synthetic::new(
                    procedural.scene(),
                    synthetic_frames,
                    sampling.instants,
                    None,
                )));
            }
        };
        let reader = Box::new(Repeated::new(reader, sampling.frames_per_image));
        Ok(Box::new(Recorded::new(reader, sampling.instants, sampling.frames)?))
    }

    /// Returns true for synthetic scenes, whose flow is known.
    pub fn is_synthetic(&self) -> bool {
        matches!(self, Self::Still { .. } | Self::Procedural(_))
    }

    /// Returns the name of the file or folder, for messages.
    pub fn place(&self) -> String {
        match self {
            Self::Images { path }
            | Self::Gif { path }
            | Self::Y4m { path }
            | Self::Npy { path }
            | Self::Tiff { path }
            | Self::Video { path }
            | Self::Still { path, .. } => path.display().to_string(),
            Self::Procedural(p) => format!("scene:{}", p.kind.name()),
            Self::Pipe { .. } => "standard input".to_owned(),
        }
    }
}
