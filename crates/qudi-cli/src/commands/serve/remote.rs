//! Devices of other machines, through Burn's remote backend over WebSocket: their servers run every
//! operation, this program draws data and reads results. Nothing is encrypted.

use crate::error::{CliError, Result};
use burn::remote::{ConnectError, RemoteHost};
use burn::server::{RemoteServer, TokenAuthorizer, WebSocketTransport};
use burn::tensor::Device;
use std::net::{SocketAddr, TcpListener};

/// The environment variable with the word that server and clients share. Arguments can be read by everybody
/// on a machine.
const TOKEN: &str = "QUDI_TOKEN";

/// Connects to a device named `ws://HOST:PORT`, or `ws://HOST:PORT/1` for the second that is served there.
pub(crate) fn connect(name: &str) -> Result<Device> {
    let (scheme, address) = name.split_once("://").unwrap_or(("ws", name));
    let (address, number) = match address.trim_end_matches('/').split_once('/') {
        None => (address.trim_end_matches('/'), Some(0)),
        Some((address, number)) => (address, number.parse::<u32>().ok()),
    };
    let help = "write ws://HOST:PORT, or ws://HOST:PORT/1 for the second device there";
    let number = number.ok_or_else(|| CliError::new("no number of a device", name, help))?;
    let host = RemoteHost::websocket(&format!("{scheme}://{address}"));
    let host = match token() {
        Some(token) => host.with_credential(token),
        None => host,
    };
    let problem = match Device::remote_options(&host).device_index(number).init() {
        Ok(device) => return Ok(device),
        Err(ConnectError::Unauthorized) => {
            return Err(CliError::new(
                "the server does not know the token",
                name,
                format!("set {TOKEN} to what it is on the server's side"),
            ));
        }
        Err(error) => error.to_string(),
    };
    Err(CliError::new(
        format!("no device there: {problem}"),
        name,
        "start `qudi serve --listen HOST:PORT` there, of the same version",
    ))
}

/// Lets other machines compute on `devices`, until Ctrl-C. `ready` hears of the address once clients can
/// come.
pub(crate) fn serve(
    devices: Vec<Device>,
    address: SocketAddr,
    ready: impl FnOnce(SocketAddr) -> Result<()>,
) -> Result<()> {
    let mut server = RemoteServer::new(devices);
    match token() {
        Some(token) => {
            let authorizer = TokenAuthorizer::new(token)
                .map_err(|e| CliError::new(e, TOKEN, "choose a longer one"))?;
            server = server.with_authorizer(authorizer);
        }
        None if address.ip().is_loopback() => {}
        None => {
            return Err(CliError::new(
                "anybody who reaches this address could compute here",
                address,
                format!("set {TOKEN} to the same word here and where `--device ws://` is used"),
            ));
        }
    }
    let failed = |e: &dyn std::fmt::Display| {
        CliError::new(format!("cannot serve: {e}"), address, "choose another --listen ADDRESS:PORT")
    };
    let listener = TcpListener::bind(address).map_err(|e| failed(&e))?;
    ready(listener.local_addr().map_err(|e| failed(&e))?)?;
    server.serve(WebSocketTransport::from_listener(listener)).map_err(|e| failed(&e))
}

fn token() -> Option<String> {
    std::env::var(TOKEN).ok().filter(|token| !token.is_empty())
}
