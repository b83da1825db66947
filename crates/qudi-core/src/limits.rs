//! Limits on what a file or a request may ask for, in one place.
//!
//! A header of a few bytes can claim any size, and a path can name a device that never ends. Readers compare
//! with these limits before they allocate; a file beyond a limit is refused with both numbers.

/// The most pixels of one frame: more than any sensor has, and indices fit into 32 bits.
pub const FRAME_PIXELS: usize = 1 << 29;

/// The most pixels of an image that is decoded as a whole: 134 megapixels, or 512 MiB as 32-bit floats.
pub const IMAGE_PIXELS: u64 = 1 << 27;

/// The most bytes of one frame in a video stream: 8-bit 4:4:4 frames of the largest images, and some.
pub const VIDEO_FRAME_BYTES: usize = 1 << 30;

/// The most instants of one exposure: finer steps than any motion needs.
pub const EXPOSURE_INSTANTS: usize = 4096;

/// The most bytes of a file that a person writes, as sensors, settings and recipes: they are a few pages
/// long.
pub const TEXT_BYTES: u64 = 1 << 20;

/// The most bytes of a file that this program wrote beside data, as records, manifests and results of
/// `bench`: one line a frame at most.
pub const RECORD_BYTES: u64 = 1 << 24;

/// The most bytes of a weight file: the paper's network has 0.2 GiB.
pub const WEIGHT_BYTES: u64 = 4 << 30;

/// The most bytes of one entry in a pack of training clips: an image of 64 megapixels has fewer.
pub const PACK_ENTRY_BYTES: u64 = 64 << 20;

/// The most bytes of an index of another program that lists every frame (`transforms.json` of visionsim).
pub const INDEX_BYTES: u64 = 1 << 28;

/// The most bytes of an array's header: NumPy writes about 100, MATLAB some hundreds.
pub const ARRAY_HEADER_BYTES: usize = 1 << 16;

/// The most bytes of an array that is read whole, since its axes are turned.
pub const HELD_ARRAY_BYTES: u64 = 1 << 31;

/// The most files of one capture's folder.
pub const FOLDER_FILES: usize = 4_000_000;

/// The most frames that a capture is judged by before all of it is read.
pub const SAMPLE_FRAMES: u64 = 1000;

/// The most variables of a MAT file whose headers are read.
pub const MAT_VARIABLES: usize = 4096;

/// The most bytes that one byte of DEFLATE can stand for (RFC 1951: 258 bytes in two bits), rounded up.
pub const DEFLATE_RATIO: u64 = 1032;

/// The most bytes of one chunk of an HDF5 data set.
pub const HDF5_CHUNK_BYTES: u64 = 1 << 28;

/// The most chunks of an HDF5 data set.
pub const HDF5_CHUNKS: u64 = 1 << 22;

/// The most bytes that an HDF5 reader may hold at once.
pub const HDF5_BYTES_AT_ONCE: u64 = 1 << 30;

/// The most objects of an HDF5 file.
pub const HDF5_OBJECTS: usize = 1_000_000;

/// The deepest nesting of groups in an HDF5 file.
pub const HDF5_DEPTH: u32 = 16;
