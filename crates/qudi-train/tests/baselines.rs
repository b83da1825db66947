//! Learned methods of others learn by the same recipes, trainer and runs.
#![allow(clippy::unwrap_used)]

use burn::tensor::Device;
use qudi_baselines::import::{METHODS, Method, describe};
use qudi_baselines::learning::Baseline;
use qudi_baselines::restorer::LearnedRestorer;
use qudi_core::restorer::{Acquisition, BurstView, Restorer};
use qudi_core::sensor::Sensor;
use qudi_core::{Error, Size};
use qudi_train::dataset::Dataset;
use qudi_train::{
    BurstSampler, Event, Files, From, Learner, METRICS, Prefetcher, Recipe, Run, StepReport,
    Trainer, WEIGHTS, parameters,
};
use std::ops::ControlFlow;
use std::path::Path;

/// Returns the shipped recipe of a method on procedural scenes, with these sizes, and some steps of some
/// small samples.
fn recipe(method: Method, changes: &[(&str, &str)]) -> Recipe {
    let text = std::fs::read_to_string(format!(
        "{}/../qudi-baselines/recipes/{}.toml",
        env!("CARGO_MANIFEST_DIR"),
        method.name()
    ));
    let text = text.unwrap();
    let scenes =
        "{ name = \"scenes\", kind = \"scenes\", from = [\"dead-leaves\", \"text\"], speed = 5.0 }";
    let scenes = format!("source = [{scenes}]\n\n[train]");
    let text = text.replace("[train]", &scenes);
    let small = [
        ("data.crop", "32"),
        ("train.steps", "4"),
        ("train.batch", "2"),
        ("train.warmup", "2"),
        ("train.checkpoint", "2"),
        ("validation.from", "[\"scene:text\"]"),
        ("validation.frames", "3"),
        ("validation.crop", "24"),
        ("validation.ppp", "[3.25]"),
        ("validation.every", "2"),
    ];
    let sizes = match method {
        Method::Quiver => &[("blocks", "2"), ("past", "1"), ("future", "1")][..],
        Method::Emvd => &[("width", "4")],
        Method::FloRnn => &[("features", "4"), ("blocks", "1")],
        Method::Spk2ImgNet => &[("features", "4"), ("stem", "2"), ("blocks", "1"), ("groups", "2")],
        Method::MemDeblur => {
            &[("features", "8"), ("forward_blocks", "1"), ("backward_blocks", "1")]
        }
        Method::Rvrt => &[("features", "12")],
        Method::StudentTeacher => &[("frames", "5"), ("features", "4"), ("kernel", "3")],
    };
    let frames = match method {
        Method::Quiver => "3",
        Method::Emvd | Method::StudentTeacher => "5",
        Method::FloRnn => "11",
        Method::Spk2ImgNet => "10",
        Method::MemDeblur => "6",
        Method::Rvrt => "4",
    };
    let sizes = sizes.iter().map(|(key, value)| (format!("network.{key}"), (*value).to_owned()));
    let frames = [("data.frames", frames)];
    let others = small.iter().chain(&frames).chain(changes);
    let others = others.map(|(key, value)| ((*key).to_owned(), (*value).to_owned()));
    let changes: Vec<_> = sizes.chain(others).collect();
    Recipe::parse(&text, method.name(), &changes).unwrap()
}

fn trained(recipe: &Recipe, steps: usize) -> (Trainer<Baseline>, Vec<StepReport>) {
    let bursts = BurstSampler::new(recipe, Dataset::new(&recipe.data, None).unwrap(), None);
    let mut prefetcher = Prefetcher::new(recipe, &bursts, 0, 1).unwrap();
    let mut trainer = Trainer::new(recipe, None, &[Device::flex()], None).unwrap();
    let reports = (0..steps).map(|_| trainer.step(&mut prefetcher).unwrap()).collect();
    (trainer, reports)
}

fn weights(network: &Baseline) -> Vec<f32> {
    let list = parameters(network).into_iter();
    list.flat_map(|v| v.into_data().try_into_vec::<f32>().unwrap()).collect()
}

fn open(folder: &Path, recipe: &Recipe, from: From<Baseline>) -> Result<Run<Baseline>, Error> {
    Run::open(
        folder,
        recipe,
        from,
        Files::default(),
        &[Device::flex()],
        None,
        qudi_train::Origin::default(),
    )
}

fn learn(run: &mut Run<Baseline>, stop_after: u64) -> Result<(), Error> {
    run.learn(1, &mut |event| match event {
        Event::Step(report) if report.step == stop_after => ControlFlow::Break(()),
        _ => ControlFlow::Continue(()),
    })
}

/// All seven take two steps, and restore with the weights that they write.
#[test]
fn every_method_learns_and_restores() {
    let size = Size { height: 20, width: 26 };
    let frames: Vec<Vec<u16>> = (0..5)
        .map(|t| (0..size.pixels()).map(|i| ((i * 7 + t * 3) % 8) as u16).collect())
        .collect();
    let acquisition = Acquisition::new(Sensor::load("qudi-paper").unwrap(), 3.25, 0.45).unwrap();
    let folder = tempfile::tempdir().unwrap();
    for method in METHODS {
        let recipe = recipe(method, &[("train.steps", "2")]);
        let name = method.name();
        let before =
            weights(&Baseline::init(recipe.network.baseline().unwrap(), 1, &Device::flex()));
        let (trainer, reports) = trained(&recipe, 2);
        let loss = &reports[0].loss;
        assert!(loss.terms[0].0 == "image" && loss.term("image") > 0.0, "{name}: {loss:?}");
        let sum: f64 = loss.terms.iter().map(|(_, value)| value).sum();
        assert!((loss.total - sum).abs() < 1e-5 * sum, "{name}: {loss:?}");
        let after = weights(&trainer.averaged());
        assert!(after.iter().all(|value| value.is_finite()), "{name}");
        let moved = after.iter().zip(&before).filter(|(a, b)| a != b).count();
        assert!(moved > after.len() / 3, "{name}: {moved} of {} weights moved", after.len());

        let path = folder.path().join(format!("{name}.safetensors"));
        let origin =
            qudi_train::Origin { steps: 2, commit: Some("abc".to_owned()), ..Default::default() };
        trainer.averaged().save(&recipe, &origin, &path).unwrap();
        let description = describe(&path, &Device::flex()).unwrap().unwrap().description.unwrap();
        assert_eq!((description.method.as_str(), description.provenance.steps), (name, 2));
        assert_eq!(
            (description.provenance.ppp, description.provenance.sensors[0].as_str()),
            ([2.0, 30.0], "qudi-paper")
        );
        let mut read = LearnedRestorer::load(&path, method, &Device::flex()).unwrap();
        let mut own = trainer.averaged().restorer(&recipe, &Device::flex()).unwrap();
        let burst = BurstView { size, frames: &frames };
        let [read, own]: [_; 2] = [&mut read as &mut dyn Restorer, own.as_mut()]
            .map(|restorer| restorer.restore(burst, &acquisition).unwrap().frames);
        assert_eq!(read, own, "{name}: other weights were read than written");
        // Half the mean level, and the same counts: a picture of half the brightness.
        let dim = Acquisition { mean_level: 0.225, ..acquisition.clone() };
        let mut restorer = LearnedRestorer::load(&path, method, &Device::flex()).unwrap();
        let dim = restorer.restore(burst, &dim).unwrap().frames;
        for (a, b) in read[2].data.iter().zip(&dim[2].data) {
            assert!((a / 2.0 - b).abs() < 1e-5 || *a == 1.0, "{name}: {a} and {b}");
        }
        // Going on from the file: the same network, whose teachers start anew.
        let again = <Baseline as Learner>::load(&path, &recipe, &Device::flex()).unwrap();
        let own = trainer.averaged();
        let count = parameters(own.network()).len();
        assert_eq!(parameters(again.network()).len(), count);
        for (a, b) in parameters(again.network()).into_iter().zip(parameters(own.network())) {
            assert!(a.into_data() == b.into_data(), "{name}");
        }
    }
}

/// The loss falls within some tens of steps.
#[test]
fn losses_fall() {
    for (method, size, least) in [
        (Method::Emvd, ("network.width", "4"), 0.6),
        (Method::StudentTeacher, ("network.features", "4"), 0.8),
    ] {
        let changes = [
            size,
            ("train.lr", "1e-2"),
            ("train.steps", "60"),
            // The same two bursts again and again: what is learnt shows sooner than what samples differ in.
            ("train.crops", "{ bursts = 2, cached_frames = 5, frames = 5, side = 32 }"),
        ];
        let (_, reports) = trained(&recipe(method, &changes), 60);
        let mean = |part: &[StepReport]| {
            part.iter().map(|report| report.loss.term("image")).sum::<f64>() / part.len() as f64
        };
        let (first, last) = (mean(&reports[..2]), mean(&reports[50..]));
        assert!(last < least * first, "{}: from {first} to {last}", method.name());
    }
}

/// Stopped and resumed, a run has the bits of one that went on: weights, state, metrics.
#[test]
fn resumed_run_equals_undisturbed_run() {
    for method in [Method::Emvd, Method::MemDeblur] {
        let recipe = recipe(method, &[("data.crop", "16"), ("validation.crop", "16")]);
        let folders = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
        let mut run = open(folders[0].path(), &recipe, From::Start(None)).unwrap();
        learn(&mut run, u64::MAX).unwrap();
        for stop in [1, 3] {
            let from = if stop == 1 { From::Start(None) } else { From::State };
            let mut run = open(folders[1].path(), &recipe, from).unwrap();
            assert!(matches!(learn(&mut run, stop), Err(Error::Interrupted)));
            assert_eq!(run.progress(), [stop, 4]);
        }
        let mut run = open(folders[1].path(), &recipe, From::State).unwrap();
        learn(&mut run, u64::MAX).unwrap();
        let read = |folder: &tempfile::TempDir, name: &str| {
            std::fs::read(folder.path().join(name)).unwrap()
        };
        for name in ["state/tensors.safetensors", WEIGHTS] {
            assert!(read(&folders[0], name) == read(&folders[1], name), "{name} differs");
        }
        let lines = |folder: &tempfile::TempDir| {
            String::from_utf8(read(folder, METRICS)).unwrap().lines().count()
        };
        assert_eq!([lines(&folders[0]), lines(&folders[1])], [7, 7]); // four steps, three validations
    }
}

/// Two devices with a batch each give what one device with both gives: gradients, and statistics of batches.
#[test]
fn weights_do_not_depend_on_the_number_of_devices() {
    let changes = [("data.crop", "16"), ("train.batch", "1"), ("train.accumulate", "2")];
    let recipe = recipe(Method::MemDeblur, &changes);
    let of = |devices: &[Device]| {
        let dataset = Dataset::new(&recipe.data, None).unwrap();
        let bursts = BurstSampler::new(&recipe, dataset, None);
        let mut prefetcher = Prefetcher::new(&recipe, &bursts, 0, 1).unwrap();
        let mut trainer = Trainer::<Baseline>::new(&recipe, None, devices, None).unwrap();
        let total = trainer.step(&mut prefetcher).unwrap().loss.total;
        (total, weights(&trainer.averaged()))
    };
    assert!(of(&[Device::flex()]) == of(&[Device::flex(), Device::flex()]), "weights differ");
}

/// Statistics of batches reach the weights, though no gradient moves them.
#[test]
fn running_statistics_move() {
    let recipe = recipe(Method::MemDeblur, &[("train.ema", "0.0")]);
    let (trainer, _) = trained(&recipe, 2);
    let network = trainer.averaged();
    let names = network.named_shapes().into_iter().map(|(name, _)| name);
    let statistics = names.zip(parameters(&network)).filter(|(name, _)| name.contains(".running_"));
    for (name, values) in statistics {
        let values = values.into_data().try_into_vec::<f32>().unwrap();
        let first = if name.ends_with("running_mean") { 0.0 } else { 1.0 };
        assert!(values.iter().any(|value| (value - first).abs() > 1e-3), "{name} stays");
    }
}

#[test]
fn wrong_recipes_are_refused_by_key() {
    let load = |name: &str, key: &str, value: &str| {
        Recipe::load(name, &[(key.to_owned(), value.to_owned())]).unwrap_err().to_string()
    };
    for (name, key, value, word) in [
        ("emvd", "network.width", "0", "from 1 to 4096"),
        ("emvd", "network.features", "8", "features"),
        ("emvd", "network.method", "other", "other"),
        ("emvd", "data.crop", "50", "data.crop"),
        ("emvd", "train.learns", "[\"flow\"]", "train.learns"),
        (
            "emvd",
            "train.loss",
            "{ prediction = 1.0, pre = 0.2, perceptual = 0.0, term = \"none\" }",
            "train.loss",
        ),
        ("emvd", "train.noise_start_fraction", "0.3", "train.noise_start_fraction"),
        ("emvd", "validation.steps", "1", "validation.steps"),
        ("quiver", "network.features", "24", "multiples of 16"),
        ("quiver", "network.future", "5", "as many frames"),
        ("quiver", "data.frames", "4", "5 or more"),
        ("flornn", "network.ahead", "3", "ahead"),
        ("flornn", "data.frames", "10", "11 or more"),
        ("spk2imgnet", "data.frames", "11", "learns from 10"),
        ("memdeblur", "data.frames", "10", "multiple of 5"),
        ("rvrt", "data.frames", "11", "multiple of 2"),
        ("student-teacher", "network.kernel", "4", "odd"),
        ("tiny", "network.method", "emvd", "unknown field"),
    ] {
        let error = load(name, key, value);
        assert!(error.contains(word), "{name} {key}={value}: {error}");
    }
    let text = include_str!("../../qudi-model/recipes/tiny.toml")
        .replace("noise_start_fraction = 0.7\n", "");
    let error = Recipe::parse(&text, "tiny", &[]).unwrap_err().to_string();
    assert!(error.contains("train.noise_start_fraction is missing"), "{error}");
    for method in METHODS {
        let recipe = Recipe::load(method.name(), &[]).unwrap();
        assert_eq!(recipe.network.baseline().unwrap().method(), method);
        assert_eq!(Recipe::parse(&recipe.text(), "again", &[]).unwrap(), recipe);
        let other: Result<Trainer<qudi_model::diffusion::Diffusion>, Error> =
            Trainer::new(&recipe, None, &[Device::flex()], None);
        assert!(other.unwrap_err().to_string().contains(method.name()));
    }
}
