//! Descriptions of TIFF stacks by ImageJ and OME: order of pages, channels, frame interval.

/// The axes of a stack beyond rows and columns.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Description {
    /// Number of all images, if known.
    pub(super) images: Option<u64>,
    /// Channels of the stack.
    pub(super) channels: u64,
    /// Planes of one instant, one above the other; 1 where planes are instants.
    pub(super) slices: u64,
    /// Images of their own, each with all axes.
    pub(super) series: u64,
    /// Pages between a channel and the next one of the same instant.
    pub(super) run: u64,
    /// Frames per second.
    pub(super) fps: Option<f64>,
    /// Names of the files that hold the stack, in order, if it says.
    pub(super) files: Vec<String>,
    /// Program that wrote it.
    pub(super) program: &'static str,
}

impl Description {
    /// Parses the text of the first page.
    pub(super) fn parse(text: &str) -> Option<Self> {
        if text.starts_with("ImageJ=") { Some(imagej(text)) } else { ome(text) }
    }
}

/// Parses `key=value` lines; pages are ordered channels first, then slices, then frames.
fn imagej(text: &str) -> Description {
    let value = |key: &str| {
        text.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix('=').map(str::trim))
    };
    let number = |key: &str| value(key)?.parse::<u64>().ok().filter(|&n| n > 0);
    let interval = value("finterval").and_then(|text| text.parse::<f64>().ok());
    let rate = value("fps").and_then(|text| text.parse::<f64>().ok());
    let fps = interval.filter(|&seconds| seconds > 0.0).map(|seconds| 1.0 / seconds).or(rate);
    Description {
        images: number("images"),
        channels: number("channels").unwrap_or(1),
        slices: slices(number("slices"), number("frames")),
        series: 1,
        run: 1,
        fps: fps.filter(|fps| fps.is_finite() && *fps > 0.0),
        files: Vec::new(),
        program: "ImageJ",
    }
}

/// Returns the planes of one instant, where there are instants, too: programs also call instants slices.
fn slices(slices: Option<u64>, instants: Option<u64>) -> u64 {
    if instants.is_some_and(|instants| instants > 1) { slices.unwrap_or(1) } else { 1 }
}

/// Parses the attributes of the first `<Pixels ...>` of OME-XML.
fn ome(text: &str) -> Option<Description> {
    let at = text.find("<OME").and_then(|at| Some(at + text[at..].find("Pixels ")?))?;
    let element = &text[at..at + text[at..].find('>')?];
    let attribute = |name: &str| {
        let from = element.find(&format!(" {name}=\""))? + name.len() + 3;
        element[from..].split('"').next()
    };
    let extent = |name: &str| {
        let text = attribute(name)?;
        text.parse::<u64>().ok().filter(|&n| n > 0)
    };
    let order = attribute("DimensionOrder").unwrap_or("XYZCT");
    let before = order.split('C').next().unwrap_or_default();
    let size = |axis: char| match axis {
        'Z' => extent("SizeZ").unwrap_or(1),
        'T' => extent("SizeT").unwrap_or(1),
        _ => 1,
    };
    let run = before.chars().try_fold(1u64, |run, axis| run.checked_mul(size(axis)))?;
    // Interleaved samples of a pixel are channels of its page, not pages.
    let samples = text.find("SamplesPerPixel=\"").and_then(|at| {
        let digits = text[at + "SamplesPerPixel=\"".len()..].split('"').next()?;
        digits.parse::<u64>().ok().filter(|&n| n > 0)
    });
    let unit = match attribute("TimeIncrementUnit") {
        Some("ms") => 1e-3,
        Some("µs" | "us") => 1e-6,
        Some("ns") => 1e-9,
        _ => 1.0,
    };
    let increment = attribute("TimeIncrement").and_then(|text| text.parse::<f64>().ok());
    let fps = increment.filter(|&seconds| seconds > 0.0).map(|seconds| 1.0 / (seconds * unit));
    Some(Description {
        images: None,
        channels: (extent("SizeC").unwrap_or(1) / samples.unwrap_or(1)).max(1),
        slices: slices(extent("SizeZ"), extent("SizeT")),
        series: text.matches("<Pixels ").count() as u64,
        run,
        fps: fps.filter(|fps| fps.is_finite()),
        files: files(text),
        program: "OME",
    })
}

/// Returns the files that `<TiffData FirstT="0" ...><UUID FileName="...">` name, in the order of their first
/// instants. Only names in the same folder are taken.
fn files(text: &str) -> Vec<String> {
    let mut files: Vec<(u64, String)> = Vec::new();
    for data in text.split("<TiffData").skip(1) {
        let data = data.split("</TiffData>").next().unwrap_or_default();
        let value = |name: &str| data.split(&format!("{name}=\"")).nth(1)?.split('"').next();
        let first = value("FirstT").and_then(|text| text.parse().ok()).unwrap_or(0);
        let Some(name) = value("FileName") else { continue };
        let name = name.rsplit(['/', '\\']).next().unwrap_or_default();
        if !name.is_empty() && !files.iter().any(|(_, other)| other == name) {
            files.push((first, name.to_owned()));
        }
    }
    files.sort_by_key(|&(first, _)| first);
    files.into_iter().map(|(_, name)| name).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn reads_imagej() {
        let text =
            "ImageJ=1.11a\nimages=12\nchannels=3\nframes=4\nhyperstack=true\nfinterval=0.02\n";
        let d = Description::parse(text).unwrap();
        assert_eq!((d.images, d.channels, d.run, d.fps), (Some(12), 3, 1, Some(50.0)));
        let plain = Description::parse("ImageJ=1.53\nimages=7\n").unwrap();
        assert_eq!((plain.images, plain.channels, plain.fps), (Some(7), 1, None));
    }

    #[test]
    fn reads_names_of_ome_sets() {
        let data = |first: u64, name: &str| {
            format!(
                "<TiffData FirstT=\"{first}\" IFD=\"0\" PlaneCount=\"10\"><UUID FileName=\"{name}\">urn:uuid:1</UUID></TiffData>"
            )
        };
        let text = format!(
            "<OME><Image><Pixels SizeT=\"30\">{}{}{}{}</Pixels></Image></OME>",
            data(20, "c.ome.tif"),
            data(0, "/elsewhere/a.ome.tif"),
            data(10, "b.ome.tif"),
            data(11, "b.ome.tif"),
        );
        let files = Description::parse(&text).unwrap().files;
        assert_eq!(files, ["a.ome.tif", "b.ome.tif", "c.ome.tif"]);
    }

    #[test]
    fn reads_ome() {
        let ome = |attributes: &str| {
            format!(
                "<?xml version=\"1.0\"?><OME><Image><Pixels {attributes}><Channel/></Pixels></Image></OME>"
            )
        };
        let text = ome(
            "DimensionOrder=\"XYZCT\" SizeC=\"3\" SizeT=\"5\" SizeZ=\"2\" TimeIncrement=\"10\" TimeIncrementUnit=\"ms\"",
        );
        let d = Description::parse(&text).unwrap();
        assert_eq!((d.channels, d.run, d.fps), (3, 2, Some(100.0)));
        let first =
            Description::parse(&ome("DimensionOrder=\"XYCZT\" SizeC=\"2\" SizeT=\"4\"")).unwrap();
        assert_eq!((first.channels, first.run), (2, 1));
        assert_eq!(Description::parse("a microscope"), None);
    }

    proptest! {
        #[test]
        fn descriptions_from_strangers_never_panic(text in "(ImageJ=|<OME|Pixels |SizeC=\"|\"|>|[0-9]|channels=|\\n){0,20}") {
            let _ = Description::parse(&text);
        }
    }
}
