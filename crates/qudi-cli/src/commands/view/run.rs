//! `qudi view`: a capture on a page that restores what is looked at.

use super::address::Address;
use super::args::View;
use super::frames::Frames;
use super::page::page;
use super::server::Server;
use crate::args::Global;
use crate::capture::is_pipe;
use crate::error::{CliError, Result};
use crate::interrupt;
use crate::report::Report;
use crate::settings::Settings;
use serde_json::json;
use std::net::{Ipv4Addr, TcpListener};
use std::time::Duration;

/// Time between looks for Ctrl-C.
const POLL: Duration = Duration::from_millis(100);

pub(crate) fn run(
    view: &View,
    settings: &Settings,
    global: &Global,
    report: &Report,
) -> Result<()> {
    if is_pipe(&view.capture) {
        return Err(CliError::new(
            "a pipe comes once, and frames are looked at in any order",
            "-",
            "store the capture in a file",
        ));
    }
    let mut frames = Frames::open(view, settings, global, report)?;
    let port = view.port.unwrap_or(0);
    let unable = |e: std::io::Error| {
        let help = "leave out --port: a free one is taken";
        CliError::new(format!("cannot listen: {e}"), format!("127.0.0.1:{port}"), help)
    };
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, port)).map_err(unable)?;
    let address = Address::new(listener.local_addr().map_err(unable)?.port())?;
    let page = page(&frames, &view.capture.display().to_string())?;
    let server = Server::start(listener, address.clone(), page)?;
    let url = address.url();
    report.result(&format!("{url}\n"), || json!({"address": url}))?;
    report.remark("note: open this address in a browser on this computer; Ctrl-C stops serving it");
    while interrupt::check().is_continue() {
        if let Some(asked) = server.next(POLL) {
            let answer = frames.get(&asked.layer, asked.frame);
            asked.answer(answer);
        }
    }
    Ok(())
}
