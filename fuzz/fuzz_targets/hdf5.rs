#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| qudi_fuzz::read("a.h5", &qudi_fuzz::format("hdf5"), bytes));
