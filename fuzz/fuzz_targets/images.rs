#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| qudi_fuzz::read("a.png", &qudi_fuzz::format("images"), bytes));
