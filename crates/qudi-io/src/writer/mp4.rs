//! MP4 through the `ffmpeg` program on PATH, for looking at: 8 bits, compressed.

use super::clip::Planes;
use qudi_core::atomic_file::{Overwrite, UnfinishedFolder, refuse_taken};
use qudi_core::ffmpeg;
use qudi_core::{Error, Result};
use qudi_core::{Frame, Size};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};

/// Name of the unfinished film in its folder.
const FILM: &str = "film.mp4";

/// Even sides and half-resolution colour, which players want, in the matrix of BT.709.
const FILTERS: &str = "scale=out_color_matrix=bt709:out_range=tv,pad=ceil(iw/2)*2:ceil(ih/2)*2";

/// What the film says of its colours: the primaries and the curve of sRGB, the matrix and range of BT.709.
/// Players guess what a film does not say, by its size.
const COLOUR_TAGS: [&str; 8] = [
    "-color_primaries",
    "bt709",
    "-color_trc",
    "iec61966-2-1",
    "-colorspace",
    "bt709",
    "-color_range",
    "tv",
];

/// A film being written.
#[derive(Debug)]
pub struct Mp4Writer {
    child: Child,
    /// Messages of ffmpeg; a file, since a full pipe would stop it.
    words: File,
    unfinished: UnfinishedFolder,
    path: PathBuf,
    overwrite: Overwrite,
}

impl Mp4Writer {
    /// Starts a film of frames of `size`, `fps` of them per second.
    ///
    /// # Errors
    /// [`Error`] if the name is taken or there is no ffmpeg.
    pub fn create(
        path: &Path,
        size: Size,
        planes: Planes,
        fps: f64,
        overwrite: Overwrite,
    ) -> Result<Self> {
        refuse_taken(path, overwrite)?;
        let io = |e| Error::io("create the output", path, e);
        let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let unfinished = UnfinishedFolder::create_in(folder).map_err(io)?;
        let words = tempfile::tempfile().map_err(io)?;
        // `file:` keeps ffmpeg from taking the name for a URL or an option.
        let mut url = std::ffi::OsString::from("file:");
        url.push(unfinished.path().join(FILM));
        let rate = fps.to_string();
        let pixels = if planes == Planes::Gray { "gray" } else { "rgb24" };
        let shape = format!("{}x{}", size.width, size.height);
        let spawned = ffmpeg()
            .args(["-nostdin", "-v", "error", "-y", "-f", "rawvideo", "-pix_fmt", pixels])
            .args(["-s", shape.as_str(), "-r", rate.as_str(), "-i", "-"])
            .args(["-vf", FILTERS, "-c:v", "libx264", "-crf", "16", "-pix_fmt", "yuv420p"])
            .args(COLOUR_TAGS)
            .args(["-movflags", "+faststart"])
            .arg(url)
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(words.try_clone().map_err(io)?)
            .spawn();
        let child = spawned.map_err(|e| match e.kind() {
            std::io::ErrorKind::NotFound => Error::data(
                "films are made by ffmpeg, and there is no `ffmpeg` on PATH",
                path,
                "install ffmpeg (https://ffmpeg.org), or write .gif, .npy or a folder",
            ),
            _ => Error::io("start ffmpeg for", path, e),
        })?;
        Ok(Self { child, words, unfinished, path: path.to_owned(), overwrite })
    }

    /// Adds a frame.
    ///
    /// # Errors
    /// [`Error`] with ffmpeg's words if it has given up.
    pub fn push(&mut self, frame: &Frame) -> Result<()> {
        self.push_values(&frame.data)
    }

    /// Adds a frame of all its samples, pixel by pixel.
    pub(super) fn push_values(&mut self, values: &[f32]) -> Result<()> {
        let bytes: Vec<u8> =
            values.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
        let Some(stdin) = &mut self.child.stdin else { return Err(self.failed()) };
        match stdin.write_all(&bytes) {
            Ok(()) => Ok(()),
            Err(_) => Err(self.failed()),
        }
    }

    /// Waits for ffmpeg and gives the film its name.
    ///
    /// # Errors
    /// [`Error`] if ffmpeg failed or the disk is full.
    pub fn finish(mut self) -> Result<()> {
        drop(self.child.stdin.take());
        let status =
            self.child.wait().map_err(|e| Error::io("wait for ffmpeg at", &self.path, e))?;
        if !status.success() {
            return Err(self.failed());
        }
        // A file that took the name since the start is kept.
        refuse_taken(&self.path, self.overwrite)?;
        std::fs::rename(self.unfinished.path().join(FILM), &self.path)
            .map_err(|e| Error::io("write", &self.path, e))
    }

    fn failed(&mut self) -> Error {
        let _ = self.child.kill();
        let _ = self.child.wait();
        let mut text = Vec::new();
        let _ = self.words.seek(SeekFrom::Start(0));
        let _ = (&mut self.words).take(4096).read_to_end(&mut text);
        let text = String::from_utf8_lossy(&text);
        let reason = text.lines().next().unwrap_or("it gave no reason").trim().to_owned();
        Error::data(
            format!("ffmpeg cannot write the film: {reason}"),
            &self.path,
            "an ffmpeg with libx264 is needed; or write .gif, .npy or a folder",
        )
    }
}

impl Drop for Mp4Writer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
