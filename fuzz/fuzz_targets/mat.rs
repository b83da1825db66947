#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| qudi_fuzz::read("a.mat", &qudi_fuzz::format("mat"), bytes));
