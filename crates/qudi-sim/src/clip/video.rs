//! Any video, decoded by the `ffmpeg` program on PATH.

use super::FrameReader;
use super::ppm::PpmStream;
use qudi_core::Transfer;
use qudi_core::ffmpeg;
use qudi_core::regular_file::open_regular;
use qudi_core::{Error, Result};
use qudi_core::{Frame, Size};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Stdio};

/// Frames of a video, decoded by `ffmpeg`.
pub struct Video {
    child: Child,
    /// Standard error of ffmpeg; a file, since a full pipe would block it.
    words: File,
    frames: PpmStream<BufReader<ChildStdout>>,
    path: PathBuf,
}

impl std::fmt::Debug for Video {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Video").finish_non_exhaustive()
    }
}

impl Video {
    /// Starts `ffmpeg` on the file at `path`.
    ///
    /// # Errors
    /// [`Error`] if `ffmpeg` is missing or cannot decode it.
    pub fn open(path: &Path, transfer: Transfer) -> Result<Self> {
        // Opened here first, so that ffmpeg neither reports a missing file nor waits for a pipe.
        open_regular(path, "open the video")?;
        let scratch = |e| Error::io("make a temporary file for ffmpeg's messages", path, e);
        let mut words = tempfile::tempfile().map_err(scratch)?;
        // `file:` keeps ffmpeg from taking the name for a URL or an option.
        let mut url = std::ffi::OsString::from("file:");
        url.push(path);
        let spawned = ffmpeg()
            .args(["-nostdin", "-v", "error", "-i"])
            .arg(url)
            .args([
                "-map",
                "0:v:0",
                "-fps_mode",
                "passthrough",
                "-pix_fmt",
                "rgb24",
                "-c:v",
                "ppm",
                "-f",
                "image2pipe",
                "-",
            ])
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(words.try_clone().map_err(scratch)?)
            .spawn();
        let mut child = spawned.map_err(|e| match e.kind() {
            std::io::ErrorKind::NotFound => Error::data(
                "videos are decoded by ffmpeg, and there is no `ffmpeg` on PATH",
                path,
                "install ffmpeg (https://ffmpeg.org), or give a folder of PNG frames, a GIF or a Y4M file",
            ),
            _ => Error::io("start ffmpeg for the video", path, e),
        })?;
        let stdout = child.stdout.take().expect("stdout is piped");
        match PpmStream::open(BufReader::with_capacity(1 << 16, stdout), path, transfer) {
            Ok(Some(frames)) => Ok(Self { child, words, frames, path: path.to_owned() }),
            Ok(None) | Err(_) => Err(failed(&mut child, &mut words, path)),
        }
    }
}

/// Creates the error from ffmpeg's own messages.
fn failed(child: &mut Child, words: &mut File, path: &Path) -> Error {
    let _ = child.kill();
    let _ = child.wait();
    let mut text = Vec::new();
    // The last lines are enough; without them the error stands on its own.
    let length = words.seek(SeekFrom::End(0)).unwrap_or(0);
    let _ = words.seek(SeekFrom::Start(length.saturating_sub(4096)));
    let _ = words.take(4096).read_to_end(&mut text);
    let text = String::from_utf8_lossy(&text);
    let reason = text.lines().next_back().unwrap_or("no video frames in it").trim().to_owned();
    Error::data(
        format!("ffmpeg cannot decode the file: {reason}"),
        path,
        "check that it is a video; `ffmpeg -i FILE` tells what ffmpeg sees in it",
    )
}

impl FrameReader for Video {
    fn size(&self) -> Size {
        self.frames.size()
    }

    fn frames(&self) -> Option<u64> {
        None
    }

    fn next(&mut self) -> Result<Option<Frame>> {
        let frame = self.frames.next()?;
        if frame.is_none() {
            let status =
                self.child.wait().map_err(|e| Error::io("wait for ffmpeg", &self.path, e))?;
            if !status.success() {
                return Err(failed(&mut self.child, &mut self.words, &self.path));
            }
        }
        Ok(frame)
    }
}

impl Drop for Video {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
