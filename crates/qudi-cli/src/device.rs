//! The compute devices of this build and this machine.

#[cfg(any(feature = "wgpu", feature = "vulkan", feature = "metal", feature = "cuda"))]
use burn::tensor::{Device, DeviceType};

/// A device that `--device` can name.
#[derive(Debug)]
pub(crate) struct Listed {
    pub(crate) name: String,
    pub(crate) description: String,
}

/// All devices: the CPU first, then the graphics cards of each backend that was compiled in.
pub(crate) fn list() -> Vec<Listed> {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let mut devices = Vec::new();
    let mut add = |name: String, description: String| devices.push(Listed { name, description });
    if cfg!(feature = "cpu") {
        add("cpu".to_owned(), format!("{cores} cores (flex)"));
    }
    if cfg!(feature = "ndarray") {
        add("ndarray".to_owned(), format!("{cores} cores (ndarray: slow, deprecated upstream)"));
    }
    #[cfg(feature = "wgpu")]
    add_cards("wgpu", DeviceType::Wgpu, &mut add);
    #[cfg(feature = "vulkan")]
    add_cards("vulkan", DeviceType::Vulkan, &mut add);
    #[cfg(feature = "metal")]
    add_cards("metal", DeviceType::Metal, &mut add);
    #[cfg(feature = "cuda")]
    add_cards("cuda", DeviceType::Cuda, &mut add);
    devices
}

#[cfg(any(feature = "wgpu", feature = "vulkan", feature = "metal", feature = "cuda"))]
fn add_cards(backend: &str, kind: DeviceType, add: &mut impl FnMut(String, String)) {
    // Drivers that are missing or broken make some backends panic; then there is no such device.
    let quiet = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| {}));
    let cards = std::panic::catch_unwind(|| {
        let cards = Device::enumerate(kind).into_vec();
        cards
            .into_iter()
            .map(|card| card.identity().map_or_else(|| format!("{card:?}"), |i| i.name))
            .collect::<Vec<_>>()
    });
    std::panic::set_hook(quiet);
    for (n, card) in cards.unwrap_or_default().into_iter().enumerate() {
        add(format!("{backend}:{n}"), card);
    }
}
