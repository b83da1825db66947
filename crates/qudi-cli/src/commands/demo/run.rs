//! `qudi demo`: what the tool is for, on two built-in scenes: the noisy burst, what averaging and the best
//! classical methods make of it, what the network makes of it, the truth, errors and uncertainty.

use super::animation::gif;
use super::args::Demo;
use super::diffusion;
use super::html::html;
use super::picture::picture;
use super::restored::{Contender, ExposedScene, RestoredScene, rms};
use super::scenes::{SIZE, scenes};
use crate::args::Global;
use crate::error::{CliError, Result};
use crate::methods::network::{self, NetworkChoice};
use crate::methods::trained::built_in_knows;
use crate::report::{Output, Report, json};
use crate::settings::Settings;
use qudi_burst::{Average, PostFilter, Qbp, QbpRefined};
use qudi_core::atomic_file::Overwrite;
use serde_json::json;
use std::fmt::Write;
use std::path::PathBuf;

pub(crate) fn run(
    demo: &Demo,
    settings: &Settings,
    global: &Global,
    report: &Report,
) -> Result<()> {
    let path = demo.output.clone().unwrap_or_else(|| PathBuf::from("qudi-demo.png"));
    let page = path.with_extension("html");
    let animation = demo.animate.then(|| path.with_extension("gif"));
    let diffusion = demo.with_diffusion.then(|| path.with_extension("jpg"));
    if [Some(&page), animation.as_ref(), diffusion.as_ref()].contains(&Some(&path)) {
        let help = "name a .png; the other files lie next to it";
        return Err(CliError::new("two of the files have this name", path.display(), help));
    }
    let overwrite =
        if global.force || demo.output.is_none() { Overwrite::Yes } else { Overwrite::No };
    let picture_file = Output::open(Some(&path), overwrite)?;
    let page_file = Output::open(Some(&page), overwrite)?;
    let animation_file = Output::open(animation.as_deref(), overwrite)?;
    let diffusion_file = Output::open(diffusion.as_deref(), overwrite)?;
    let sensor = settings.sensor(&demo.sensor)?.as_read();
    let mut bar = report.bar();
    let (mut restored, mut sampled) = (Vec::new(), Vec::new());
    for scene in scenes()? {
        let exposed = ExposedScene::new(scene, &sensor, demo.ppp, demo.seed, &mut bar)?;
        // The first scene is a photograph.
        if demo.with_diffusion && sampled.is_empty() {
            let options = demo.network.options(demo.steps.steps, &demo.given);
            sampled = diffusion::picture(&exposed, &options, &mut bar)?;
        }
        let contenders = contenders(demo, &exposed)?;
        restored.push(exposed.restore(contenders, &mut bar)?);
    }
    drop(bar);
    if restored.iter().all(|scene| scene.methods.len() < 4) {
        report.remark(
            "note: the built-in weights do not know this sensor or light; the other methods do",
        );
    }

    picture_file.write(|| picture(&restored, demo.ppp).png())?;
    let foot = format!(
        "{} at {} photons/pixel/frame, seed {}; psnr in dB, -a after the best gain",
        sensor.name, demo.ppp, demo.seed
    );
    page_file.write(|| html(&restored, demo.ppp, &chosen(demo), &foot))?;
    if let Some(scene) = restored.first() {
        animation_file.write(|| gif(scene))?;
    }
    diffusion_file.write(|| Ok(sampled))?;
    let text: String =
        restored.iter().map(|scene| scene.table().to_text() + &text(scene)).collect();
    let mut text = format!("{text}{}   {foot}\n{}\n", path.display(), page.display());
    for further in animation.iter().chain(&diffusion) {
        let _ = writeln!(text, "{}", further.display());
    }
    report.result(&text, || {
        let scenes = restored.iter().map(|scene| {
            let name = scene.exposed.name.to_owned();
            (name, json!(json::rows(&scene.table())))
        });
        json!({
            "picture": path,
            "page": page,
            "animation": animation,
            "diffusion": diffusion,
            "seed": demo.seed,
            "figures": scenes.collect::<serde_json::Map<_, _>>(),
        })
    })
}

/// Returns the methods that are shown, the best one last.
fn contenders(demo: &Demo, exposed: &ExposedScene) -> Result<Vec<Contender>> {
    let acquisition = &exposed.acquisition;
    let mut contenders = vec![
        Contender {
            label: "AVERAGE OF 11",
            restorer: Box::new(Average),
            how: "the mean of all frames, without motion".to_owned(),
        },
        Contender {
            label: "QBP + BM3D",
            restorer: Box::new(Qbp::new(PostFilter::Bm3d)),
            how: "frames aligned and merged patch by patch, then BM3D on every frame".to_owned(),
        },
        Contender {
            label: "QBP REFINED",
            restorer: Box::new(QbpRefined),
            how: "a burst merged twice, the second time along better motion".to_owned(),
        },
    ];
    let options = demo.network.options(demo.steps.steps, &demo.given);
    options.check_weights(&[])?;
    if demo.network.own_weights().is_some() || built_in_knows(acquisition)? {
        let (restorer, how) = network::restorer(NetworkChoice::Best, &options, acquisition, SIZE)?;
        contenders.push(Contender { label: "QUDI", restorer, how: format!("the network{how}") });
    }
    let seeing = |contender: Contender| -> Result<Contender> {
        Ok(Contender { restorer: exposed.behind_filter(contender.restorer)?, ..contender })
    };
    contenders.into_iter().map(seeing).collect()
}

/// Returns the command that makes the same pictures.
fn chosen(demo: &Demo) -> String {
    let Demo { sensor, ppp, seed, .. } = demo;
    format!("qudi demo --sensor {sensor} --ppp {ppp} --seed {seed}")
}

fn text(scene: &RestoredScene) -> String {
    let Some(method) = scene.methods.last() else { return String::new() };
    let (error, uncertainty) = (rms(&scene.error(method)), rms(scene.uncertainty.centre()));
    let said = scene.uncertainty.said;
    format!("\n{} errs by {error:.3}; {said} {uncertainty:.3}\n\n", method.name)
}
