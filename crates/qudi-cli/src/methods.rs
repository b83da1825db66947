//! The registry of methods: one row each. Help texts, the default, forecasts and the overview of
//! `docs/methods.md` are read from it.

pub(crate) mod classical;
pub(crate) mod default;
pub(crate) mod learned;
pub(crate) mod network;
pub(crate) mod options;
pub(crate) mod trained;

use crate::error::Result;
use learned::EMVD;
use network::NetworkChoice;
use options::NetworkOptions;
use qudi_baselines::import;
use qudi_burst::{Average, PostFilter, Qbp, QbpRefined, Transform};
use qudi_core::restorer::{Acquisition, Restorer};
use qudi_io::capture::Capture;
use qudi_model::config::NetworkKind;

/// A restorer, and what follows the method's name in messages: ` over 5 frames`, ` (regression) on cpu`.
pub(crate) type Built = (Box<dyn Restorer>, String);

/// A method of restoring frames.
#[derive(Debug)]
pub(crate) struct Method {
    /// Name on the command line.
    pub(crate) name: &'static str,
    /// Summary for help texts.
    pub(crate) about: &'static str,
    /// Rough time in seconds for a frame of 256 x 256 on two processor cores.
    pub(crate) cost: f64,
    /// True if the method aligns frames itself, so that it gains from longer sums aligned along the motion.
    pub(crate) aligns: bool,
    /// Origin of its weights, and how its restorer is made.
    pub(crate) kind: Kind,
}

/// Origin of a method's weights, with what makes its restorer.
#[derive(Debug)]
pub(crate) enum Kind {
    /// No weights.
    Classical(fn(&mut Capture, &Acquisition) -> Result<Built>),
    /// A network of this project.
    Network(NetworkChoice),
    /// A learned method of others.
    Learned {
        /// Its network.
        method: import::Method,
        /// Weights in the program.
        built_in: Option<&'static [u8]>,
    },
}

/// Methods that `eval` and `bench` compare by default.
pub(crate) const COMPARED: [&str; 2] = ["average", "mle"];

/// The default for captures whose dark rate is unknown.
pub(crate) const MLE: Method = Method::classical(
    "mle",
    "averages 1 to 11 frames, inverts the response of the sensor, subtracts dark counts",
    0.0002,
    classical::mle,
);

/// The default for sensors and light that the built-in weights were not trained for.
pub(crate) const QBP_REFINED: Method = Method::classical(
    "qbp-refined",
    "runs qbp-bm3d twice, the second time on its first result",
    0.12,
    |_, _| Ok((Box::new(QbpRefined), String::new())),
)
.aligning();

/// The default.
pub(crate) const QUDI: Method = Method {
    name: "qudi",
    about: "runs qudi-regression, or the network of --weights",
    cost: 0.4,
    aligns: true,
    kind: Kind::Network(NetworkChoice::Best),
};

/// The regression.
pub(crate) const QUDI_REGRESSION: Method = Method {
    name: "qudi-regression",
    about: "applies a trained network to aligned frames and qbp-refined, twice",
    kind: Kind::Network(NetworkChoice::Of(NetworkKind::Regression)),
    ..QUDI
};

/// The diffusion.
pub(crate) const QUDI_DIFFUSION: Method = Method {
    name: "qudi-diffusion",
    about: "samples from photons alone, as the paper's network does",
    cost: 0.2,
    aligns: false,
    kind: Kind::Network(NetworkChoice::Of(NetworkKind::Diffusion)),
};

/// All methods.
pub(crate) const METHODS: &[Method] = &[
    Method::classical("average", "averages 11 frames", 0.00003, |_, _| {
        Ok((Box::new(Average), String::new()))
    }),
    MLE,
    Method::classical(
        "transform-denoise",
        "averages 1 to 11 frames, stabilizes their variance, applies BM3D",
        0.09,
        |capture, acquisition| {
            classical::transform_denoise(Transform::Integral, capture, acquisition)
        },
    ),
    Method::classical(
        "bm3d",
        "averages 1 to 11 frames, applies BM3D with one noise level",
        0.09,
        |capture, acquisition| {
            classical::transform_denoise(Transform::Identity, capture, acquisition)
        },
    ),
    Method::classical("qbp", "aligns patches of 11 frames and merges them", 0.02, |_, _| {
        Ok((Box::new(Qbp::new(PostFilter::None)), String::new()))
    })
    .aligning(),
    Method::classical("qbp-bm3d", "runs qbp, then BM3D", 0.1, |_, _| {
        Ok((Box::new(Qbp::new(PostFilter::Bm3d)), String::new()))
    })
    .aligning(),
    QBP_REFINED,
    QUDI,
    QUDI_REGRESSION,
    QUDI_DIFFUSION,
    Method::learned(import::Method::Quiver, "QUIVER (Chennuri et al., ECCV 2024)", 3.0, None),
    Method::learned(import::Method::Emvd, "EMVD (Maggioni et al., CVPR 2021)", 0.03, Some(EMVD)),
    Method::learned(import::Method::FloRnn, "FloRNN (Li et al., ECCV 2022)", 8.0, None),
    Method::learned(import::Method::Spk2ImgNet, "Spk2ImgNet (Zhao et al., CVPR 2021)", 5.0, None),
    Method::learned(import::Method::MemDeblur, "MemDeblur (Ji and Yao, CVPR 2022)", 0.4, None),
    Method::learned(import::Method::Rvrt, "RVRT (Liang et al., NeurIPS 2022)", 1.8, None),
    Method::learned(
        import::Method::StudentTeacher,
        "student and teachers (after Chi et al., ECCV 2020)",
        0.1,
        None,
    ),
];

/// Returns the names of the learned methods of others.
pub(crate) fn learned_names() -> Vec<&'static str> {
    let learned = METHODS.iter().filter(|method| method.as_learned().is_some());
    learned.map(|method| method.name).collect()
}

impl Method {
    const fn classical(
        name: &'static str,
        about: &'static str,
        cost: f64,
        restorer: fn(&mut Capture, &Acquisition) -> Result<Built>,
    ) -> Self {
        Self { name, about, cost, aligns: false, kind: Kind::Classical(restorer) }
    }

    const fn learned(
        method: import::Method,
        about: &'static str,
        cost: f64,
        built_in: Option<&'static [u8]>,
    ) -> Self {
        let kind = Kind::Learned { method, built_in };
        Self { name: method.name(), about, cost, aligns: false, kind }
    }

    const fn aligning(self) -> Self {
        Self { aligns: true, ..self }
    }

    /// Returns the method of this name.
    pub(crate) fn by_name(name: &str) -> Option<&'static Self> {
        METHODS.iter().find(|method| method.name == name)
    }

    /// Returns the row of a learned method of others.
    pub(crate) fn of_learned(learned: import::Method) -> Option<&'static Self> {
        METHODS.iter().find(|method| method.as_learned() == Some(learned))
    }

    /// Returns the learned method of others that it is, if it is one.
    pub(crate) fn as_learned(&self) -> Option<import::Method> {
        match self.kind {
            Kind::Learned { method, .. } => Some(method),
            Kind::Classical(_) | Kind::Network(_) => None,
        }
    }

    /// Returns the network of this project that it runs, if it runs one.
    pub(crate) fn as_own(&self) -> Option<NetworkChoice> {
        match self.kind {
            Kind::Network(choice) => Some(choice),
            Kind::Classical(_) | Kind::Learned { .. } => None,
        }
    }

    /// Returns true if it is any network: weights take time to read, and devices may fail.
    pub(crate) fn is_network(&self) -> bool {
        !matches!(self.kind, Kind::Classical(_))
    }

    /// Makes its restorer for a capture.
    ///
    /// # Errors
    /// [`CliError`](crate::error::CliError) if the capture cannot be read, or weights or device do not fit it.
    pub(crate) fn restorer(
        &self,
        capture: &mut Capture,
        acquisition: &Acquisition,
        options: &NetworkOptions,
    ) -> Result<Built> {
        match self.kind {
            Kind::Classical(restorer) => restorer(capture, acquisition),
            Kind::Network(choice) => {
                network::restorer(choice, options, acquisition, capture.size())
            }
            Kind::Learned { method, .. } => {
                learned::restorer(method, options, acquisition, capture.size())
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_core::Size;

    #[test]
    fn names_are_unique_and_every_learned_method_has_a_row() {
        for (n, method) in METHODS.iter().enumerate() {
            assert!(METHODS[..n].iter().all(|other| other.name != method.name), "{}", method.name);
        }
        for learned in import::METHODS {
            assert!(Method::of_learned(learned).is_some(), "{learned:?}");
        }
        assert!(COMPARED.iter().all(|name| Method::by_name(name).is_some()));
    }

    #[test]
    fn restorers_have_the_name_of_their_method() {
        let counts = vec![vec![1; 64 * 64]; 11];
        let size = Size { height: 64, width: 64 };
        let sensor = qudi_core::sensor::Sensor::load("qudi-paper").unwrap();
        let acquisition = Acquisition::new(sensor.clone(), 3.25, 0.45).unwrap();
        for method in METHODS {
            let Kind::Classical(restorer) = method.kind else { continue };
            let mut capture = Capture::in_memory("c", size, counts.clone(), &sensor).unwrap();
            let (restorer, _) = restorer(&mut capture, &acquisition).unwrap();
            assert_eq!(restorer.name(), method.name);
        }
    }

    #[test]
    fn the_overview_of_the_documentation_has_these_rows() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/methods.md");
        let text = std::fs::read_to_string(path).unwrap();
        let rows: Vec<&str> = text.lines().filter(|line| line.starts_with("| [`")).collect();
        assert_eq!(rows.len(), METHODS.len());
        for (row, method) in rows.iter().zip(METHODS) {
            let weights = match method.kind {
                Kind::Classical(_) => "none",
                Kind::Network(_) | Kind::Learned { built_in: Some(_), .. } => "built in",
                Kind::Learned { built_in: None, .. } => "`--weights`",
            };
            let Method { name, about, cost, .. } = method;
            let (first, last) =
                (format!("| [`{name}`](#"), format!(" | {about} | {weights} | {cost} |"));
            assert!(row.starts_with(&first) && row.ends_with(&last), "{row}\n{first}...){last}");
        }
    }
}
