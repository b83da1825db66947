//! What the trainer needs of a network, and the networks that have it.

mod baseline;
mod bursts;
pub mod diffusion;
mod regression;
mod window;

use crate::burst_cache::BurstSampler;
use crate::loss::lpips::Lpips;
use crate::recipe::Recipe;
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_core::atomic_file::Overwrite;
use qudi_core::restorer::Restorer;
use qudi_core::{Error, Result};
use qudi_layers::{Provenance, parameter_shapes};
use qudi_model::checkpoint::{Description, Network, Precision, Sampling, load, save};
use qudi_model::config::NetworkConfig;
use qudi_model::regression::BurstAligner;
use std::fmt::{Debug, Formatter};
use std::path::Path;

pub use bursts::CountBatch;
pub use regression::AlignedBatch;

/// A network that can be trained by recipes for it.
///
/// # Errors
/// Methods that take a recipe refuse one that is for another network.
pub trait Learner: Module + Sync {
    /// Samples that pass at once, as threads draw them.
    type Batch: Send + Sync + 'static;

    /// Returns the network of a recipe without weights: it takes no memory yet.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the recipe is for another network.
    fn uninitialized(recipe: &Recipe, device: &Device) -> Result<Self>;

    /// Returns the network of a recipe with the initial weights of its seed.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the recipe is for another network.
    fn init(recipe: &Recipe, device: &Device) -> Result<Self>;

    /// Loads the network from which the training of a recipe starts, out of a file of weights.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the file does not hold a network that can become the recipe's.
    fn load(path: &Path, recipe: &Recipe, device: &Device) -> Result<Self>;

    /// Draws batch `number` of a recipe.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the data cannot be read.
    fn draw(recipe: &Recipe, bursts: &mut BurstSampler, number: u64) -> Result<Self::Batch>;

    /// Computes the loss of a batch. The network is on `context.device`.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the device fails or a sensor is impossible.
    fn loss<'a>(&'a self, batch: &'a Self::Batch, context: &Context<'a>) -> Result<Loss<'a>>;

    /// Copies a batch to the device that its loss is computed on.
    fn upload(_batch: &mut Self::Batch, _device: &Device) {}

    /// Splits a batch into at most `count` parts of equal size whose mean loss is the loss of the batch. One
    /// part where the loss is no mean over samples.
    fn parts(batch: Self::Batch, _count: usize) -> Vec<Self::Batch> {
        vec![batch]
    }

    /// Returns the restorer of validations, by a network that is outside autodiff on `device`.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the network or the recipe cannot restore.
    fn restorer(&self, recipe: &Recipe, device: &Device) -> Result<Box<dyn Restorer>>;

    /// Writes the weights for use, with a description of their training.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the file cannot be written.
    fn save(&self, recipe: &Recipe, origin: &Origin, path: &Path) -> Result<()>;

    /// Names and shapes of all parameters in states, in the order of the network.
    fn named_shapes(&self) -> Vec<(String, Vec<usize>)> {
        parameter_shapes(self)
    }

    /// Returns for each parameter whether it learns.
    fn learns(&self, _recipe: &Recipe) -> Vec<bool> {
        vec![true; self.named_shapes().len()]
    }

    /// Returns the names of the layers whose input is zero in all samples of a recipe: no gradient reaches
    /// them.
    fn idle_layers(_recipe: &Recipe) -> &'static [&'static str] {
        &[]
    }

    /// Returns true if a parameter learns with Adam under every optimizer.
    fn prefers_adam(_name: &str) -> bool {
        false
    }

    /// Creates what aligns samples; none for most networks.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the recipe is for another network.
    fn aligner(&self, _recipe: &Recipe, _device: &Device) -> Result<Option<BurstAligner>> {
        Ok(None)
    }
}

/// A weighted sum of named terms.
#[derive(Clone, Debug, Default)]
struct WeightedSum {
    total: Option<Tensor<1>>,
    terms: Vec<(&'static str, Tensor<1>)>,
}

impl WeightedSum {
    /// Adds a term, `[1]`, times its weight.
    fn add(&mut self, name: &'static str, weight: f32, term: Tensor<1>) {
        self.terms.push((name, term.clone()));
        let term = term * weight;
        self.total = Some(self.total.take().map_or(term.clone(), |total| total + term));
    }

    /// Returns the sum.
    ///
    /// # Panics
    /// Without terms.
    fn total(&self) -> Tensor<1> {
        self.total.clone().expect("at least one term")
    }
}

/// Returns true for each parameter whose part is among those that learn; all learn if none is named.
fn learning<N: Module>(network: &N, recipe: &Recipe) -> Vec<bool> {
    let parts = &recipe.train.learns;
    let learns = |name: &str| parts.is_empty() || parts.iter().any(|part| part.has(name));
    parameter_shapes(network).iter().map(|(name, _)| learns(name)).collect()
}

/// What the loss depends on besides network and batch.
#[derive(Clone, Copy, Debug)]
pub struct Context<'a> {
    /// The recipe.
    pub recipe: &'a Recipe,
    /// The device, with autodiff.
    pub device: &'a Device,
    /// Steps taken before this one.
    pub step: u64,
    /// The perceptual term, if the recipe has one.
    pub perceptual: Option<&'a Lpips>,
}

/// The loss of a batch.
pub struct Loss<'a> {
    /// The weighted sum, `[1]`.
    pub total: Tensor<1>,
    /// The terms by name, `[1]` each, as metrics call them.
    pub terms: Vec<(&'static str, Tensor<1>)>,
    /// Computes the gradients of the total for all parameters, in the order of the network, `[values]` each.
    pub gradients: Box<dyn FnOnce() -> Vec<Tensor<1>> + 'a>,
    /// Values of parameters after the step by their places in the network, `[values]` each: statistics that a
    /// network keeps of what passes through it, and that no gradient moves.
    pub statistics: Vec<(usize, Tensor<1>)>,
}

impl Debug for Loss<'_> {
    fn fmt(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Loss").field("terms", &self.terms).finish_non_exhaustive()
    }
}

/// Loads the network of a recipe.
///
/// # Errors
/// [`Error`] if the file holds another network, or one with other keys, which it names.
fn load_fitting<N: Network>(path: &Path, sizes: &NetworkConfig, device: &Device) -> Result<N> {
    let (network, description) = load(path, device)?;
    if description.network == *sizes {
        return Ok(network);
    }
    let keys = differing_keys(&description.network, sizes).join(", ");
    Err(Error::data(
        format!(
            "these weights are for another network than the recipe's, with other values of {keys}"
        ),
        path,
        "choose the recipe that they were trained with, or its [network] table",
    ))
}

/// Returns the keys of `[network]` with different values.
fn differing_keys(one: &NetworkConfig, other: &NetworkConfig) -> Vec<String> {
    let table = |sizes| toml::Table::try_from(sizes).unwrap_or_default();
    let mut keys = Vec::new();
    compare(&table(one), &table(other), "network", &mut keys);
    keys
}

/// Adds the names of the keys of tables at `place` with different values. A key without a value has its
/// default, which is false for those that are left out.
fn compare(one: &toml::Table, other: &toml::Table, place: &str, keys: &mut Vec<String>) {
    let absent = toml::Value::Boolean(false);
    let mut names: Vec<&String> = one.keys().chain(other.keys()).collect();
    names.sort();
    names.dedup();
    for name in names {
        let [a, b] = [one, other].map(|table| table.get(name).unwrap_or(&absent));
        let place = format!("{place}.{name}");
        match (a, b) {
            (toml::Value::Table(a), toml::Value::Table(b)) => compare(a, b, &place, keys),
            _ if a != b => keys.push(place),
            _ => {}
        }
    }
}

/// Writes a network of these sizes, with a description of its training.
///
/// # Errors
/// [`Error`] if the file cannot be written.
fn save_described<N: Network>(
    network: &N,
    sizes: NetworkConfig,
    sampling: Option<Sampling>,
    recipe: &Recipe,
    origin: &Origin,
    path: &Path,
) -> Result<()> {
    let description = Description {
        preset: sizes.preset_name().map(str::to_owned),
        network: sizes,
        window: recipe.data.frames.max(11),
        passes: recipe.train.passes,
        provenance: provenance(recipe, origin),
        sampling,
    };
    save(network, &description, Precision::Single, path, Overwrite::Yes)
}

/// Where weights come from, besides the recipe.
#[derive(Clone, Debug, Default)]
pub struct Origin {
    /// Steps taken.
    pub steps: u64,
    /// The commit of the program.
    pub commit: Option<String>,
    /// Recipes of the stages before, as TOML.
    pub earlier: Vec<String>,
}

/// Returns the description that weights of a recipe hold of their training.
fn provenance(recipe: &Recipe, origin: &Origin) -> Provenance {
    Provenance {
        program: format!("qudi {}", env!("CARGO_PKG_VERSION")),
        sensors: recipe.data.sensor_names(),
        ppp: recipe.data.light(),
        data: recipe.data.source_names(),
        steps: origin.steps,
        commit: origin.commit.clone(),
        licence: recipe.train.licence.clone(),
        recipes: origin.earlier.iter().cloned().chain([recipe.text()]).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_that_differ_are_named() {
        let preset = |name| NetworkConfig::preset(name).unwrap_or_else(|e| panic!("{e}"));
        let window = preset("window");
        assert!(differing_keys(&window, &window).is_empty());
        let NetworkConfig::Window(mut config) = window.clone() else { panic!("a window network") };
        config.linear_entries = false;
        config.state = 32;
        let other = NetworkConfig::Window(config);
        assert_eq!(differing_keys(&window, &other), ["network.linear_entries", "network.state"]);
        assert!(differing_keys(&window, &preset("small")).contains(&"network.kind".to_owned()));
    }
}
