#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| qudi_fuzz::read("a.npy", &qudi_fuzz::format("npy"), bytes));
