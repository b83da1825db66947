//! Options of `qudi serve`.

use clap::Args as ClapArgs;

/// Let other machines compute on this one's devices, with --device ws://HOST:PORT there, until Ctrl-C
///
/// Operations and tensors cross the network unencrypted, so serve within a network that you trust. Where
/// others can reach it, server and clients need the same word in QUDI_TOKEN. Both must be of the same
/// version.
#[derive(Debug, ClapArgs)]
pub(crate) struct Serve {
    /// Devices to serve, as for train
    #[arg(long, value_name = "NAME,...", value_delimiter = ',', default_value = "auto")]
    pub(crate) device: Vec<String>,
    /// Where to listen; port 0 takes a free one
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:4001")]
    pub(crate) listen: std::net::SocketAddr,
}
