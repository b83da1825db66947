//! Pictures that play on a page: frames of several methods under one slider, moved by `templates/player.js`.

use super::html::{TableView, data_url};
use jpeg_encoder::{ColorType, Encoder};
use qudi_core::{Frame, Size};
use serde::Serialize;
use std::collections::BTreeSet;

/// JPEG quality of pictures: their errors are smaller than the errors of the methods.
pub(crate) const QUALITY: u8 = 90;

/// JPEG quality of maps: their colours are coarser than grays.
const MAP_QUALITY: u8 = 75;

/// End of the key of uncertainty, in image values.
pub(crate) const MAX_UNCERTAINTY: f32 = 0.125;

/// End of the key of errors, in image values.
const MAX_ERROR: f32 = 0.25;

/// Pixels of all frames of a layer at most, so that a page stays small.
const MAX_LAYER_PIXELS: usize = 6_000_000;

/// Frames of a layer at most.
pub(crate) const MAX_FRAMES: u64 = 60;

/// A scene as a page shows it.
pub(crate) struct Scene {
    pub(crate) title: String,
    /// Sentences above the pictures.
    pub(crate) caption: Vec<String>,
    pub(crate) size: Size,
    /// Number of frames that can be looked at.
    pub(crate) frames: u64,
    /// Numbers of the frames in the capture, where they do not count from 0.
    pub(crate) numbers: Option<Vec<u64>>,
    /// Number of frames of the capture, where more than `frames`.
    pub(crate) total: Option<u64>,
    pub(crate) layers: Vec<Layer>,
    /// Layers that are shown first, by number.
    pub(crate) left: usize,
    pub(crate) right: usize,
    /// Drawing of light and change over time: an SVG of ours, whose text is escaped.
    pub(crate) strip: Option<String>,
    pub(crate) table: Option<TableView>,
    /// Sentences below the table.
    pub(crate) notes: Vec<String>,
}

/// The frames of one method, or another picture of the scene.
#[derive(Debug, Serialize)]
pub(crate) struct Layer {
    name: String,
    /// A few words under the name.
    #[serde(skip_serializing_if = "Option::is_none")]
    note: Option<String>,
    kind: Kind,
    /// End of the key of a map, and its description.
    #[serde(skip_serializing_if = "Option::is_none")]
    max: Option<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    meaning: Option<String>,
    /// Data URLs, one per frame; a single one stands for all frames.
    #[serde(skip_serializing_if = "Option::is_none")]
    frames: Option<Vec<String>>,
    /// Address of the frames, where they are served.
    #[serde(skip_serializing_if = "Option::is_none")]
    path: Option<String>,
}

/// The content of a layer. Restored layers have errors where the scene has a truth.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Kind {
    Counts,
    Restored,
    Truth,
    Map,
}

/// A scene as the template reads it.
#[derive(Debug, Serialize)]
pub(crate) struct Player {
    title: String,
    caption: Vec<String>,
    width: usize,
    height: usize,
    strip: Option<String>,
    table: Option<TableView>,
    notes: Vec<String>,
    /// The script's JSON document, in which nothing is markup.
    data: String,
}

/// A scene as the script reads it.
#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Data<'a> {
    width: usize,
    height: usize,
    frames: u64,
    numbers: &'a Option<Vec<u64>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    total: Option<u64>,
    layers: &'a [Layer],
    left: usize,
    right: usize,
    error_max: f32,
}

impl Scene {
    /// Creates a scene without layers, table or text.
    pub(crate) fn new(title: impl Into<String>, size: Size, frames: u64) -> Self {
        Self {
            title: title.into(),
            caption: Vec::new(),
            size,
            frames,
            numbers: None,
            total: None,
            layers: Vec::new(),
            left: 0,
            right: 0,
            strip: None,
            table: None,
            notes: Vec::new(),
        }
    }

    /// Returns the scene for the template `player.html`.
    pub(crate) fn player(self) -> Player {
        let Size { height, width } = self.size;
        let data = Data {
            width,
            height,
            frames: self.frames,
            numbers: &self.numbers,
            total: self.total,
            layers: &self.layers,
            left: self.left,
            right: self.right,
            error_max: MAX_ERROR,
        };
        // Strings, numbers and lists always become JSON.
        let data = serde_json::to_string(&data).unwrap_or_default();
        Player {
            title: self.title,
            caption: self.caption,
            width,
            height,
            strip: self.strip,
            table: self.table,
            notes: self.notes,
            data: without_markup(&data),
        }
    }
}

impl Layer {
    /// Creates a layer of pictures in the page.
    pub(crate) fn new(name: impl Into<String>, kind: Kind, frames: Vec<String>) -> Self {
        let frames = Some(frames);
        Self { name: name.into(), note: None, kind, max: None, meaning: None, frames, path: None }
    }

    /// Creates a layer whose frames are served under an address.
    pub(crate) fn served(name: impl Into<String>, kind: Kind, path: String) -> Self {
        Self { frames: None, path: Some(path), ..Self::new(name, kind, Vec::new()) }
    }

    /// Makes it a map: values in colours, of which white in the pictures is `max`.
    pub(crate) fn into_map(self, max: f32, meaning: &str) -> Self {
        Self { kind: Kind::Map, max: Some(max), meaning: Some(meaning.to_owned()), ..self }
    }

    /// Adds a few words under its name.
    pub(crate) fn with_note(self, note: impl Into<String>) -> Self {
        Self { note: Some(note.into()), ..self }
    }
}

/// Selects the frames of a capture of `frames` frames that a page shows: evenly spaced, as many as keep it
/// small. Returns the distance between them.
pub(crate) fn frame_distance(size: Size, frames: u64) -> u64 {
    let fitting = (MAX_LAYER_PIXELS / size.pixels().max(1)) as u64;
    frames.div_ceil(fitting.clamp(1, MAX_FRAMES)).max(1)
}

/// Encodes a picture as a JPEG data URL; 0 is black and 1 is white.
pub(crate) fn picture_url(frame: &Frame, quality: u8) -> String {
    data_url("jpeg", &jpeg(frame, quality))
}

/// Encodes red, green and blue of a picture as a JPEG data URL.
pub(crate) fn colour_url(planes: &[Frame; 3], quality: u8) -> String {
    data_url("jpeg", &colour_jpeg(planes, quality))
}

/// Encodes a map as a JPEG data URL, whose white is `max`.
pub(crate) fn map_url(map: &Frame, max: f32) -> String {
    let data = map.data.iter().map(|value| value / max).collect();
    picture_url(&Frame { size: map.size, data }, MAP_QUALITY)
}

/// Encodes counts as a data URL: as PNG, or as JPEG where that is smaller.
pub(crate) fn counts_url(frame: &Frame, quality: u8) -> String {
    let (png, jpeg) = (png(frame), jpeg(frame, quality));
    if png.len() <= jpeg.len() { data_url("png", &png) } else { data_url("jpeg", &jpeg) }
}

/// Encodes a frame as a gray JPEG.
pub(crate) fn jpeg(frame: &Frame, quality: u8) -> Vec<u8> {
    encoded(&samples(frame), frame.size, ColorType::Luma, quality)
}

/// Encodes red, green and blue as a JPEG.
pub(crate) fn colour_jpeg(planes: &[Frame; 3], quality: u8) -> Vec<u8> {
    let [red, green, blue] = planes.each_ref().map(samples);
    let pixels = red.into_iter().zip(green).zip(blue);
    let pixels: Vec<u8> = pixels.flat_map(|((red, green), blue)| [red, green, blue]).collect();
    encoded_rgb(&pixels, planes[0].size, quality)
}

/// Encodes red, green and blue samples as a JPEG.
pub(crate) fn encoded_rgb(samples: &[u8], size: Size, quality: u8) -> Vec<u8> {
    encoded(samples, size, ColorType::Rgb, quality)
}

fn encoded(samples: &[u8], size: Size, colour: ColorType, quality: u8) -> Vec<u8> {
    let mut jpeg = Vec::new();
    let mut encoder = Encoder::new(&mut jpeg, quality);
    encoder.set_optimized_huffman_tables(true);
    // Sides that no JPEG has leave the picture out; a missing one is seen on the page.
    if let (Ok(height), Ok(width)) = (u16::try_from(size.height), u16::try_from(size.width)) {
        let _ = encoder.encode(samples, width, height, colour);
    }
    jpeg
}

/// Encodes a frame as a gray PNG, for values that are few and unlike their neighbours: 16 values take 4 bits.
pub(crate) fn png(frame: &Frame) -> Vec<u8> {
    let samples = samples(frame);
    let levels: BTreeSet<u8> = samples.iter().copied().collect();
    let levels: Vec<u8> = levels.into_iter().collect();
    let Size { height, width } = frame.size;
    let mut png = Vec::new();
    let mut encoder = png::Encoder::new(&mut png, width as u32, height as u32);
    encoder.set_compression(png::Compression::High);
    encoder.set_filter(png::Filter::NoFilter);
    let data = if levels.len() <= 16 {
        encoder.set_color(png::ColorType::Indexed);
        encoder.set_depth(png::BitDepth::Four);
        encoder.set_palette(levels.iter().flat_map(|&level| [level; 3]).collect::<Vec<u8>>());
        let index = |sample: &u8| levels.partition_point(|level| level < sample) as u8;
        let pair = |pair: &[u8]| index(&pair[0]) << 4 | pair.get(1).map_or(0, index);
        samples.chunks(width).flat_map(|row| row.chunks(2).map(pair)).collect()
    } else {
        encoder.set_color(png::ColorType::Grayscale);
        encoder.set_depth(png::BitDepth::Eight);
        samples
    };
    // Writing to memory does not fail; a missing picture would be seen on the page.
    let _ = encoder.write_header().and_then(|mut writer| writer.write_image_data(&data));
    png
}

/// Divides counts by the largest one of their sensor.
pub(crate) fn counts_frame(size: Size, counts: &[u16], max_count: u16) -> Frame {
    let full = f32::from(max_count);
    Frame { size, data: counts.iter().map(|&count| f32::from(count) / full).collect() }
}

fn samples(frame: &Frame) -> Vec<u8> {
    frame.data.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect()
}

/// Escapes all characters of a JSON document that could end a script or begin markup.
fn without_markup(json: &str) -> String {
    let mut escaped = String::with_capacity(json.len());
    for character in json.chars() {
        match character {
            '<' | '>' | '&' | '\u{2028}' | '\u{2029}' => {
                escaped += &format!("\\u{:04x}", character as u32);
            }
            other => escaped.push(other),
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: Size = Size { height: 16, width: 24 };

    fn ramp() -> Frame {
        Frame::from_fn(SIZE, |x, y| (x + y) as f32 / 40.0)
    }

    #[test]
    fn nothing_in_the_document_is_markup() {
        let mut scene = Scene::new("</script><b>", SIZE, 1);
        let name = "</script><script>alert(1)</script>&\u{2028}";
        scene.layers = vec![Layer::new(name, Kind::Counts, vec![picture_url(&ramp(), QUALITY)])];
        let data = scene.player().data;
        assert!(!data.contains(['<', '>', '&', '\u{2028}']), "{data}");
        let read: serde_json::Value =
            serde_json::from_str(&data).unwrap_or_else(|e| panic!("{e}: {data}"));
        assert_eq!(read["layers"][0]["name"], name);
    }

    #[test]
    fn pictures_can_be_decoded() {
        for bytes in [jpeg(&ramp(), QUALITY), png(&ramp())] {
            let image = image::load_from_memory(&bytes).unwrap_or_else(|e| panic!("{e}"));
            let gray = image.to_luma8();
            assert_eq!(gray.dimensions(), (24, 16));
            assert!(gray.as_raw().iter().zip(samples(&ramp())).all(|(a, b)| a.abs_diff(b) < 12));
        }
    }

    #[test]
    fn few_levels_are_packed_exactly() {
        for (levels, width) in [(2, 24), (8, 23), (16, 1), (17, 24), (200, 9)] {
            let size = Size { height: 16, width };
            let value = |x: usize, y: usize| (x * 31 + y * 17) % levels;
            let frame = Frame::from_fn(size, |x, y| value(x, y) as f32 / (levels - 1) as f32);
            let image = image::load_from_memory(&png(&frame)).unwrap_or_else(|e| panic!("{e}"));
            assert_eq!(image.to_luma8().into_raw(), samples(&frame), "{levels} levels");
        }
    }

    #[test]
    fn counts_of_few_levels_are_png() {
        let noise = Frame::from_fn(Size { height: 64, width: 64 }, |x, y| {
            ((x * 7919 + y * 104_729 + x * y * 31) % 8) as f32 / 7.0
        });
        assert!(counts_url(&noise, QUALITY).starts_with("data:image/png"));
        assert!(picture_url(&noise, QUALITY).starts_with("data:image/jpeg"));
    }

    #[test]
    fn long_captures_are_thinned() {
        let size = Size { height: 256, width: 256 };
        assert_eq!(frame_distance(size, 11), 1);
        assert_eq!(frame_distance(size, 60), 1);
        assert_eq!(frame_distance(size, 61), 2);
        assert_eq!(frame_distance(Size { height: 1024, width: 1024 }, 11), 3);
        assert_eq!(frame_distance(Size { height: 10_000, width: 10_000 }, 5), 5);
        assert_eq!(frame_distance(size, 0), 1);
    }
}
