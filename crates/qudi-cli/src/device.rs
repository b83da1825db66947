//! The compute devices of this build and this machine.

use crate::error::{CliError, Result};
use burn::tensor::Device;
#[cfg(any(feature = "wgpu", feature = "vulkan", feature = "metal", feature = "cuda"))]
use burn::tensor::DeviceType;
use std::sync::{Mutex, OnceLock, PoisonError};

/// A device that `--device` can name.
#[derive(Debug)]
pub(crate) struct Listed {
    pub(crate) name: String,
    pub(crate) description: String,
}

/// A device to compute on.
#[derive(Clone, Debug)]
pub(crate) struct Opened {
    pub(crate) name: String,
    pub(crate) device: Device,
}

impl Opened {
    /// Returns true if it computes in the program's own memory.
    pub(crate) fn is_processor(&self) -> bool {
        is_processor(&self.name)
    }
}

/// Returns true if a backend of this name computes on the processor.
fn is_processor(backend: &str) -> bool {
    matches!(backend, "cpu" | "flex" | "ndarray" | "libtorch-cpu")
}

/// Lists all devices: the CPU first, then the graphics cards of each backend that was compiled in.
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
    if cfg!(feature = "libtorch") {
        add("libtorch-cpu".to_owned(), format!("{cores} cores (LibTorch)"));
    }
    for (backend, cards) in all_cards() {
        for (n, card) in cards.iter().enumerate() {
            add(format!("{backend}:{n}"), card.clone());
        }
    }
    devices
}

/// Returns the feature that this build lacks for a backend.
fn feature_of(backend: &str) -> Option<&'static str> {
    let features = [
        ("wgpu", cfg!(feature = "wgpu")),
        ("vulkan", cfg!(feature = "vulkan")),
        ("metal", cfg!(feature = "metal")),
        ("cuda", cfg!(feature = "cuda")),
        ("libtorch", cfg!(feature = "libtorch")),
        ("libtorch-cpu", cfg!(feature = "libtorch")),
        ("ndarray", cfg!(feature = "ndarray")),
    ];
    let lacks = |(name, built): &&(&'static str, bool)| *name == backend && !built;
    features.iter().find(lacks).map(|(name, _)| *name)
}

/// Opens a device by name and computes something small on it; once, however often it is asked for.
pub(crate) fn open(name: &str) -> Result<Opened> {
    static OPENED_DEVICES: Mutex<Vec<Opened>> = Mutex::new(Vec::new());
    let name = if name == "auto" { best() } else { name.to_owned() };
    let mut opened = OPENED_DEVICES.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(device) = opened.iter().find(|device| device.name == name) {
        return Ok(device.clone());
    }
    let device = open_new(&name)?;
    opened.push(device.clone());
    Ok(device)
}

fn open_new(name: &str) -> Result<Opened> {
    let (backend, number) = match name.split_once(':') {
        None => (name, Some(0)),
        Some((backend, number)) => (backend, number.parse::<usize>().ok()),
    };
    let missing = || {
        let names: Vec<_> = list().into_iter().map(|device| device.name).collect();
        let names = names.join(", ");
        let help = match feature_of(backend) {
            Some(feature) => {
                let feature = feature.trim_end_matches("-cpu");
                format!("this build has {names}; build it with `--features {feature}` for more")
            }
            None => format!("this build and machine have {names}; or use auto"),
        };
        CliError::new(format!("there is no device `{name}`"), "--device", help)
    };
    let number = number.ok_or_else(missing)?;
    let on_card = || all_cards().iter().any(|(b, cards)| *b == backend && number < cards.len());
    let on_processor = is_processor(backend) && number == 0;
    if !on_processor && !on_card() {
        return Err(missing());
    }
    let opened = guarded(name, || {
        let device = create(backend, number)?;
        let two = burn::tensor::Tensor::<1>::ones([2], &device) + 1.0;
        (two.try_into_data().ok()?.try_to_vec::<f32>().ok()? == [2.0, 2.0]).then_some(device)
    });
    match opened {
        Ok(Some(device)) => Ok(Opened { name: name.to_owned(), device }),
        Ok(None) => Err(missing()),
        Err(problem) => Err(CliError::new(
            format!("the device cannot be used: {problem}"),
            name,
            "check its driver with `qudi selftest`, or use --device cpu",
        )),
    }
}

/// Returns the name of the first real graphics card, or of the processor.
fn best() -> String {
    // Drivers that compute on the processor are slower than our own way to do so.
    let software = ["llvmpipe", "lavapipe", "swiftshader", "software", "cpu"];
    for (backend, cards) in all_cards() {
        let real = |card: &String| !software.iter().any(|s| card.to_lowercase().contains(s));
        if let Some(n) = cards.iter().position(real) {
            return format!("{backend}:{n}");
        }
    }
    if cfg!(feature = "cpu") { "cpu".to_owned() } else { "ndarray".to_owned() }
}

#[allow(unused_variables)] // which backends there are depends on features
fn create(backend: &str, number: usize) -> Option<Device> {
    match backend {
        #[cfg(feature = "cpu")]
        "cpu" | "flex" => Some(Device::flex()),
        #[cfg(feature = "ndarray")]
        #[allow(deprecated)] // asked for by name
        "ndarray" => Some(Device::ndarray()),
        #[cfg(feature = "libtorch")]
        #[allow(deprecated)]
        // upstream prefers its own backends, and has none as fast in training yet
        "libtorch-cpu" => Some(Device::libtorch()),
        #[cfg(feature = "libtorch")]
        #[allow(deprecated)]
        "libtorch" => Some(Device::libtorch_cuda(number)),
        #[cfg(feature = "wgpu")]
        "wgpu" => card(DeviceType::Wgpu, number),
        #[cfg(feature = "vulkan")]
        "vulkan" => card(DeviceType::Vulkan, number),
        #[cfg(feature = "metal")]
        "metal" => card(DeviceType::Metal, number),
        #[cfg(feature = "cuda")]
        "cuda" => Some(Device::cuda(number)),
        _ => None,
    }
}

#[cfg(any(feature = "wgpu", feature = "vulkan", feature = "metal"))]
fn card(kind: DeviceType, number: usize) -> Option<Device> {
    Device::enumerate(kind).into_vec().into_iter().nth(number)
}

/// Keeps drivers of graphics cards from complaining on standard error that there is no desktop session. They
/// look for sockets below this folder only, and find none.
///
/// To be called before there are threads.
#[cfg(any(feature = "wgpu", feature = "vulkan"))]
#[allow(unsafe_code)]
pub(crate) fn quieten_drivers() {
    const FOLDER: &str = "XDG_RUNTIME_DIR";
    if cfg!(unix) && std::env::var_os(FOLDER).is_none() {
        // SAFETY: called at the start of `main`, when no other thread can read the environment.
        unsafe { std::env::set_var(FOLDER, std::env::temp_dir()) };
    }
}

/// Returns backends with the names of their cards; searched once, since drivers print to standard error.
fn all_cards() -> &'static [(&'static str, Vec<String>)] {
    static CARDS: OnceLock<Vec<(&'static str, Vec<String>)>> = OnceLock::new();
    CARDS.get_or_init(find_cards)
}

fn find_cards() -> Vec<(&'static str, Vec<String>)> {
    vec![
        #[cfg(feature = "libtorch")]
        ("libtorch", libtorch_cards()),
        #[cfg(feature = "cuda")]
        ("cuda", cards(DeviceType::Cuda)),
        #[cfg(feature = "vulkan")]
        ("vulkan", cards(DeviceType::Vulkan)),
        #[cfg(feature = "metal")]
        ("metal", cards(DeviceType::Metal)),
        #[cfg(feature = "wgpu")]
        ("wgpu", cards(DeviceType::Wgpu)),
    ]
}

#[cfg(feature = "libtorch")]
fn libtorch_cards() -> Vec<String> {
    let count = guarded("", qudi_kernels::count_libtorch_cards).unwrap_or_default();
    (0..count).map(|number| format!("CUDA card {number} (LibTorch)")).collect()
}

#[cfg(any(feature = "wgpu", feature = "vulkan", feature = "metal", feature = "cuda"))]
fn cards(kind: DeviceType) -> Vec<String> {
    let names = guarded("", || {
        let cards = Device::enumerate(kind).into_vec().into_iter();
        cards.map(|card| card.identity().map_or_else(|| format!("{card:?}"), |i| i.name)).collect()
    });
    names.unwrap_or_default()
}

/// Runs what a missing or broken driver, or too little memory, makes panic; gives the panic's words.
pub(crate) fn guarded<T>(device: &str, run: impl FnOnce() -> T) -> Result<T, String> {
    let quiet = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| {}));
    let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(run));
    std::panic::set_hook(quiet);
    result.map_err(|panic| {
        let text = panic.downcast_ref::<String>().map(String::as_str);
        let text = text.or_else(|| panic.downcast_ref::<&str>().copied());
        text.map_or_else(
            || format!("{device} failed"),
            |text| text.lines().next().unwrap_or_default().to_owned(),
        )
    })
}
