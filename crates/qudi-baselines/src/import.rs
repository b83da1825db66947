//! Reading of the authors' files: the network that they are of, its sizes and its weights.

mod shapes;

use crate::weights::{self, Description};
use burn::tensor::Device;
use qudi_core::{Error, Result};
use qudi_layers::{StateDict, init_parameters, parameter_shapes};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

pub use crate::method::{METHODS, Method, Network, Sizes};
pub(crate) use shapes::Shapes;

/// Largest number of keys of one kind in a message.
const MAX_LISTED: usize = 20;

/// Contents of a file.
#[derive(Clone, Debug, PartialEq)]
pub struct Contents {
    /// The network.
    pub method: Method,
    /// Its sizes, in words.
    pub sizes: String,
    /// The number of its parameters.
    pub parameters: usize,
    /// The description in a file that this program wrote.
    pub description: Option<Description>,
}

/// A network from a file.
#[derive(Debug)]
pub struct Loaded {
    /// The network.
    pub network: Network,
    /// Its sizes.
    pub sizes: Sizes,
    /// The description in a file that this program wrote; none in the authors' files.
    pub description: Option<Description>,
}

/// Returns the method whose weights a file holds, if it is one of these.
fn method_of(file: &StateDict) -> Option<Method> {
    METHODS.into_iter().find(|method| file.shape(method.mark()).is_some())
}

/// Describes the file at `path`; none if it is no file of a learned method. `device` is for networks without
/// weights.
///
/// # Errors
/// [`Error`] if it cannot be read, or its network lacks parameters or has too many.
pub fn describe(path: &Path, device: &Device) -> Result<Option<Contents>> {
    describe_file(&StateDict::open(path)?, device)
}

/// Describes a SafeTensors file in memory, which errors call `name`, as [`describe`].
///
/// # Errors
/// As [`describe`].
pub fn describe_bytes(bytes: &[u8], name: &Path, device: &Device) -> Result<Option<Contents>> {
    describe_file(&StateDict::of_bytes(bytes.to_vec(), name)?, device)
}

fn describe_file(file: &StateDict, device: &Device) -> Result<Option<Contents>> {
    let Some(method) = method_of(file) else { return Ok(None) };
    let sizes = sizes_of(file, method)?;
    let parameters = count(&sizes.network(device), file)?;
    let description = weights::description(file)?;
    Ok(Some(Contents { method, sizes: sizes.to_string(), parameters, description }))
}

/// Loads the network of a method from a file of its authors, or from one with the same keys.
///
/// # Errors
/// [`Error`] if the file cannot be read, or does not hold this network, to the last key.
pub fn load(path: &Path, method: Method, device: &Device) -> Result<Loaded> {
    load_file(&StateDict::open(path)?, method, device)
}

/// Loads a network from a SafeTensors file in memory, which errors call `name`, as [`load`].
///
/// # Errors
/// As [`load`].
pub fn load_bytes(bytes: &[u8], name: &Path, method: Method, device: &Device) -> Result<Loaded> {
    load_file(&StateDict::of_bytes(bytes.to_vec(), name)?, method, device)
}

fn load_file(file: &StateDict, method: Method, device: &Device) -> Result<Loaded> {
    let found = method_of(file);
    if found != Some(method) {
        let what = match found {
            Some(found) => format!("weights of {}, not of {}", found.name(), method.name()),
            None => format!("no weights of {}: `{}` is missing", method.name(), method.mark()),
        };
        return Err(Error::data(what, file.path(), "name a file that was saved for this method"));
    }
    let sizes = sizes_of(file, method)?;
    let description = weights::description(file)?;
    Ok(Loaded { network: filled(sizes.network(device), file)?, sizes, description })
}

/// Returns the sizes that follow from the shapes of a file.
fn sizes_of(file: &StateDict, method: Method) -> Result<Sizes> {
    let sizes = method.sizes(&Shapes::new(file))?;
    match sizes.problem() {
        None => Ok(sizes),
        Some(problem) => {
            let help = "this network cannot be of these sizes: name another file";
            Err(Error::data(format!("{problem}; the file has {sizes}"), file.path(), help))
        }
    }
}

/// Returns true for constants that files of authors hold.
fn is_constant(name: &str) -> bool {
    let constant = ["num_batches_tracked", "relative_position_index"];
    let mean = ["spynet.mean", "spynet.std"].contains(&name);
    mean || constant.iter().any(|constant| name.ends_with(constant))
}

/// Compares all parameters with the file, and returns their names and shapes there by our names.
fn compared(network: &Network, file: &StateDict) -> Result<BTreeMap<String, (String, Vec<usize>)>> {
    let (mut missing, mut different) = (Vec::new(), Vec::new());
    let (mut names, mut expected) = (BTreeMap::new(), BTreeSet::new());
    for (ours, shape) in parameter_shapes(network) {
        let theirs = network.file_name(&ours);
        expected.insert(theirs.clone());
        expected.extend(network.repeated_names(&theirs));
        match file.shape(&theirs) {
            None => missing.push(theirs),
            Some(found) if squeezed(&found) != shape => {
                different.push(format!("{theirs} is {found:?} instead of {shape:?}"));
            }
            Some(found) => {
                names.insert(ours, (theirs, found));
            }
        }
    }
    let is_surplus = |name: &String| !expected.contains(name) && !is_constant(name);
    let surplus: Vec<String> = file.names().into_iter().filter(is_surplus).collect();
    if missing.is_empty() && different.is_empty() && surplus.is_empty() {
        return Ok(names);
    }
    let lists = [("missing", missing), ("surplus", surplus), ("of another shape", different)];
    let faults = lists.into_iter().filter(|(_, list)| !list.is_empty());
    let shown = |list: &[String]| {
        let more = list.len().saturating_sub(MAX_LISTED);
        let first = list[..list.len() - more].join(", ");
        if more > 0 { format!("{first} and {more} more") } else { first }
    };
    let faults = faults.map(|(what, list)| format!("{} {what}: {}", list.len(), shown(&list)));
    let what = format!("keys do not fit the network; {}", faults.collect::<Vec<_>>().join("; "));
    Err(Error::data(what, file.path(), "name a file of this network, whole and unchanged"))
}

/// Returns a shape without the axis of one frame that some convolutions have.
fn squeezed(shape: &[usize]) -> Vec<usize> {
    let mut shape = shape.to_vec();
    if shape.len() == 5 && shape[2] == 1 {
        shape.remove(2);
    }
    shape
}

/// Returns the number of parameters, after all keys have been compared.
fn count(network: &Network, file: &StateDict) -> Result<usize> {
    compared(network, file)?;
    let is_learnt = |name: &str| !name.contains(".running_");
    let shapes = parameter_shapes(network).into_iter();
    Ok(shapes.filter(|(name, _)| is_learnt(name)).map(|(_, s)| s.iter().product::<usize>()).sum())
}

/// Gives a network the values of a file.
fn filled(network: Network, file: &StateDict) -> Result<Network> {
    let names = compared(&network, file)?;
    // A view of one number may claim any shape: values take no more than the file has.
    let claimed: u64 =
        names.values().map(|(_, shape)| 2 * shape.iter().product::<usize>() as u64).sum();
    if claimed > file.length() {
        let what = format!("tensors of {claimed} bytes or more in a file of {}", file.length());
        return Err(Error::data(what, file.path(), "name a file that holds all its values"));
    }
    let mut values = BTreeMap::new();
    for (ours, (theirs, shape)) in &names {
        let read = file.read(theirs, shape)?;
        check_repeated(&read, theirs, shape, &network, file)?;
        values.insert(ours.clone(), read);
    }
    Ok(init_parameters(network, |name, _| values.remove(name).unwrap_or_default()))
}

/// Checks that a tensor has the same values under all its names.
fn check_repeated(
    first: &[f32],
    theirs: &str,
    shape: &[usize],
    network: &Network,
    file: &StateDict,
) -> Result<()> {
    for again in network.repeated_names(theirs) {
        if file.shape(&again).is_some() && file.read(&again, shape)? != first {
            let what = format!("`{again}` is not the same as `{theirs}`");
            let help = format!("this is another network than {}", network.method().name());
            return Err(Error::data(what, file.path(), help));
        }
    }
    Ok(())
}
