//! Memory of this process: what becomes of freed pages, and the peak, where the system tells (Linux).

/// `mi_option_purge_delay` of mimalloc.h; the bindings name its neighbours 14 and 16 only.
const PURGE_DELAY: i32 = 15;

/// The delay that never comes.
const KEEP: std::ffi::c_long = -1;

/// Growth of the peak since a moment.
#[derive(Debug)]
pub(crate) struct PeakMemory {
    before: Option<f64>,
}

impl PeakMemory {
    /// Forgets the peak so far, and gives kept pages back first: they would hide what comes.
    #[allow(unsafe_code)]
    pub(crate) fn start() -> Self {
        // SAFETY: measurements start while no other thread works; both values are in the option's range.
        unsafe {
            libmimalloc_sys::mi_option_set(PURGE_DELAY, 0);
            libmimalloc_sys::mi_collect(true);
            libmimalloc_sys::mi_option_set(PURGE_DELAY, KEEP);
        }
        // 5 resets the peak (proc(5), clear_refs); elsewhere there is no such file.
        let reset = std::fs::write("/proc/self/clear_refs", "5").is_ok();
        Self { before: reset.then(|| field("VmRSS:")).flatten() }
    }

    /// MiB that the peak lies above what was held at the start.
    pub(crate) fn grown_mib(&self) -> Option<f64> {
        Some((field("VmHWM:")? - self.before?).max(0.0))
    }
}

/// Bytes that the system and this process's control group can still give, where they tell.
pub(crate) fn available_bytes() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    let free = 1024 * line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?;
    let number = |name: &str| {
        let text = std::fs::read_to_string(format!("/sys/fs/cgroup/{name}")).ok()?;
        text.trim().parse::<u64>().ok()
    };
    match (number("memory.max"), number("memory.current")) {
        (Some(most), Some(used)) => Some(free.min(most.saturating_sub(used))),
        _ => Some(free),
    }
}

/// How a shortage is said: what is needed, about, and what is free.
pub(crate) fn shortage(taker: &str, needed: u64, available: u64) -> String {
    let gib = |bytes: u64| bytes as f64 / f64::from(1 << 30);
    format!("{taker} about {:.1} GiB, {:.1} GiB are free", gib(needed), gib(available))
}

/// A field of /proc/self/status in MiB.
fn field(name: &str) -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix(name))?;
    let kib: f64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kib / 1024.0)
}

/// Keeps freed pages for the next allocation. The network's tensors are large and short-lived; giving them
/// back to the system and faulting them in again costs a tenth of the time.
#[allow(unsafe_code)]
pub(crate) fn keep_freed_pages() {
    // SAFETY: called at the start of `main`, before there are other threads; the value is in the option's
    // range.
    unsafe { libmimalloc_sys::mi_option_set(PURGE_DELAY, KEEP) };
}
