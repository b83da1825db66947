//! What an evaluation measured, in a sentence.

use super::score::{FlowKind, Row};
use serde_json::Value;

/// Describes clips, sensor, protocol, seed and measures of an evaluation with these settings.
pub(super) fn about(settings: &Value, rows: &[Row]) -> String {
    let flow = match rows.first().and_then(Row::flow) {
        Some(FlowKind::True) => "; flicker: rms change along the true flow beyond the truth's",
        Some(FlowKind::Estimated) => {
            "; flicker: rms change along the estimated flow (on the truth, checked both ways) beyond the truth's"
        }
        None => "",
    };
    let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    let names: Vec<String> = settings["clips"].as_array().into_iter().flatten().map(text).collect();
    let without_lpips = if settings["lpips_missing"] == true {
        "; LPIPS was not measured: --backbones names no weights"
    } else {
        ""
    };
    format!(
        "{} {} ({}), {}, protocol {}, seed {}; mean over clips ± 95 % confidence; PSNR in dB, -a after the best gain; worst 5 % of frames{flow}; peak MiB above what was held before{without_lpips}",
        names.len(),
        if names.len() == 1 { "clip" } else { "clips" },
        names.join(", "),
        text(&settings["sensor"]["name"]),
        text(&settings["protocol"]),
        settings["seed"],
    )
}
