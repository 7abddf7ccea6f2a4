//! The keys of a described device in gateway.toml.

use crate::signal::Message;
use alloc::collections::BTreeMap;
use alloc::string::String;
use alloc::vec::Vec;
use proprio_topics::Kind;
use serde::{Deserialize, Deserializer, de};

/// The keys of one device.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct DbcOptions {
    /// The .dbc file, relative to the configuration.
    pub file: String,
    /// The period of the readings of a simulated device \[ms\].
    pub period_ms: Option<u32>,
    /// Whether extended identifiers are those of SAE J1939; default as the file says.
    pub j1939: Option<bool>,
    /// Of J1939: the only source address whose frames count.
    pub source_address: Option<u8>,
    /// Of J1939: the only destination whose frames count, for messages that have one.
    pub destination_address: Option<u8>,
    /// Of J1939: the only priority whose frames count.
    pub priority: Option<u8>,
    /// What is read.
    pub reading: Vec<ReadingKeys>,
    /// The contents of `file`, which the gateway reads.
    #[serde(skip)]
    pub messages: Vec<Message>,
}

/// One reading: the signals of its values.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct ReadingKeys {
    /// Its kind.
    #[serde(deserialize_with = "kind")]
    #[cfg_attr(test, schemars(with = "String", extend("enum" = WORDS)))]
    pub kind: Kind,
    /// The end of its channel's name; empty for the device's own.
    #[serde(default)]
    pub name: String,
    /// Per value of the kind, by the names of [`Kind::fields`], `Message.Signal`.
    pub fields: BTreeMap<String, String>,
    /// Per value, the unit of its signal.
    #[serde(default)]
    pub units: BTreeMap<String, String>,
    /// Per value, how long the last one is used \[ms\].
    #[serde(default)]
    pub hold_ms: BTreeMap<String, f64>,
    /// The message that opens a reading; that of the first value if absent.
    pub first: Option<String>,
    /// The longest time from the first to the last frame of a reading \[ms\].
    pub pair_timeout_ms: Option<f64>,
    /// The signal that is not 0 while the device has a fault.
    pub fault: Option<String>,
    /// The signal that counts the readings.
    pub counter: Option<String>,
}

/// The kinds.
const WORDS: &[&str] = &[
    "joint",
    "wrench",
    "imu",
    "gauges",
    "temperature",
    "actuator",
    "skin",
];

fn kind<'de, D: Deserializer<'de>>(word: D) -> Result<Kind, D::Error> {
    let word = String::deserialize(word)?;
    let known = Kind::ALL.into_iter().find(|kind| kind.word() == word);
    known.ok_or_else(|| de::Error::unknown_variant(&word, WORDS))
}
