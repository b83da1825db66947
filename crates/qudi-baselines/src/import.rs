//! The authors' files: which network they are of, in which size, and its weights.

use crate::emvd::{self, Emvd};
use crate::flornn::{self, FloRnn};
use crate::memdeblur::{self, MemDeblur};
use crate::quiver::{self, Quiver};
use crate::rvrt::{self, Rvrt};
use crate::sizes::{MOST, Sizes};
use crate::spk2imgnet::{self, Spk2ImgNet};
use crate::student_teacher::{self, KernelPrediction};
use crate::weights::{self, Description};
use burn::module::Module;
use burn::tensor::Device;
use qudi_core::{Error, Result};
use qudi_layers::{StateDict, init_parameters, parameter_shapes};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Keys of a kind that a message lists.
const SHOWN: usize = 20;

/// A learned method.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Method {
    /// [`Quiver`]
    Quiver,
    /// [`Emvd`]
    Emvd,
    /// [`FloRnn`]
    FloRnn,
    /// [`Spk2ImgNet`]
    Spk2ImgNet,
    /// [`MemDeblur`]
    MemDeblur,
    /// [`Rvrt`]
    Rvrt,
    /// [`KernelPrediction`]
    StudentTeacher,
}

/// All methods.
pub const METHODS: [Method; 7] = [
    Method::Quiver,
    Method::Emvd,
    Method::FloRnn,
    Method::Spk2ImgNet,
    Method::MemDeblur,
    Method::Rvrt,
    Method::StudentTeacher,
];

/// A network with weights.
#[derive(Module, Debug)]
#[allow(clippy::large_enum_variant)] // one at a time
pub enum Network {
    /// QUIVER.
    Quiver(Quiver),
    /// EMVD.
    Emvd(Emvd),
    /// FloRNN.
    FloRnn(FloRnn),
    /// Spk2ImgNet.
    Spk2ImgNet(Spk2ImgNet),
    /// MemDeblur.
    MemDeblur(MemDeblur),
    /// RVRT.
    Rvrt(Rvrt),
    /// A student of two teachers.
    StudentTeacher(KernelPrediction),
}

/// What a file holds.
#[derive(Clone, Debug, PartialEq)]
pub struct Contents {
    /// The network.
    pub method: Method,
    /// Its sizes, in words.
    pub sizes: String,
    /// The number of its parameters.
    pub parameters: usize,
    /// What a file says of itself that this program wrote.
    pub description: Option<Description>,
}

/// A network out of a file.
#[derive(Debug)]
pub struct Loaded {
    /// The network.
    pub network: Network,
    /// Its sizes.
    pub sizes: Sizes,
    /// What a file says of itself that this program wrote; none of those of authors.
    pub description: Option<Description>,
}

impl Method {
    /// The name on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Quiver => "quiver",
            Self::Emvd => "emvd",
            Self::FloRnn => "flornn",
            Self::Spk2ImgNet => "spk2imgnet",
            Self::MemDeblur => "memdeblur",
            Self::Rvrt => "rvrt",
            Self::StudentTeacher => "student-teacher",
        }
    }

    /// The method of this name.
    pub fn by_name(name: &str) -> Option<Self> {
        METHODS.into_iter().find(|method| method.name() == name)
    }

    /// A parameter that no other network has.
    fn mark(self) -> &'static str {
        match self {
            Self::Quiver => "predenoise.sfe1.weight",
            Self::Emvd => "vd.fusion.net1.weight",
            Self::FloRnn => "forward_rnn.first_conv.weight",
            Self::Spk2ImgNet => "extractor.conv0_0.weight",
            Self::MemDeblur => "memory.key_proj.key_proj.weight",
            Self::Rvrt => "reconstruction.main.1.weight",
            Self::StudentTeacher => "kernels.weight",
        }
    }

    /// The method whose weights a file holds, if it is one of these.
    fn of(file: &StateDict) -> Option<Self> {
        METHODS.into_iter().find(|method| file.shape(method.mark()).is_some())
    }
}

/// What the file at `path` holds; none if it is no file of a learned method. `device` is for networks without
/// weights.
///
/// # Errors
/// [`Error`] if it cannot be read, or its network lacks parameters or has too many.
pub fn describe(path: &Path, device: &Device) -> Result<Option<Contents>> {
    describe_file(&StateDict::open(path)?, device)
}

/// [`describe`] of a SafeTensors file in memory, which errors call `name`.
///
/// # Errors
/// As [`describe`].
pub fn describe_bytes(bytes: &[u8], name: &Path, device: &Device) -> Result<Option<Contents>> {
    describe_file(&StateDict::of_bytes(bytes.to_vec(), name)?, device)
}

fn describe_file(file: &StateDict, device: &Device) -> Result<Option<Contents>> {
    let Some(method) = Method::of(file) else { return Ok(None) };
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

/// [`load`] from a SafeTensors file in memory, which errors call `name`.
///
/// # Errors
/// As [`load`].
pub fn load_bytes(bytes: &[u8], name: &Path, method: Method, device: &Device) -> Result<Loaded> {
    load_file(&StateDict::of_bytes(bytes.to_vec(), name)?, method, device)
}

fn load_file(file: &StateDict, method: Method, device: &Device) -> Result<Loaded> {
    let found = Method::of(file);
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

/// The sizes that follow from the shapes of a file.
fn sizes_of(file: &StateDict, method: Method) -> Result<Sizes> {
    let side = |name: &str, axis: usize| {
        let side = file.shape(name).and_then(|shape| shape.get(axis).copied());
        let help = "these are weights of another network, or the file is damaged";
        match side {
            Some(side) if (1..=MOST).contains(&side) => Ok(side),
            Some(side) => {
                Err(Error::data(format!("`{name}` has a side of {side}"), file.path(), help))
            }
            None => Err(Error::data(format!("`{name}` is missing"), file.path(), help)),
        }
    };
    let names = file.names();
    // Blocks are numbered from 0.
    let count = |list: &str| {
        let number = |name: &String| {
            let rest = name.strip_prefix(list)?.strip_prefix('.')?;
            rest.split('.').next()?.parse::<usize>().ok()
        };
        names.iter().filter_map(number).max().map_or(0, |most| most.min(MOST) + 1)
    };
    let sizes = match method {
        Method::Quiver => {
            let features = side("predenoise.sfe1.weight", 0)?;
            let frames = side("spatial_att.conv.weight", 0)? / (4 * features).max(1);
            let past = frames.saturating_sub(1).div_ceil(2);
            Sizes::Quiver(quiver::Sizes {
                features,
                blocks: 1 + count("forward_cell.F_R.1.RDBs"),
                past,
                future: frames.saturating_sub(1 + past),
            })
        }
        Method::Emvd => Sizes::Emvd(emvd::Sizes { width: side("vd.fusion.net1.weight", 0)? }),
        Method::FloRnn => Sizes::FloRnn(flornn::Sizes {
            channels: side("d.convs.2.weight", 0)?,
            features: side("forward_rnn.first_conv.weight", 0)?,
            blocks: count("forward_rnn.resblocks"),
            flow: names.iter().any(|name| name.starts_with("pwcnet.")),
            ..flornn::PUBLISHED
        }),
        Method::Spk2ImgNet => Sizes::Spk2ImgNet(spk2imgnet::Sizes {
            features: side("extractor.conv.weight", 0)?,
            stem: side("extractor.conv0_0.weight", 0)?,
            blocks: count("extractor.net"),
            groups: side("pcd_align.pcd_align.cas_dcnpack.conv_offset_mask.weight", 0)? / 27,
        }),
        Method::MemDeblur => Sizes::MemDeblur(memdeblur::Sizes {
            channels: side("downsampling.0.weight", 0)?,
            features: side("fusion.weight", 0)?,
            forward_blocks: count("forward_resblocks.main.0"),
            backward_blocks: count("backward_resblocks.main.2"),
            memory_blocks: count("memory.key_encoder.forward_resblocks.main.2"),
            bottlenecks: count("memory.key_encoder.layer1"),
            ..memdeblur::PUBLISHED
        }),
        Method::Rvrt => Sizes::Rvrt(rvrt::Sizes {
            channels: side("conv_last.weight", 0)?,
            features: side("feat_extract.3.weight", 0)?,
            blocks: count("backbone.backward_1.main.5"),
        }),
        Method::StudentTeacher => {
            let frames = side("extractor.0.weight", 1)?;
            Sizes::StudentTeacher(student_teacher::Sizes {
                frames,
                features: side("extractor.0.weight", 0)?,
                kernel: (side("kernels.weight", 0)? / frames).isqrt(),
            })
        }
    };
    match sizes.problem() {
        None => Ok(sizes),
        Some(problem) => {
            let help = "this network cannot be of these sizes: name another file";
            Err(Error::data(format!("{problem}; the file has {sizes}"), file.path(), help))
        }
    }
}

impl Network {
    /// The method that it is of.
    pub fn method(&self) -> Method {
        match self {
            Self::Quiver(_) => Method::Quiver,
            Self::Emvd(_) => Method::Emvd,
            Self::FloRnn(_) => Method::FloRnn,
            Self::Spk2ImgNet(_) => Method::Spk2ImgNet,
            Self::MemDeblur(_) => Method::MemDeblur,
            Self::Rvrt(_) => Method::Rvrt,
            Self::StudentTeacher(_) => Method::StudentTeacher,
        }
    }

    /// The name in files of one of our parameters, which begins with the name of the variant.
    pub(crate) fn file_name(&self, ours: &str) -> String {
        let own = ours.split_once('.').map_or(ours, |(_, own)| own);
        match self {
            Self::Quiver(_) => Quiver::authors_name(own),
            Self::Emvd(_) => own.to_owned(),
            Self::FloRnn(_) => FloRnn::authors_name(own),
            Self::Spk2ImgNet(_) => Spk2ImgNet::authors_name(own),
            Self::MemDeblur(_) => MemDeblur::authors_name(own),
            Self::Rvrt(_) => Rvrt::authors_name(own),
            Self::StudentTeacher(_) => KernelPrediction::file_name(own),
        }
    }
}

/// Keys that files have beside parameters: constants, and what the same tensor is called elsewhere.
fn is_beside(name: &str) -> bool {
    let repeated = (1..5).any(|k| name.starts_with(&format!("predenoise.rdbs.{k}.")));
    let constant = ["num_batches_tracked", "relative_position_index"];
    let mean = ["spynet.mean", "spynet.std"].contains(&name);
    repeated || mean || constant.iter().any(|constant| name.ends_with(constant))
}

/// The names of all parameters in the file, with their shapes here and there, after comparing them all.
fn compared(network: &Network, file: &StateDict) -> Result<BTreeMap<String, (String, Vec<usize>)>> {
    let (mut missing, mut different) = (Vec::new(), Vec::new());
    let (mut names, mut expected) = (BTreeMap::new(), BTreeSet::new());
    for (ours, shape) in parameter_shapes(network) {
        let theirs = network.file_name(&ours);
        expected.insert(theirs.clone());
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
    let is_surplus = |name: &String| !expected.contains(name) && !is_beside(name);
    let surplus: Vec<String> = file.names().into_iter().filter(is_surplus).collect();
    if missing.is_empty() && different.is_empty() && surplus.is_empty() {
        return Ok(names);
    }
    let lists = [("missing", missing), ("surplus", surplus), ("of another shape", different)];
    let faults = lists.into_iter().filter(|(_, list)| !list.is_empty());
    let shown = |list: &[String]| {
        let more = list.len().saturating_sub(SHOWN);
        let first = list[..list.len() - more].join(", ");
        if more > 0 { format!("{first} and {more} more") } else { first }
    };
    let faults = faults.map(|(what, list)| format!("{} {what}: {}", list.len(), shown(&list)));
    let what = format!("keys do not fit the network; {}", faults.collect::<Vec<_>>().join("; "));
    Err(Error::data(what, file.path(), "name a file of this network, whole and unchanged"))
}

/// A shape without the axis of one frame that some convolutions have.
fn squeezed(shape: &[usize]) -> Vec<usize> {
    let mut shape = shape.to_vec();
    if shape.len() == 5 && shape[2] == 1 {
        shape.remove(2);
    }
    shape
}

/// The number of parameters, after all keys have been compared.
fn count(network: &Network, file: &StateDict) -> Result<usize> {
    compared(network, file)?;
    let is_learnt = |name: &str| !name.contains(".running_");
    let shapes = parameter_shapes(network).into_iter();
    Ok(shapes.filter(|(name, _)| is_learnt(name)).map(|(_, s)| s.iter().product::<usize>()).sum())
}

/// The network with the values of a file.
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
        check_repeated(&read, theirs, shape, file)?;
        values.insert(ours.clone(), read);
    }
    Ok(init_parameters(network, |name, _| values.remove(name).unwrap_or_default()))
}

/// The one dense block of QUIVER's pre-denoiser stands in its files five times: refuses files where these differ.
fn check_repeated(first: &[f32], theirs: &str, shape: &[usize], file: &StateDict) -> Result<()> {
    let Some(rest) = theirs.strip_prefix("predenoise.rdbs.0.") else { return Ok(()) };
    for k in 1..5 {
        let again = format!("predenoise.rdbs.{k}.{rest}");
        if file.shape(&again).is_some() && file.read(&again, shape)? != first {
            let what = format!("`{again}` is not the same as `{theirs}`");
            return Err(Error::data(what, file.path(), "this is another network than QUIVER"));
        }
    }
    Ok(())
}
