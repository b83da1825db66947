//! Frames as a page asks for them: counts and restored frames, encoded, the latest ones kept.

use super::args::View;
use super::server::Answer;
use crate::args::Global;
use crate::colour::{Rendering, encoded};
use crate::commands::restore::on_demand::OnDemand;
use crate::error::{CliError, Result};
use crate::methods::{METHODS, Method};
use crate::report::Report;
use crate::report::player::{Kind, Layer, QUALITY, colour_jpeg, jpeg};
use crate::settings::Settings;
use qudi_core::{Frame, linear_to_srgb};
use qudi_io::restore::RestoreSink;
use std::collections::{BTreeMap, HashMap, VecDeque};
use std::sync::Arc;

/// Bytes of encoded frames that are kept.
const MAX_KEPT_BYTES: usize = 64 << 20;

/// Frames that are restored together where frames are looked at one after the other.
const RUN_LENGTH: u64 = 8;

/// The layer of counts.
const COUNTS: &str = "counts";

/// The methods next to the default one.
const OTHERS: [&str; 4] = ["average", "mle", "qbp-bm3d", "qbp-refined"];

/// A capture, and the methods that restore it when their frames are looked at.
pub(super) struct Frames<'a> {
    view: &'a View,
    settings: &'a Settings,
    global: &'a Global,
    report: &'a Report,
    /// The default method of the capture.
    default: &'static str,
    /// The capture as each method reads it, by name.
    opened: BTreeMap<&'static str, OnDemand>,
    kept: Kept,
}

impl<'a> Frames<'a> {
    /// Opens the capture for its default method.
    pub(super) fn open(
        view: &'a View,
        settings: &'a Settings,
        global: &'a Global,
        report: &'a Report,
    ) -> Result<Self> {
        let first = OnDemand::new(&view.restore(None), settings, global, report)?;
        let default = first.method();
        let opened = BTreeMap::from([(default, first)]);
        Ok(Self { view, settings, global, report, default, opened, kept: Kept::default() })
    }

    /// Returns the capture as its default method reads it.
    pub(super) fn first(&self) -> &OnDemand {
        &self.opened[self.default]
    }

    /// Returns the layers of the page: counts, methods, the default one last.
    pub(super) fn layers(&self) -> Vec<Layer> {
        let layer = |name: &str, kind| Layer::served(name, kind, format!("frame/{name}"));
        let methods = OTHERS.into_iter().filter(|name| *name != self.default);
        let methods = methods.chain([self.default]).map(|name| layer(name, Kind::Restored));
        std::iter::once(layer(COUNTS, Kind::Counts)).chain(methods).collect()
    }

    /// Returns a frame of a layer.
    pub(super) fn get(&mut self, layer: &str, frame: u64) -> Answer {
        match self.find(layer, frame) {
            Ok(Some(jpeg)) => Answer::Jpeg(jpeg),
            Ok(None) => Answer::Unknown,
            Err(CliError::Error { what, help, .. }) => {
                Answer::Failed(help.map_or(what.clone(), |help| format!("{what}: {help}")))
            }
            Err(other) => Answer::Failed(format!("{other:?}")),
        }
    }

    /// Finds or restores a frame; none if there is no such layer or frame.
    fn find(&mut self, layer: &str, frame: u64) -> Result<Option<Arc<Vec<u8>>>> {
        let method = match layer {
            COUNTS => self.default,
            name if name == self.default => self.default,
            name => match OTHERS.into_iter().find(|other| *other == name) {
                Some(name) => name,
                None => return Ok(None),
            },
        };
        if frame >= self.first().pictures() {
            return Ok(None);
        }
        if let Some(kept) = self.kept.get(layer, frame) {
            return Ok(Some(kept));
        }
        let tone = Tone { is_display: self.first().is_simulated() };
        let previous = frame.checked_sub(1).is_some_and(|n| self.kept.get(layer, n).is_some());
        let report = self.report;
        let restorer = self.opened(method)?;
        let rendering = restorer.rendering();
        // Methods that align sums may make one picture less than others.
        let picture = frame.min(restorer.pictures().saturating_sub(1));
        if layer == COUNTS {
            let counts = restorer.counts(picture)?;
            self.kept.insert(layer, frame, tone.encode(&counts));
        } else {
            let length = if previous { RUN_LENGTH } else { 1 };
            let end = (picture + length).min(restorer.pictures());
            let mut encoded = Encoded { tone, rendering, frames: Vec::new() };
            restorer.restore(picture..end, &mut encoded, report)?;
            for (n, jpeg) in (frame..).zip(encoded.frames) {
                self.kept.insert(layer, n, jpeg);
            }
        }
        Ok(self.kept.get(layer, frame))
    }

    /// Returns the capture as a method reads it, opened when it is first looked at.
    fn opened(&mut self, method: &'static str) -> Result<&mut OnDemand> {
        if !self.opened.contains_key(method) {
            let method = Method::by_name(method).unwrap_or(&METHODS[0]);
            let args = self.view.restore(Some(method));
            let opened = OnDemand::new(&args, self.settings, self.global, self.report)?;
            self.opened.insert(method.name, opened);
        }
        self.opened
            .get_mut(method)
            .ok_or_else(|| CliError::new("a method is missing", method, "report this as a bug"))
    }
}

/// How frames become pictures: brightened for the eye, unless they came from such pictures.
#[derive(Clone, Copy)]
struct Tone {
    is_display: bool,
}

impl Tone {
    fn encode(self, frame: &Frame) -> Vec<u8> {
        if self.is_display {
            return jpeg(frame, QUALITY);
        }
        let data = frame.data.iter().map(|value| linear_to_srgb(value.max(0.0))).collect();
        jpeg(&Frame { size: frame.size, data }, QUALITY)
    }
}

/// Restored frames, encoded as they come.
struct Encoded {
    tone: Tone,
    rendering: Option<Rendering>,
    frames: Vec<Vec<u8>>,
}

impl RestoreSink for Encoded {
    fn frame(&mut self, _: u64, restored: &Frame, _: &[u16]) -> qudi_core::Result<()> {
        self.frames.push(self.tone.encode(restored));
        Ok(())
    }

    fn colour(&mut self, _: u64, restored: &[Frame; 3], _: &[u16]) -> qudi_core::Result<()> {
        let rendered = self.rendering.as_ref().map(|rendering| rendering.rendered(restored));
        let shown = encoded(rendered.as_ref().unwrap_or(restored));
        self.frames.push(colour_jpeg(&shown, QUALITY));
        Ok(())
    }
}

/// Encoded frames by layer and number, of which the oldest are dropped.
#[derive(Default)]
struct Kept {
    bytes: usize,
    order: VecDeque<(String, u64)>,
    frames: HashMap<(String, u64), Arc<Vec<u8>>>,
}

impl Kept {
    fn get(&self, layer: &str, frame: u64) -> Option<Arc<Vec<u8>>> {
        self.frames.get(&(layer.to_owned(), frame)).cloned()
    }

    fn insert(&mut self, layer: &str, frame: u64, jpeg: Vec<u8>) {
        let key = (layer.to_owned(), frame);
        self.bytes += jpeg.len();
        if let Some(before) = self.frames.insert(key.clone(), Arc::new(jpeg)) {
            self.bytes -= before.len();
        } else {
            self.order.push_back(key);
        }
        while self.bytes > MAX_KEPT_BYTES && self.order.len() > 1 {
            let Some(oldest) = self.order.pop_front() else { return };
            self.bytes -= self.frames.remove(&oldest).map_or(0, |jpeg| jpeg.len());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keeps_the_latest_frames_in_bounded_memory() {
        let mut kept = Kept::default();
        for frame in 0..20 {
            kept.insert("mle", frame, vec![0; 8 << 20]);
            kept.insert("mle", frame, vec![0; 8 << 20]);
        }
        assert_eq!(kept.bytes, MAX_KEPT_BYTES);
        assert!(kept.get("mle", 19).is_some() && kept.get("mle", 11).is_none());
        assert_eq!((kept.frames.len(), kept.order.len()), (8, 8));
    }
}
