#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| qudi_fuzz::read("transforms.json", &qudi_fuzz::format("visionsim"), bytes));
