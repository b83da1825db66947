//! `qudi train`: a recipe and data in, weights out.

use super::args::Train;
use super::data::{files, make_pack};
use super::environment::{ENVIRONMENT, environment};
use super::plan::{Action, Plan};
use super::resume::{check_pack, check_recipe};
use super::run_folder::{RunFolder, check_folder, clear};
use super::stages::train_stages;
use super::watch::{Watch, quality_text, write, write_report};
use crate::args::Global;
use crate::device;
use crate::error::{CliError, Result};
use crate::interrupt;
use crate::report::Report;
use crate::settings::Settings;
use crate::version::COMMIT;
use crate::weights::recipes_of;
use burn::tensor::Device;
use qudi_baselines::learning::Baseline;
use qudi_model::config::NetworkConfig;
use qudi_model::diffusion::Diffusion;
use qudi_model::regression::Regression;
use qudi_model::window::Window;
use qudi_train::dataset::Pack;
use qudi_train::loss::lpips::Lpips;
use qudi_train::{From, Learner, NetworkRecipe, Origin, Run, WEIGHTS, draw_bursts};
use serde_json::json;
use std::path::Path;

pub(crate) fn run(
    args: &Train,
    settings: &Settings,
    global: &Global,
    report: &Report,
) -> Result<()> {
    let plan = Plan::new(args, settings, global)?;
    match plan.action {
        Action::Prepare if plan.bursts.is_none() => pack(&plan, report),
        Action::Prepare => match plan.recipe.network {
            NetworkRecipe::Qudi(NetworkConfig::Regression(_)) => draw::<Regression>(&plan, report),
            NetworkRecipe::Qudi(NetworkConfig::Diffusion(_)) => draw::<Diffusion>(&plan, report),
            NetworkRecipe::Qudi(NetworkConfig::Window(_)) => draw::<Window>(&plan, report),
            NetworkRecipe::Baseline(_) => draw::<Baseline>(&plan, report),
        },
        Action::Start | Action::Resume => match plan.recipe.stages()? {
            stages if stages.is_empty() => train(&plan, report),
            stages => train_stages(&plan, stages, report),
        },
    }
}

/// Makes the pack of a recipe.
fn pack(plan: &Plan, report: &Report) -> Result<()> {
    let psnr = make_pack(plan, plan.overwrite, report)?;
    let path = &plan.pack;
    let pack = Pack::open(path, &plan.recipe.packed_sources())?;
    let frames: usize = pack.clips().iter().map(|clip| clip.frames).sum();
    let clips = pack.clips().len();
    let mut text = format!("{}: {clips} clips and stills, {frames} frames", path.display());
    if let Some(psnr) = psnr {
        text += &format!("; {psnr:.1} dB PSNR of frames for training against their sources");
    }
    report.result(&text, || json!({"pack": path, "clips": clips, "frames": frames, "psnr": psnr}))
}

/// Checks that the weights of the perceptual term are there.
pub(super) fn find_backbones(plan: &Plan) -> Result<()> {
    Ok(Lpips::find(plan.recipe.train.loss().term, plan.backbones.as_deref())?)
}

/// Trains to the end of the recipe.
pub(super) fn train(plan: &Plan, report: &Report) -> Result<()> {
    match plan.recipe.network {
        NetworkRecipe::Qudi(NetworkConfig::Regression(_)) => {
            train_network::<Regression>(plan, report)
        }
        NetworkRecipe::Qudi(NetworkConfig::Diffusion(_)) => {
            train_network::<Diffusion>(plan, report)
        }
        NetworkRecipe::Qudi(NetworkConfig::Window(_)) => train_network::<Window>(plan, report),
        NetworkRecipe::Baseline(_) => train_network::<Baseline>(plan, report),
    }
}

/// Refuses weights that the network of a recipe cannot start from.
pub(super) fn check_init(plan: &Plan, init: Option<&Path>, device: &Device) -> Result<()> {
    let Some(path) = init else { return Ok(()) };
    let recipe = &plan.recipe;
    match recipe.network {
        NetworkRecipe::Qudi(NetworkConfig::Regression(_)) => {
            Regression::load(path, recipe, device).map(drop)
        }
        NetworkRecipe::Qudi(NetworkConfig::Diffusion(_)) => {
            <Diffusion as Learner>::load(path, recipe, device).map(drop)
        }
        NetworkRecipe::Qudi(NetworkConfig::Window(_)) => {
            Window::load(path, recipe, device).map(drop)
        }
        NetworkRecipe::Baseline(_) => Baseline::load(path, recipe, device).map(drop),
    }?;
    Ok(())
}

/// Returns the recipes of the stages before: of the weights to start from, or of the run's own but the last.
fn earlier_recipes(plan: &Plan) -> Vec<String> {
    if plan.action != Action::Resume {
        return plan.init.as_deref().map(recipes_of).unwrap_or_default();
    }
    let mut recipes = recipes_of(&plan.folder.join(WEIGHTS));
    recipes.pop();
    recipes
}

fn train_network<L: Learner>(plan: &Plan, report: &Report) -> Result<()> {
    let (folder, recipe) = (&plan.folder, &plan.recipe);
    check_folder(plan)?;
    if plan.action == Action::Resume {
        check_recipe(folder, recipe)?;
        check_pack(folder, &plan.pack)?;
    }
    let devices = plan.devices.iter().map(|name| device::open(name)).collect::<Result<Vec<_>>>()?;
    if devices.iter().any(|device| recipe.train.precision.is_emulated(&device.device)) {
        report.remark(
            "note: without units for bfloat16, numbers are only rounded to it: a run started with --set \
             train.precision=f32 is faster",
        );
    }
    let _folder = RunFolder::open(folder)?;
    find_backbones(plan)?;
    let files = files(plan, report)?;
    let from = if plan.action == Action::Resume {
        From::State
    } else {
        let init = plan.init.as_deref();
        let init = init.map(|path| L::load(path, recipe, &devices[0].device).map(Box::new));
        From::Start(init.transpose()?)
    };
    let list: Vec<_> = devices.iter().map(|device| device.device.clone()).collect();
    let commit = COMMIT.map(str::to_owned);
    let earlier = earlier_recipes(plan);
    let origin = Origin { steps: 0, commit, earlier };
    let mut run = Run::open(folder, recipe, from, files, &list, plan.backbones.as_deref(), origin)?;
    if plan.action == Action::Start {
        clear(folder)?;
    }
    write(folder, ENVIRONMENT, environment(&devices, &plan.pack)?.as_bytes())?;
    let mut watch = Watch::new(recipe, folder, plan.end, report);
    let learnt =
        device::guarded("training", || run.learn(plan.workers, &mut |event| watch.event(&event)));
    let [step, steps] = run.progress();
    let is_over = watch.is_over();
    let last = watch.finish()?;
    match learnt {
        Ok(Ok(())) => {}
        Ok(Err(qudi_core::Error::Interrupted)) => {
            let text = format!("stopped after step {step} of {steps}: --resume goes on");
            let stopped = if is_over { CliError::TimeOver } else { CliError::Stopped };
            return Err(stopped(text));
        }
        Ok(Err(error)) => return Err(error.into()),
        Err(problem) => {
            return Err(CliError::new(
                format!("the device failed in step {}: {problem}", step + 1),
                "--device",
                "lower train.batch or data.crop and raise train.accumulate; --resume goes on from the last state",
            ));
        }
    }
    write_report(folder)?;
    let weights = folder.join(WEIGHTS);
    let means = last.unwrap_or_default();
    let quality: Vec<_> = means
        .iter()
        .map(|(ppp, [psnr_a, psnr, ssim])| {
            json!({"ppp": ppp, "psnr_a": psnr_a, "psnr": psnr, "ssim": ssim})
        })
        .collect();
    let text = format!("{} after {steps} steps\n{}", weights.display(), quality_text(&means));
    report.result(&text, || json!({"weights": weights, "steps": steps, "validation": quality}))
}

/// Draws all bursts of a recipe.
fn draw<L: Learner>(plan: &Plan, report: &Report) -> Result<()> {
    let opened = device::open(plan.devices.first().map_or("auto", String::as_str))?;
    let (folder, recipe) = (&plan.folder, &plan.recipe);
    if !recipe.stage.is_empty() {
        return Err(CliError::new(
            "bursts of a later stage are drawn with what the one before has learnt",
            "--prepare",
            "leave --bursts out here: each stage draws its own when it trains, and keeps them in --bursts",
        ));
    }
    let files = files(plan, report)?;
    let network = match &plan.init {
        Some(path) => L::load(path, recipe, &opened.device)?,
        None => L::init(recipe, &opened.device)?,
    };
    let mut bar = report.bar();
    let mut bursts = 0;
    let drawn = device::guarded("drawing", || {
        let workers = plan.workers;
        draw_bursts(recipe, &network, files, &opened.device, workers, &mut |[done, all]| {
            bursts = all;
            bar.update("drawing", done, Some(all));
            interrupt::check()
        })
    });
    match drawn {
        Ok(Err(qudi_core::Error::Interrupted)) => {
            let text = format!("stopped: the same command goes on in {}", folder.display());
            return Err(CliError::Stopped(text));
        }
        Ok(drawn) => drawn?,
        Err(problem) => {
            let what = format!("the device failed: {problem}");
            return Err(CliError::new(what, "--device", "lower data.crop, or take cpu"));
        }
    }
    let text = format!("{}: {bursts} bursts", folder.display());
    report.result(&text, || json!({"folder": folder, "bursts": bursts}))
}
