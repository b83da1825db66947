#![no_main]

use qudi_fuzz::{format, read};
use qudi_io::description::ReadOptions;

// The first byte chooses a camera. Frames are small to keep files small.
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let Some((&choice, bytes)) = bytes.split_first() else { return };
    let name = ["spad512s", "spad512s-8", "spad512s-16", "spad512s-sparse", "qvga", "raw-bits"];
    let options = format(name[usize::from(choice) % name.len()]);
    let size = (choice < 128).then(|| "8x16".parse().expect("a size"));
    read("spc_data1.bin", &ReadOptions { size, ..options }, bytes);
    if choice % 7 == 0 {
        // Recognised by itself.
        read("RAW00000.bin", &ReadOptions::default(), bytes);
    }
});
