//! Recognising a sensor with the identifiers that it is delivered with.

use super::options::{RftModel, RobotousRftOptions};
use super::protocol::{RATES, RftIds, command, send};
use crate::recognise::{Evidence, Finding, Key, Traffic};
use crate::{Driver, Frame, Id, Recognise};
use alloc::format;
use alloc::string::String;
use alloc::vec::Vec;

const IDS: RftIds = RftIds {
    command: Id::standard(0x64),
    first: Id::standard(1),
    second: Id::standard(2),
};
const COMMANDS: [u8; 8] = [
    command::NAME,
    command::SERIAL,
    command::FIRMWARE,
    command::START,
    command::SET_RATE,
    command::GET_RATE,
    0x05,
    0x09,
];

/// The sensor, if `seen` shows it.
fn sensor(seen: &Traffic) -> Option<Finding> {
    let mut evidence = Evidence::new(seen, 1);
    let first = evidence.sends(IDS.first, |frame| match *frame.data() {
        [command, _, _, _, _, _, _, _] => COMMANDS.contains(&command),
        _ => false,
    })?;
    let second = evidence.sends_length(IDS.second, 8)?;
    evidence.together(first, second);
    evidence.measures(second);
    evidence.belongs(IDS.command);
    let is_data = |frame: &Frame| frame.data().first() == Some(&command::START);
    if first.recent().all(is_data) {
        // One of its commands alone.
        evidence.add(3.0);
    }
    // The answer's two frames come in turn: the second of a text is the one after its first.
    let text = |wanted: u8| {
        let frame = first.kept().find(|f| f.data().first() == Some(&wanted))?;
        let mut after = second.kept().filter(|f| f.t >= frame.t);
        let rest = after.next().map(Frame::data).unwrap_or_default();
        let bytes = frame.data().iter().skip(1).chain(rest);
        let text: String = (bytes.copied().map(char::from))
            .filter(char::is_ascii_graphic)
            .collect();
        (!text.is_empty()).then_some(text)
    };
    let mut what = String::from("Robotous RFT");
    let mut model = Key::fill_in("model", "\"RFT40-SA01\"", "its scales depend on it");
    if let Some(name) = text(command::NAME) {
        // Fifteen letters, digits and signs.
        evidence.add(8.0);
        if RftModel::NAMES.contains(&name.as_str()) {
            model = Key::new("model", format!("{name:?}"));
        }
        what = name;
    }
    if let Some(serial) = text(command::SERIAL) {
        evidence.add(8.0);
        what = format!("{what}, serial {serial}");
    }
    let measured = first
        .period_of(is_data)
        .map(|period| 1.0 / period.seconds());
    let near = |hz: f64, rate: u32| (hz / f64::from(rate) - 1.0).abs() < 0.1;
    let rate = RATES
        .iter()
        .find(|(rate, _)| measured.is_some_and(|hz| near(hz, *rate)));
    let finding = evidence.finding(RobotousRftOptions::NAME, IDS.command.raw(), what)?;
    let rate = rate.map(|(rate, _)| Key::new("rate_hz", rate));
    Some(finding.with_keys([model]).with_keys(rate))
}

impl Recognise for RobotousRftOptions {
    const ASKED_BY_NAME: bool = true;

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        sensor(seen).into_iter().collect()
    }

    /// A sensor that streams ignores them.
    fn questions(_seen: &Traffic) -> Vec<Frame> {
        [command::NAME, command::SERIAL, command::GET_RATE]
            .map(|command| send(IDS.command, command, 0))
            .to_vec()
    }
}
