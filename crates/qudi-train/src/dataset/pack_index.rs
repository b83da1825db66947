//! The index of a pack: its clips, the sources that they were made from, and a digest.

use super::config::SourceKind;
use super::frame_codec::FrameCodec;
use qudi_core::limits::{DEFLATE_RATIO, PACK_PIXELS};
use qudi_core::{Error, Result, Size};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::path::Path;

/// Name of the index in the archive.
pub(super) const INDEX: &str = "index.json";

/// Version of the layout. Version 1 held PNG images only, and no digest.
const VERSION: u32 = 2;

/// Remedy for packs that cannot be used.
pub(super) const REMEDY: &str =
    "make the pack again: qudi train RECIPE --data FOLDER --pack FILE --prepare --force";

/// A source as a pack holds it: everything that decides its pixels, its files aside.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PackedSource {
    /// Its name.
    pub name: String,
    /// Clips or stills.
    pub kind: SourceKind,
    /// Files and folders below the data folder.
    pub from: Vec<String>,
    /// The factor that frames are downscaled by.
    pub shrink: f64,
    /// The part of validation clips that is kept, without loss; `None` for training.
    pub lossless: Option<ClipWindow>,
}

/// The middle of a clip: a number of frames, and a square of their pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClipWindow {
    /// Frames.
    pub frames: usize,
    /// Side of the square in pixels.
    pub crop: usize,
}

/// A clip, or a still, in a pack.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Clip {
    /// The source that it belongs to.
    pub source: String,
    /// Its name, unique in the source.
    pub name: String,
    /// Bytes of the files that it was made from.
    pub file_bytes: u64,
    /// Frames; 1 for a still.
    pub frames: usize,
    /// Rows and columns.
    pub size: Size,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Index {
    version: u32,
    pub(super) sources: Vec<PackedSource>,
    pub(super) clips: Vec<Clip>,
    /// Digest of the index without this field, and of all images.
    sha256: String,
}

/// Reads the version of any index.
#[derive(Deserialize)]
struct Version {
    version: u32,
}

impl PackedSource {
    /// Returns the coding of its frames.
    pub(super) fn codec(&self) -> FrameCodec {
        if self.lossless.is_some() { FrameCodec::Png } else { FrameCodec::Jpeg }
    }

    /// Returns true if a pack with this source serves for `other`.
    fn serves(&self, other: &Self) -> bool {
        let rest = |source: &Self| Self { lossless: None, ..source.clone() };
        let window = match (self.lossless, other.lossless) {
            (Some(own), Some(other)) => own.frames >= other.frames && own.crop >= other.crop,
            (own, other) => own == other,
        };
        window && rest(self) == rest(other)
    }
}

impl Index {
    pub(super) fn new(sources: Vec<PackedSource>) -> Self {
        Self { version: VERSION, sources, clips: Vec::new(), sha256: String::new() }
    }

    /// Parses the index of the pack at `path`, and checks that it can be.
    pub(super) fn parse(text: &[u8], path: &Path) -> Result<Self> {
        let parse = |e: serde_json::Error| damaged(path, e.to_string());
        let Version { version } = serde_json::from_slice(text).map_err(parse)?;
        if version != VERSION {
            let what = format!("the pack's layout is {version}, this program reads {VERSION}");
            return Err(Error::data(what, path, REMEDY));
        }
        let index: Self = serde_json::from_slice(text).map_err(parse)?;
        for clip in &index.clips {
            let size = Size::new(clip.size.height, clip.size.width, &clip.name);
            if clip.frames == 0 || size.is_err() || index.source(clip).is_none() {
                return Err(damaged(path, format!("clip `{}` cannot be", clip.name)));
            }
        }
        Ok(index)
    }

    /// Checks that the clips fit into a file of `bytes` with `images` images, and into memory.
    pub(super) fn check_sizes(&self, bytes: u64, images: usize, path: &Path) -> Result<()> {
        let (mut frames, mut pixels) = (0usize, 0u64);
        for clip in &self.clips {
            frames = frames.saturating_add(clip.frames);
            let clip = (clip.size.pixels() as u64).saturating_mul(clip.frames as u64);
            pixels = pixels.saturating_add(clip);
        }
        if frames != images {
            let what = format!("its index names {frames} images, there are {images}");
            return Err(damaged(path, what));
        }
        if pixels > bytes.saturating_mul(DEFLATE_RATIO) {
            return Err(damaged(path, format!("{bytes} bytes cannot hold {pixels} pixels")));
        }
        if pixels > PACK_PIXELS {
            return Err(Error::data(
                format!("the pack has {pixels} pixels; at most {PACK_PIXELS} are held in memory"),
                path,
                "name fewer clips in data.source, or raise its shrink",
            ));
        }
        Ok(())
    }

    /// Checks that the pack was made from `sources`; it may hold others, too.
    pub(super) fn check_sources(&self, sources: &[PackedSource], path: &Path) -> Result<()> {
        for source in sources {
            let Some(own) = self.sources.iter().find(|own| own.name == source.name) else {
                let names: Vec<_> = self.sources.iter().map(|own| own.name.as_str()).collect();
                let names = names.join(", ");
                let what = format!("the pack has no source `{}`; it has {names}", source.name);
                return Err(Error::data(what, path, REMEDY));
            };
            if !own.serves(source) {
                let text = |source| serde_json::to_string(source).expect("plain data");
                let what = format!(
                    "the pack was made from another recipe: it has {}, the recipe {}",
                    text(own),
                    text(source)
                );
                return Err(Error::data(what, path, REMEDY));
            }
        }
        Ok(())
    }

    /// Returns the source of a clip.
    pub(super) fn source(&self, clip: &Clip) -> Option<&PackedSource> {
        self.sources.iter().find(|source| source.name == clip.source)
    }

    /// Returns the name of an image in the archive.
    pub(super) fn entry(&self, clip: &Clip, frame: usize) -> String {
        let codec = self.source(clip).map_or(FrameCodec::Jpeg, PackedSource::codec);
        format!("{}/{}/{frame:06}.{}", clip.source, clip.name, codec.extension())
    }

    /// Returns the digest of the images' bytes, in the order of clips and frames, and of this index.
    pub(super) fn digest(&self, images: Sha256) -> String {
        let unsigned = Self {
            version: self.version,
            sources: self.sources.clone(),
            clips: self.clips.clone(),
            sha256: String::new(),
        };
        let text = serde_json::to_vec(&unsigned).expect("plain data");
        format!("{:x}", images.chain_update(text).finalize())
    }

    /// Returns the digest that is written down.
    pub(super) fn sha256(&self) -> &str {
        &self.sha256
    }

    /// Checks the digest.
    pub(super) fn check_digest(&self, images: Sha256, path: &Path) -> Result<()> {
        if self.digest(images) == self.sha256 {
            Ok(())
        } else {
            Err(damaged(path, "its digest differs from its content"))
        }
    }

    /// Writes the index down, with the digest.
    pub(super) fn signed(mut self, images: Sha256) -> Vec<u8> {
        self.sha256 = self.digest(images);
        serde_json::to_vec_pretty(&self).expect("plain data")
    }
}

/// Creates the error for a file that is no pack any more, or never was.
pub(super) fn damaged(path: &Path, what: impl Into<String>) -> Error {
    Error::data(format!("not a whole training pack: {}", what.into()), path, REMEDY)
}
