#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| qudi_fuzz::read("a.tif", &qudi_fuzz::format("tiff"), bytes));
