//! The table that decoding and encoding follow: per message, which of its bits are which value of
//! which reading. Made from the keys and the file at start; every mistake in either is found here.

use super::options::{Options, ReadingKeys};
use crate::signal::{Bits, Message, Raw, Signal};
use crate::unit::{Unit, quantities, spellings, unit};
use crate::{Format, Id, Spec, SpecError};
use alloc::collections::BTreeMap;
use alloc::format;
use alloc::string::{String, ToString};
use alloc::vec::Vec;
use proprio_topics::{Kind, Nanos};

/// What a signal is for its reading.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Role {
    /// A value: SI value = gain x raw + offset.
    Value {
        /// Its number.
        index: usize,
        gain: f64,
        offset: f64,
        /// Its last one is used for this long; `None`: it comes with each reading.
        hold: Option<Nanos>,
        /// Other values of the reading come in fewer of these frames: it is taken along with them.
        rides: bool,
    },
    /// It counts the readings.
    Counter,
    /// It is not 0 while the device has a fault.
    Fault,
}

/// A signal that is used.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Field {
    pub(super) role: Role,
    pub(super) bits: Bits,
    pub(super) raw: Raw,
}

/// Frames that have a signal: those in which these bits are within one of these ranges.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Condition {
    pub(super) bits: Bits,
    pub(super) ranges: Vec<(u64, u64)>,
}

impl Condition {
    /// Whether a frame with this payload fulfils it.
    pub(super) fn holds(&self, data: &[u8]) -> bool {
        self.bits.of(data).is_some_and(|raw| {
            let within = |range: &(u64, u64)| (range.0..=range.1).contains(&raw);
            self.ranges.iter().any(within)
        })
    }
}

/// The signals of one reading that the same frames have. Signals that all frames of a multiplexed
/// message have are in the part of each page that has another signal of the reading.
#[derive(Debug, Clone)]
pub(super) struct Part {
    /// The reading's number.
    pub(super) reading: usize,
    pub(super) conditions: Vec<Condition>,
    pub(super) fields: Vec<Field>,
    /// The length of the shortest frame that has them all \[bytes\].
    pub(super) reach: usize,
}

impl Part {
    /// The values that only these frames have and each reading needs, one bit each.
    pub(super) fn needed(&self) -> u16 {
        let bit = |field: &Field| match field.role {
            Role::Value {
                index,
                hold: None,
                rides: false,
                ..
            } => 1 << index,
            _ => 0,
        };
        self.fields.iter().map(bit).fold(0, |all, bit| all | bit)
    }
}

/// The frames of one identifier.
#[derive(Debug, Clone)]
pub(super) struct MessageLayout {
    pub(super) id: Id,
    pub(super) size: usize,
    pub(super) parts: Vec<Part>,
}

impl MessageLayout {
    /// Moves the signals of reading `reading` that more frames have than others of its signals into
    /// the parts of those.
    fn join_riders(&mut self, reading: usize) {
        let mine = |part: &&Part| part.reading == reading;
        let parts: Vec<Part> = self.parts.iter().filter(mine).cloned().collect();
        let has_all = |part: &Part, of: &Part| {
            (of.conditions.iter()).all(|condition| part.conditions.contains(condition))
        };
        let is_narrower = |part: &Part, than: &Part| has_all(part, than) && !has_all(than, part);
        let rides = |part: &Part| parts.iter().any(|other| is_narrower(other, part));
        self.parts
            .retain(|part| part.reading != reading || !rides(part));
        for part in self.parts.iter_mut().filter(|part| part.reading == reading) {
            let riders = parts.iter().filter(|rider| is_narrower(part, rider));
            for rider in riders.collect::<Vec<_>>() {
                part.reach = part.reach.max(rider.reach);
                for field in &rider.fields {
                    let mut field = field.clone();
                    if let Role::Value { rides, .. } = &mut field.role {
                        *rides = true;
                    }
                    part.fields.push(field);
                }
            }
        }
    }

    /// How the frames of a simulated device are sent.
    pub(super) const fn format(&self) -> Format {
        match self.size {
            ..=8 => Format::Classic,
            _ => Format::Fd {
                bit_rate_switch: true,
                error_state: false,
            },
        }
    }
}

/// One reading.
#[derive(Debug, Clone)]
pub(super) struct ReadingLayout {
    pub(super) kind: Kind,
    /// The values that each reading needs, one bit each.
    pub(super) needed: u16,
    /// Those of them whose frame opens a reading.
    pub(super) opening: u16,
    /// The longest time from the first to the last frame.
    pub(super) limit: Nanos,
}

/// Everything that is read.
#[derive(Debug, Clone)]
pub(super) struct Layout {
    /// Sorted by identifier.
    pub(super) messages: Vec<MessageLayout>,
    pub(super) readings: Vec<ReadingLayout>,
}

impl Layout {
    pub(super) fn new(spec: &Spec, options: &Options) -> Result<Self, SpecError> {
        let fail = |problem| Err(SpecError::Description(problem));
        if options.reading.is_empty() {
            return fail("there is no [[bus.device.reading]]: name what is to be read".into());
        }
        let mut this = Self {
            messages: Vec::new(),
            readings: Vec::new(),
        };
        for (number, keys) in options.reading.iter().enumerate() {
            let place = format!("reading {number} ({})", keys.kind);
            if let Err(problem) = this.add(options, spec, number, keys) {
                return fail(format!("{place}: {problem}"));
            }
        }
        this.messages.sort_by_key(|message| message.id);
        Ok(this)
    }

    /// The messages of reading `reading`, the one that opens it first.
    pub(super) fn order(&self, reading: usize) -> Vec<usize> {
        let opening = self.readings.get(reading).map_or(0, |r| r.opening);
        let parts = |message: &MessageLayout| {
            let mine = message.parts.iter().filter(|part| part.reading == reading);
            mine.map(|part| (part.needed() & opening != 0, true))
                .fold((false, false), |a, b| (a.0 | b.0, true))
        };
        let mut order: Vec<(bool, usize)> = (self.messages.iter().enumerate())
            .filter_map(|(number, message)| match parts(message) {
                (opens, true) => Some((!opens, number)),
                _ => None,
            })
            .collect();
        order.sort_unstable();
        order.into_iter().map(|(_, number)| number).collect()
    }

    fn add(
        &mut self,
        options: &Options,
        spec: &Spec,
        number: usize,
        keys: &ReadingKeys,
    ) -> Result<(), String> {
        let (kind, known) = (keys.kind, keys.kind.fields());
        let maps = [
            keys.fields.keys().collect::<Vec<_>>(),
            keys.units.keys().collect(),
            keys.hold_ms.keys().collect(),
        ];
        for (map, names) in ["fields", "units", "hold_ms"].iter().zip(maps) {
            for name in names {
                if !known.contains(&name.as_str()) {
                    return Err(format!(
                        "{map}.{name}: there is no such value; there is {}",
                        known.join(", ")
                    ));
                }
                if *map != "fields" && !keys.fields.contains_key(name) {
                    return Err(format!("{map}.{name}: fields.{name} is missing"));
                }
            }
        }
        let all = |kind| matches!(kind, Kind::Wrench | Kind::Gauges);
        let mut opener: Option<&str> = keys.first.as_deref();
        let mut messages: Vec<&str> = Vec::new();
        for (index, name) in known.iter().enumerate() {
            let Some(path) = keys.fields.get(*name) else {
                if all(kind) {
                    return Err(format!("fields.{name} is missing: a {kind} needs it"));
                }
                continue;
            };
            let at = |problem: String| format!("fields.{name} = {path:?}: {problem}");
            let (message, signal) = find(options, path).map_err(at)?;
            let unit = convert(signal, keys.units.get(*name), kind, index).map_err(at)?;
            let hold = match keys.hold_ms.get(*name) {
                None => None,
                Some(ms) if *ms > 0.0 && *ms <= 3.6e6 => Some(Nanos::from_seconds(ms * 1e-3)),
                Some(ms) => {
                    return Err(format!(
                        "hold_ms.{name} = {ms} must be above 0, at most an hour"
                    ));
                }
            };
            if hold.is_none() {
                opener.get_or_insert(&message.name);
                if !messages.contains(&message.name.as_str()) {
                    messages.push(&message.name);
                }
            }
            let role = Role::Value {
                index,
                gain: signal.factor * unit.factor,
                offset: signal.offset * unit.factor + unit.offset,
                hold,
                rides: false,
            };
            self.field(spec, number, message, signal, role)
                .map_err(at)?;
        }
        let opener = opener.unwrap_or_default();
        if keys.first.is_some() && !messages.contains(&opener) {
            return Err(format!(
                "first = {opener:?} must be a message of its fields: {}",
                messages.join(", ")
            ));
        }
        for (key, path, role) in [
            ("counter", &keys.counter, Role::Counter),
            ("fault", &keys.fault, Role::Fault),
        ] {
            let Some(path) = path else { continue };
            let at = |problem: String| format!("{key} = {path:?}: {problem}");
            let (message, signal) = find(options, path).map_err(at)?;
            if role == Role::Counter && message.name != opener {
                return Err(at(format!("it must be a signal of {opener}")));
            }
            if matches!(signal.raw, Raw::Float32 | Raw::Float64) {
                return Err(at("it must be an integer".into()));
            }
            self.field(spec, number, message, signal, role)
                .map_err(at)?;
        }
        let opener = options.messages.iter().find(|m| m.name == opener);
        let opener = opener.and_then(|message| shifted(message.id, spec.address));
        let mut reading = ReadingLayout {
            kind,
            needed: 0,
            opening: 0,
            limit: Nanos::MAX,
        };
        let mut frames = 0;
        for message in &mut self.messages {
            message.join_riders(number);
            for part in message.parts.iter().filter(|part| part.reading == number) {
                let needed = part.needed();
                frames += usize::from(needed != 0);
                reading.needed |= needed;
                if Some(message.id) == opener && reading.opening == 0 {
                    reading.opening = needed;
                }
            }
        }
        if reading.needed == 0 {
            return Err("it needs a value without hold_ms".into());
        }
        if frames > 1 {
            reading.limit = match keys.pair_timeout_ms {
                Some(ms) if ms > 0.0 && ms <= 1000.0 => Nanos::from_seconds(ms * 1e-3),
                Some(ms) => {
                    return Err(format!(
                        "pair_timeout_ms = {ms} must be above 0, at most 1000"
                    ));
                }
                None => {
                    return Err(format!(
                        "pair_timeout_ms is missing: its values come in several frames ({}), and \
                         the last must come within this time after the first: less than half the \
                         period",
                        messages.join(", ")
                    ));
                }
            };
        }
        self.readings.push(reading);
        Ok(())
    }

    /// Adds a signal to the part that has the same frames.
    fn field(
        &mut self,
        spec: &Spec,
        reading: usize,
        message: &Message,
        signal: &Signal,
        role: Role,
    ) -> Result<(), String> {
        let id = shifted(message.id, spec.address)
            .ok_or_else(|| format!("the identifier {} plus address is too large", message.id))?;
        let conditions = conditions(message, signal)?;
        let used = core::iter::once(signal.bits).chain(conditions.iter().map(|c| c.bits));
        let reach = used.map(Bits::reach).max().unwrap_or(0);
        if reach > message.size {
            return Err(format!(
                "its bits reach to byte {reach}, but the message has {}",
                message.size
            ));
        }
        let field = Field {
            role,
            bits: signal.bits,
            raw: signal.raw,
        };
        let messages = &mut self.messages;
        let at = messages.iter().position(|m| m.id == id).unwrap_or_else(|| {
            messages.push(MessageLayout {
                id,
                size: message.size,
                parts: Vec::new(),
            });
            messages.len() - 1
        });
        let Some(layout) = messages.get_mut(at) else {
            return Ok(());
        };
        let same = |part: &&mut Part| part.reading == reading && part.conditions == conditions;
        match layout.parts.iter_mut().find(same) {
            Some(part) => {
                part.fields.push(field);
                part.reach = part.reach.max(reach);
            }
            None => layout.parts.push(Part {
                reading,
                conditions,
                fields: [field].to_vec(),
                reach,
            }),
        }
        Ok(())
    }
}

fn shifted(id: Id, by: u32) -> Option<Id> {
    match id {
        Id::Standard(raw) => {
            let sum = u32::from(raw).checked_add(by)?;
            u16::try_from(sum)
                .ok()
                .filter(|s| *s < 0x800)
                .map(Id::standard)
        }
        Id::Extended(raw) => {
            let sum = raw.checked_add(by).filter(|sum| *sum < 0x2000_0000)?;
            Some(Id::extended(sum))
        }
    }
}

/// The message and the signal of `path`.
fn find<'o>(options: &'o Options, path: &str) -> Result<(&'o Message, &'o Signal), String> {
    let Some((message, signal)) = path.split_once('.') else {
        return Err("it must be written Message.Signal".into());
    };
    let mut named = options.messages.iter().filter(|m| m.name == message);
    let Some(found) = named.next() else {
        let names = options.messages.iter().map(|m| m.name.as_str());
        return Err(format!(
            "{:?} has no message {message:?}; it has {}",
            options.file,
            listed(names)
        ));
    };
    match found.signals.iter().find(|s| s.name == signal) {
        Some(signal) => Ok((found, signal)),
        None => Err(format!(
            "the message has no signal {signal:?}; it has {}",
            listed(found.signals.iter().map(|s| s.name.as_str()))
        )),
    }
}

/// Some of `names`, for a message.
fn listed<'n>(names: impl Iterator<Item = &'n str> + Clone) -> String {
    const SOME: usize = 12;
    let more = names.clone().count().saturating_sub(SOME);
    let some = names.take(SOME).collect::<Vec<_>>().join(", ");
    match more {
        0 => some,
        more => format!("{some} and {more} more"),
    }
}

/// The unit of `signal` as value `index` of a reading of kind `kind`.
fn convert(
    signal: &Signal,
    given: Option<&String>,
    kind: Kind,
    index: usize,
) -> Result<Unit, String> {
    let (legal, word) = (quantities(kind, index), given.unwrap_or(&signal.unit));
    let name = kind.fields().get(index).copied().unwrap_or_default();
    let units = || spellings(legal).collect::<Vec<_>>().join(", ");
    match unit(word) {
        Some(unit) if legal.contains(&unit.quantity) => Ok(unit),
        Some(_) if given.is_none() && word.trim().is_empty() => Err(format!(
            "the file gives no unit: add units = {{ {name} = \"...\" }}, one of {}",
            units()
        )),
        Some(_) => Err(format!(
            "its unit {word:?} does not fit: it must be one of {}",
            units()
        )),
        None => Err(format!(
            "its unit {word:?} is not known: add units = {{ {name} = \"...\" }}, one of {}",
            units()
        )),
    }
}

/// The conditions under which a frame has `signal`: its own, those of its multiplexor, and so on.
fn conditions(message: &Message, signal: &Signal) -> Result<Vec<Condition>, String> {
    let by_name: BTreeMap<&str, &Signal> = message
        .signals
        .iter()
        .map(|s| (s.name.as_str(), s))
        .collect();
    let mut conditions = Vec::new();
    let mut at = signal;
    while let Some(switch) = &at.switch {
        let Some(multiplexor) = by_name.get(switch.signal.as_str()) else {
            return Err(format!(
                "its multiplexor {:?} does not exist",
                switch.signal
            ));
        };
        if conditions.len() >= message.signals.len() {
            return Err("its multiplexors select each other in a circle".to_string());
        }
        conditions.push(Condition {
            bits: multiplexor.bits,
            ranges: switch.ranges.clone(),
        });
        at = multiplexor;
    }
    Ok(conditions)
}
