//! Files of any kind: written whole or not at all, read within limits, NumPy arrays, names in natural order.

pub mod atomic_file;
pub mod natural_order;
pub mod npy;
pub mod regular_file;
