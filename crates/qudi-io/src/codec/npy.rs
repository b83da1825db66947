//! NumPy `.npy`, also gzipped: packed bits as photoncube and visionsim write them, or plain counts.

use super::array::{Array, Hints, Place};
use super::{Format, Recognition};
use crate::description::{
    Axes, BitOrder, CaptureInfo, Certainty, PackAxis, Packing, RECORD, ReadOptions,
};
use crate::frames::CountFrames;
use crate::frames::frame_bytes::Opener;
use crate::recognition::Probe;
use crate::sidecar::{self, BurstLayout, Sidecar};
use crate::writer::BurstFormat;
use flate2::read::MultiGzDecoder;
use qudi_core::limits::DEFLATE_RATIO;
use qudi_core::npy::Header;
use qudi_core::regular_file::open_regular;
use qudi_core::sensor::{Response, preset};
use qudi_core::{Error, Result};
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

pub(crate) const FORMAT: Format = Format {
    name: "npy",
    title: "NumPy array",
    options: super::ARRAY_OPTIONS,
    probe: |probe| {
        let found = probe.head.starts_with(b"\x93NUMPY");
        Ok(found.then(|| Recognition::new(Certainty::Certain, &["NumPy's magic number"])))
    },
    open: |probe, options, info| {
        let array = open_array(&probe.path)?;
        let hints = hints(&probe.path, info);
        array.open(options, &hints, info)
    },
};

pub(crate) const COMPRESSED: Format = Format {
    name: "npy-gz",
    title: "gzipped NumPy array",
    options: super::ARRAY_OPTIONS,
    probe: |probe| {
        let found =
            probe.head.starts_with(&[0x1f, 0x8b]) && probe.stem().to_lowercase().ends_with(".npy");
        Ok(found
            .then(|| Recognition::new(Certainty::Certain, &["gzip's magic number", "the name"])))
    },
    open: |probe, options, info| open_gzip(probe, options, info),
};

/// Opens a `.npy` file as an array; [`Array::open`] checks sizes.
pub(crate) fn open_array(path: &Path) -> Result<Array> {
    let file = open_regular(path, "open the file")?;
    let length = file.metadata().map_err(|e| Error::io("open", path, e))?.len();
    let header = Header::read(&mut BufReader::new(file), path)?;
    let place = Place::File {
        start: header.data_start,
        available: length.saturating_sub(header.data_start),
        checksum: None,
    };
    Ok(array(path, header, place))
}

pub(crate) fn array(path: &Path, header: Header, place: Place) -> Array {
    Array {
        path: path.to_owned(),
        sample: header.sample,
        shape: header.shape,
        fortran: header.fortran,
        axes: Axes::Thw,
        place,
    }
}

fn open_gzip(
    probe: &Probe,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<Box<dyn CountFrames>> {
    let path = probe.path.clone();
    let unpacked = move || -> Result<MultiGzDecoder<BufReader<File>>> {
        let file = File::open(&path).map_err(|e| Error::io("open", &path, e))?;
        Ok(MultiGzDecoder::new(BufReader::with_capacity(1 << 16, file)))
    };
    let header = Header::read(&mut unpacked()?, &probe.path)?;
    refuse_bomb(&header, probe.length, &probe.path)?;
    let start = header.data_start;
    let path = probe.path.clone();
    let opener: Opener = Box::new(move || {
        let mut stream = unpacked()?;
        std::io::copy(&mut stream.by_ref().take(start), &mut std::io::sink())
            .map_err(|e| Error::io("decompress", &path, e))?;
        Ok(Box::new(stream))
    });
    array(&probe.path, header, Place::Stream(opener)).open(options, &Hints::default(), info)
}

/// Refuses a header that promises more than its compressed bytes can hold.
pub(crate) fn refuse_bomb(header: &Header, compressed: u64, path: &Path) -> Result<()> {
    let most = compressed.saturating_mul(DEFLATE_RATIO);
    match header.data_bytes() {
        Some(bytes) if bytes <= most => Ok(()),
        _ => Err(Error::data(
            format!(
                "its header promises an array of shape {:?}, more than {compressed} compressed bytes can hold",
                header.shape
            ),
            path,
            "the file is truncated or damaged: copy or export it again",
        )),
    }
}

/// Returns the hints of our own record next to an array.
fn hints(path: &Path, info: &mut CaptureInfo) -> Hints {
    let Some(layout) = described(&sidecar::beside(path), info) else { return Hints::default() };
    let packed = layout.format == BurstFormat::NpyPacked;
    let packing = packed.then_some(Packing { axis: PackAxis::Width, order: BitOrder::Msb });
    Hints { stored: packing.into(), size: Some(layout.size), recorded: Some(layout) }
}

/// Returns the layout in our record at `path`, if it exists; what it says about the camera goes to `info`.
pub(crate) fn described(path: &Path, info: &mut CaptureInfo) -> Option<BurstLayout> {
    if !path.is_file() {
        return None;
    }
    let record = match Sidecar::load(path) {
        Ok(record) => record,
        Err(e) => {
            info.notes.push(format!("{} is ignored: {e}", path.display()));
            return None;
        }
    };
    info.reasons.push(RECORD.to_owned());
    let layout = match record {
        Sidecar::Simulated(record) => {
            info.binary = record.simulation.sensor.response == Response::Binary;
            info.gain = Some(record.gain);
            info.ppp = Some(record.light.ppp);
            info.mean_level = Some(record.light.mean_level);
            info.sensor = Some(record.simulation.sensor);
            record.burst
        }
        Sidecar::Converted(conversion) => {
            info.binary = conversion.binary;
            let known = conversion.preset.as_deref().and_then(preset);
            info.preset = known.map(|preset| preset.name);
            info.cfa = conversion.cfa;
            info.gain = conversion.gain;
            info.ppp = conversion.light.map(|light| light.ppp);
            info.mean_level = conversion.light.map(|light| light.mean_level);
            info.sensor = conversion.sensor;
            conversion.burst
        }
    };
    info.max_count = Some(layout.max_count);
    info.fps = layout.fps;
    Some(layout)
}
