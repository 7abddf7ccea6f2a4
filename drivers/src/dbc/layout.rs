//! The table that decoding and encoding follow: per message, which of its bits are which value of
//! which reading. Made from the keys and the file at start; every mistake in either is found here.

use super::options::{DbcOptions, ReadingKeys};
use crate::signal::{Bits, Message, Raw, Signal};
use crate::unit::{Unit, is_multiple, is_of_other_case, quantities, spellings, unit};
use crate::{Claim, Decoded, Format, Id, Spec, SpecError};
use alloc::collections::BTreeMap;
use alloc::format;
use alloc::string::{String, ToString};
use alloc::vec::Vec;
use core::ptr;
use proprio_topics::{Kind, Nanos};

/// What a signal is for its reading.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum SignalRole {
    /// A value: SI value = gain x raw + offset.
    Value {
        /// Its number.
        index: usize,
        gain: f64,
        offset: f64,
        /// Its last one is used for this long; `None`: it comes with each reading.
        hold: Option<Nanos>,
        /// A reading needs it of other frames: it is taken along with others of these.
        rides: bool,
    },
    /// It counts the readings.
    Counter,
    /// It is not 0 while the device has a fault.
    Fault,
}

impl SignalRole {
    /// Whether it belongs to one reading, and is not kept for the next ones.
    const fn is_timed(self) -> bool {
        match self {
            Self::Value { hold, .. } => hold.is_none(),
            Self::Counter => true,
            Self::Fault => false,
        }
    }
}

/// A signal that is used.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct UsedSignal {
    pub(super) role: SignalRole,
    pub(super) bits: Bits,
    pub(super) raw: Raw,
    /// The least raw value that stands for none (J1939).
    pub(super) none_from: Option<u64>,
}

impl UsedSignal {
    /// Whether the raw value `found` stands for none.
    pub(super) fn is_none(&self, found: u64) -> bool {
        self.none_from.is_some_and(|least| found >= least)
    }
}

/// The least raw value of a signal of J1939 that stands for none (SAE J1939-71): of whole bytes,
/// the highest one is FE for an error, and FF where there is no value; of two bits these are 2 and
/// 3. Of others, all bits are 1 where there is none. An error of a fault flag is a fault. What has
/// a sign is of a maker's own.
fn none_from(raw: Raw, bits: Bits, role: SignalRole) -> Option<u64> {
    let length = u32::from(bits.length());
    if raw != Raw::Unsigned || role == SignalRole::Counter || length == 1 {
        return None;
    }
    let has_error = role != SignalRole::Fault;
    Some(match length {
        2 if has_error => 2,
        _ if length % 8 == 0 => (if has_error { 0xFE } else { 0xFF }) << (length - 8),
        _ => u64::MAX >> (64 - length),
    })
}

/// Frames that have a signal: those in which these bits are within one of these ranges, which are
/// sorted and do not touch each other.
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

/// The frames that fulfil both; `None`: there are none.
pub(super) fn meet(ours: &[Condition], others: &[Condition]) -> Option<Vec<Condition>> {
    let mut both = ours.to_vec();
    for other in others {
        match both.iter_mut().find(|mine| mine.bits == other.bits) {
            None => both.push(other.clone()),
            Some(mine) => {
                let pairs = mine.ranges.iter();
                let pairs = pairs.flat_map(|a| other.ranges.iter().map(move |b| (a, b)));
                let common = pairs.map(|(a, b)| (a.0.max(b.0), a.1.min(b.1)));
                mine.ranges = common.filter(|(first, last)| first <= last).collect();
                if mine.ranges.is_empty() {
                    return None;
                }
            }
        }
    }
    Some(both)
}

/// Whether each frame that fulfils `ours` fulfils `others`, too.
pub(super) fn implies(ours: &[Condition], others: &[Condition]) -> bool {
    meet(ours, others).is_some_and(|both| both == ours)
}

/// The frames that have several of the signals with these conditions: for each signal, those that
/// it shares with as many of the others as go together, so that they are taken from one frame.
pub(super) fn shared<'c>(
    all: impl Iterator<Item = &'c Vec<Condition>> + Clone,
) -> Vec<Vec<Condition>> {
    let mut shared: Vec<Vec<Condition>> = Vec::new();
    for own in all.clone() {
        let mut frames = own.clone();
        for other in all.clone() {
            frames = meet(&frames, other).unwrap_or(frames);
        }
        if !shared
            .iter()
            .any(|known| implies(known, &frames) && implies(&frames, known))
        {
            shared.push(frames);
        }
    }
    shared
}

/// The signals of one reading that the same frames have. A signal that more frames have is in the
/// parts of all those that have another signal of the reading.
#[derive(Debug, Clone)]
pub(super) struct SignalGroup {
    /// The reading's number.
    pub(super) reading: usize,
    pub(super) conditions: Vec<Condition>,
    pub(super) fields: Vec<UsedSignal>,
    /// The length of the shortest frame that has them all \[bytes\].
    pub(super) reach: usize,
}

impl SignalGroup {
    /// Whether its signals belong to one reading: it has no held values and no fault.
    fn is_timed(&self) -> bool {
        self.fields.iter().all(|field| field.role.is_timed())
    }

    /// The values that a reading needs of these frames, one bit each.
    pub(super) fn needed(&self) -> u16 {
        let bit = |field: &UsedSignal| match field.role {
            SignalRole::Value {
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

/// The frames of one message.
#[derive(Debug, Clone)]
pub(super) struct MessageLayout {
    /// Which they are. Of the identifiers, a simulated device sends the one that is named.
    pub(super) frames: Claim,
    /// They are frames of J1939.
    pub(super) j1939: bool,
    pub(super) size: usize,
    pub(super) parts: Vec<SignalGroup>,
}

impl MessageLayout {
    /// The sender of `frame`, if it is one of several that may send this message.
    #[allow(clippy::cast_possible_truncation)] // the low 8 bits
    pub(super) const fn sender(&self, id: Id) -> Option<u8> {
        match self.j1939 && self.frames.mask & SOURCE == 0 {
            true => Some(id.raw() as u8),
            false => None,
        }
    }

    /// Puts the signals of reading `reading` that a frame has together into one part.
    fn join(&mut self, reading: usize) {
        let is_mine = |part: &SignalGroup| part.reading == reading && part.is_timed();
        let mine: Vec<SignalGroup> = self.parts.iter().filter(|p| is_mine(p)).cloned().collect();
        self.parts.retain(|part| !is_mine(part));
        let mut taken: u16 = 0;
        for conditions in shared(mine.iter().map(|part| &part.conditions)) {
            let mut joint = SignalGroup {
                reading,
                conditions,
                fields: Vec::new(),
                reach: 0,
            };
            for part in &mine {
                if !implies(&joint.conditions, &part.conditions) {
                    continue;
                }
                joint.reach = joint.reach.max(part.reach);
                joint.fields.extend(part.fields.iter().cloned());
            }
            for field in &mut joint.fields {
                if let SignalRole::Value { index, rides, .. } = &mut field.role {
                    *rides = taken & 1 << *index != 0;
                }
            }
            taken |= joint.needed();
            // After what only joins a reading: it is of the same frame.
            self.parts.push(joint);
        }
    }

    /// How the frames of a simulated device are sent.
    pub(super) const fn format(&self) -> Format {
        match self.size {
            ..=8 => Format::Classic,
            _ => Format::fd(true, false),
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

/// A reading that is to be laid out.
#[derive(Clone, Copy)]
struct WantedReading<'a> {
    options: &'a DbcOptions,
    spec: &'a Spec,
    number: usize,
    keys: &'a ReadingKeys,
}

impl WantedReading<'_> {
    /// Refuses keys of values that its kind, or the reading, has not.
    fn check_names(&self) -> Result<(), String> {
        let (keys, known) = (self.keys, self.keys.kind.fields());
        let fields = keys.fields.keys().map(|name| ("fields", name));
        let units = keys.units.keys().map(|name| ("units", name));
        let holds = keys.hold_ms.keys().map(|name| ("hold_ms", name));
        for (map, name) in fields.chain(units).chain(holds) {
            if !known.contains(&name.as_str()) {
                return Err(format!(
                    "{map}.{name}: there is no such value; there is {}",
                    known.join(", ")
                ));
            }
            if !keys.fields.contains_key(name) {
                return Err(format!("{map}.{name}: fields.{name} is missing"));
            }
        }
        Ok(())
    }

    /// How long the last value called `name` is used.
    fn hold(&self, name: &str) -> Result<Option<Nanos>, String> {
        match self.keys.hold_ms.get(name) {
            None => Ok(None),
            Some(ms) if *ms > 0.0 && *ms <= 3.6e6 => Ok(Some(Nanos::from_seconds(ms * 1e-3))),
            Some(ms) => Err(format!(
                "hold_ms.{name} = {ms} must be above 0, at most an hour"
            )),
        }
    }

    /// The longest time from its first to its last frame, if its values come in several frames, of
    /// `messages`.
    fn pair_timeout(&self, messages: &[&Message]) -> Result<Nanos, String> {
        match self.keys.pair_timeout_ms {
            Some(ms) if ms > 0.0 && ms <= 1000.0 => Ok(Nanos::from_seconds(ms * 1e-3)),
            Some(ms) => Err(format!(
                "pair_timeout_ms = {ms} must be above 0, at most 1000"
            )),
            None => Err(format!(
                "pair_timeout_ms is missing: its values come in several frames ({}), and the last \
                 must come within this time after the first: less than half the period",
                names(messages)
            )),
        }
    }
}

/// Everything that is read.
#[derive(Debug, Clone)]
pub(super) struct DbcLayout {
    /// Sorted by identifier.
    pub(super) messages: Vec<MessageLayout>,
    pub(super) readings: Vec<ReadingLayout>,
}

impl DbcLayout {
    pub(super) fn new(spec: &Spec, options: &DbcOptions) -> Result<Self, SpecError> {
        let fail = |problem| Err(SpecError::Description(problem));
        if options.reading.is_empty() {
            return fail("there is no [[bus.device.reading]]: name what is to be read".into());
        }
        let mut this = Self {
            messages: Vec::new(),
            readings: Vec::new(),
        };
        for (number, keys) in options.reading.iter().enumerate() {
            let wanted = WantedReading {
                options,
                spec,
                number,
                keys,
            };
            if let Err(problem) = this.add(wanted) {
                return fail(format!("reading {number} ({}): {problem}", keys.kind));
            }
        }
        let asks = [
            ("source_address", options.source_address),
            ("destination_address", options.destination_address),
            ("priority", options.priority),
        ];
        let used = |(key, asked): (_, Option<u8>)| asked.map(|_| key);
        if let Some(key) = asks.into_iter().find_map(used)
            && this.messages.iter().all(|message| !message.j1939)
        {
            return fail(format!(
                "{key}: none of its messages is one of J1939; j1939 = true takes their extended \
                 identifiers for such ones"
            ));
        }
        this.messages.sort_by_key(|message| message.frames.id);
        this.check_number()?;
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

    fn add(&mut self, wanted: WantedReading<'_>) -> Result<(), String> {
        let WantedReading { number, keys, .. } = wanted;
        wanted.check_names()?;
        let (opener, messages) = self.add_values(wanted)?;
        if !messages.is_empty() && !messages.iter().any(|message| ptr::eq(*message, opener)) {
            return Err(format!(
                "first = {:?} must be a message of its fields: {}",
                name(opener),
                names(&messages)
            ));
        }
        for (key, path, role) in [
            ("counter", &keys.counter, SignalRole::Counter),
            ("fault", &keys.fault, SignalRole::Fault),
        ] {
            let Some(path) = path else { continue };
            let at = |problem: String| format!("{key} = {path:?}: {problem}");
            let (message, signal) = find(wanted.options, path).map_err(at)?;
            if role == SignalRole::Counter && !ptr::eq(message, opener) {
                return Err(at(format!("it must be a signal of {}", name(opener))));
            }
            if matches!(signal.raw, Raw::Float32 | Raw::Float64) {
                return Err(at("it must be an integer".into()));
            }
            self.field(wanted, (message, signal), role).map_err(at)?;
        }
        let (opener, _) = frames(wanted.options, wanted.spec, opener)?;
        let mut reading = ReadingLayout {
            kind: keys.kind,
            needed: 0,
            opening: 0,
            limit: Nanos::MAX,
        };
        let mut frames = 0;
        for message in &mut self.messages {
            message.join(number);
            for part in message.parts.iter().filter(|part| part.reading == number) {
                let needed = part.needed();
                frames += usize::from(needed != 0);
                reading.needed |= needed;
                if message.frames == opener && reading.opening == 0 {
                    reading.opening = needed;
                }
            }
        }
        if reading.needed == 0 {
            return Err("it needs a value without hold_ms".into());
        }
        if frames > 1 {
            reading.limit = wanted.pair_timeout(&messages)?;
        }
        self.readings.push(reading);
        Ok(())
    }

    /// Adds the values of a reading; returns the message that opens it, and all those that have a
    /// value that each reading needs.
    fn add_values<'a>(
        &mut self,
        wanted: WantedReading<'a>,
    ) -> Result<(&'a Message, Vec<&'a Message>), String> {
        let WantedReading { options, keys, .. } = wanted;
        let kind = keys.kind;
        let mut opener = match &keys.first {
            Some(first) => {
                Some(find_message(options, first).map_err(|e| format!("first = {first:?}: {e}"))?)
            }
            None => None,
        };
        let mut messages: Vec<&Message> = Vec::new();
        for (index, name) in kind.fields().iter().enumerate() {
            let Some(path) = keys.fields.get(*name) else {
                if matches!(kind, Kind::Wrench | Kind::Gauges) {
                    return Err(format!("fields.{name} is missing: a {kind} needs it"));
                }
                continue;
            };
            let at = |problem: String| format!("fields.{name} = {path:?}: {problem}");
            let (message, signal) = find(options, path).map_err(at)?;
            let unit = convert(signal, keys.units.get(*name), kind, index).map_err(at)?;
            let hold = wanted.hold(name)?;
            if hold.is_none() {
                opener.get_or_insert(message);
                if !messages.iter().any(|known| ptr::eq(*known, message)) {
                    messages.push(message);
                }
            }
            let role = SignalRole::Value {
                index,
                gain: signal.factor * unit.factor,
                offset: signal.offset * unit.factor + unit.offset,
                hold,
                rides: false,
            };
            self.field(wanted, (message, signal), role).map_err(at)?;
        }
        match opener {
            Some(opener) => Ok((opener, messages)),
            None => Err("it needs a value without hold_ms".into()),
        }
    }

    /// Refuses a frame that may complete more readings than one result holds.
    fn check_number(&self) -> Result<(), SpecError> {
        let most = Decoded::MOST;
        for message in &self.messages {
            let overlaps = |other: &&MessageLayout| other.frames.overlaps(&message.frames);
            let others = self.messages.iter().filter(overlaps);
            let parts: Vec<&SignalGroup> = others.flat_map(|other| &other.parts).collect();
            for conditions in shared(parts.iter().map(|part| &part.conditions)) {
                let comes = |part: &&&SignalGroup| implies(&conditions, &part.conditions);
                let readings = parts.iter().filter(comes).map(|part| part.reading);
                let mut readings: Vec<usize> = readings.collect();
                readings.sort_unstable();
                readings.dedup();
                if readings.len() > most {
                    return Err(SpecError::Description(format!(
                        "{} readings have signals of frame {}, and a frame has at most {most}: \
                         leave some out",
                        readings.len(),
                        message.frames.id
                    )));
                }
            }
        }
        Ok(())
    }

    /// Adds a signal to the part that has the same frames.
    fn field(
        &mut self,
        wanted: WantedReading<'_>,
        (message, signal): (&Message, &Signal),
        role: SignalRole,
    ) -> Result<(), String> {
        let reading = wanted.number;
        let (frames, j1939) = frames(wanted.options, wanted.spec, message)?;
        let bits = signal.bits.clone()?;
        let conditions = conditions(message, signal)?;
        let used = core::iter::once(bits).chain(conditions.iter().map(|c| c.bits));
        let reach = used.map(Bits::reach).max().unwrap_or(0);
        if reach > message.size {
            return Err(format!(
                "its bits reach to byte {reach}, but the message has {}",
                message.size
            ));
        }
        let field = UsedSignal {
            role,
            bits,
            raw: signal.raw,
            none_from: none_from(signal.raw, bits, role).filter(|_| j1939),
        };
        let messages = &mut self.messages;
        let known = messages.iter().position(|m| m.frames == frames);
        let at = known.unwrap_or_else(|| {
            messages.push(MessageLayout {
                frames,
                j1939,
                size: message.size,
                parts: Vec::new(),
            });
            messages.len() - 1
        });
        let Some(layout) = messages.get_mut(at) else {
            return Ok(());
        };
        let same = |part: &&mut SignalGroup| {
            part.reading == reading
                && part.conditions == conditions
                && part.is_timed() == role.is_timed()
        };
        match layout.parts.iter_mut().find(same) {
            Some(part) => {
                part.fields.push(field);
                part.reach = part.reach.max(reach);
            }
            None => layout.parts.push(SignalGroup {
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

/// Of an identifier of J1939 (SAE J1939-21): its priority, its parameter group, the destination
/// that the group has if its format is below 240, and its source.
const PRIORITY: u32 = 0x1C00_0000;
const GROUP: u32 = 0x03FF_0000;
const DESTINATION: u32 = 0xFF00;
const SOURCE: u32 = 0xFF;
/// The source address that stands for none.
const NO_SOURCE: u32 = 0xFE;

/// The bits of an identifier of J1939 that tell what a frame holds.
const fn group(raw: u32) -> u32 {
    const FORMAT: u32 = 0x00FF_0000;
    const BROADCAST: u32 = 0x00F0_0000;
    match raw & FORMAT < BROADCAST {
        true => GROUP,
        false => GROUP | DESTINATION,
    }
}

/// Which frames are those of `message`, and whether they are of J1939: then their parameter group
/// counts, and what the keys ask for. Where the file has several messages of one group, their
/// addresses count.
fn frames(options: &DbcOptions, spec: &Spec, message: &Message) -> Result<(Claim, bool), String> {
    let id = message.id.clone()?;
    let (Id::Extended(mut raw), true) = (id, options.j1939.unwrap_or(message.j1939)) else {
        let id = shifted(id, spec.address)
            .ok_or_else(|| format!("the identifier {id} plus address is too large"))?;
        return Ok((Claim::shared(id), false));
    };
    if spec.address != 0 {
        return Err(format!(
            "address is added to identifiers, and of {id}, which is one of J1939, the parameter \
             group counts: source_address tells the devices apart (j1939 = false: the whole \
             identifier counts)"
        ));
    }
    let group = group(raw);
    let differs = |other: &Message| match other.id {
        Ok(Id::Extended(of)) => (of ^ raw) & group == 0 && of & !PRIORITY != raw & !PRIORITY,
        _ => false,
    };
    let mut mask = group;
    if options.messages.iter().any(differs) {
        mask |= DESTINATION | if raw & SOURCE == NO_SOURCE { 0 } else { SOURCE };
    }
    for (asked, field) in [
        (options.source_address, SOURCE),
        (options.destination_address, DESTINATION & !group),
        (options.priority, PRIORITY),
    ] {
        // A group without a destination is for all.
        if let Some(asked) = asked.filter(|_| field != 0) {
            raw = raw & !field | u32::from(asked) << field.trailing_zeros() & field;
            mask |= field;
        }
    }
    let claim = Claim {
        mask,
        ..Claim::shared(Id::extended(raw))
    };
    Ok((claim, true))
}

/// The name of a message as its file's readers see it.
fn name(message: &Message) -> &str {
    message.long_name.as_deref().unwrap_or(&message.name)
}

/// The names of messages, for a person.
fn names(messages: &[&Message]) -> String {
    let names: Vec<&str> = messages.iter().map(|message| name(message)).collect();
    names.join(", ")
}

/// The identifier of a message, for a person.
fn shown(message: &Message) -> String {
    let id = message.id.as_ref();
    id.map_or_else(Clone::clone, ToString::to_string)
}

/// The identifier that `wanted` is: its number, and whether it is an extended one.
fn id_in(wanted: &str) -> Option<(u32, bool)> {
    let digits = wanted
        .strip_prefix("0x")
        .filter(|digits| digits.len() <= 8)?;
    // As candump writes them: eight digits are an extended identifier.
    Some((u32::from_str_radix(digits, 16).ok()?, digits.len() == 8))
}

/// The messages that have the name `wanted`, or the identifier.
fn messages_of<'o>(options: &'o DbcOptions, wanted: &str) -> Vec<&'o Message> {
    let id = id_in(wanted);
    let is_wanted = |message: &&Message| match (id, &message.id) {
        (Some(wanted), Ok(id)) => (id.raw(), matches!(id, Id::Extended(_))) == wanted,
        (Some(_), Err(_)) => false,
        (None, _) => message.name == wanted || message.long_name.as_deref() == Some(wanted),
    };
    let mut found: Vec<&Message> = Vec::new();
    for message in options.messages.iter().filter(is_wanted) {
        // Some files have the same message twice.
        if !found.contains(&message) {
            found.push(message);
        }
    }
    found
}

/// The message that has the name `wanted`, or the identifier.
fn find_message<'o>(options: &'o DbcOptions, wanted: &str) -> Result<&'o Message, String> {
    let is_id = id_in(wanted).is_some();
    let found = messages_of(options, wanted);
    match *found {
        [message] => Ok(message),
        [] if is_id => Err(format!(
            "{:?} has no message with this identifier; a standard one has three digits, an \
             extended one eight",
            options.file
        )),
        [] => {
            let names = options.messages.iter().map(name);
            Err(format!(
                "{:?} has no message {wanted:?}; it has {}",
                options.file,
                listed(names)
            ))
        }
        _ => {
            let all: Vec<String> = (found.iter())
                .map(|message| format!("{} {}", name(message), shown(message)))
                .collect();
            let is_told = |message: &&Message| match is_id {
                true => messages_of(options, name(message)).len() == 1,
                false => messages_of(options, &shown(message)).len() == 1,
            };
            let remedy = match (found.iter().all(is_told), is_id) {
                (true, true) => "write the name of one of them instead",
                (true, false) => "write the identifier of one of them instead",
                (false, _) => "give each another name in the file",
            };
            Err(format!(
                "{:?} has several messages {wanted:?}: {}; {remedy}",
                options.file,
                all.join(", "),
            ))
        }
    }
}

/// The message and the signal of `path`.
fn find<'o>(options: &'o DbcOptions, path: &str) -> Result<(&'o Message, &'o Signal), String> {
    let Some((message, signal)) = path.split_once('.') else {
        return Err("it must be written Message.Signal".into());
    };
    let found = find_message(options, message)?;
    let is_wanted = |s: &&Signal| s.name == signal || s.long_name.as_deref() == Some(signal);
    let wanted: Vec<&Signal> = found.signals.iter().filter(is_wanted).collect();
    match *wanted {
        [signal] => {
            // Whatever else is missing is no reason then.
            found.id.as_ref().map_err(Clone::clone)?;
            signal.bits.as_ref().map_err(Clone::clone)?;
            Ok((found, signal))
        }
        [] => {
            let names = found.signals.iter();
            let names = names.map(|s| s.long_name.as_deref().unwrap_or(&s.name));
            Err(format!(
                "the message has no signal {signal:?}; it has {}",
                listed(names)
            ))
        }
        _ => Err(format!(
            "the message has several signals {signal:?}: give them different names in the file"
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
    let units = || spellings(legal).join(", ");
    let add = || format!("add units = {{ {name} = \"...\" }}, one of {}", units());
    match unit(word, legal) {
        Some(unit) if legal.contains(&unit.quantity) => Ok(unit),
        Some(_) if given.is_none() && word.trim().is_empty() => {
            Err(format!("the file gives no unit: {}", add()))
        }
        Some(_) => Err(format!(
            "its unit {word:?} does not fit: it must be one of {}",
            units()
        )),
        None if is_multiple(word) => Err(format!(
            "its unit {word:?} has a number: if the file's factor {} holds it already, {}; else \
             multiply factor and offset in the file by it first",
            signal.factor,
            add()
        )),
        None if is_of_other_case(word) => Err(format!(
            "its unit {word:?} is not known: m is a thousandth, and M a million: {}",
            add()
        )),
        None => Err(format!("its unit {word:?} is not known: {}", add())),
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
        let mut ranges: Vec<(u64, u64)> = Vec::new();
        let mut sorted = switch.ranges.clone();
        sorted.sort_unstable();
        for (first, last) in sorted {
            match ranges.last_mut() {
                Some(before) if first <= before.1.saturating_add(1) => {
                    before.1 = before.1.max(last);
                }
                _ => ranges.push((first, last)),
            }
        }
        conditions.push(Condition {
            bits: multiplexor.bits.clone()?,
            ranges,
        });
        at = multiplexor;
    }
    Ok(conditions)
}
