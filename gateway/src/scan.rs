//! What is on a bus: listens, asks if it is told to, and names the devices found.
//!
//! ```text
//! Link or log -> Traffic -> findings of all drivers -> Device (found.rs)
//!                                                      -> tables of gateway.toml (tables.rs)
//! ```
//!
//! Recognition belongs to the drivers ([`proprio_drivers::recognise()`]).

mod found;
mod tables;

pub(crate) use found::contested;
pub use found::{FoundDevice, devices};
pub(crate) use tables::FILL_IN;
pub use tables::{ScannedBus, file, placeholders, tables};

use crate::clock::Clock;
use crate::link::{Link, Received, TransmitError, send_by};
use crate::log;
use proprio_drivers::{Format, Traffic, questions};
use proprio_topics::{LinkState, Nanos};
use std::collections::BTreeMap;
use std::io::{self, BufRead};

/// How long the answers to a round of questions are waited for.
const ANSWERS: Nanos = Nanos::from_millis(300);
/// Between two questions: a bus at 125 kbit/s carries a question and its answer in it.
const BETWEEN: Nanos = Nanos::from_millis(3);
/// How long a question waits for room in the interface's queue.
const SEND_WITHIN: Nanos = Nanos::from_millis(100);
/// Rounds of questions: who is there, what it is, and one more.
const ROUNDS: usize = 3;

/// Why a bus could not be scanned.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ScanError {
    /// Nothing can be received.
    #[error("the link is {}; `proprio doctor` says why", .0.word())]
    Link(LinkState),
    /// A question could not be sent.
    #[error("a question could not be sent: {0}")]
    Send(TransmitError),
}

/// Listens to `link` until `end` and adds what is heard to `heard`.
fn listen(link: &mut dyn Link, clock: &impl Clock, end: Nanos, heard: &mut Traffic) {
    while clock.now() < end {
        match link.recv(end) {
            Received::Frame(frame) => heard.on_frame(&frame),
            Received::Ended => return,
            Received::Error(_) | Received::TimedOut | Received::StateChanged => {}
        }
    }
}

/// Listens for `time`. Nothing is sent.
///
/// # Errors
/// [`ScanError::Link`]: nothing was heard, and the link is not up.
pub fn hear(link: &mut dyn Link, clock: &impl Clock, time: Nanos) -> Result<Traffic, ScanError> {
    let mut heard = Traffic::new();
    listen(link, clock, clock.now() + time, &mut heard);
    match link.state() {
        LinkState::Up => Ok(heard),
        _ if heard.streams().next().is_some() => Ok(heard),
        state => Err(ScanError::Link(state)),
    }
}

/// Asks the devices on `link` what they are: all that can be asked safely, and the families in
/// `named` ([`proprio_drivers::asked_by_name()`]). Adds what is heard to `heard`, and returns how
/// many questions were sent. Without `fd`, questions in CAN FD are not sent.
///
/// # Errors
/// [`ScanError::Send`].
pub fn ask(
    link: &mut dyn Link,
    clock: &impl Clock,
    named: &[&str],
    fd: bool,
    heard: &mut Traffic,
) -> Result<usize, ScanError> {
    let mut asked = Vec::new();
    for _ in 0..ROUNDS {
        let before = asked.len();
        for question in questions(heard, named) {
            let fits = fd || !matches!(question.format, Format::Fd { .. });
            if !fits || asked.contains(&question) {
                continue;
            }
            let sent = send_by(link, &question, clock.now() + SEND_WITHIN);
            sent.map_err(ScanError::Send)?;
            asked.push(question);
            listen(link, clock, clock.now() + BETWEEN, heard);
        }
        if asked.len() == before {
            break;
        }
        listen(link, clock, clock.now() + ANSWERS, heard);
    }
    Ok(asked.len())
}

/// What was heard on each interface of a recorded log, whose relative stamps mean `stamps`, and
/// what is to be told of the log.
///
/// # Errors
/// A read error, or why there is no frame in it.
pub fn log(
    file: impl BufRead,
    stamps: log::Stamps,
) -> io::Result<(BTreeMap<String, Traffic>, Vec<String>)> {
    let mut buses: BTreeMap<String, Traffic> = BTreeMap::new();
    let mut reader = log::LogReader::with_stamps(file, stamps);
    while let Some(record) = reader.next_record()? {
        match buses.get_mut(record.interface) {
            Some(heard) => heard.on_frame(&record.frame),
            None => {
                let mut heard = Traffic::new();
                heard.on_frame(&record.frame);
                buses.insert(record.interface.to_owned(), heard);
            }
        }
    }
    if buses.is_empty() {
        let why = reader.why_empty();
        return Err(io::Error::new(io::ErrorKind::InvalidData, why));
    }
    let notes = [reader.skipped(), reader.doubt(log::STAMPS_OPTION)];
    Ok((buses, notes.into_iter().flatten().collect()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::Monotonic;
    use crate::link::{LinkCounters, ListenOnly};
    use proprio_drivers::{Board, Frame, Frames, Id, Mode, Options, Outputs, Spec};
    use std::collections::VecDeque;

    /// A bus with boards that answer at once, and a link that counts what it sends.
    struct Boards {
        boards: Vec<Box<dyn Board>>,
        answers: VecDeque<Frame>,
        sent: Vec<Frame>,
        state: LinkState,
    }

    fn boards(of: &[(&str, u32)]) -> Boards {
        let board = |(driver, address): &(&str, u32)| {
            let options = Options::deserialize(driver, toml::Table::new()).unwrap();
            let joints = options.outputs();
            let joints = (joints.iter()).filter(|o| o.kind == proprio_topics::Kind::Joint);
            let spec = Spec {
                address: *address,
                max_silence: Nanos::from_millis(100),
                mode: Mode::Supervise,
                outputs: Outputs(joints.map(|output| output.number).collect()),
            };
            options.board(&spec).unwrap()
        };
        Boards {
            boards: of.iter().map(board).collect(),
            answers: VecDeque::new(),
            sent: Vec::new(),
            state: LinkState::Up,
        }
    }

    impl Link for Boards {
        fn recv(&mut self, deadline: Nanos) -> Received {
            match self.answers.pop_front() {
                Some(frame) => Received::Frame(frame),
                None => {
                    crate::clock::sleep_until(deadline);
                    Received::TimedOut
                }
            }
        }

        fn send(&mut self, frame: &Frame) -> Result<(), TransmitError> {
            self.sent.push(*frame);
            for board in &mut self.boards {
                let mut answers = Frames::new();
                board.on_frame(frame, &mut answers);
                self.answers.extend(answers);
            }
            Ok(())
        }

        fn state(&self) -> LinkState {
            self.state
        }

        fn counters(&self) -> LinkCounters {
            LinkCounters::default()
        }
    }

    fn names(devices: &[FoundDevice]) -> Vec<&str> {
        devices.iter().map(|device| device.name.as_str()).collect()
    }

    #[test]
    fn devices_are_named_and_rivals_kept() {
        let mut bus = boards(&[("icub_strain", 3), ("canopen_encoder", 9), ("moteus", 4)]);
        let mut heard = Traffic::new();
        let count = ask(&mut bus, &Monotonic, &[], true, &mut heard).unwrap();
        assert_eq!(count, bus.sent.len());
        let devices = devices(&heard, "arm_");
        let mut found = names(&devices);
        found.sort_unstable();
        // A strain2 has an IMU too.
        let expected = [
            "arm_canopen_encoder_9",
            "arm_icub_imu_3",
            "arm_icub_strain_3",
            "arm_moteus_4",
        ];
        assert_eq!(found, expected);
        let encoder = &devices
            .iter()
            .find(|d| d.finding.driver == "canopen_encoder");
        assert!(encoder.unwrap().explains(Id::standard(0x589)));
        assert!(
            encoder.unwrap().explains(Id::standard(0x189)),
            "what it reads"
        );
        assert!(!encoder.unwrap().explains(Id::standard(0x190)));
        let mut twice = bus.sent.clone();
        twice.sort_unstable_by_key(|frame| (frame.id, frame.data().to_vec()));
        twice.dedup();
        assert_eq!(twice.len(), bus.sent.len(), "no question is sent twice");
    }

    #[test]
    fn a_node_without_a_profile_has_two_readers() {
        let mut heard = Traffic::new();
        for (id, data) in [(0x709, &[5][..]), (0x589, &[0x60, 0, 0x18, 1, 0, 0, 0, 0])] {
            heard.on_frame(&Frame::new(Id::standard(id), data));
        }
        let devices = devices(&heard, "");
        assert_eq!(names(&devices), ["canopen_drive_9"]);
        let rivals: Vec<&str> = devices[0].rivals.iter().map(|rival| rival.driver).collect();
        assert_eq!(rivals, ["canopen_encoder"]);
    }

    #[test]
    fn questions_in_can_fd_need_a_bus_with_it() {
        let is_fd = |frame: &Frame| matches!(frame.format, Format::Fd { .. });
        for fd in [false, true] {
            let mut bus = boards(&[("moteus", 4)]);
            let mut heard = Traffic::new();
            ask(&mut bus, &Monotonic, &[], fd, &mut heard).unwrap();
            assert_eq!(bus.sent.iter().any(is_fd), fd);
            assert_eq!(devices(&heard, "").len(), usize::from(fd));
        }
    }

    #[test]
    fn listening_sends_nothing_and_a_dead_link_is_told() {
        let mut bus = boards(&[("icub_strain", 3)]);
        let time = Nanos::from_millis(5);
        hear(&mut bus, &Monotonic, time).unwrap();
        assert_eq!(bus.sent, []);
        bus.state = LinkState::BusOff;
        let dead = hear(&mut bus, &Monotonic, time).unwrap_err();
        assert_eq!(dead, ScanError::Link(LinkState::BusOff));
        bus.state = LinkState::Up;
        let mut closed = ListenOnly(Box::new(bus));
        let refused = ask(&mut closed, &Monotonic, &[], true, &mut Traffic::new());
        assert_eq!(refused, Err(ScanError::Send(TransmitError::ListenOnly)));
    }

    #[test]
    fn each_interface_of_a_log_is_a_bus() {
        let text = "(1.0) can0 31A#000000000000\n(1.1) can1 123#01\n(1.2) can0 123#02\nbad\n";
        let (buses, notes) = log(text.as_bytes(), log::Stamps::Detect).unwrap();
        let counts: Vec<(&str, usize)> = (buses.iter())
            .map(|(name, heard)| (name.as_str(), heard.streams().count()))
            .collect();
        assert_eq!(counts, [("can0", 2), ("can1", 1)]);
        assert_eq!(notes.len(), 1);
        assert!(notes[0].starts_with("1 lines of the log were skipped; the first is line 4: "));
    }
}
