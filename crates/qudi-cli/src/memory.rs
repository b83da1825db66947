//! Memory of this process: what becomes of freed pages, and the peak, where the system tells (Linux).

use crate::error::{CliError, Result};
use qudi_core::Size;

/// `mi_option_purge_delay` of mimalloc.h; the bindings name its neighbours 14 and 16 only.
const PURGE_DELAY: i32 = 15;

/// The delay that never comes.
const NEVER_PURGE: std::ffi::c_long = -1;

/// Growth of the peak since a moment.
#[derive(Debug)]
pub(crate) struct PeakMemory {
    before: Option<f64>,
}

impl PeakMemory {
    /// Starts a measurement. Gives back the kept pages of all threads first, which would hide later growth.
    #[allow(unsafe_code)]
    pub(crate) fn start() -> Self {
        // SAFETY: it frees what the calling thread keeps and nobody uses.
        let collect = || unsafe { libmimalloc_sys::mi_collect(true) };
        // SAFETY: measurements start while no other thread works; both values are in the option's range.
        let set_delay = |delay| unsafe { libmimalloc_sys::mi_option_set(PURGE_DELAY, delay) };
        set_delay(0);
        rayon::broadcast(|_| collect());
        collect();
        set_delay(NEVER_PURGE);
        // 5 resets the peak (proc(5), clear_refs); elsewhere there is no such file.
        let reset = std::fs::write("/proc/self/clear_refs", "5").is_ok();
        Self { before: reset.then(|| field("VmRSS:")).flatten() }
    }

    /// Returns the growth of the peak since the start, in MiB.
    pub(crate) fn grown_mib(&self) -> Option<f64> {
        Some((field("VmHWM:")? - self.before?).max(0.0))
    }
}

/// Returns the bytes that the system and this process's control group can still give, if they are known.
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

/// Refuses tiles that memory cannot hold, before the system ends the program for it. `sides` are the sides of
/// the smallest and of the requested tiles, `needed` the bytes that a tile takes.
pub(crate) fn check_tiles(
    sides: [usize; 2],
    frame: Size,
    available: Option<u64>,
    needed: impl Fn(Size) -> u64,
) -> Result<()> {
    let [smallest, requested] = sides;
    let of_side =
        |side: usize| needed(Size { height: frame.height.min(side), width: frame.width.min(side) });
    let Some(available) = available.filter(|&available| of_side(requested) > available) else {
        return Ok(());
    };
    let what =
        shortage(&format!("tiles of {requested} pixels take"), of_side(requested), available);
    let mut smaller = (smallest..requested).rev();
    let help = match smaller.find(|&side| side % 32 == 0 && of_side(side) <= available) {
        Some(side) => format!("--tile {side} fits"),
        None => "free some memory, or use smaller weights".to_owned(),
    };
    Err(CliError::new(what, "--tile", help))
}

/// Formats a shortage: about how much is needed, and how much is free.
pub(crate) fn shortage(taker: &str, needed: u64, available: u64) -> String {
    let gib = |bytes: u64| bytes as f64 / f64::from(1 << 30);
    format!("{taker} about {:.1} GiB, {:.1} GiB are free", gib(needed), gib(available))
}

/// Reads a field of /proc/self/status in MiB.
fn field(name: &str) -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix(name))?;
    let kib: f64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kib / 1024.0)
}

/// Keeps freed pages for the next allocation. The network's tensors are large and short-lived; giving them
/// back to the system and faulting them in again costs a tenth of the time. Call it at the start of a program
/// whose allocator is mimalloc.
#[allow(unsafe_code)]
pub fn keep_freed_pages() {
    // SAFETY: called at the start, while no other thread works; the value is in the option's range.
    unsafe { libmimalloc_sys::mi_option_set(PURGE_DELAY, NEVER_PURGE) };
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_that_do_not_fit_name_one_that_does() {
        let frame = Size { height: 2000, width: 3000 };
        let needed = |size: Size| 10_000 * size.pixels() as u64;
        let check = |tile, frame, available| check_tiles([64, tile], frame, available, needed);
        assert!(check(256, frame, Some(1 << 30)).is_ok());
        assert!(check(4096, frame, None).is_ok());
        let Err(CliError::Error { what, help: Some(help), .. }) = check(512, frame, Some(1 << 30))
        else {
            panic!("a tile of 512 in 1 GiB");
        };
        assert!(what.contains("2.4 GiB, 1.0 GiB are free"), "{what}");
        assert_eq!(help, "--tile 320 fits");
        assert!(check(320, frame, Some(1 << 30)).is_ok());
        assert!(check(352, frame, Some(1 << 30)).is_err());
        // The whole frame is smaller than the tile.
        assert!(check(1024, Size { height: 128, width: 128 }, Some(1 << 30)).is_ok());
        let Err(CliError::Error { help: Some(help), .. }) = check(512, frame, Some(1 << 20)) else {
            panic!("a tile of 512 in 1 MiB");
        };
        assert!(help.starts_with("free some memory"), "{help}");
    }
}
