//! CPU operations for Burn.
