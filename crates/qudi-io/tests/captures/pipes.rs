//! Captures through a pipe: the same frames as from a file, memory bounded, ends noticed.

use crate::{counts, npy, open, pack, plain, refusal, scene, scratch, write};
use proptest::prelude::*;
use qudi_burst::Average;
use qudi_core::restorer::Acquisition;
use qudi_core::sensor::Sensor;
use qudi_core::windows::Windows;
use qudi_core::{Error, Frame};
use qudi_io::capture::Capture;
use qudi_io::description::{Axes, PackAxis, ReadOptions};
use qudi_io::restore::{RestoreSink, Schedule, run};
use std::ops::ControlFlow;

fn piped(bytes: &[u8], options: &ReadOptions) -> Result<Capture, Error> {
    Capture::from_pipe(std::io::Cursor::new(bytes.to_vec()), options, None)
}

fn raw(size: &str) -> ReadOptions {
    ReadOptions {
        format: Some("raw-u8".to_owned()),
        size: Some(size.parse().unwrap()),
        bits: Some(1),
        ..plain()
    }
}

proptest! {
    /// Headers, lengths and options of any kind: frames or an error, never a panic.
    #[test]
    fn hostile_piped_arrays_never_panic(
        shape in prop::collection::vec(0usize..7, 0..5),
        descr in prop::sample::select(vec!["|u1", "|b1", "<u2", ">i4", "<f4"]),
        fortran in prop::sample::select(vec!["True", "False"]),
        data in prop::collection::vec(0u8..3, 0..600),
        (start, end) in (0u64..9, prop::option::of(0u64..9)),
        sum in 0u32..5,
        (lenient, channel) in (any::<bool>(), prop::option::of(0usize..4)),
        axes in prop::option::of(prop::sample::select(vec![Axes::Thw, Axes::Twh, Axes::Hwt])),
    ) {
        let shape: Vec<String> = shape.iter().map(|d| format!("{d},")).collect();
        let bytes = npy(descr, fortran, &format!("({})", shape.concat()), &data);
        let options = ReadOptions {
            pack_axis: Some(PackAxis::None),
            start: Some(start),
            end,
            sum: Some(sum),
            lenient,
            channel,
            axes,
            ..plain()
        };
        if let Ok(mut capture) = piped(&bytes, &options) {
            prop_assert!(capture.frames() > 0);
            let mut counts = vec![0; capture.size().pixels()];
            if let Ok(frames) = capture.wait_for(u64::MAX) {
                for frame in 0..frames {
                    let _ = capture.read(frame, &mut counts);
                }
                prop_assert_eq!(capture.length(), Some(frames));
            }
        }
    }
}

#[derive(Default)]
struct Collected(Vec<(u64, Frame)>);

impl RestoreSink for Collected {
    fn frame(&mut self, number: u64, restored: &Frame, _: &[u16]) -> qudi_core::Result<()> {
        self.0.push((number, restored.clone()));
        Ok(())
    }
}

fn restored(capture: &mut Capture) -> Result<Vec<(u64, Frame)>, Error> {
    let acquisition =
        Acquisition::new(Sensor::load("ideal").unwrap(), 1.0, 0.45).unwrap().with_seed(1);
    let windows = Windows::new(capture.frames(), 11, 3)?;
    let mut sink = Collected::default();
    let mut on = |_: u64, _: Option<u64>| ControlFlow::Continue(());
    run(
        &mut Average,
        capture,
        &Schedule::all(windows),
        0..u64::MAX,
        &acquisition,
        &mut sink,
        &mut on,
    )?;
    Ok(sink.0)
}

/// Every length around one, two and three windows, of which the last is moved.
#[test]
fn pipe_restores_the_same_frames_as_a_file() {
    let folder = scratch();
    for frames in 1..40 {
        let data: Vec<u8> =
            scene(frames, 6, 9, frames as u64).iter().flatten().map(|&c| c as u8).collect();
        let path = write(folder.path(), "a.bin", &data);
        let options = raw("6x9");
        let file = restored(&mut open(&path, &options).unwrap()).unwrap();
        let mut pipe = piped(&data, &options).unwrap();
        assert_eq!(pipe.length(), (frames < 11).then_some(frames as u64), "not known yet");
        let pipe = restored(&mut pipe).unwrap();
        assert_eq!(file.len(), frames);
        assert!(file == pipe, "{frames} frames");
        let array = npy("|u1", "False", &format!("({frames}, 6, 9)"), &data);
        let options = ReadOptions { pack_axis: Some(PackAxis::None), bits: Some(1), ..plain() };
        let mut pipe = piped(&array, &options).unwrap();
        assert_eq!(pipe.length(), Some(frames as u64), "the header tells");
        assert!(file == restored(&mut pipe).unwrap(), "{frames} frames of .npy");
    }
}

#[test]
fn packed_frames_parts_and_sums_are_those_of_a_file() {
    let folder = scratch();
    let frames = scene(100, 16, 24, 3);
    let packed: Vec<u8> = frames.iter().flat_map(|frame| pack(frame, 24, false)).collect();
    let array = npy("|u1", "False", "(100, 16, 3)", &packed);
    let path = write(folder.path(), "a.npy", &array);
    for (start, end, sum) in [(None, None, 1), (Some(7), None, 3), (Some(40), Some(93), 7)] {
        let options = ReadOptions { start, end, sum: Some(sum), ..plain() };
        let mut file = open(&path, &options).unwrap();
        let mut pipe = piped(&array, &options).unwrap();
        assert_eq!(pipe.frames().min(11), file.frames().min(11), "a first window is there");
        assert_eq!(pipe.wait_for(u64::MAX).unwrap(), file.frames());
        assert_eq!(counts(&mut pipe), counts(&mut file));
        assert_eq!(pipe.info().notes, file.info().notes);
    }
}

#[test]
fn released_frames_are_gone_and_the_end_is_known() {
    let data: Vec<u8> = scene(30, 4, 5, 1).iter().flatten().map(|&c| c as u8).collect();
    let mut pipe = piped(&data, &ReadOptions { end: Some(50), ..raw("4x5") }).unwrap();
    assert_eq!(pipe.length(), None);
    pipe.wait_for(20).unwrap();
    pipe.discard_before(15);
    let mut frame = vec![0; 20];
    pipe.read(15, &mut frame).unwrap();
    let gone = pipe.read(14, &mut frame).unwrap_err();
    assert!(gone.to_string().contains("frame 14 of a pipe"), "{gone}");
    assert_eq!(pipe.wait_for(50).unwrap(), 30);
    assert_eq!(pipe.length(), Some(30));
    assert_eq!(pipe.info().notes, ["the pipe ended after 30 frames, before `end 50`"]);
}

#[test]
fn rejects_formats_that_cannot_be_piped() {
    let says = |bytes: &[u8], options: &ReadOptions| refusal(piped(bytes, options));
    assert!(says(b"", &plain()).contains("nothing came"));
    assert!(says(b"YUV4MPEG2 W8 H8", &plain()).contains("pictures, not photon counts"));
    assert!(says(b"hello", &plain()).contains("no known format"));
    let named = ReadOptions { format: Some("tiff".to_owned()), ..plain() };
    assert!(says(b"II*\0", &named).contains("cannot be read from a pipe"));
    assert!(says(b"abc", &raw("2x2")).contains("3 of 4 bytes"));
    assert!(says(b"", &raw("2x2")).contains("frames 0 to 0 of 0"));
    // Headers of monsters allocate nothing.
    for shape in ["(9, 99999999999, 99999999999)", "(5, 4000, 4000)", "(0, 4, 4)", "(3,)"] {
        assert!(!says(&npy("|u1", "False", shape, &[1; 64]), &plain()).is_empty(), "{shape}");
    }
    let fortran = npy("|u1", "True", "(5, 4, 4)", &[1; 80]);
    let unpacked = ReadOptions { pack_axis: Some(PackAxis::None), ..plain() };
    assert!(says(&fortran, &unpacked).contains("frame axis of a piped array"));
}
