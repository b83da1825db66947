#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| qudi_fuzz::read("a.npz", &qudi_fuzz::format("npz"), bytes));
