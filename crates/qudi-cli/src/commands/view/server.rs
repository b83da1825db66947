//! The server: it answers browsers on this computer, a few at once, and asks the command for frames.

use super::address::Address;
use super::request::{MAX_REQUEST_BYTES, Refusal, Route, TOO_LARGE, route};
use crate::report::html::policy;
use qudi_core::{Error, Result};
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::time::{Duration, Instant};

/// Connections at once.
const MAX_CONNECTIONS: usize = 16;

/// Frames that wait to be restored.
const MAX_WAITING: usize = 4;

/// Time for a request to arrive, and for its answer to be taken.
const TIMEOUT: Duration = Duration::from_secs(10);

/// A frame that is asked for.
pub(super) struct Asked {
    pub(super) layer: String,
    pub(super) frame: u64,
    reply: SyncSender<Answer>,
}

/// An encoded frame, or what is wrong.
#[derive(Clone, Debug)]
pub(super) enum Answer {
    Jpeg(Arc<Vec<u8>>),
    Unknown,
    Failed(String),
}

/// A running server; it stops when it is dropped.
pub(super) struct Server {
    local: SocketAddr,
    stop: Arc<AtomicBool>,
    asked: Receiver<Asked>,
}

/// What all connections share.
struct Shared {
    address: Address,
    page: String,
    asked: SyncSender<Asked>,
    stop: Arc<AtomicBool>,
    connections: AtomicUsize,
}

impl Asked {
    /// Sends the answer, if anybody still waits.
    pub(super) fn answer(self, answer: Answer) {
        let _ = self.reply.send(answer);
    }
}

impl Server {
    /// Serves `page` on a thread of its own.
    ///
    /// # Errors
    /// [`Error::Io`] if the socket has no address.
    pub(super) fn start(listener: TcpListener, address: Address, page: String) -> Result<Self> {
        let local =
            listener.local_addr().map_err(|e| Error::io("listen at", Path::new("127.0.0.1"), e))?;
        let (sender, asked) = sync_channel(MAX_WAITING);
        let stop = Arc::new(AtomicBool::new(false));
        let shared = Shared {
            address,
            page,
            asked: sender,
            stop: stop.clone(),
            connections: AtomicUsize::new(0),
        };
        std::thread::spawn(move || accept(&listener, &Arc::new(shared)));
        Ok(Self { local, stop, asked })
    }

    /// Waits for the next frame that is asked for; none if nobody asks for a while.
    pub(super) fn next(&self, timeout: Duration) -> Option<Asked> {
        self.asked.recv_timeout(timeout).ok()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        // Wakes the thread that waits for a connection.
        let _ = TcpStream::connect_timeout(&self.local, Duration::from_secs(1));
    }
}

fn accept(listener: &TcpListener, shared: &Arc<Shared>) {
    for stream in listener.incoming() {
        if shared.stop.load(Ordering::Relaxed) {
            return;
        }
        let Ok(mut stream) = stream else { continue };
        if shared.connections.fetch_add(1, Ordering::Relaxed) >= MAX_CONNECTIONS {
            let _ = respond(&mut stream, "503 Service Unavailable", TEXT, b"too many connections");
            shared.connections.fetch_sub(1, Ordering::Relaxed);
            continue;
        }
        let shared = shared.clone();
        std::thread::spawn(move || {
            // A browser that is gone needs no answer.
            let _ = handle(&mut stream, &shared);
            shared.connections.fetch_sub(1, Ordering::Relaxed);
        });
    }
}

const TEXT: &str = "text/plain; charset=utf-8";

/// Answers one request.
fn handle(stream: &mut TcpStream, shared: &Shared) -> std::io::Result<()> {
    stream.set_write_timeout(Some(TIMEOUT))?;
    let head = read_head(stream)?;
    let asked = head.and_then(|head| route(&head, &shared.address));
    let (layer, frame) = match asked {
        Err(Refusal { status, text }) => return respond(stream, status, TEXT, text.as_bytes()),
        Ok(Route::Page) => {
            return respond(stream, "200 OK", "text/html; charset=utf-8", shared.page.as_bytes());
        }
        Ok(Route::Frame { layer, frame }) => (layer, frame),
    };
    let (reply, answer) = sync_channel(1);
    match shared.asked.try_send(Asked { layer, frame, reply }) {
        Ok(()) => {}
        Err(TrySendError::Full(_) | TrySendError::Disconnected(_)) => {
            return respond(
                stream,
                "503 Service Unavailable",
                TEXT,
                b"busy restoring other frames",
            );
        }
    }
    match answer.recv() {
        Ok(Answer::Jpeg(jpeg)) => respond(stream, "200 OK", "image/jpeg", &jpeg),
        Ok(Answer::Unknown) => respond(stream, "404 Not Found", TEXT, b"nothing here"),
        Ok(Answer::Failed(what)) => {
            respond(stream, "500 Internal Server Error", TEXT, what.as_bytes())
        }
        Err(_) => respond(stream, "503 Service Unavailable", TEXT, b"stopping"),
    }
}

/// Reads a request up to its empty line.
fn read_head(stream: &mut TcpStream) -> std::io::Result<Result<String, Refusal>> {
    let end = Instant::now() + TIMEOUT;
    let mut head = Vec::new();
    let mut part = [0; 1024];
    while !head.windows(4).any(|window| window == b"\r\n\r\n") {
        if head.len() > MAX_REQUEST_BYTES {
            return Ok(Err(TOO_LARGE));
        }
        let left = end.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Err(std::io::ErrorKind::TimedOut.into());
        }
        stream.set_read_timeout(Some(left))?;
        match stream.read(&mut part)? {
            0 => break,
            read => head.extend_from_slice(&part[..read]),
        }
    }
    Ok(Ok(String::from_utf8_lossy(&head).into_owned()))
}

fn respond(stream: &mut TcpStream, status: &str, kind: &str, body: &[u8]) -> std::io::Result<()> {
    let allow = if status.starts_with("405") { "Allow: GET\r\n" } else { "" };
    let head = format!(
        "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {}\r\nConnection: close\r\n{allow}\
         Cache-Control: no-store\r\nX-Content-Type-Options: nosniff\r\nReferrer-Policy: no-referrer\r\n\
         Cross-Origin-Resource-Policy: same-origin\r\nContent-Security-Policy: {}; frame-ancestors 'none'\r\n\r\n",
        body.len(),
        policy(),
    );
    stream.write_all(head.as_bytes())?;
    stream.write_all(body)?;
    stream.flush()
}
