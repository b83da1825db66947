//! Limits on what a file or a request may ask for.
//!
//! A header of a few bytes can claim any size, and a path can name a device that never ends. Readers compare
//! with these limits before they allocate; a file beyond a limit is refused with both numbers.

/// Pixels of one frame: more than any sensor has, and indices fit into 32 bits.
pub const FRAME_PIXELS: usize = 1 << 29;

/// Pixels of an image that is decoded as a whole: 67 megapixels, or 256 MiB as 32-bit floats.
pub const IMAGE_PIXELS: u64 = 1 << 26;

/// Pixels of a frame of a capture that is stored as images, whose sums take 1 GiB: more than any sensor has.
pub const IMAGE_FRAME_PIXELS: u64 = 1 << 25;

/// Bytes of one frame in a video stream: enough for 8-bit 4:4:4 frames of the largest images.
pub const VIDEO_FRAME_BYTES: usize = 1 << 30;

/// Instants of one exposure: finer steps than any motion needs.
pub const EXPOSURE_INSTANTS: usize = 4096;

/// Bytes of a file that a person writes (sensors, settings, recipes), which has a few pages.
pub const TEXT_BYTES: u64 = 1 << 20;

/// Bytes of a record, a manifest or results of `bench`, which have one line per frame at most.
pub const RECORD_BYTES: u64 = 1 << 24;

/// Bytes of a weight file: the paper's network has 0.2 GiB.
pub const WEIGHT_BYTES: u64 = 4 << 30;

/// Bytes of the index of a pack of training clips, which has five lines per clip.
pub const PACK_INDEX_BYTES: u64 = 64 << 20;

/// Pixels of all frames of a pack of training clips, which stay in memory as bytes: 64 GiB.
pub const PACK_PIXELS: u64 = 1 << 36;

/// Bytes of an index of another program that lists every frame (`transforms.json` of visionsim).
pub const INDEX_BYTES: u64 = 1 << 28;

/// Bytes of an array's header: NumPy writes about 100, MATLAB some hundreds.
pub const ARRAY_HEADER_BYTES: usize = 1 << 16;

/// Bytes of an array that is read whole to transpose its axes.
pub const HELD_ARRAY_BYTES: u64 = 1 << 31;

/// Files in the folder of one capture.
pub const FOLDER_FILES: usize = 4_000_000;

/// Frames that are read to judge a capture before all of it is read.
pub const SAMPLE_FRAMES: u64 = 1000;

/// Variables of a MAT file whose headers are read.
pub const MAT_VARIABLES: usize = 4096;

/// Bytes that one byte of DEFLATE can stand for (RFC 1951: 258 bytes in two bits), rounded up.
pub const DEFLATE_RATIO: u64 = 1032;

/// Bytes of one chunk of an HDF5 data set.
pub const HDF5_CHUNK_BYTES: u64 = 1 << 28;

/// Chunks of an HDF5 data set.
pub const HDF5_CHUNKS: u64 = 1 << 22;

/// Bytes that an HDF5 reader may hold at once.
pub const HDF5_BYTES_AT_ONCE: u64 = 1 << 30;

/// Objects of an HDF5 file.
pub const HDF5_OBJECTS: usize = 1_000_000;

/// Depth of nested groups in an HDF5 file.
pub const HDF5_DEPTH: u32 = 16;
