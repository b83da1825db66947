//! The diffusion that encodes a window once.
//!
//! Pre-denoiser, flow and fusion see the captured counts alone and run once a window; the U-Net and the merge
//! of its predictions run in every reverse step. All networks are wide plain convolutions at half the
//! resolution and below. The paper's order, with everything in every step, is
//! [`diffusion`](crate::diffusion).

mod agreement;
mod config;
mod denoiser;
mod encoding;
mod fusion;
pub(crate) mod hourglass;
mod initial;
mod input;
mod merging;
mod motion;
mod network;
mod noise;
mod predenoiser;
#[cfg(test)]
mod scenes;
mod unet;

pub use config::WindowConfig;
pub use encoding::EncodedWindow;
pub use motion::flow::WindowFlow;
pub use network::{Window, WindowPrediction};
