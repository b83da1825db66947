//! `qudi light`: how many photons a lux is, with every assumption printed.

use super::args::Light;
use crate::error::{CliError, Result};
use crate::report::Report;
use crate::settings::Settings;
use qudi_core::{Spectrum, ppp_from_lux, sensor_lux};
use serde_json::json;
use std::fmt::Write;

pub(crate) fn run(light: &Light, settings: &Settings, report: &Report) -> Result<()> {
    let sensor = settings.sensor(&light.sensor)?;
    let missing = |what: &str, flag: &str| {
        CliError::new(
            format!("the sensor has no {what}"),
            format!("sensor `{}`", sensor.name),
            format!("give it with {flag}"),
        )
    };
    let frame_time = || sensor.fps.map(|fps| f64::from(sensor.frames_summed) / fps);
    let exposure = light
        .exposure_time
        .or_else(frame_time)
        .ok_or_else(|| missing("frame rate", "--exposure-time"))?;
    let pitch = light.pitch.or(sensor.pitch_um).ok_or_else(|| missing("pixel pitch", "--pitch"))?;
    let spectrum =
        if light.daylight { Spectrum::Daylight } else { Spectrum::wavelength(light.wavelength) };
    for (flag, value, range) in [
        ("--lux", light.lux.unwrap_or(0.0), 0.0..=1e9),
        ("--ppp", light.ppp.unwrap_or(0.0), 0.0..=1e9),
        ("--scene-lux", light.scene_lux.unwrap_or(0.0), 0.0..=1e9),
        ("--exposure-time", exposure, 1e-12..=1e6),
        ("--pitch", pitch, 1e-3..=1e6),
        ("--wavelength", light.wavelength, 380.0..=780.0),
        ("--reflectance", light.reflectance, 0.0..=1.0),
        ("--transmission", light.transmission, 0.0..=1.0),
        ("--f-number", light.f_number, 0.1..=1000.0),
        ("--magnification", light.magnification, 0.0..=1000.0),
    ] {
        if !range.contains(&value) {
            return Err(CliError::new(
                format!("{flag} is {value}"),
                flag,
                format!("give a number between {} and {}", range.start(), range.end()),
            ));
        }
    }

    let ppp_per_lux = ppp_from_lux(1.0, exposure, pitch, spectrum);
    let through_lens = |lux| {
        sensor_lux(lux, light.reflectance, light.transmission, light.f_number, light.magnification)
    };
    let lux = match (light.ppp, light.scene_lux) {
        (Some(ppp), _) => ppp / ppp_per_lux,
        (None, Some(scene)) => through_lens(scene),
        (None, None) => light.lux.unwrap_or(0.0),
    };
    let ppp = lux * ppp_per_lux;
    let detected = sensor.quantum_efficiency * ppp;
    let dark = sensor.dark_per_frame()? * exposure / frame_time().unwrap_or(exposure);

    let colour = match spectrum {
        Spectrum::Daylight => "daylight, 395 to 718 nm".to_owned(),
        Spectrum::Monochromatic { nm, .. } => format!("one wavelength, {nm} nm"),
    };
    let kappa = spectrum.photons_per_lux_second_um2();
    let mut text = String::new();
    let _ = writeln!(
        text,
        "{lux:.4} lx on the sensor = {ppp:.4} incident photons per pixel and exposure"
    );
    let _ = writeln!(
        text,
        "  detected           {detected:.4} e- (QE {}), dark {dark:.4} e-",
        sensor.quantum_efficiency
    );
    let _ = writeln!(text, "assuming");
    let _ = writeln!(text, "  light              {colour}: {kappa:.0} photons per lx, s and um^2");
    let _ = writeln!(text, "  exposure           {exposure:.4e} s");
    let _ = writeln!(
        text,
        "  pixel              {pitch} um square, all of it; QE includes the fill factor"
    );
    if light.scene_lux.is_some() {
        let _ = writeln!(
            text,
            "  lens               f/{}, transmission {}, magnification {}; diffuse scene of reflectance {}",
            light.f_number, light.transmission, light.magnification, light.reflectance
        );
    }
    let unverified = if sensor.unverified.is_empty() {
        String::new()
    } else {
        format!(" (unverified: {})", sensor.unverified.join(", "))
    };
    let _ = writeln!(text, "  sensor             {}{unverified}", sensor.name);
    report.result(&text, || {
        json!({
            "lux": lux, "ppp": ppp, "detected": detected, "dark": dark,
            "assumptions": {
                "sensor": sensor.name, "spectrum": colour, "photons_per_lux_second_um2": kappa,
                "exposure_s": exposure, "pitch_um": pitch, "quantum_efficiency": sensor.quantum_efficiency,
            },
        })
    })
}
