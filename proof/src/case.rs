//! What the campaign is made of: a case as its maker gets it, and the truth that the maker hands over.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// What a case is for; tables and pages are made by it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Group {
    /// A real recording.
    Real,
    /// A cell simulated by a model that others wrote.
    Cells,
    /// A circuit simulated with a circuit simulator's own devices.
    Circuits,
    /// One concealed effect.
    Single,
    /// Two or three concealed effects.
    Combined,
    /// Nothing concealed.
    Clean,
    /// A concealed effect that the library does not have.
    Outside,
    /// A recording that cannot separate two effects.
    Inseparable,
    /// The unmodified image on the emulated board.
    Board,
}

impl Group {
    /// All of them, in the order of the tables.
    pub const ALL: [Self; 9] = [
        Self::Real,
        Self::Cells,
        Self::Circuits,
        Self::Single,
        Self::Combined,
        Self::Clean,
        Self::Outside,
        Self::Inseparable,
        Self::Board,
    ];

    /// As a heading says it.
    pub fn title(self) -> &'static str {
        match self {
            Self::Real => "real recordings",
            Self::Cells => "cells by PyBaMM",
            Self::Circuits => "circuits by ngspice",
            Self::Single => "one concealed effect",
            Self::Combined => "two and three concealed effects",
            Self::Clean => "nothing concealed",
            Self::Outside => "effects that are not in the library",
            Self::Inseparable => "recordings that cannot separate two effects",
            Self::Board => "emulated board",
        }
    }
}

/// A concealed effect and its size.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Concealed {
    /// Of the library, or a name that it lacks.
    pub id: String,
    /// 1 is just visible: the effect moves the reading by 0.3 of the noise's rms.
    pub strength: f64,
}

/// A case as its maker gets it (CASE.json).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Case {
    /// Unique, and a name of a folder.
    pub id: String,
    /// Module of `proof/makers`; empty for what this program prepares itself.
    pub maker: String,
    /// Nothing for a clean recording.
    pub effects: Vec<Concealed>,
    /// white, coloured, quantised or none.
    pub noise: String,
    /// Profile of the current.
    pub drive: String,
    /// Everything random follows from it.
    pub seed: u64,
    /// Rows of the recording that is fitted.
    pub rows: usize,
    /// What only one maker knows.
    #[serde(default)]
    pub options: Map<String, Value>,
}

impl Case {
    /// Strength of the weakest of the concealed effects; infinite where strengths say nothing (a real recording).
    pub fn strength(&self) -> f64 {
        self.effects
            .iter()
            .map(|effect| effect.strength)
            .fold(f64::INFINITY, f64::min)
    }
}

/// A case, and what is done with it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Planned {
    /// What it is for.
    pub group: Group,
    /// As its maker gets it.
    pub case: Case,
    /// Explain once more with the true effects taken out of the library.
    pub without: bool,
    /// Explain it a second time: the report has to be the same.
    pub twice: bool,
    /// Today's methods that get the same files.
    pub methods: Vec<String>,
}

/// An effect that is in the data, with its true parameters.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct TrueEffect {
    /// Of the library, or a name that it lacks.
    pub id: String,
    /// By the library's names; nothing where they do not follow from what was made.
    #[serde(default)]
    pub parameters: Option<BTreeMap<String, Option<f64>>>,
}

/// What a publisher measured of a parameter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Published {
    /// Effect of the library.
    pub effect: String,
    /// Its parameter.
    pub name: String,
    /// The published figure.
    pub value: f64,
    /// Lower end of what is right.
    pub low: f64,
    /// Upper end.
    pub high: f64,
    /// Who says so.
    #[serde(default)]
    pub source: String,
}

/// Where an effect acts.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Place {
    /// Column of the recording.
    pub column: String,
    /// Lower end.
    #[serde(default)]
    pub from: Option<f64>,
    /// Upper end.
    #[serde(default)]
    pub to: Option<f64>,
    /// The magnitude counts.
    #[serde(default)]
    pub absolute: bool,
}

/// A figure for what is fitted and one for what is not.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Pair {
    /// Of `recording.csv`.
    #[serde(default)]
    pub recording: Option<f64>,
    /// Of `holdout.csv`.
    #[serde(default)]
    pub holdout: Option<f64>,
}

/// What the maker knows (truth.json).
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Truth {
    /// a real, b a simulator that others wrote, c others' solver with our equations, d our own.
    pub kind: String,
    /// In words.
    pub maker: String,
    /// With their parameters.
    #[serde(default)]
    pub effects: Vec<TrueEffect>,
    /// One list for each hidden effect; any of its ids is the right name.
    #[serde(default)]
    pub required: Vec<Vec<String>>,
    /// Further ids that are true of this data.
    #[serde(default)]
    pub allowed: Vec<String>,
    /// Effects that this recording cannot separate.
    #[serde(default)]
    pub class_ids: Vec<Vec<String>>,
    /// Why it cannot.
    #[serde(default)]
    pub why: Option<String>,
    /// Where the effect acts.
    #[serde(default, rename = "where")]
    pub place: Option<Place>,
    /// Strength of all effects together, where they hide one another.
    #[serde(default)]
    pub combined_strength: Option<f64>,
    /// Of the added noise.
    #[serde(default)]
    pub noise_rms: Option<f64>,
    /// What the true model leaves.
    #[serde(default)]
    pub oracle_rms: Option<Pair>,
    /// What the model as designed leaves.
    #[serde(default)]
    pub before_rms: Option<Pair>,
    /// Of a real recording: published, beside or none (expected.toml).
    #[serde(default)]
    pub standing: Option<String>,
    /// Of a real recording.
    #[serde(default)]
    pub published: Vec<Published>,
}

impl Truth {
    /// Strength of what is hidden: of the weakest effect, or of all together if that is less.
    pub fn strength(&self, weakest: f64) -> f64 {
        self.combined_strength
            .map_or(weakest, |together| weakest.min(together))
    }

    /// Nobody knows what is right here: only errors are scored.
    pub fn unknown(&self) -> bool {
        self.standing.as_deref() == Some("none")
    }
}
