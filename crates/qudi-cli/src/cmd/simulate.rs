//! `qudi simulate`: settings to simulation, exposed frames to files.

use crate::args::{Global, Simulate};
use crate::cmd::tiff_samples::tiff_samples;
use crate::error::{Fault, Result};
use crate::interrupt;
use crate::places::Places;
use crate::report::Report;
use crate::settings::Settings;
use qudi_core::SimError;
use qudi_core::atomic_file::{Overwrite, PendingFile, refuse_taken};
use qudi_core::flow::Flow;
use qudi_core::sensor::Sensor;
use qudi_io::sidecar::{BurstLayout, ClipDigest, Record, VERSION};
use qudi_io::writer::{ArrayWriter, ClipWriter, GifWriter, TiffSamples};
use qudi_io::writer::{BurstFormat, BurstWriter, write_npy_stream};
use qudi_sim::clip::{Input, Sampling};
use qudi_sim::{Exposed, Simulation, Sink, Stage, Start, Summary, simulate};
use serde_json::{Value, json};
use std::fmt::Write as _;
use std::hash::{BuildHasher, RandomState};
use std::io::{IsTerminal, Write, stdout};
use std::path::{Path, PathBuf};

pub(crate) fn run(
    args: &Simulate,
    settings: Settings,
    global: &Global,
    report: &Report,
) -> Result<()> {
    let to_stdout = args.output == "-";
    if to_stdout && report.json() {
        return Err(Fault::new(
            "--json and -o - both write to standard output",
            "--json",
            "write the burst to a file",
        ));
    }
    let (mut simulation, recorded) = match &args.from {
        Some(path) => {
            reject_settings_beside_record(args, global)?;
            let record = Record::load(path)?;
            (record.simulation, Some((record.clip.crc32, path)))
        }
        None => (simulation(args, &settings.with_flags(&args.keys)?)?, None),
    };
    if matches!(simulation.input, Input::Pipe { .. }) && std::io::stdin().is_terminal() {
        return Err(Fault::new(
            "nothing is piped in",
            "standard input",
            "pipe a clip in, as in `ffmpeg -i VIDEO -f yuv4mpegpipe - | qudi simulate - -o OUT`",
        ));
    }
    let overwrite = if global.force { Overwrite::Yes } else { Overwrite::No };
    if args.flow.is_some() && !simulation.input.is_synthetic() {
        return Err(Fault::new(
            "a recorded clip has no known flow",
            "--flow",
            "leave it out, or use a still in motion or a procedural scene",
        ));
    }
    let input = args.input.as_deref().filter(|input| !input.starts_with("scene:"));
    let format = BurstFormat::for_path(Path::new(&args.output), 1, true);
    let record = format.ok().map(|format| format.record_path(Path::new(&args.output)));
    // The record of a folder lies in the folder.
    let record = record.filter(|record| !record.starts_with(&args.output));
    let beside = [&args.truth, &args.flow, &args.preview];
    Places::default()
        .reads(input)
        .reads(&args.from)
        .reads([simulation.input.place()])
        .reads(&global.config)
        .writes([&args.output])
        .writes(record.filter(|_| args.output != "-"))
        .writes(beside.into_iter().flatten())
        .writes(args.visionsim.then(|| transforms_path(args)))
        .check()?;
    let mut outputs = Outputs::new(args, &simulation.sensor, overwrite)?;
    simulation.input.spool(&mut std::io::stdin().lock(), &mut interrupt::check)?;
    let mut bar = report.bar();
    let summary = simulate(&simulation, &mut outputs, &mut |progress| {
        let what = match progress.stage {
            Stage::Measuring => "measuring",
            Stage::Exposing => "exposing",
        };
        bar.update(what, progress.done, progress.total);
        interrupt::check()
    })?;
    drop(bar);
    if let Some((crc32, path)) = recorded
        && crc32 != summary.clip_crc32
    {
        return Err(Fault::new(
            "the input has changed since the record was written",
            path.display(),
            "restore the old input; `simulation.input` in the record names it",
        ));
    }
    if let Some(asked) = simulation.sampling.frames
        && summary.frames < asked
    {
        report
            .remark(&format!("the clip gives {} frames of the {asked} asked for", summary.frames));
    }
    let record = record_of(simulation, &summary, outputs.format);
    let written = outputs.finish(&record)?;
    let text = describe(&record, &summary, &written, args);
    if to_stdout {
        report.remark(text.trim_end());
        return Ok(());
    }
    report.result(&text, || {
        let mut document = serde_json::to_value(&record).unwrap_or(Value::Null);
        document["written"] = json!(written);
        document["mean_count"] = json!(summary.mean_count);
        document["saturated"] = json!(summary.saturated);
        document
    })
}

fn reject_settings_beside_record(args: &Simulate, global: &Global) -> Result<()> {
    let given = args.keys.first();
    let given = given.or((!global.set.is_empty()).then(|| "--set".to_owned()));
    let given = given.or(global.config.is_some().then(|| "--config".to_owned()));
    let Some(given) = given else { return Ok(()) };
    Err(Fault::new(
        format!("{given} beside --from: a record says everything about its burst"),
        &given,
        "leave it out, or give the input instead of the record",
    ))
}

fn simulation(args: &Simulate, settings: &Settings) -> Result<Simulation> {
    let input = Input::parse(
        args.input.as_deref().unwrap_or_default(),
        settings.parse("simulate.motion")?,
        settings.parse("simulate.size")?,
        settings.get("simulate.scene_seed")?,
        settings.get("simulate.speed")?,
    )?;
    // Drawn seeds stay short enough to be read out and typed.
    let drawn = || RandomState::new().hash_one(0) % 1_000_000;
    Ok(Simulation {
        input,
        sampling: Sampling {
            frames: settings.get("simulate.frames")?,
            instants: settings.get("simulate.instants")?,
            transfer: settings.get("simulate.transfer")?,
            white: settings.get("simulate.white")?,
        },
        sensor: settings.sensor(&settings.get::<String>("simulate.sensor")?)?,
        ppp: settings.get("simulate.ppp")?,
        ppp_def: settings.get("simulate.ppp_def")?,
        exposure: settings.get("simulate.exposure")?,
        seed: settings.get::<Option<u64>>("simulate.seed")?.unwrap_or_else(drawn),
    })
}

/// Counts of a frame as the bytes of a stream.
type FrameEncoder = Box<dyn Fn(&[u16]) -> Vec<u8>>;

/// Where the frames of one simulation go.
struct Outputs<'a> {
    args: &'a Simulate,
    overwrite: Overwrite,
    max_count: u16,
    format: BurstFormat,
    burst: Option<BurstWriter>,
    stream: Option<FrameEncoder>,
    truth: Option<ClipWriter>,
    tiff: TiffSamples,
    flow: Option<ArrayWriter>,
    preview: Option<GifWriter>,
}

impl<'a> Outputs<'a> {
    fn new(args: &'a Simulate, sensor: &Sensor, overwrite: Overwrite) -> Result<Self> {
        let max_count = sensor.max_count();
        let packed = !args.unpacked;
        let format = if args.output == "-" {
            BurstFormat::npy(max_count, packed)
        } else {
            BurstFormat::for_path(Path::new(&args.output), max_count, packed)?
        };
        if args.visionsim && (format != BurstFormat::NpyPacked || args.output == "-") {
            return Err(Fault::new(
                "visionsim opens packed binary .npy files only",
                "--visionsim",
                "use a binary sensor (--sensor swissspad2), no --sum, and -o NAME.npy",
            ));
        }
        // Refused here, before the clip is read.
        let path = PathBuf::from(&args.output);
        let record = format.record_path(&path);
        let burst = [path, record].map(|path| (args.output != "-").then_some(path));
        let beside = [&args.truth, &args.flow, &args.preview].map(Clone::clone);
        let transforms = args.visionsim.then(|| transforms_path(args));
        for path in burst.into_iter().chain(beside).chain([transforms]).flatten() {
            refuse_taken(&path, overwrite)?;
        }
        Ok(Self {
            args,
            overwrite,
            max_count,
            format,
            burst: None,
            stream: None,
            truth: None,
            tiff: args
                .truth
                .as_ref()
                .map_or(Ok(TiffSamples::U16), |p| tiff_samples(args.float, p))?,
            flow: None,
            preview: None,
        })
    }

    /// Gives everything its name, side outputs first, the burst and its record last.
    fn finish(self, record: &Record) -> Result<Vec<PathBuf>> {
        let mut written = Vec::new();
        if let (Some(truth), Some(path)) = (self.truth, &self.args.truth) {
            truth.finish()?;
            written.push(path.clone());
        }
        if let (Some(flow), Some(path)) = (self.flow, &self.args.flow) {
            flow.finish()?;
            written.push(path.clone());
        }
        if let (Some(preview), Some(path)) = (self.preview, &self.args.preview) {
            preview.finish()?;
            written.push(path.clone());
        }
        let path = PathBuf::from(&self.args.output);
        if self.args.visionsim {
            let transforms = transforms_path(self.args);
            let document = serde_json::to_vec(&visionsim_transforms(record, &path));
            let document = document
                .map_err(|e| Fault::new(e, transforms.display(), "report this as a bug"))?;
            PendingFile::write_whole(&transforms, &document, self.overwrite)?;
            written.push(transforms);
        }
        if let Some(burst) = self.burst {
            let json = serde_json::to_vec_pretty(record)
                .map_err(|e| Fault::new(e, &self.args.output, "report this as a bug"))?;
            let record_path = self.format.record_path(&path);
            burst.finish(&json, self.overwrite)?;
            written.splice(0..0, [path, record_path]);
        }
        Ok(written)
    }
}

impl Sink for Outputs<'_> {
    fn start(&mut self, start: Start) -> qudi_core::Result<()> {
        let (args, overwrite) = (self.args, self.overwrite);
        if args.output == "-" {
            let stream = write_npy_stream(
                &mut stdout().lock(),
                self.format,
                start.frames as usize,
                start.size,
            );
            let stream =
                stream.map_err(|e| SimError::io("write", Path::new("standard output"), e))?;
            self.stream = Some(Box::new(stream));
        } else {
            let path = Path::new(&args.output);
            self.burst = Some(BurstWriter::create(
                path,
                self.format,
                start.size,
                self.max_count,
                overwrite,
            )?);
        }
        let create = |path: &PathBuf| ClipWriter::create(path, start.size, self.tiff, overwrite);
        self.truth = args.truth.as_ref().map(create).transpose()?;
        let create = |path: &PathBuf| {
            ArrayWriter::create(path, overwrite, "<f4", &[3, start.size.height, start.size.width])
        };
        self.flow = args.flow.as_ref().map(create).transpose()?;
        let create =
            |path: &PathBuf| GifWriter::create(path, overwrite, start.size, self.max_count);
        self.preview = args.preview.as_ref().map(create).transpose()?;
        Ok(())
    }

    fn frame(
        &mut self,
        exposed: Exposed<'_>,
        flow: &dyn Fn() -> Option<Flow>,
    ) -> qudi_core::Result<()> {
        if let Some(burst) = &mut self.burst {
            burst.push(exposed.counts)?;
        }
        if let Some(encode) = &self.stream {
            let written = stdout().lock().write_all(&encode(exposed.counts));
            written.map_err(|e| SimError::io("write", Path::new("standard output"), e))?;
        }
        if let Some(truth) = &mut self.truth {
            truth.push(exposed.truth)?;
        }
        if let Some(preview) = &mut self.preview {
            preview.push(exposed.counts)?;
        }
        let Some(array) = &mut self.flow else { return Ok(()) };
        let Some(flow) = flow() else { return Ok(()) };
        let visible = flow.visible.iter().map(|&v| f32::from(u8::from(v)));
        array.push_f32(flow.dx.iter().copied().chain(flow.dy.iter().copied()).chain(visible))
    }
}

fn record_of(simulation: Simulation, summary: &Summary, format: BurstFormat) -> Record {
    Record {
        version: VERSION,
        program: concat!("qudi ", env!("CARGO_PKG_VERSION")).to_owned(),
        burst: BurstLayout::new(format, summary.frames, summary.size, &simulation.sensor),
        light: summary.light,
        gain: summary.gain,
        clip: ClipDigest { mean: summary.clip_mean, crc32: summary.clip_crc32 },
        simulation,
    }
}

/// The file beside the burst that visionsim looks for.
fn transforms_path(args: &Simulate) -> PathBuf {
    Path::new(&args.output).with_file_name("transforms.json")
}

/// What visionsim needs to unpack the burst; a camera without pose.
fn visionsim_transforms(record: &Record, path: &Path) -> Value {
    let burst = &record.burst;
    let identity = json!([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]);
    let frames: Vec<_> =
        (0..burst.frames).map(|_| json!({ "transform_matrix": identity })).collect();
    json!({
        "file_path": path.file_name().unwrap_or_default().to_string_lossy(),
        "h": burst.size.height, "w": burst.size.width, "c": 1,
        "fl_x": burst.size.width, "fl_y": burst.size.width,
        "cx": burst.size.width as f64 / 2.0, "cy": burst.size.height as f64 / 2.0,
        "bitpack": true, "bitpack_dim": 2,
        "frames": frames,
    })
}

fn describe(record: &Record, summary: &Summary, written: &[PathBuf], args: &Simulate) -> String {
    let burst = &record.burst;
    let meaning = serde_json::to_value(record.simulation.ppp_def).ok();
    let meaning = meaning.as_ref().and_then(Value::as_str).unwrap_or_default().to_owned();
    let mut text = String::new();
    let name = if args.output == "-" { "standard output" } else { args.output.as_str() };
    let _ =
        writeln!(text, "{name}   {} frames of {}, {} bit", burst.frames, burst.size, burst.bits);
    let _ = writeln!(
        text,
        "  sensor  {} · gain {:.4} DN/e-",
        record.simulation.sensor.name, record.gain
    );
    let _ = writeln!(
        text,
        "  light   {} photons/pixel/frame ({meaning}) · {:.4} incident · exposure {:.4}",
        record.simulation.ppp, record.light.ppp, record.light.exposure
    );
    let _ = writeln!(
        text,
        "  counts  mean {:.4} of {} · {:.2} % saturated",
        summary.mean_count,
        burst.max_count,
        100.0 * summary.saturated
    );
    if summary.hot_and_dead != (0, 0) {
        let _ = writeln!(
            text,
            "  pixels  {} hot · {} dead",
            summary.hot_and_dead.0, summary.hot_and_dead.1
        );
    }
    let _ = writeln!(text, "  seed    {}", record.simulation.seed);
    for path in written.iter().skip(1) {
        let _ = writeln!(text, "  wrote   {}", path.display());
    }
    text
}
