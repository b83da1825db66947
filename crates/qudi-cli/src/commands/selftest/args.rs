//! Options of `qudi selftest`.

use clap::Args as ClapArgs;

/// Check that a device computes what Burn's stock operations do on the processor: every operation of the
/// network, and a small network whole
///
/// Exits with 1 if a result is off. GPU drivers and backends have had wrong kernels; run this once on yours.
#[derive(Debug, ClapArgs)]
pub(crate) struct Selftest {
    /// The device: auto, cpu, ndarray, wgpu, vulkan, cuda, metal, or one of several, as wgpu:1
    #[arg(long, value_name = "NAME", default_value = "auto")]
    pub(crate) device: String,
    /// Checks whose names contain one of these
    #[arg(long, value_name = "A,B,...", value_delimiter = ',')]
    pub(crate) only: Vec<String>,
}
