//! `qudi train`: a recipe and data in, weights out.

use crate::args::{Global, Train};
use crate::cmd::train_environment::{ENVIRONMENT, environment};
use crate::cmd::train_resume::{check_pack, check_recipe};
use crate::cmd::train_watch::{Watch, told, write, write_report};
use crate::device::{self, Opened};
use crate::error::{Fault, Result};
use crate::interrupt;
use crate::report::Report;
use crate::settings::{Settings, toml_text};
use qudi_core::atomic_file::Overwrite;
use qudi_model::checkpoint::{Description, load};
use qudi_train::dataset::{Pack, write_pack};
use qudi_train::loss::lpips::fetch;
use qudi_train::{Files, From, METRICS, RECIPE, Recipe, Run, Validation, WEIGHTS, draw_bursts};
use serde_json::json;
use std::path::{Path, PathBuf};

pub(crate) fn run(
    args: &Train,
    settings: &Settings,
    global: &Global,
    report: &Report,
) -> Result<()> {
    let recipe = recipe(args, settings)?;
    if args.cache_only {
        let path = args.pack.as_deref().unwrap_or(Path::new("pack.zip"));
        make_pack(args, &recipe, path, overwrite(global), report)?;
        let pack = Pack::open(path)?;
        let frames: usize = pack.clips().iter().map(|clip| clip.frames).sum();
        let clips = pack.clips().len();
        let text = format!("{}: {clips} clips and stills, {frames} frames", path.display());
        return report.result(&text, || json!({"pack": path, "clips": clips, "frames": frames}));
    }
    if args.draw_only {
        return draw_only(args, &recipe, report);
    }
    let folder = args.output.clone().unwrap_or_default();
    let exists = Run::exists(&folder);
    check_folder(args, global, &folder, exists)?;
    let pack_path = pack_path(args, &folder);
    if args.resume {
        check_recipe(&folder, &recipe)?;
        check_pack(&folder, &pack_path)?;
    }
    let devices = args.device.iter().map(|name| device::open(name)).collect::<Result<Vec<_>>>()?;
    make_folder(&folder, "the run's folder", "choose another with -o")?;
    if let (true, Some(backbones)) = (args.fetch, &args.backbones) {
        for path in fetch(recipe.train.loss.term, backbones)? {
            report.remark(&format!("{} is there", path.display()));
        }
    }
    let files = files(args, &recipe, &folder, report)?;
    let from = if args.resume {
        From::State
    } else {
        From::Start(
            args.init.as_deref().map(|path| initial(path, &recipe, &devices[0])).transpose()?,
        )
    };
    let list: Vec<_> = devices.iter().map(|device| device.device.clone()).collect();
    let commit = option_env!("QUDI_COMMIT").map(str::to_owned);
    let mut run =
        Run::open(&folder, &recipe, from, files, &list, args.backbones.as_deref(), commit)?;
    write(&folder, ENVIRONMENT, environment(&devices, &pack_path)?.as_bytes())?;
    let mut watch = Watch::new(&recipe, &folder, report)?;
    let learnt =
        device::guarded("training", || run.learn(args.workers, &mut |event| watch.event(&event)));
    let [step, steps] = run.progress();
    let last = watch.finish()?;
    match learnt {
        Ok(Ok(())) => {}
        Ok(Err(qudi_core::SimError::Interrupted)) => {
            let text = format!("stopped after step {step} of {steps}: --resume goes on");
            return Err(Fault::Stopped(text));
        }
        Ok(Err(error)) => return Err(error.into()),
        Err(problem) => {
            return Err(Fault::new(
                format!("the device failed in step {}: {problem}", step + 1),
                "--device",
                "lower train.batch or data.crop and raise train.accumulate; --resume goes on from the last state",
            ));
        }
    }
    write_report(&folder)?;
    let weights = folder.join(WEIGHTS);
    let means = last.as_ref().map(Validation::means).unwrap_or_default();
    let quality: Vec<_> = means
        .iter()
        .map(|(ppp, [psnr_a, psnr, ssim])| {
            json!({"ppp": ppp, "psnr_a": psnr_a, "psnr": psnr, "ssim": ssim})
        })
        .collect();
    let text = format!("{} after {steps} steps\n{}", weights.display(), told(&means));
    report.result(&text, || json!({"weights": weights, "steps": steps, "validation": quality}))
}

/// All bursts of a recipe, for other programs, or before anything learns from them.
fn draw_only(args: &Train, recipe: &Recipe, report: &Report) -> Result<()> {
    let opened = device::open(args.device.first().map_or("auto", String::as_str))?;
    let folder = args.bursts.clone().unwrap_or_default();
    let files = files(args, recipe, &folder, report)?;
    let network = match &args.init {
        Some(path) => *initial(path, recipe, &opened)?,
        None => recipe.network.init(recipe.train.seed, &opened.device),
    };
    let mut bar = report.bar();
    let mut bursts = 0;
    let drawn = device::guarded("drawing", || {
        let workers = args.workers;
        draw_bursts(recipe, &network, files, &opened.device, workers, &mut |[done, all]| {
            bursts = all;
            bar.update("drawing", done, Some(all));
            interrupt::check()
        })
    });
    match drawn {
        Ok(Err(qudi_core::SimError::Interrupted)) => {
            let text = format!("stopped: the same command goes on in {}", folder.display());
            return Err(Fault::Stopped(text));
        }
        Ok(drawn) => drawn?,
        Err(problem) => {
            let what = format!("the device failed: {problem}");
            return Err(Fault::new(what, "--device", "lower data.crop, or take cpu"));
        }
    }
    let text = format!("{}: {bursts} bursts", folder.display());
    report.result(&text, || json!({"folder": folder, "bursts": bursts}))
}

/// What the recipe learns from; made first if it is not there.
fn files(args: &Train, recipe: &Recipe, folder: &Path, report: &Report) -> Result<Files> {
    if let Some(folder) = &args.bursts {
        make_folder(folder, "the folder of bursts", "choose another with --bursts")?;
    }
    let pack = pack(args, recipe, folder, report)?;
    Ok(Files { pack, bursts: args.bursts.clone() })
}

fn make_folder(folder: &Path, what: &str, help: &str) -> Result<()> {
    std::fs::create_dir_all(folder)
        .map_err(|e| Fault::new(format!("cannot make {what}: {e}"), folder.display(), help))
}

fn overwrite(global: &Global) -> Overwrite {
    if global.force { Overwrite::Yes } else { Overwrite::No }
}

fn recipe(args: &Train, settings: &Settings) -> Result<Recipe> {
    let changes = settings.recipe_changes().iter();
    let changes: Vec<_> = changes.map(|(key, value, _)| (key.clone(), toml_text(value))).collect();
    let own = args.output.as_ref().map(|folder| folder.join(RECIPE));
    let name = match (&args.recipe, own) {
        (Some(name), _) => name.clone(),
        (None, Some(own)) if args.resume => own.display().to_string(),
        _ => {
            return Err(Fault::new(
                "no recipe",
                "RECIPE",
                "name one: tiny, small, base, paper, or a .toml file",
            ));
        }
    };
    Ok(Recipe::load(&name, &changes)?)
}

fn check_folder(args: &Train, global: &Global, folder: &Path, exists: bool) -> Result<()> {
    if args.resume && !exists {
        return Err(Fault::new(
            "there is no state to go on from",
            folder.display(),
            "start without --resume, or name the run's folder with -o",
        ));
    }
    let own = [WEIGHTS, RECIPE, METRICS, ENVIRONMENT, "report.html"];
    let taken = exists || own.iter().any(|name| folder.join(name).exists());
    if !args.resume && taken && !global.force {
        return Err(Fault::new(
            "the folder holds a run already",
            folder.display(),
            "go on with --resume, choose another folder, or start anew with --force",
        ));
    }
    if !args.resume && taken {
        // A new run must not be taken for the old one's continuation.
        for name in ["state", "state.old", "state.new"] {
            let _ = std::fs::remove_dir_all(folder.join(name));
        }
        let _ = std::fs::remove_file(folder.join(METRICS));
    }
    Ok(())
}

/// Where the decoded files lie.
fn pack_path(args: &Train, folder: &Path) -> PathBuf {
    args.pack.clone().unwrap_or_else(|| folder.join("pack.zip"))
}

/// The recipe's files, decoded; made first if they are not there.
fn pack(args: &Train, recipe: &Recipe, folder: &Path, report: &Report) -> Result<Option<Pack>> {
    if !recipe.data.needs_files() && recipe.validation_data().is_none() {
        return Ok(None);
    }
    let path = pack_path(args, folder);
    if !path.exists() {
        make_pack(args, recipe, &path, Overwrite::No, report)?;
    }
    Ok(Some(Pack::open(&path)?))
}

fn make_pack(
    args: &Train,
    recipe: &Recipe,
    path: &Path,
    overwrite: Overwrite,
    report: &Report,
) -> Result<()> {
    let Some(data) = &args.data else {
        return Err(Fault::new(
            "the recipe reads files",
            "--data",
            "name the folder that they lie in, or a pack with --pack",
        ));
    };
    let validation = recipe.validation_data();
    let mut configs = vec![&recipe.data];
    configs.extend(&validation);
    let mut bar = report.bar();
    write_pack(&configs, data, path, overwrite, &mut |progress| {
        let [done, total] = progress.done;
        bar.update("decoding", done as u64, Some(total as u64));
        interrupt::check()
    })?;
    Ok(())
}

/// Weights to start from.
fn initial(
    path: &Path,
    recipe: &Recipe,
    device: &Opened,
) -> Result<Box<qudi_model::network::Qudi>> {
    let (mut network, Description { network: mut sizes, .. }) = load(path, &device.device)?;
    let before = sizes.pre.aligned_neighbours();
    // A pre-denoiser that sees more than a refinement stage does cannot become one.
    let is_stage = before == sizes.pre.stage().aligned_neighbours();
    if sizes.pre.stages + 1 == recipe.network.pre.stages && is_stage {
        sizes.pre.stages += 1;
        network = network.with_stage_added(sizes.pre.aligned_neighbours().count() - before.count());
    }
    if recipe.network.pre.uncertainty && !sizes.pre.uncertainty {
        let fresh = recipe.network.init(recipe.train.seed, &device.device);
        network = network.with_uncertainty_head_of(fresh);
        sizes.pre.uncertainty = true;
    }
    if sizes != recipe.network {
        return Err(Fault::new(
            "these weights are for a network of other sizes than the recipe's",
            path.display(),
            "choose the recipe that they were trained with, its [network] table, or that with one more refinement stage or with an uncertainty head",
        ));
    }
    Ok(Box::new(network))
}
