//! Weight files of version 0.1.0, in which one network could be both: the only place that knows their layout.

use serde_json::{Value, json};

/// Modules of the diffusion on top of the regression, which was removed.
const REMOVED_MODULES: [&str; 5] = ["low", "high", "flow", "fusion", "unet"];

/// The reason why a regression cannot diffuse.
pub(super) const NO_DIFFUSION: &str = "the diffusion on top of the regression was removed: lesions showed that it used neither its noise nor the simulated measurement";

/// Converts the description of a former file. Returns false if it is none; an error names what is removed.
pub(super) fn modernize(description: &mut Value) -> Result<bool, String> {
    let network = &description["network"];
    if !network.is_object() || !network["kind"].is_null() {
        return Ok(false);
    }
    let converted = if network["reference"] == "none" {
        diffusion(network.clone())?
    } else {
        regression(network)?
    };
    let is_diffusion = converted["kind"] == "diffusion";
    if is_diffusion {
        let steps = description["default_steps"].as_u64().unwrap_or(1).max(1);
        let spacing = description["spacing"].as_str().unwrap_or("log-logistic");
        description["sampling"] = json!({"steps": steps, "spacing": spacing});
    }
    description["network"] = converted;
    Ok(true)
}

fn regression(network: &Value) -> Result<Value, String> {
    let pre = &network["pre"];
    let is_whole = pre["stages"] == 2
        && pre["alignments"] == 3
        && pre["uncertainty"] == true
        && pre["weight_channels"].as_u64().is_some_and(|channels| channels > 0);
    if !is_whole {
        return Err("a regression without its refinement or its uncertainty was removed".to_owned());
    }
    let mut converted = json!({"kind": "regression", "fold": network["fold"]});
    for key in ["width", "blocks", "growth", "neighbours", "weight_channels"] {
        converted[key] = pre[key].clone();
    }
    Ok(converted)
}

fn diffusion(mut network: Value) -> Result<Value, String> {
    if network["unet"]["temporal"] == true {
        return Err("attention over time was removed".to_owned());
    }
    if network["unet"]["predicts"].is_null() {
        return Err("a U-Net with the skip connection of Karras et al. was removed".to_owned());
    }
    if network["ablate"].as_array().is_some_and(|parts| !parts.is_empty()) {
        return Err("weights no longer name parts that are left out".to_owned());
    }
    for (table, key) in [("pre", "neighbours"), ("flow", "registration"), ("unet", "temporal")] {
        if let Some(table) = network[table].as_object_mut() {
            table.remove(key);
        }
    }
    if let Some(network) = network.as_object_mut() {
        network.remove("reference");
        network.remove("ablate");
        network.insert("kind".to_owned(), "diffusion".into());
    }
    Ok(network)
}

/// Returns the name of a parameter in former files.
pub(super) fn name(parameter: &str) -> String {
    match parameter.strip_prefix("refinement.") {
        Some(rest) => format!("stages.0.{rest}"),
        None => parameter.to_owned(),
    }
}

/// Returns true if a parameter of a former regression is no longer used.
pub(super) fn is_removed(parameter: &str) -> bool {
    let module = parameter.split('.').next().unwrap_or_default();
    REMOVED_MODULES.contains(&module) || parameter.contains("simulated_in.")
}
