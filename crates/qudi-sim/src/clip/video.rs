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
        if video_stream(path)?.is_some_and(|stream| stream.is_interlaced) {
            return Err(Error::data(
                "an interlaced film: the lines of a frame belong to two instants",
                path,
                "deinterlace it first, as with `ffmpeg -i FILE -vf bwdif OUT.mkv`",
            ));
        }
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

/// A video stream as ffmpeg describes it.
#[derive(Clone, Debug, PartialEq)]
pub struct VideoStream {
    /// Name of the codec, as `ffv1`.
    pub codec: String,
    /// Name of the pixel format, as `gray16le`.
    pub pixels: String,
    /// True if each frame has lines of two instants.
    pub is_interlaced: bool,
}

impl VideoStream {
    /// Finds the first video stream in what `ffmpeg -i` prints:
    /// `Stream #0:0: Video: ffv1 (FFV1 / 0x31564646), gray16le(pc, top first), 96x64, ...`.
    fn parse(text: &str) -> Option<Self> {
        let line = text.lines().find_map(|line| line.split_once(": Video: "))?.1;
        // Commas in parentheses divide nothing.
        let mut depth = 0;
        let mut fields = line.split(|c: char| {
            depth += i32::from(c == '(') - i32::from(c == ')');
            c == ',' && depth == 0
        });
        let codec = fields.next()?.split_whitespace().next()?.to_owned();
        let format = fields.next()?.trim();
        let pixels = format.split('(').next()?.trim().to_owned();
        let is_interlaced = format.contains("top ") || format.contains("bottom ");
        Some(Self { codec, pixels, is_interlaced })
    }

    /// Returns the bits of a sample: `gray16le` has 16, `yuv420p10le` has 10, `rgb24` has 8.
    pub fn bits(&self) -> u32 {
        let plain = self.pixels.trim_end_matches("le").trim_end_matches("be");
        let digits = plain.rsplit(|c: char| !c.is_ascii_digit()).next().unwrap_or_default();
        let bits: u32 = digits.parse().unwrap_or(8);
        // Digits that are the bits of a pixel, or name a layout.
        let bits = match plain.trim_end_matches(|c: char| c.is_ascii_digit()) {
            "rgb" | "bgr" => bits / 3,
            "rgba" | "bgra" | "argb" | "abgr" => bits / 4,
            "nv" => 8,
            _ => bits,
        };
        if (9..=32).contains(&bits) { bits } else { 8 }
    }
}

/// Describes the video stream of the file at `path`; `None` if ffmpeg does not say.
///
/// # Errors
/// [`Error`] if it is no regular file.
pub fn video_stream(path: &Path) -> Result<Option<VideoStream>> {
    open_regular(path, "open the video")?;
    let mut url = std::ffi::OsString::from("file:");
    url.push(path);
    let output = ffmpeg().args(["-nostdin", "-hide_banner", "-i"]).arg(url).output();
    let text = output.map(|output| String::from_utf8_lossy(&output.stderr).into_owned());
    Ok(text.ok().as_deref().and_then(VideoStream::parse))
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn streams_have_codec_depth_and_fields() {
        let parse = |line: &str| {
            let stream = VideoStream::parse(&format!("x\n  Stream #0:0: Video: {line}\n")).unwrap();
            (stream.bits(), stream.codec, stream.is_interlaced)
        };
        let ffv1 = |bits| (bits, "ffv1".to_owned(), false);
        let line = "ffv1 (FFV1 / 0x31564646), gray16le(pc, gbr/unknown/unknown), 96x64, 25 fps";
        assert_eq!(parse(line), ffv1(16));
        assert_eq!(parse("ffv1, gray(pc), 96x64"), ffv1(8));
        assert_eq!(parse("ffv1, yuv420p10le, 96x64"), ffv1(10));
        assert_eq!(parse("ffv1, bgr0, 96x64"), ffv1(8));
        assert_eq!(parse("ffv1, rgb48le, 96x64"), ffv1(16));
        assert_eq!(parse("ffv1, nv12, 96x64"), ffv1(8));
        assert_eq!(parse("ffv1, uyvy422, 96x64"), ffv1(8));
        let line = "mpeg2video (Main), yuv420p(tv, bt470bg, top first), 720x576, 25 fps";
        assert_eq!(parse(line), (8, "mpeg2video".to_owned(), true));
        assert_eq!(VideoStream::parse("Stream #0:1: Audio: aac"), None);
    }
}
