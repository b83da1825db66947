//! A command that runs on a thread of its own, as a stream of messages.

use crate::errors::exception;
use crate::keywords::keywords;
use crate::source::Source;
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3::types::PyBytes;
use qudi_cli::{CliError, Listener, Message, Receiver};
use qudi_core::{Error, Frame};
use serde_json::Value;
use std::rc::Rc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver as Messages, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// Messages that may wait for Python: a thread that is ahead waits, so that memory holds a few frames.
const WAITING_MESSAGES: usize = 8;

/// Time between two looks for Ctrl-C.
const SIGNAL_PERIOD: Duration = Duration::from_millis(50);

/// What the thread has to say.
enum Event {
    /// Settings, and the number of frames if it is known.
    Start(Value, Option<u64>),
    /// Values of a frame; of colours, pixel by pixel.
    Frame(Vec<f32>),
    Sigma(Vec<f32>),
    Message(Message),
    /// The end, with the result of a restoration.
    End(Result<Option<Value>, CliError>),
}

/// A command on a thread of its own.
#[pyclass(frozen)]
pub(crate) struct Run {
    stop: Arc<AtomicBool>,
    messages: Mutex<Option<Messages<Event>>>,
    source: Option<Py<Source>>,
}

#[pymethods]
impl Run {
    /// Starts a command, given by its arguments. Frames of restorations are messages if `frames` is true;
    /// then `source` may replace the capture.
    #[new]
    #[pyo3(signature = (arguments, *, frames=false, source=None))]
    fn new(arguments: Vec<String>, frames: bool, source: Option<Py<Source>>) -> PyResult<Self> {
        let (sender, messages) = sync_channel(WAITING_MESSAGES);
        let stop = Arc::new(AtomicBool::new(false));
        let asked = stop.clone();
        let input = source.as_ref().map(|source| source.get().input());
        let work = move || {
            let teller = sender.clone();
            // Nobody listens to a command that was dropped; it stops by its flag.
            let listener: Listener =
                Rc::new(move |message| drop(teller.send(Event::Message(message))));
            let result = if frames {
                let mut receiver = Sender(sender.clone());
                qudi_cli::restore(&arguments, input, &asked, listener, &mut receiver).map(Some)
            } else {
                qudi_cli::call(&arguments, &asked, listener).map(|()| None)
            };
            drop(sender.send(Event::End(result)));
        };
        std::thread::Builder::new()
            .name("qudi".to_owned())
            .stack_size(16 << 20)
            .spawn(work)
            .map_err(|e| PyRuntimeError::new_err(format!("cannot start a thread: {e}")))?;
        Ok(Self { stop, messages: Mutex::new(Some(messages)), source })
    }

    /// Waits for the next message: its kind and its value. `None` comes after the last.
    fn next<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        loop {
            let event = py.detach(|| {
                let messages = self.messages.lock().unwrap_or_else(PoisonError::into_inner);
                let messages = messages.as_ref().ok_or(RecvTimeoutError::Disconnected)?;
                messages.recv_timeout(SIGNAL_PERIOD)
            });
            let event = match event {
                Ok(event) => event,
                Err(RecvTimeoutError::Timeout) => {
                    py.check_signals()?;
                    continue;
                }
                Err(RecvTimeoutError::Disconnected) if self.is_closed() => return Ok(None),
                Err(RecvTimeoutError::Disconnected) => {
                    self.close();
                    let text = "the command ended without a result: this is a mistake in qudi_spad";
                    return Err(PyRuntimeError::new_err(text));
                }
            };
            return self.translate(py, event).map(Some);
        }
    }

    /// Asks the command to stop, and waits until it has, for `seconds` at most; returns true if it has.
    fn stop(&self, py: Python<'_>, seconds: f64) -> bool {
        self.stop.store(true, Ordering::Relaxed);
        let limit = Duration::from_secs_f64(seconds.clamp(0.0, 1e6));
        let start = std::time::Instant::now();
        py.detach(|| {
            let mut messages = self.messages.lock().unwrap_or_else(PoisonError::into_inner);
            let Some(open) = messages.as_ref() else { return true };
            loop {
                match open.recv_timeout(limit.saturating_sub(start.elapsed())) {
                    Ok(Event::End(_)) | Err(RecvTimeoutError::Disconnected) => break,
                    Err(RecvTimeoutError::Timeout) => {
                        *messages = None;
                        return false;
                    }
                    Ok(_) => {}
                }
            }
            *messages = None;
            true
        })
    }
}

impl Run {
    fn is_closed(&self) -> bool {
        self.messages.lock().unwrap_or_else(PoisonError::into_inner).is_none()
    }

    fn close(&self) {
        *self.messages.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }

    fn translate<'py>(&self, py: Python<'py>, event: Event) -> PyResult<Bound<'py, PyAny>> {
        match event {
            Event::Start(settings, frames) => pair(py, "start", (settings.to_string(), frames)),
            Event::Frame(values) => pair(py, "frame", bytes(py, &values)),
            Event::Sigma(values) => pair(py, "sigma", bytes(py, &values)),
            Event::Message(Message::Note(text)) => pair(py, "note", keywords(&text)),
            Event::Message(Message::Warning(text)) => pair(py, "warning", keywords(&text)),
            Event::Message(Message::Progress { what, done, total }) => {
                pair(py, "progress", (what, done, total))
            }
            Event::Message(Message::Result(value)) => pair(py, "result", value.to_string()),
            Event::End(result) => {
                self.close();
                if let Some(raised) = self.source.as_ref().and_then(|s| s.get().raised()) {
                    return Err(raised);
                }
                pair(py, "end", result.map_err(exception)?.map(|value| value.to_string()))
            }
        }
    }
}

/// Returns the pair of a kind of message and its value.
fn pair<'py>(
    py: Python<'py>,
    kind: &str,
    value: impl IntoPyObject<'py>,
) -> PyResult<Bound<'py, PyAny>> {
    Ok((kind, value).into_pyobject(py)?.into_any())
}

impl Drop for Run {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
    }
}

fn bytes<'py>(py: Python<'py>, values: &[f32]) -> Bound<'py, PyBytes> {
    let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_ne_bytes()).collect();
    PyBytes::new(py, &bytes)
}

/// Sends frames to Python.
struct Sender(SyncSender<Event>);

impl Sender {
    fn send(&self, event: Event) -> qudi_core::Result<()> {
        self.0.send(event).map_err(|_| Error::Interrupted)
    }
}

impl Receiver for Sender {
    fn start(&mut self, settings: &Value, frames: Option<u64>) -> qudi_core::Result<()> {
        self.send(Event::Start(settings.clone(), frames))
    }

    fn frame(&mut self, frame: &Frame) -> qudi_core::Result<()> {
        self.send(Event::Frame(frame.data.clone()))
    }

    fn colour(&mut self, frame: &[Frame; 3]) -> qudi_core::Result<()> {
        self.send(Event::Frame(interleaved(frame)))
    }

    fn uncertainty(&mut self, sigma: &Frame) -> qudi_core::Result<()> {
        self.send(Event::Sigma(sigma.data.clone()))
    }

    fn colour_uncertainty(&mut self, sigma: &[Frame; 3]) -> qudi_core::Result<()> {
        self.send(Event::Sigma(interleaved(sigma)))
    }
}

/// Returns the values of three planes pixel by pixel.
fn interleaved([red, green, blue]: &[Frame; 3]) -> Vec<f32> {
    let pixels = red.data.iter().zip(&green.data).zip(&blue.data);
    pixels.flat_map(|((&r, &g), &b)| [r, g, b]).collect()
}
