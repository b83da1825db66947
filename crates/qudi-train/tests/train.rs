//! Training is reproducible: results depend neither on workers nor devices, and a resumed run equals an
//! undisturbed one.
#![allow(clippy::unwrap_used)]

use burn::tensor::Device;
use qudi_core::Error;
use qudi_model::checkpoint::load;
use qudi_model::diffusion::Diffusion;
use qudi_model::regression::Regression;
use qudi_model::window::Window;
use qudi_model::{init_parameters, parameter_shapes};
use qudi_train::dataset::Dataset;
use qudi_train::diffusion::Batch;
use qudi_train::{
    BurstSampler, Event, Files, From, Learner, METRICS, Origin, Prefetcher, Recipe, Run,
    StepReport, Trainer, WEIGHTS, parameters,
};
use std::ops::ControlFlow;
use std::path::Path;

/// Returns the small diffusion, smaller and shorter.
fn recipe(changes: &[(&str, &str)]) -> Recipe {
    shortened(include_str!("../../../tests/golden/tiny.toml"), changes)
}

/// Returns the small regression, as short.
fn regression(changes: &[(&str, &str)]) -> Recipe {
    shortened(include_str!("../../../tests/golden/regression.toml"), changes)
}

fn shortened(text: &str, changes: &[(&str, &str)]) -> Recipe {
    let small = [
        ("data.crop", "32"),
        ("data.frames", "3"),
        ("train.steps", "6"),
        ("train.checkpoint", "2"),
        ("train.warmup", "2"),
        ("validation.frames", "3"),
        ("validation.crop", "32"),
        ("validation.every", "3"),
    ];
    let changes: Vec<_> =
        small.iter().chain(changes).map(|(k, v)| ((*k).to_owned(), (*v).to_owned())).collect();
    Recipe::parse(text, "tests/golden", &changes).unwrap()
}

fn init(recipe: &Recipe) -> Diffusion {
    Diffusion::init(recipe, &Device::flex()).unwrap()
}

fn weights<L: Learner>(network: &L) -> Vec<f32> {
    let list = parameters(network).into_iter();
    list.flat_map(|v| v.into_data().try_into_vec::<f32>().unwrap()).collect()
}

fn trained(recipe: &Recipe, devices: &[Device], workers: usize) -> (Vec<f32>, Vec<StepReport>) {
    trained_as::<Diffusion>(recipe, devices, workers)
}

fn trained_as<L: Learner>(
    recipe: &Recipe,
    devices: &[Device],
    workers: usize,
) -> (Vec<f32>, Vec<StepReport>) {
    let mut trainer = Trainer::<L>::new(recipe, None, devices, None).unwrap();
    let aligner = trainer.averaged().aligner(recipe, &Device::flex()).unwrap();
    let bursts = BurstSampler::new(recipe, Dataset::new(&recipe.data, None).unwrap(), aligner);
    let mut prefetcher = Prefetcher::new(recipe, &bursts, 0, workers).unwrap();
    let steps = (0..3).map(|_| trainer.step(&mut prefetcher).unwrap()).collect();
    (weights(&trainer.averaged()), steps)
}

fn open<L: Learner>(folder: &Path, recipe: &Recipe, from: From<L>) -> Result<Run<L>, Error> {
    Run::open(folder, recipe, from, Files::default(), &[Device::flex()], None, Origin::default())
}

fn learn<L: Learner>(run: &mut Run<L>, stop_after: u64) -> Result<(), Error> {
    run.learn(1, &mut |event| match event {
        Event::Step(report) if report.step == stop_after => ControlFlow::Break(()),
        Event::Validation(validation) if validation.step == stop_after => ControlFlow::Break(()),
        _ => ControlFlow::Continue(()),
    })
}

#[test]
fn weights_do_not_depend_on_the_number_of_workers() {
    let recipe = recipe(&[]);
    let (one, steps) = trained(&recipe, &[Device::flex()], 1);
    let (three, _) = trained(&recipe, &[Device::flex()], 3);
    assert!(one == three, "weights differ");
    assert_eq!(steps.iter().map(|s| s.step).collect::<Vec<_>>(), [1, 2, 3]);
    assert!(steps.iter().all(|s| s.loss.total > 0.0 && s.norm > 0.0));
    let loss = &steps[0].loss;
    let expected = loss.term("prediction") + 0.2 * loss.term("pre") + 30.0 * loss.term("flow");
    assert!((loss.total - expected).abs() < 1e-6 * loss.total);
}

/// Returns a small window network, whose batches pass in parts.
fn window(changes: &[(&str, &str)]) -> Recipe {
    const NETWORK: &str = "kind = \"window\"\nwidths = [32, 32, 32]\nflow = [32, 32, 32]\nstate = 32\n\
        cell_blocks = 1\n\n[data]";
    let tiny = include_str!("../../../tests/golden/tiny.toml");
    let (before, others) = tiny.split_once("[network]").unwrap();
    let (_, data) = others.split_once("[data]").unwrap();
    shortened(&format!("{before}[network]\n{NETWORK}{data}"), changes)
}

/// Four samples in parts, on one or three threads, and the same samples at once: several devices take whole
/// batches.
#[test]
fn parts_of_a_batch_take_the_step_of_the_batch() {
    let recipe = window(&[("train.batch", "4")]);
    let on_threads = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| trained_as::<Window>(&recipe, &[Device::flex()], 1))
    };
    let ((one, parts), (three, _)) = (on_threads(1), on_threads(3));
    assert!(one == three, "weights differ");
    let (_, whole) = trained_as::<Window>(&recipe, &[Device::flex(), Device::flex()], 1);
    let (parts, whole) = (&parts[0], &whole[0]);
    assert!((parts.loss.total - whole.loss.total).abs() < 1e-4 * whole.loss.total.abs());
    assert!((parts.norm - whole.norm).abs() < 1e-3 * whole.norm, "{} {}", parts.norm, whole.norm);
}

/// With more passes to draw from, the first batch has another loss.
#[test]
fn batches_are_encoded_in_one_to_so_many_passes() {
    let losses = |passes: &str| {
        let recipe = window(&[("train.batch", "2"), ("train.passes", passes)]);
        let (_, steps) = trained_as::<Window>(&recipe, &[Device::flex()], 1);
        steps.into_iter().map(|step| step.loss.term("prediction")).collect::<Vec<_>>()
    };
    let (one, many) = (losses("1"), losses("8"));
    assert_ne!(one[0], many[0]);
    assert!(many.iter().all(|loss| loss.is_finite()));
}

/// Every second batch follows the motion in its counts: the first one learns as without. Only batches that
/// follow the learnt flow teach it.
#[test]
fn a_share_of_batches_follows_the_motion_in_their_counts() {
    let losses = |share: &str| {
        let recipe = window(&[("train.batch", "2"), ("train.matched", share)]);
        let (_, steps) = trained_as::<Window>(&recipe, &[Device::flex()], 1);
        let terms = ["prediction", "flow"];
        steps.into_iter().map(|step| terms.map(|term| step.loss.term(term))).collect::<Vec<_>>()
    };
    let (none, half, all) = (losses("0"), losses("0.5"), losses("1"));
    assert_eq!(none[0], half[0]);
    assert_ne!(none[1][0], half[1][0]);
    assert_ne!(none[0][0], all[0][0]);
    let teaches_flow =
        |steps: &[[f64; 2]]| steps.iter().map(|step| step[1] != 0.0).collect::<Vec<_>>();
    assert_eq!(teaches_flow(&half), [true, false, true]);
    assert_eq!(teaches_flow(&all), [false; 3]);
}

/// Two devices with a batch each, one device with both in turn, and one device with both at once.
#[test]
fn weights_do_not_depend_on_the_number_of_devices() {
    let accumulated = recipe(&[("train.batch", "1"), ("train.accumulate", "2")]);
    let (turns, _) = trained(&accumulated, &[Device::flex()], 1);
    let (pair, _) = trained(&accumulated, &[Device::flex(), Device::flex()], 1);
    assert!(turns == pair, "weights differ");
    // A doubled batch has one coin for the first pass: compare a step where both sides agree.
    let doubled = recipe(&[
        ("train.batch", "2"),
        ("train.ablate", "[\"forward-model\", \"self-conditioning\"]"),
    ]);
    let mut halves = doubled.clone();
    (halves.train.batch, halves.train.accumulate) = (1, 2);
    let (whole, a) = trained(&doubled, &[Device::flex()], 1);
    let (pair, b) = trained(&halves, &[Device::flex(), Device::flex()], 1);
    assert!((a[0].loss.total - b[0].loss.total).abs() < 1e-6 * a[0].loss.total);
    assert!((a[0].norm - b[0].norm).abs() < 1e-4 * a[0].norm, "{} {}", a[0].norm, b[0].norm);
    let far = whole.iter().zip(&pair).map(|(a, b)| (a - b).abs()).fold(0f32, f32::max);
    // Adam's first steps have the gradient's sign: where it is about zero, rounding decides.
    assert!(far < 2.5 * 3.0 * 2e-3, "{far}");
    let mean = whole.iter().zip(&pair).map(|(a, b)| (a - b).abs()).sum::<f32>();
    assert!(mean / (whole.len() as f32) < 2e-5, "{}", mean / whole.len() as f32);
}

/// What follows a stop, in another process as it were, gives the bits of an undisturbed run; also a stop in
/// the validation before the first step.
#[test]
fn resumed_run_equals_undisturbed_run() {
    let recipe = recipe(&[("train.optimizer", "\"muon\"")]);
    let folders = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let mut run = open::<Diffusion>(folders[0].path(), &recipe, From::Start(None)).unwrap();
    learn(&mut run, u64::MAX).unwrap();
    for stop in [0, 1, 4] {
        let from = if stop == 0 { From::Start(None) } else { From::State };
        let mut run = open::<Diffusion>(folders[1].path(), &recipe, from).unwrap();
        assert!(matches!(learn(&mut run, stop), Err(Error::Interrupted)));
        assert_eq!(run.progress(), [stop, 6]);
    }
    let mut run = open::<Diffusion>(folders[1].path(), &recipe, From::State).unwrap();
    learn(&mut run, u64::MAX).unwrap();
    let read =
        |folder: &tempfile::TempDir, name: &str| std::fs::read(folder.path().join(name)).unwrap();
    for name in ["state/tensors.safetensors", WEIGHTS] {
        assert!(read(&folders[0], name) == read(&folders[1], name), "{name} differs");
    }
    // The same metrics but for the seconds, each step once.
    let lines = |folder| {
        let text = String::from_utf8(read(folder, METRICS)).unwrap();
        let line = |line: &str| {
            let mut line: serde_json::Map<String, serde_json::Value> =
                serde_json::from_str(line).unwrap();
            line.retain(|key, _| !key.ends_with("_s"));
            serde_json::to_string(&line).unwrap()
        };
        text.lines().map(line).collect::<Vec<_>>()
    };
    assert_eq!(lines(&folders[0]), lines(&folders[1]));
    assert_eq!(lines(&folders[0]).len(), 9); // six steps, three validations
}

#[test]
fn rejects_damaged_states() {
    let recipe = recipe(&[]);
    let folder = tempfile::tempdir().unwrap();
    let mut run = open::<Diffusion>(folder.path(), &recipe, From::Start(None)).unwrap();
    let _ = learn(&mut run, 1);
    let path = folder.path().join("state/tensors.safetensors");
    let whole = std::fs::read(&path).unwrap();
    for length in [0, 7, 100, whole.len() / 2, whole.len() - 1] {
        std::fs::write(&path, &whole[..length]).unwrap();
        let error = open::<Diffusion>(folder.path(), &recipe, From::State).unwrap_err();
        assert!(error.to_string().contains("state"), "{error}");
    }
    for at in [whole.len() - 1, whole.len() / 2] {
        let mut flipped = whole.clone();
        flipped[at] ^= 1;
        std::fs::write(&path, &flipped).unwrap();
        let error = open::<Diffusion>(folder.path(), &recipe, From::State).unwrap_err();
        assert!(error.to_string().contains("digest"), "{error}");
    }
    std::fs::write(&path, &whole).unwrap();
    let wider = crate::recipe(&[("network.unet.width", "16")]);
    assert!(
        open::<Diffusion>(folder.path(), &wider, From::State)
            .unwrap_err()
            .to_string()
            .contains("size")
    );
    open::<Diffusion>(folder.path(), &recipe, From::State).unwrap();
}

/// First the refinement alone, on single frames of cached bursts. No other weight changes.
#[test]
fn refinement_learns_alone_on_crops() {
    let recipe = regression(&[
        ("train.crops", "{ bursts = 3, cached_frames = 2, frames = 1, side = 24 }"),
        ("train.learns", "[\"refinement\"]"),
        ("train.steps", "4"),
    ]);
    let init = Regression::init(&recipe, &Device::flex()).unwrap();
    let before = weights(&init);
    let train = |workers| trained_as::<Regression>(&recipe, &[Device::flex()], workers);
    let (after, reports) = train(2);
    assert_eq!(after, train(1).0, "whoever draws the bursts");
    let term = |report: &StepReport, name| report.loss.term(name);
    assert!(reports.iter().all(|r| term(r, "pre") > 0.0 && term(r, "uncertainty") == 0.0));
    let list = parameter_shapes(&init);
    let sizes = list.iter().filter(|(name, _)| name.starts_with("refinement."));
    let learning = sizes.map(|(_, shape)| shape.iter().product::<usize>()).sum::<usize>();
    // Averages of equal weights are equal but for rounding.
    let moved = after.iter().zip(&before).filter(|(a, b)| (**a - **b).abs() > 1e-6).count();
    assert!(moved > learning / 2 && moved <= learning, "{moved} of {learning} weights moved");
}

#[test]
fn rejects_crops_that_do_not_fit() {
    for (value, word) in [
        ("{ bursts = 3, cached_frames = 2, frames = 1, side = 24 }", "3 frames"),
        ("{ bursts = 0, cached_frames = 3, frames = 3, side = 24 }", "one burst"),
        ("{ bursts = 3, cached_frames = 3, frames = 3, side = 30 }", "train.crops.side"),
        ("{ bursts = 3, cached_frames = 3, frames = 3, side = 40 }", "fit"),
        ("{ bursts = 3, cached_frames = 2, frames = 3, side = 24 }", "fit"),
    ] {
        let changes = [("data.crop", "32"), ("data.frames", "3"), ("train.crops", value)];
        let changes = changes.map(|(key, value)| (key.to_owned(), value.to_owned()));
        let error = Recipe::load("tiny", &changes).unwrap_err().to_string();
        assert!(error.contains(word), "{value}: {error}");
    }
}

/// While the second pre-denoiser and the uncertainty learn, the refinement stays as it was, bit for bit, in
/// the average, too; a resumed run has the same bursts.
#[test]
fn refinement_keeps_its_weights_afterwards() {
    let recipe = regression(&[]);
    let start = Regression::init(&recipe, &Device::flex()).unwrap();
    let start = init_parameters(start, |_, shape| {
        let count = shape.iter().product::<usize>();
        (0..count).map(|i| 0.03 * ((i * 37 % 101) as f32 / 50.0 - 1.0)).collect()
    });
    let split = |network: &Regression| -> [Vec<f32>; 2] {
        let names = parameter_shapes(network).into_iter().map(|(name, _)| name);
        let lists = names.zip(parameters(network)).map(|(name, values)| {
            (name.starts_with("refinement."), values.into_data().try_into_vec::<f32>().unwrap())
        });
        let (first, others): (Vec<_>, Vec<_>) = lists.partition(|(is_first, _)| *is_first);
        [first, others].map(|lists| lists.into_iter().flat_map(|(_, values)| values).collect())
    };
    let [first, others] = split(&start);
    assert!(!first.is_empty() && first.len() < others.len());
    let folders = [0, 1].map(|_| tempfile::tempdir().unwrap());
    let [whole, parts] = [0, 1].map(|i| folders[i].path());
    let from = || From::Start(Some(Box::new(start.clone())));
    learn(&mut open(whole, &recipe, from()).unwrap(), u64::MAX).unwrap();
    assert!(learn(&mut open(parts, &recipe, from()).unwrap(), 2).is_err());
    learn(&mut open::<Regression>(parts, &recipe, From::State).unwrap(), u64::MAX).unwrap();
    let [whole, parts] = [whole, parts]
        .map(|folder| load::<Regression>(&folder.join(WEIGHTS), &Device::flex()).unwrap().0);
    let [kept, learnt] = split(&whole);
    assert!(kept == first && learnt != others);
    assert_eq!(weights(&whole), weights(&parts));
}

/// A correction learns on the frames of the window network that `train.first` names, and on no others.
#[test]
fn corrections_learn_on_the_frames_of_a_diffusion() {
    let folder = tempfile::tempdir().unwrap();
    let sizes = window(&[("train.steps", "1")]);
    let save = |seed: u64, name: &str| {
        let seed = seed.to_string();
        let recipe = window(&[("train.seed", seed.as_str())]);
        let path = folder.path().join(name);
        let network = Window::init(&recipe, &Device::flex()).unwrap();
        network.save(&sizes, &Origin::default(), &path).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let names = [save(1, "one.safetensors"), save(2, "two.safetensors")];
    let of = |first: &str| {
        let changes = [("network.first", "diffusion"), ("train.first", first)];
        let network = Regression::init(&regression(&changes), &Device::flex()).unwrap();
        assert!(network.refinement().is_none());
        let reports = trained_as::<Regression>(&regression(&changes), &[Device::flex()], 1).1;
        reports.iter().map(|report| report.loss.term("uncertainty")).collect::<Vec<_>>()
    };
    let losses = of(&names[0]);
    assert!(losses.iter().all(|loss| loss.is_finite()));
    assert_eq!(losses, of(&names[0]));
    assert_ne!(losses, of(&names[1]), "the frames of other weights");
    // It starts from a whole regression, too, whose first pre-denoiser it does not need.
    let whole = Regression::init(&regression(&[("train.seed", "5")]), &Device::flex()).unwrap();
    let path = folder.path().join("whole.safetensors");
    whole.save(&regression(&[]), &Origin::default(), &path).unwrap();
    let recipe = regression(&[("network.first", "diffusion"), ("train.first", &names[0])]);
    let start = Regression::load(&path, &recipe, &Device::flex()).unwrap();
    assert_eq!(weights(&start), weights(&whole.without_refinement()));
    let wider = [
        ("network.first", "diffusion"),
        ("train.first", names[0].as_str()),
        ("network.width", "12"),
    ];
    let error = Regression::load(&path, &regression(&wider), &Device::flex()).unwrap_err();
    assert!(error.to_string().contains("network.width"), "{error}");
    let recipe = regression(&[("network.first", "diffusion"), ("train.first", "none")]);
    let network = Regression::init(&recipe, &Device::flex()).unwrap();
    let error = network.aligner(&recipe, &Device::flex()).unwrap_err();
    assert!(error.to_string().contains("cannot read the weights"), "{error}");
    assert!(error.place().is_some_and(|place| place.contains("none")), "{error}");
}

/// The uncertainty learns from the errors of the frames, which learn nothing from it.
#[test]
fn uncertainty_learns_without_the_frames() {
    let recipe = regression(&[("train.learns", "[\"uncertainty\"]")]);
    let init = Regression::init(&recipe, &Device::flex()).unwrap();
    let (after, reports) = trained_as::<Regression>(&recipe, &[Device::flex()], 1);
    assert!(reports.iter().all(|report| report.loss.term("uncertainty") != 0.0));
    let mut moved = after.iter().zip(weights(&init)).map(|(a, b)| (a - b).abs() > 1e-6);
    for (name, shape) in parameter_shapes(&init) {
        let count = shape.iter().product();
        let any = moved.by_ref().take(count).filter(|moves| *moves).count() > 0;
        assert!(!any || name.starts_with("uncertainty."), "{name} moved");
    }
}

/// Trains some parts of the window network, and checks that their modules change and no other weight does.
fn parts_learn_alone(parts: &str, modules: &[&str], loss_of_flow: &str) -> Vec<StepReport> {
    let recipe = window(&[
        ("train.loss.pre", "0"),
        ("train.loss.flow", loss_of_flow),
        ("train.batch", "2"),
        ("train.learns", parts),
    ]);
    let (after, reports) = trained_as::<Window>(&recipe, &[Device::flex()], 1);
    let init = Window::init(&recipe, &Device::flex()).unwrap();
    let mut moved = after.iter().zip(weights(&init)).map(|(a, b)| a.to_bits() != b.to_bits());
    for (name, shape) in parameter_shapes(&init) {
        let count = shape.iter().product();
        let any = moved.by_ref().take(count).filter(|moves| *moves).count() > 0;
        let expected = name.split('.').next().is_some_and(|module| modules.contains(&module));
        assert_eq!(any, expected, "{name}");
    }
    reports
}

#[test]
fn flow_of_the_window_network_learns_alone() {
    parts_learn_alone("[\"flow\"]", &["flow"], "0.1");
}

/// The U-Net of the window network learns with the merge of its predictions, and no other weight changes.
#[test]
fn unet_learns_alone_on_encoded_windows() {
    let reports = parts_learn_alone("[\"unet\"]", &["unet", "agreement"], "0");
    // The first loss is the same where all learn, and its gradient is longer there.
    let whole = window(&[("train.loss.pre", "0"), ("train.loss.flow", "0"), ("train.batch", "2")]);
    let (_, all) = trained_as::<Window>(&whole, &[Device::flex()], 1);
    assert_eq!(reports[0].loss.total, all[0].loss.total);
    assert!(reports[0].norm < all[0].norm, "{} and {}", reports[0].norm, all[0].norm);
}

/// A loss that is not finite stops the run before it spoils the state.
#[test]
fn nan_loss_stops_the_step_and_names_the_term() {
    let recipe = recipe(&[]);
    let bursts = BurstSampler::new(&recipe, Dataset::new(&recipe.data, None).unwrap(), None);
    let broken = init(&recipe);
    let broken = init_parameters(broken, |_, shape| vec![f32::NAN; shape.iter().product()]);
    let mut trainer = Trainer::new(&recipe, Some(broken), &[Device::flex()], None).unwrap();
    let mut prefetcher = Prefetcher::new(&recipe, &bursts, 0, 1).unwrap();
    let error = trainer.step(&mut prefetcher).unwrap_err().to_string();
    assert!(
        error.contains("first estimate") || error.contains("prediction loss is NaN at step 1"),
        "{error}"
    );
    assert!(error.contains("first estimate") || error.contains("no checkpoint"), "{error}");
    assert_eq!(trainer.step_number(), 0);
    // Neither state nor weights with NaN are written.
    let folder = tempfile::tempdir().unwrap();
    let error = trainer.save_state(folder.path()).unwrap_err().to_string();
    assert!(error.contains("not finite"), "{error}");
    assert!(std::fs::read_dir(folder.path()).unwrap().next().is_none());
    let origin = Origin { steps: 1, ..Origin::default() };
    let path = folder.path().join(WEIGHTS);
    let error = trainer.averaged().save(&recipe, &origin, &path).unwrap_err().to_string();
    assert!(error.contains("not finite") && !path.exists(), "{error}");
}

#[test]
fn bf16_changes_a_step_by_rounding() {
    let few =
        |precision: &str| trained(&recipe(&[("train.precision", precision)]), &[Device::flex()], 1);
    let (exact_weights, exact) = few("f32");
    let (weights, got) = few("bf16");
    assert!(weights != exact_weights, "nothing was rounded");
    let off = |got: f64, exact: f64| (got / exact - 1.0).abs();
    let norm = off(got[0].norm, exact[0].norm);
    assert!(norm > 0.0 && norm < 0.05, "{norm}");
    let total = off(got[2].loss.total, exact[2].loss.total);
    assert!(total < 0.05, "{total}");
}

#[test]
fn rejects_bf16_on_devices_without_it() {
    #[allow(deprecated)] // asked for by name
    let device = Device::ndarray();
    let recipe = recipe(&[("train.precision", "bf16")]);
    let text = Trainer::<Diffusion>::new(&recipe, None, &[device], None).unwrap_err().to_string();
    assert!(text.contains("bf16"), "{text}");
}

#[test]
fn rejects_wrong_recipes_by_key() {
    const TINY: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden/tiny.toml");
    let load = |key: &str, value: &str| Recipe::load(TINY, &[(key.to_owned(), value.to_owned())]);
    for (key, value, word) in [
        ("train.steps", "0", "train.steps"),
        ("train.lr", "-1", "train.lr"),
        ("train.ema", "1.0", "train.ema"),
        ("train.timesteps", "often", "often"),
        ("train.loss.form", "l3", "l3"),
        ("validation.spacing", "odd", "odd"),
        ("network.kind", "other", "other"),
        ("network.pre.neighbours", "4", "neighbours"),
        ("train.learns", "[\"refinement\"]", "regression"),
        ("train.loss.prediction", "0", "train.loss.prediction"),
        ("validation.steps", "0", "validation.steps"),
        ("train.passes", "2", "train.passes"),
        ("train.matched", "0.5", "train.matched"),
        ("train.learning", "3", "learning"),
        ("trains.steps", "3", "trains.steps"),
        ("data.crop", "50", "data.crop"),
        ("data.source.0.kind", "films", "films"),
        ("data.source.0.from", "[\"deadleaves\"]", "deadleaves"),
        ("data.sensor.0.ppp", "[]", "ppp"),
        ("data.source.7.weight", "1", "data.source.7"),
        ("train.loss.perceptual", "0.3", "train.loss.term"),
        ("network.unet.width", "0", "unet.width"),
    ] {
        let error = load(key, value).unwrap_err().to_string();
        assert!(error.contains(word), "{key}={value}: {error}");
    }
    for (learns, other, word) in [
        ("[\"features\"]", ("train.matched", "0"), "other diffusion"),
        ("[\"uncertainty\"]", ("train.matched", "0"), "regression"),
        ("[\"unet\"]", ("train.matched", "0"), "train.loss.pre"),
        // Nothing would learn in some batches, or in any.
        ("[\"flow\"]", ("train.matched", "0.5"), "train.matched"),
        ("[\"flow\", \"flow\"]", ("train.loss.flow", "0"), "train.loss.flow"),
    ] {
        let changes = [("train.learns", learns), other];
        let changes = changes.map(|(key, value)| (key.to_owned(), value.to_owned()));
        let text = window(&[]).text();
        let error = Recipe::parse(&text, "window", &changes).unwrap_err().to_string();
        assert!(error.contains("train.learns") && error.contains(word), "{error}");
    }
    assert!(Recipe::load("huge", &[]).unwrap_err().to_string().contains("huge"));
    assert_eq!(load("train.steps", "77").unwrap().train.steps, 77);
    let recipe = load("data.sensor.0.ppp", "[3.25, 9.75]").unwrap();
    assert_eq!(Recipe::parse(&recipe.text(), "again", &[]).unwrap(), recipe);
    let mut bursts = BurstSampler::new(&recipe, Dataset::new(&recipe.data, None).unwrap(), None);
    let again = Batch::draw(&recipe, &mut bursts, 3).unwrap();
    assert_eq!(again.len(), 2);
}

#[test]
fn regression_recipes_are_refused_by_key() {
    let load = |key: &str, value: &str| {
        let changes = [(key.to_owned(), value.to_owned())];
        let text = include_str!("../../../tests/golden/regression.toml");
        Recipe::parse(text, "regression", &changes).unwrap_err().to_string()
    };
    for (key, value, word) in [
        ("train.learns", "[]", "train.learns"),
        ("train.learns", "[\"refinement\", \"pre\"]", "train.learns"),
        ("train.learns", "[\"unet\"]", "train.learns"),
        ("train.ablate", "[\"flow\"]", "train.ablate"),
        ("train.noise_start_fraction", "0.3", "train.noise_start_fraction"),
        ("train.passes", "2", "train.passes"),
        ("train.matched", "0.5", "train.matched"),
        ("validation.steps", "1", "validation.steps"),
        ("network.neighbours", "0", "network.neighbours"),
        ("network.first", "diffusion", "train.first"),
        ("network.first", "average", "average"),
        ("train.first", "w.safetensors", "network.first"),
    ] {
        let error = load(key, value);
        assert!(error.contains(word), "{key}={value}: {error}");
    }
    let changes = [
        ("network.first", "diffusion"),
        ("train.first", "w.safetensors"),
        ("train.learns", "[\"refinement\"]"),
    ];
    let changes = changes.map(|(key, value)| (key.to_owned(), value.to_owned()));
    let text = include_str!("../../../tests/golden/regression.toml");
    let error = Recipe::parse(text, "regression", &changes).unwrap_err().to_string();
    assert!(error.contains("train.learns"), "{error}");
    assert!(Recipe::load("small", &[]).unwrap().stages().unwrap().len() == 2);
    for passes in ["0", "9"] {
        let changes = [("train.passes".to_owned(), passes.to_owned())];
        let error = Recipe::load("window", &changes).unwrap_err().to_string();
        assert!(error.contains("train.passes must be from 1 to 8"), "{passes}: {error}");
    }
    let changes = [("train.matched".to_owned(), "1.5".to_owned())];
    let error = Recipe::load("window", &changes).unwrap_err().to_string();
    assert!(error.contains("train.matched must be from 0 to 1"), "{error}");
}

/// The weights of the whole network start one that leaves parts out, which learns as if it had been made so.
#[test]
fn whole_weights_start_a_network_without_a_part() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("whole.safetensors");
    let whole = recipe(&[]);
    init(&whole).save(&whole, &Origin { steps: 1, ..Origin::default() }, &path).unwrap();
    let without = recipe(&[("train.ablate", "[\"flow\", \"fusion\"]")]);
    let loaded = Diffusion::load(&path, &without, &Device::flex()).unwrap();
    let third_loss = |recipe: &Recipe, start: Option<Diffusion>| {
        let folder = tempfile::tempdir().unwrap();
        let mut run =
            open::<Diffusion>(folder.path(), recipe, From::Start(start.map(Box::new))).unwrap();
        let mut loss = 0.0;
        let stopped = run.learn(1, &mut |event| match event {
            // A new network's output layers are zero.
            Event::Step(report) if report.step == 3 => {
                loss = report.loss.term("prediction");
                ControlFlow::Break(())
            }
            _ => ControlFlow::Continue(()),
        });
        assert!(matches!(stopped, Err(Error::Interrupted)));
        loss
    };
    let expected = third_loss(&without, None);
    assert_eq!(third_loss(&without, Some(loaded)), expected);
    assert_ne!(third_loss(&whole, None), expected);
}
