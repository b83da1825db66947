//! The list of learned methods, and what the folder of each gives to files, training and restoring.
//!
//! A new method is a folder with an implementation of `LearnedMethod`, and a line in `methods!`.

use crate::emvd::{self, Emvd};
use crate::flornn::{self, FloRnn};
use crate::import::Shapes;
use crate::learning::{Bursts, Law, NetworkLosses};
use crate::memdeblur::{self, MemDeblur};
use crate::quiver::{self, Quiver};
use crate::restorer::Window;
use crate::rvrt::{self, Rvrt};
use crate::spk2imgnet::{self, Spk2ImgNet};
use crate::student_teacher::{self, KernelPrediction};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_core::{Result, Size};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Largest number of channels, blocks or frames that a file or a recipe may ask for.
pub(crate) const MAX_SIZE: usize = 4096;

/// A learned method.
pub(crate) trait LearnedMethod: Module {
    /// Sizes of the network, as in the `[network]` table of recipes.
    type Sizes: Copy;

    /// Text of the recipe that trains the method.
    const RECIPE: &'static str;

    /// A parameter that no other network has.
    const MARK: &'static str;

    /// The divisor of the sides of frames.
    const MULTIPLE: usize;

    /// Bytes that restoring a window takes on the processor for each pixel and feature, at most: measured
    /// with the authors' sizes on frames of 256 x 256 (docs/notes/engineering/learned-methods.md).
    const BYTES: usize;

    /// Frames that are restored at once.
    const FRAMES: usize = 11;

    /// Networks that learn at the same time and that this one learns from; they are not saved.
    const TEACHERS: &'static [&'static str] = &[];

    /// Makes the network, all weights zero.
    fn init(sizes: Self::Sizes, device: &Device) -> Self;

    /// Reads the sizes off the shapes of a file.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the file lacks a parameter.
    fn sizes(shapes: &Shapes<'_>) -> Result<Self::Sizes>;

    /// Returns the sizes in words.
    fn describe(sizes: Self::Sizes) -> String;

    /// Returns all numbers of channels, blocks and frames.
    fn numbers(sizes: Self::Sizes) -> Vec<usize>;

    /// Returns the channels of the widest layers at full size.
    fn features(sizes: Self::Sizes) -> usize;

    /// Returns the reason why a network cannot have these sizes.
    fn problem(_sizes: Self::Sizes) -> Option<&'static str> {
        None
    }

    /// Returns the reason why a recipe cannot have these sizes: a file must tell them again.
    fn problem_in_recipe(sizes: Self::Sizes) -> Option<&'static str> {
        Self::problem(sizes)
    }

    /// Returns the lengths of bursts that the network learns from, in words, unless `frames` is one of them.
    fn other_lengths(sizes: Self::Sizes, frames: usize) -> Option<String>;

    /// Returns the name of a parameter in files.
    fn file_name(name: &str) -> String {
        name.to_owned()
    }

    /// Returns other names of the same tensor in files.
    fn repeated_names(_file_name: &str) -> Vec<String> {
        Vec::new()
    }

    /// Returns the law of a parameter's initial values, where it differs from PyTorch's. `name` is its name
    /// in files.
    fn initial_law(_sizes: Self::Sizes, _name: &str, _shape: &[usize]) -> Option<Law> {
        None
    }

    /// Returns the numbers of frames before and after a frame that the network sees to restore it; 0 for
    /// networks that see all frames.
    fn context(&self) -> [usize; 2];

    /// Restores the requested frames of a window, `[1, 1, height, width]` each.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the restoring is interrupted.
    fn restore(&self, window: Window<'_>) -> Result<Vec<Tensor<4>>>;

    /// Computes the terms of the authors' loss at a step, from 0.
    fn losses(&self, teachers: &[&Self], bursts: &Bursts, step: u64) -> NetworkLosses;

    /// Returns the step of the authors' training that `step` of `steps` stands for, where a loss changes.
    fn authors_step(step: u64, _steps: u64) -> u64 {
        step
    }
}

macro_rules! methods {
    ($($name:literal => $method:ident($network:ty, $sizes:ty)),+ $(,)?) => {
        /// A learned method.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum Method {
            $(#[doc = concat!("[`", stringify!($network), "`]")] $method),+
        }

        /// All methods.
        pub const METHODS: [Method; [$(Method::$method),+].len()] = [$(Method::$method),+];

        /// The sizes of a network; in recipes, the key `method` names the method.
        #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
        #[serde(tag = "method")]
        pub enum Sizes {
            $(#[doc = concat!("Sizes of [`", stringify!($network), "`].")]
            #[serde(rename = $name)]
            $method($sizes)),+
        }

        /// A network.
        #[derive(Module, Debug)]
        #[allow(clippy::large_enum_variant)] // one at a time
        pub enum Network {
            $(#[doc = concat!("[`", stringify!($network), "`]")] $method($network)),+
        }

        impl Method {
            /// Returns the name on the command line, in recipes and in files.
            pub const fn name(self) -> &'static str {
                match self { $(Self::$method => $name),+ }
            }

            /// Returns the text of the recipe that trains the method.
            pub fn recipe(self) -> &'static str {
                match self { $(Self::$method => <$network>::RECIPE),+ }
            }

            pub(crate) fn teachers(self) -> &'static [&'static str] {
                match self { $(Self::$method => <$network>::TEACHERS),+ }
            }

            pub(crate) fn mark(self) -> &'static str {
                match self { $(Self::$method => <$network>::MARK),+ }
            }

            pub(crate) fn sizes(self, shapes: &Shapes<'_>) -> Result<Sizes> {
                Ok(match self { $(Self::$method => Sizes::$method(<$network>::sizes(shapes)?)),+ })
            }
        }

        impl Sizes {
            /// Returns the method.
            pub fn method(self) -> Method {
                match self { $(Self::$method(_) => Method::$method),+ }
            }

            /// Makes the network of these sizes, without weights: it takes no memory yet.
            pub fn network(self, device: &Device) -> Network {
                match self { $(Self::$method(s) => Network::$method(<$network>::init(s, device))),+ }
            }

            /// Returns the reason why a network cannot have these sizes.
            pub fn problem(self) -> Option<&'static str> {
                match self { $(Self::$method(s) => <$network>::problem(s)),+ }
            }

            /// Returns the divisor of the sides of frames.
            pub fn multiple(self) -> usize {
                match self { $(Self::$method(_) => <$network>::MULTIPLE),+ }
            }

            pub(crate) fn frames_at_once(self) -> usize {
                match self { $(Self::$method(_) => <$network>::FRAMES),+ }
            }

            pub(crate) fn initial_law(self, name: &str, shape: &[usize]) -> Option<Law> {
                match self { $(Self::$method(s) => <$network>::initial_law(s, name, shape)),+ }
            }

            fn problem_of_method(self) -> Option<&'static str> {
                match self { $(Self::$method(s) => <$network>::problem_in_recipe(s)),+ }
            }

            fn other_lengths(self, frames: usize) -> Option<String> {
                match self { $(Self::$method(s) => <$network>::other_lengths(s, frames)),+ }
            }

            fn numbers(self) -> Vec<usize> {
                match self { $(Self::$method(s) => <$network>::numbers(s)),+ }
            }

            fn bytes_per_pixel(self) -> usize {
                match self { $(Self::$method(s) => <$network>::features(s) * <$network>::BYTES),+ }
            }
        }

        impl std::fmt::Display for Sizes {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str(&match *self { $(Self::$method(s) => <$network>::describe(s)),+ })
            }
        }

        impl Network {
            /// Returns the method.
            pub fn method(&self) -> Method {
                match self { $(Self::$method(_) => Method::$method),+ }
            }

            /// Returns the name in files of one of our parameters, which begins with the name of the variant.
            pub(crate) fn file_name(&self, ours: &str) -> String {
                let own = ours.split_once('.').map_or(ours, |(_, own)| own);
                match self { $(Self::$method(_) => <$network as LearnedMethod>::file_name(own)),+ }
            }

            pub(crate) fn repeated_names(&self, file_name: &str) -> Vec<String> {
                match self { $(Self::$method(_) => <$network>::repeated_names(file_name)),+ }
            }

            pub(crate) fn context(&self) -> [usize; 2] {
                match self { $(Self::$method(network) => network.context()),+ }
            }

            pub(crate) fn restore(&self, window: Window<'_>) -> Result<Vec<Tensor<4>>> {
                match self { $(Self::$method(network) => LearnedMethod::restore(network, window)),+ }
            }

            /// Computes the loss at a step of `steps`; `teachers` are of the same method.
            pub(crate) fn losses(&self, teachers: &[Self], bursts: &Bursts, step: u64, steps: u64) -> NetworkLosses {
                match self {
                    $(Self::$method(network) => {
                        let own = teachers.iter().filter_map(|teacher| match teacher {
                            Self::$method(teacher) => Some(teacher),
                            _ => None,
                        });
                        let teachers: Vec<_> = own.collect();
                        let step = <$network>::authors_step(step, steps);
                        LearnedMethod::losses(network, &teachers, bursts, step)
                    }),+
                }
            }
        }
    };
}

methods! {
    "quiver" => Quiver(Quiver, quiver::Sizes),
    "emvd" => Emvd(Emvd, emvd::Sizes),
    "flornn" => FloRnn(FloRnn, flornn::Sizes),
    "spk2imgnet" => Spk2ImgNet(Spk2ImgNet, spk2imgnet::Sizes),
    "memdeblur" => MemDeblur(MemDeblur, memdeblur::Sizes),
    "rvrt" => Rvrt(Rvrt, rvrt::Sizes),
    "student-teacher" => StudentTeacher(KernelPrediction, student_teacher::Sizes),
}

impl Method {
    /// Returns the method of this name.
    pub fn by_name(name: &str) -> Option<Self> {
        METHODS.into_iter().find(|method| method.name() == name)
    }
}

impl Sizes {
    /// Returns the reason why a recipe cannot have these sizes.
    pub fn problem_in_recipe(self) -> Option<&'static str> {
        if self.numbers().iter().any(|number| !(1..=MAX_SIZE).contains(number)) {
            return Some("sizes are from 1 to 4096");
        }
        self.problem_of_method()
    }

    /// Returns the reason why the network cannot learn from bursts of so many frames.
    pub fn problem_of_bursts(self, frames: usize) -> Option<String> {
        let lengths = self.other_lengths(frames)?;
        let name = self.method().name();
        Some(format!("bursts of {frames} frames: {name} learns from {lengths}"))
    }

    /// Returns the bytes that restoring a window of frames of `size` takes on the processor, at most, about.
    pub fn memory(self, size: Size) -> u64 {
        (size.pixels() * self.bytes_per_pixel()) as u64
    }
}
