//! A folder of restored frames that survives being killed: finished frames stay, and a manifest
//! says how they were made, so that nothing else is mixed in.

use crate::writer::save_png16;
use qudi_core::Transfer;
use qudi_core::atomic_file::{Overwrite, PendingFile};
use qudi_core::{Frame, Size};
use qudi_core::{Result, SimError};
use qudi_sim::clip::read_still;
use serde_json::{Value, json};
use std::io::Write;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// The manifest's name; it also marks a folder as ours.
pub const MANIFEST: &str = "manifest.json";

/// Manifests are short; anything much larger is something else.
const MAX_MANIFEST: u64 = 1 << 24;

/// Restored frames as 16-bit PNG: `frame_000000.png`, ..., 65535 for 1.
#[derive(Debug)]
pub struct FrameFolder {
    path: PathBuf,
    size: Size,
    settings: Value,
}

impl FrameFolder {
    /// Opens `path` for frames of `size` made with `settings`: a new folder, or one of an
    /// interrupted run with the same settings.
    ///
    /// # Errors
    /// [`SimError`] if the folder holds something else, or frames made with other settings.
    pub fn open(path: &Path, size: Size, settings: Value, overwrite: Overwrite) -> Result<Self> {
        let io = |e| SimError::io("create the output", path, e);
        let folder = Self { path: path.to_owned(), size, settings };
        let manifest = path.join(MANIFEST);
        if !path.exists() {
            std::fs::create_dir(path).map_err(io)?;
            folder.write_manifest(false, &Value::Null)?;
            return Ok(folder);
        }
        if !manifest.is_file() {
            let empty = std::fs::read_dir(path).map_err(io)?.next().is_none();
            if empty {
                folder.write_manifest(false, &Value::Null)?;
                return Ok(folder);
            }
            return Err(SimError::data(
                format!("the output exists and was not made by this program (no {MANIFEST} in it)"),
                path,
                "choose another name, or remove it yourself",
            ));
        }
        let found = read_manifest(&manifest)?;
        let difference = difference(&found["settings"], &folder.settings);
        match (difference, overwrite) {
            (None, Overwrite::No) => {}
            (_, Overwrite::Yes) => {
                folder.clear()?;
                folder.write_manifest(false, &Value::Null)?;
            }
            (Some((key, was, is)), Overwrite::No) => {
                return Err(SimError::data(
                    format!("frames made with other settings lie there: {key} was {was}, now {is}"),
                    path,
                    "choose another name, go on with the old settings, or start over with --force",
                ));
            }
        }
        Ok(folder)
    }

    /// The file of a frame.
    pub fn file(&self, frame: u64) -> PathBuf {
        self.path.join(format!("frame_{frame:06}.png"))
    }

    /// How many frames from the start of `range` on are finished.
    pub fn finished(&self, range: Range<u64>) -> u64 {
        range.clone().take_while(|&frame| self.file(frame).is_file()).count() as u64
    }

    /// Writes a frame, and gives back what a reader of the file will see.
    ///
    /// # Errors
    /// [`SimError::Io`] if the disk is full.
    pub fn push(&self, frame: u64, image: &Frame) -> Result<Frame> {
        let path = self.file(frame);
        // The last run may have been killed between writing and renaming.
        let unfinished = self.path.join(format!(".frame_{frame:06}.png"));
        save_png16(image, &unfinished)
            .and_then(|()| std::fs::rename(&unfinished, &path))
            .map_err(|e| SimError::io("write", &path, e))?;
        let seen = |v: &f32| (v.clamp(0.0, 1.0) * 65535.0).round() / 65535.0;
        Ok(Frame { size: self.size, data: image.data.iter().map(seen).collect() })
    }

    /// Reads a finished frame.
    ///
    /// # Errors
    /// [`SimError`] if it is damaged or has another size.
    pub fn read(&self, frame: u64) -> Result<Frame> {
        let path = self.file(frame);
        let image = read_still(&path, Transfer::AsIs)?;
        if image.size != self.size {
            return Err(SimError::data(
                format!("a frame of {} among frames of {}", image.size, self.size),
                &path,
                "it is not of this run: start over with --force",
            ));
        }
        Ok(image)
    }

    /// Notes in the manifest that all is done, with `results`.
    ///
    /// # Errors
    /// [`SimError::Io`] if the disk is full.
    pub fn finish(&self, results: &Value) -> Result<()> {
        self.write_manifest(true, results)
    }

    fn write_manifest(&self, complete: bool, results: &Value) -> Result<()> {
        let manifest = json!({
            "version": 1,
            "program": format!("qudi {}", env!("CARGO_PKG_VERSION")),
            "complete": complete,
            "settings": self.settings,
            "results": results,
        });
        let mut file = PendingFile::create(&self.path.join(MANIFEST), Overwrite::Yes)?;
        serde_json::to_writer_pretty(&mut file, &manifest).map_err(|e| file.fault(e.into()))?;
        writeln!(file).map_err(|e| file.fault(e))?;
        file.finish()
    }

    /// Removes our own files, and nothing else.
    fn clear(&self) -> Result<()> {
        let io = |e| SimError::io("clear the output", &self.path, e);
        for entry in std::fs::read_dir(&self.path).map_err(io)? {
            let path = entry.map_err(io)?.path();
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let frame = name.trim_start_matches('.').strip_prefix("frame_");
            let ours = frame.and_then(|rest| rest.strip_suffix(".png")).is_some_and(|number| {
                number.len() >= 6 && number.chars().all(|c| c.is_ascii_digit())
            });
            if ours {
                std::fs::remove_file(&path).map_err(io)?;
            }
        }
        Ok(())
    }
}

fn read_manifest(path: &Path) -> Result<Value> {
    let read = |e| SimError::io("read the manifest", path, e);
    let fault = |what: String| SimError::data(what, path, "choose another output, or use --force");
    let length = std::fs::metadata(path).map_err(read)?.len();
    if length > MAX_MANIFEST {
        return Err(fault(format!("a manifest of {length} bytes")));
    }
    let text = std::fs::read(path).map_err(read)?;
    serde_json::from_slice(&text).map_err(|e| fault(format!("not a manifest: {e}")))
}

/// The first key whose value differs, with both values.
fn difference(was: &Value, is: &Value) -> Option<(String, String, String)> {
    match (was, is) {
        (Value::Object(was), Value::Object(is)) => {
            let keys = was.keys().chain(is.keys());
            keys.into_iter().find_map(|key| {
                let (was, is) = (was.get(key), is.get(key));
                let (was, is) = (was.unwrap_or(&Value::Null), is.unwrap_or(&Value::Null));
                let (below, was, is) = difference(was, is)?;
                let name = if below.is_empty() { key.clone() } else { format!("{key}.{below}") };
                Some((name, was, is))
            })
        }
        // A number may come back from text as another kind of number.
        (Value::Number(a), Value::Number(b)) if a.as_f64() == b.as_f64() => None,
        (was, is) if was == is => None,
        (was, is) => Some((String::new(), was.to_string(), is.to_string())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finished_frames_stay_and_other_settings_are_refused() {
        let scratch = tempfile::tempdir().unwrap();
        let path = scratch.path().join("out");
        let size = Size { height: 3, width: 4 };
        let settings = json!({"method": "mle", "sensor": {"dark": 1.6}});
        let open = |settings: &Value, overwrite| {
            FrameFolder::open(&path, size, settings.clone(), overwrite)
        };
        let folder = open(&settings, Overwrite::No).unwrap();
        let image = Frame::from_fn(size, |x, y| (x + y) as f32 / 7.3);
        let seen = folder.push(0, &image).unwrap();
        folder.push(2, &image).unwrap();
        let again = open(&settings, Overwrite::No).unwrap();
        assert_eq!((again.finished(0..5), again.finished(2..5)), (1, 1));
        assert_eq!(again.read(0).unwrap(), seen, "what was promised is what is read");
        let other = json!({"method": "mle", "sensor": {"dark": 1.5}});
        let words = open(&other, Overwrite::No).unwrap_err().to_string();
        assert!(words.contains("sensor.dark was 1.6, now 1.5"), "{words}");
        std::fs::write(path.join("notes.txt"), "mine").unwrap();
        let fresh = open(&other, Overwrite::Yes).unwrap();
        assert_eq!(fresh.finished(0..5), 0);
        assert!(path.join("notes.txt").is_file(), "only our own files are removed");
        let foreign = scratch.path().join("foreign");
        std::fs::create_dir(&foreign).unwrap();
        std::fs::write(foreign.join("x"), "y").unwrap();
        assert!(FrameFolder::open(&foreign, size, settings, Overwrite::Yes).is_err());
    }
}
