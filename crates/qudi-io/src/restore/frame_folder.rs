//! A folder of restored frames that survives an interruption: finished frames stay, and a manifest describes
//! how they were made, so that no other frames are mixed in.

use super::changed_settings::{difference, written};
use super::inputs::Inputs;
use super::lock::{FolderLock, Share};
use crate::writer::{encode_colour_png16, encode_png16, frame_name, is_frame_below, is_frame_name};
use qudi_core::Transfer;
use qudi_core::atomic_file::{Overwrite, PendingFile};
use qudi_core::limits::RECORD_BYTES;
use qudi_core::regular_file::read_limited;
use qudi_core::{Error, Result};
use qudi_core::{Frame, Size};
use qudi_sim::clip::read_still;
use serde_json::{Value, json};
use std::io::Write;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Name of the manifest, which also marks a folder as ours.
pub const MANIFEST: &str = "manifest.json";

/// The run that writes a folder, as the manifest describes it.
#[derive(Clone, Debug)]
pub struct FolderRun {
    /// Settings on which the frames depend.
    pub settings: Value,
    /// Files that the run reads.
    pub inputs: Inputs,
    /// Share of the work.
    pub share: Share,
    /// Number of all frames; none while the length of a pipe is unknown.
    pub frames: Option<u64>,
}

/// Frames that the manifest of a pipe names at first; it is written again when there are more.
const MIN_NAMED: u64 = 256;

/// Restored frames as 16-bit PNG: `frame_000000.png`, ..., 65535 for 1.
#[derive(Debug)]
pub struct FrameFolder {
    path: PathBuf,
    size: Size,
    run: FolderRun,
    /// Number of frames that the manifest names.
    named: u64,
    _lock: FolderLock,
}

impl FrameFolder {
    /// Opens `path` for the frames of `size` of `run`: a new folder, or one of an interrupted run with the
    /// same settings, inputs and version of the program. It stays locked until it is dropped.
    ///
    /// # Errors
    /// [`Error`] if the folder holds something else or frames of another run, or if a run is writing into it.
    pub fn open(path: &Path, size: Size, run: FolderRun, overwrite: Overwrite) -> Result<Self> {
        let io = |e| Error::io("create the output", path, e);
        if !path.exists() {
            std::fs::create_dir(path).map_err(io)?;
        }
        let manifest = path.join(MANIFEST);
        if !manifest.is_file() {
            let foreign = std::fs::read_dir(path).map_err(io)?.flatten().find_map(|entry| {
                let name = entry.file_name().to_string_lossy().into_owned();
                (!name.starts_with('.')).then_some(name)
            });
            if let Some(name) = foreign {
                return Err(Error::data(
                    format!(
                        "the output exists and was not made by this program (no {MANIFEST} beside `{name}` in it)"
                    ),
                    path,
                    "choose another name, or remove it yourself",
                ));
            }
        }
        let lock = FolderLock::take(path, run.share)?;
        let named = run.frames.unwrap_or(MIN_NAMED);
        let folder = Self { path: path.to_owned(), size, run, named, _lock: lock };
        if !manifest.is_file() {
            folder.write_manifest(false, &Value::Null)?;
            return Ok(folder);
        }
        let found = read_manifest(&manifest)?;
        if overwrite == Overwrite::Yes {
            if folder.run.share != Share::Whole {
                return Err(Error::data(
                    "starting over with one part would remove the frames of the others",
                    path,
                    "start over without parts, or remove the folder yourself",
                ));
            }
            folder.clear(&found)?;
            folder.write_manifest(false, &Value::Null)?;
            return Ok(folder);
        }
        folder.check(&found)?;
        Ok(folder)
    }

    /// Refuses the frames of another run, with the difference.
    fn check(&self, found: &Value) -> Result<()> {
        let refuse = |what: String| {
            Err(Error::data(
                what,
                &self.path,
                "choose another name, go on with the old settings, or start over with `force`",
            ))
        };
        let (was, is) = (found["program"].as_str().unwrap_or_default(), program());
        if was != is {
            return refuse(format!("frames made by {was} lie there, and this is {is}"));
        }
        if let Some((key, was, is)) = difference(&found["settings"], &written(&self.run.settings)) {
            return refuse(format!(
                "frames made with other settings lie there: {key} was {was}, now {is}"
            ));
        }
        let Ok(earlier) = serde_json::from_value::<Inputs>(found["inputs"].clone()) else {
            // Manifests of old do not note their inputs; what is complete is only read.
            if found["complete"] == Value::Bool(true) || self.run.inputs == Inputs::default() {
                return Ok(());
            }
            return refuse(format!("{MANIFEST} does not say which data the frames there are of"));
        };
        if let Some((option, was, is)) = self.run.inputs.difference(&earlier) {
            return refuse(format!(
                "frames made from other data lie there: `{option}` was {was}, now {is}"
            ));
        }
        Ok(())
    }

    /// Returns the file of a frame.
    pub fn file(&self, frame: u64) -> PathBuf {
        self.path.join(frame_name(frame))
    }

    /// Returns how many frames from the start of `range` on are finished.
    pub fn finished(&self, range: Range<u64>) -> u64 {
        range.clone().take_while(|&frame| self.file(frame).is_file()).count() as u64
    }

    /// Writes a frame, and returns it as a reader of the file will see it.
    ///
    /// # Errors
    /// [`Error::Io`] if the disk is full.
    pub fn push(&mut self, frame: u64, image: &Frame) -> Result<Frame> {
        self.write(frame, encode_png16(image))?;
        let seen = |v: &f32| (v.clamp(0.0, 1.0) * 65535.0).round() / 65535.0;
        Ok(Frame { size: self.size, data: image.data.iter().map(seen).collect() })
    }

    /// Writes a frame of red, green and blue.
    ///
    /// # Errors
    /// [`Error::Io`] if the disk is full.
    pub fn push_colour(&mut self, frame: u64, planes: &[Frame; 3]) -> Result<()> {
        self.write(frame, encode_colour_png16(planes))
    }

    fn write(&mut self, frame: u64, png: std::io::Result<Vec<u8>>) -> Result<()> {
        if frame >= self.named {
            self.named = 2 * (frame + 1);
            self.write_manifest(false, &Value::Null)?;
        }
        let path = self.file(frame);
        let png = png.map_err(|e| Error::io("write", &path, e))?;
        let mut file = PendingFile::create(&path, Overwrite::Yes)?;
        file.write_all(&png).map_err(|e| file.fault(e))?;
        file.finish_unsynced()
    }

    /// Reads a finished frame.
    ///
    /// # Errors
    /// [`Error`] if it is damaged or has another size.
    pub fn read(&self, frame: u64) -> Result<Frame> {
        let path = self.file(frame);
        let image = read_still(&path, Transfer::AsIs)?;
        if image.size != self.size {
            return Err(Error::data(
                format!("a frame of {} among frames of {}", image.size, self.size),
                &path,
                "it is not of this run: start over with `force`",
            ));
        }
        Ok(image)
    }

    /// Marks the run as complete in the manifest, with `results`.
    ///
    /// # Errors
    /// [`Error::Io`] if the disk is full.
    pub fn finish(&mut self, results: &Value) -> Result<()> {
        if self.run.frames.is_none() {
            self.named = self.finished(0..u64::MAX);
        }
        self.write_manifest(true, results)
    }

    fn write_manifest(&self, complete: bool, results: &Value) -> Result<()> {
        let manifest = json!({
            "version": 1,
            "program": program(),
            "complete": complete,
            "frames": self.named,
            "settings": self.run.settings,
            "inputs": self.run.inputs,
            "results": results,
            "crc32": BLANK,
        });
        let text = format!("{manifest:#}\n");
        let text = text.replacen(&checksum_entry(BLANK), &checksum_entry(&checksum(&text)), 1);
        PendingFile::write_whole(&self.path.join(MANIFEST), text.as_bytes(), Overwrite::Yes)
    }

    /// Removes the frames that the manifest `found` names, and nothing else.
    fn clear(&self, found: &Value) -> Result<()> {
        let io = |e| Error::io("clear the output", &self.path, e);
        let named = found["frames"].as_u64().unwrap_or(0);
        let mut own = Vec::new();
        for entry in std::fs::read_dir(&self.path).map_err(io)? {
            let path = entry.map_err(io)?.path();
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            if is_frame_below(&name, named) {
                own.push(path);
            } else if is_frame_name(&name) {
                return Err(Error::data(
                    format!("the output holds `{name}`, which its {MANIFEST} does not name"),
                    &self.path,
                    "choose another name, or move that file away",
                ));
            }
        }
        own.iter().try_for_each(std::fs::remove_file).map_err(io)
    }
}

/// Stands for the checksum while it is computed.
const BLANK: &str = "--------";

/// Computes the CRC-32 of a manifest whose own checksum is blank.
fn checksum(text: &str) -> String {
    format!("{:08x}", crc32fast::hash(text.as_bytes()))
}

/// Returns false if the checksum in a manifest is not its content's. Where there is none, nothing is checked.
fn is_whole(text: &[u8], manifest: &Value) -> bool {
    let (Some(own), Ok(text)) = (manifest["crc32"].as_str(), std::str::from_utf8(text)) else {
        return true;
    };
    checksum(&text.replacen(&checksum_entry(own), &checksum_entry(BLANK), 1)) == own
}

/// Returns the entry of a checksum in a manifest.
fn checksum_entry(checksum: &str) -> String {
    format!("\"crc32\": \"{checksum}\"")
}

fn read_manifest(path: &Path) -> Result<Value> {
    let fault =
        |what: String| Error::data(what, path, "choose another output, or remove it yourself");
    let text = read_limited(path, RECORD_BYTES, "read the manifest")?;
    let manifest: Value =
        serde_json::from_slice(&text).map_err(|e| fault(format!("not a manifest: {e}")))?;
    let ours = manifest["program"].as_str().is_some_and(|program| program.starts_with("qudi "))
        && manifest["settings"].is_object();
    if ours && manifest["program"] == program().as_str() && !is_whole(&text, &manifest) {
        return Err(fault("its checksum does not fit its content: it is damaged".to_owned()));
    }
    if ours {
        return Ok(manifest);
    }
    Err(Error::data(
        format!("the output exists, and its {MANIFEST} is of no restoration by this program"),
        path,
        "choose another name, or remove it yourself",
    ))
}

/// Returns the program and its version, as the manifest notes it.
fn program() -> String {
    format!("qudi {}", env!("CARGO_PKG_VERSION"))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: Size = Size { height: 3, width: 4 };

    fn run(settings: Value) -> FolderRun {
        FolderRun { settings, inputs: Inputs::default(), share: Share::Whole, frames: Some(5) }
    }

    fn image() -> Frame {
        Frame::from_fn(SIZE, |x, y| (x + y) as f32 / 7.3)
    }

    #[test]
    fn numbers_that_are_read_with_another_last_bit_are_equal() {
        let folder = tempfile::tempdir().unwrap();
        let settings =
            json!({"exposure": 0.433_395_034_419_726_04_f64, "ppp": 4.522_505_326_704_543_f64});
        for _ in 0..3 {
            let path = folder.path().join("out");
            FrameFolder::open(&path, SIZE, run(settings.clone()), Overwrite::No).unwrap();
        }
    }

    #[test]
    fn resumes_with_equal_settings_and_refuses_others() {
        let scratch = tempfile::tempdir().unwrap();
        let path = scratch.path().join("out");
        let settings = json!({"method": "mle", "sensor": {"dark": 1.6}});
        let open = |settings: &Value, overwrite| {
            FrameFolder::open(&path, SIZE, run(settings.clone()), overwrite)
        };
        let mut folder = open(&settings, Overwrite::No).unwrap();
        let seen = folder.push(0, &image()).unwrap();
        folder.push(2, &image()).unwrap();
        drop(folder);
        let again = open(&settings, Overwrite::No).unwrap();
        assert_eq!((again.finished(0..5), again.finished(2..5)), (1, 1));
        assert_eq!(again.read(0).unwrap(), seen, "push returns what is read");
        drop(again);
        let other = json!({"method": "mle", "sensor": {"dark": 1.5}});
        let words = open(&other, Overwrite::No).unwrap_err().to_string();
        assert!(words.contains("sensor.dark was 1.6, now 1.5"), "{words}");
        std::fs::write(path.join("notes.txt"), "mine").unwrap();
        let fresh = open(&other, Overwrite::Yes).unwrap();
        assert_eq!(fresh.finished(0..5), 0);
        assert!(path.join("notes.txt").is_file(), "only our own files are removed");
    }

    #[test]
    fn removes_only_frames_that_the_manifest_names() {
        let scratch = tempfile::tempdir().unwrap();
        let path = scratch.path().join("out");
        let open = |frames| {
            let run = FolderRun { frames, ..run(json!({})) };
            FrameFolder::open(&path, SIZE, run, Overwrite::Yes)
        };
        open(None).unwrap().push(MIN_NAMED + 1, &image()).unwrap();
        assert_eq!(open(Some(2)).unwrap().finished(MIN_NAMED + 1..MIN_NAMED + 2), 0);
        std::fs::write(path.join("frame_000002.png"), "mine").unwrap();
        let words = open(Some(2)).unwrap_err().to_string();
        assert!(words.contains("frame_000002.png"), "{words}");
        assert!(path.join("frame_000002.png").is_file());
    }

    /// A link that lies where a frame is written is replaced, not followed.
    #[cfg(unix)]
    #[test]
    fn follows_no_link_that_lies_in_the_folder() {
        let scratch = tempfile::tempdir().unwrap();
        let (path, victim) = (scratch.path().join("out"), scratch.path().join("victim"));
        std::fs::write(&victim, "theirs").unwrap();
        let mut folder = FrameFolder::open(&path, SIZE, run(json!({})), Overwrite::No).unwrap();
        for name in [".frame_000000.png", "frame_000000.png"] {
            std::os::unix::fs::symlink(&victim, path.join(name)).unwrap();
        }
        folder.push(0, &image()).unwrap();
        assert_eq!(std::fs::read(&victim).unwrap(), b"theirs");
        assert!(!path.join("frame_000000.png").is_symlink());
    }

    #[test]
    fn resumes_manifests_with_former_values() {
        let scratch = tempfile::tempdir().unwrap();
        let path = scratch.path().join("out");
        let open = |settings: Value| {
            FrameFolder::open(&path, SIZE, run(settings), Overwrite::No).map(drop)
        };
        open(json!({"method": "guide", "network": {"spacing": "learnt"}})).unwrap();
        open(json!({"method": "qbp-refined", "network": {"spacing": "log-logistic"}})).unwrap();
        assert!(open(json!({"method": "mle", "network": {"spacing": "log-logistic"}})).is_err());
        assert!(open(json!({"method": "qbp-refined", "network": {"spacing": "linear"}})).is_err());
    }

    #[test]
    fn leaves_folders_and_manifests_of_others_alone() {
        let scratch = tempfile::tempdir().unwrap();
        let foreign = scratch.path().join("foreign");
        std::fs::create_dir(&foreign).unwrap();
        std::fs::write(foreign.join("frame_000000.png"), "theirs").unwrap();
        let open = || FrameFolder::open(&foreign, SIZE, run(json!({})), Overwrite::Yes);
        let words = open().unwrap_err().to_string();
        assert!(words.contains("frame_000000.png"), "{words}");
        std::fs::write(foreign.join(MANIFEST), r#"{"name": "a web page"}"#).unwrap();
        let words = open().unwrap_err().to_string();
        assert!(words.contains("of no restoration"), "{words}");
        assert!(foreign.join("frame_000000.png").is_file());
    }

    #[test]
    fn refuses_to_resume_with_another_capture() {
        let scratch = tempfile::tempdir().unwrap();
        let (path, capture) = (scratch.path().join("out"), scratch.path().join("a.npy"));
        let open = |bytes: &[u8]| {
            std::fs::write(&capture, bytes).unwrap();
            let mut inputs = Inputs::default();
            inputs.add("capture", &capture).unwrap();
            FrameFolder::open(&path, SIZE, FolderRun { inputs, ..run(json!({})) }, Overwrite::No)
        };
        drop(open(b"one").unwrap());
        drop(open(b"one").unwrap());
        let words = open(b"two").unwrap_err().to_string();
        assert!(words.contains("`capture` was 3 bytes with CRC-32"), "{words}");
    }

    #[test]
    fn refuses_damaged_manifests() {
        let scratch = tempfile::tempdir().unwrap();
        let path = scratch.path().join("out");
        let open = || FrameFolder::open(&path, SIZE, run(json!({"ppp": 3.25})), Overwrite::No);
        drop(open().unwrap());
        let manifest = std::fs::read_to_string(path.join(MANIFEST)).unwrap();
        let other = manifest.replace("\"frames\": 5", "\"frames\": 4");
        assert_ne!(manifest, other);
        std::fs::write(path.join(MANIFEST), other).unwrap();
        let words = open().unwrap_err().to_string();
        assert!(words.contains("checksum"), "{words}");
        std::fs::write(path.join(MANIFEST), manifest).unwrap();
        assert!(open().is_ok());
    }

    #[test]
    fn refuses_to_resume_frames_of_another_version() {
        let scratch = tempfile::tempdir().unwrap();
        let path = scratch.path().join("out");
        let open = || FrameFolder::open(&path, SIZE, run(json!({})), Overwrite::No);
        drop(open().unwrap());
        let manifest = std::fs::read_to_string(path.join(MANIFEST)).unwrap();
        let older = manifest.replace(&program(), "qudi 0.0.1");
        std::fs::write(path.join(MANIFEST), older).unwrap();
        let words = open().unwrap_err().to_string();
        assert!(words.contains("made by qudi 0.0.1"), "{words}");
    }

    #[test]
    fn reads_complete_manifests_that_note_no_inputs() {
        let scratch = tempfile::tempdir().unwrap();
        let (path, capture) = (scratch.path().join("out"), scratch.path().join("a.npy"));
        std::fs::create_dir(&path).unwrap();
        std::fs::write(&capture, "counts").unwrap();
        let mut inputs = Inputs::default();
        inputs.add("capture", &capture).unwrap();
        let open = |complete: bool| {
            let manifest = json!({
                "version": 1, "program": program(), "complete": complete, "settings": {}, "results": null,
            });
            std::fs::write(path.join(MANIFEST), manifest.to_string()).unwrap();
            let run = FolderRun { inputs: inputs.clone(), ..run(json!({})) };
            FrameFolder::open(&path, SIZE, run, Overwrite::No)
        };
        assert!(open(true).is_ok());
        assert!(open(false).is_err());
    }

    #[test]
    fn locks_whole_runs_and_equal_parts_against_each_other() {
        let scratch = tempfile::tempdir().unwrap();
        let path = scratch.path().join("out");
        let open = |share| {
            FrameFolder::open(&path, SIZE, FolderRun { share, ..run(json!({})) }, Overwrite::No)
        };
        let part = |number| Share::Part { number, of: 2 };
        let whole = open(Share::Whole).unwrap();
        assert!(open(Share::Whole).is_err() && open(part(1)).is_err());
        drop(whole);
        let first = open(part(1)).unwrap();
        assert!(open(part(1)).is_err() && open(Share::Whole).is_err());
        let second = open(part(2)).unwrap();
        drop((first, second));
        assert!(open(Share::Whole).is_ok());
    }
}
