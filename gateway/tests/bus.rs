//! The loop of a bus over a scripted link: what is sent, when, in which order, and what is dropped,
//! while frames keep being received.

use proprio_drivers::{Command, CommandFailed, CommandRefused, Frame, Id};
use proprio_gateway::bus::{Bus, QUEUE, RETRY};
use proprio_gateway::clock::Manual;
use proprio_gateway::devices::{BusDevices, build};
use proprio_gateway::inbox::{Replacement, Reply, Request, Requests, inbox};
use proprio_gateway::link::{Link, LinkCounters, ListenOnly, Received, TransmitError};
use proprio_gateway::plan::{BusPlan, Plan};
use proprio_gateway::publish::Memory;
use proprio_gateway::status::BusStatus;
use proprio_topics::{BusError, Counter, DeviceState, LinkState, Nanos, Quality, StampKind};
use std::collections::VecDeque;
use std::fmt::Write as _;
use std::path::Path;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex, MutexGuard};

/// What a scripted link does and has been asked to do.
#[derive(Default)]
struct Script {
    state: LinkState,
    /// What `recv` returns; then a time-out.
    receives: VecDeque<Received>,
    /// How attempts to send end; then all succeed.
    answers: VecDeque<Result<(), TransmitError>>,
    sent: Vec<Frame>,
    attempts: usize,
    /// The last deadline of `recv`.
    deadline: Nanos,
}

struct Scripted(Arc<Mutex<Script>>);

impl Link for Scripted {
    fn recv(&mut self, deadline: Nanos) -> Received {
        let mut script = self.0.lock().unwrap();
        script.deadline = deadline;
        script.receives.pop_front().unwrap_or(Received::TimedOut)
    }
    fn send(&mut self, frame: &Frame) -> Result<(), TransmitError> {
        let mut script = self.0.lock().unwrap();
        script.attempts += 1;
        let answer = script.answers.pop_front().unwrap_or(Ok(()));
        if answer.is_ok() {
            script.sent.push(*frame);
        }
        answer
    }
    fn state(&self) -> LinkState {
        self.0.lock().unwrap().state
    }
    fn counters(&self) -> LinkCounters {
        LinkCounters::default()
    }
}

/// A bus with F/T boards that are to be started, at a clock that is set by hand.
struct Rig {
    script: Arc<Mutex<Script>>,
    status: Arc<BusStatus>,
    plan: BusPlan,
    requests: Requests,
    bus: Bus<Memory>,
    clock: Manual,
    now: Nanos,
}

impl Rig {
    fn new(boards: u32) -> Self {
        Self::over(boards, |link| Box::new(link))
    }

    fn over(boards: u32, link: impl Fn(Scripted) -> Box<dyn Link>) -> Self {
        Self::of(&Self::plan(boards), link)
    }

    fn plan(boards: u32) -> BusPlan {
        let mut text = "schema = 1\nrobot = \"r\"\n[[bus]]\nname = \"b\"\n\
                        source = { kind = \"virtual\", name = \"b\" }\n"
            .to_owned();
        for address in 1..=boards {
            write!(
                text,
                "[[bus.device]]\ndriver = \"icub_strain\"\nname = \"ft{address}\"\n\
                 address = {address}\nfull_scale_n = [1804.0, 1804.0, 1804.0]\n\
                 full_scale_nm = [31.0, 31.0, 31.0]\n"
            )
            .unwrap();
        }
        Plan::parse(&text, Path::new(".")).unwrap().buses.remove(0)
    }

    fn of(plan: &BusPlan, link: impl Fn(Scripted) -> Box<dyn Link>) -> Self {
        let status = Arc::new(BusStatus::new(0, plan));
        let devices = BusDevices::new(0, plan, None, Arc::clone(&status)).unwrap();
        let script = Arc::new(Mutex::new(Script::default()));
        let link = link(Scripted(Arc::clone(&script)));
        let (requests, inbox) = inbox(plan.devices.len());
        let bus = Bus::new(link, devices, Memory::default(), Arc::clone(&status));
        let bus = bus.with_inbox(inbox);
        let now = Nanos::from_millis(1000);
        Self {
            script,
            status,
            plan: plan.clone(),
            requests,
            bus,
            clock: Manual::new(now),
            now,
        }
    }

    fn script(&self) -> MutexGuard<'_, Script> {
        self.script.lock().unwrap()
    }

    fn attempts(&self) -> usize {
        self.script().attempts
    }

    fn sent(&self) -> Vec<Frame> {
        self.script().sent.clone()
    }

    /// Lets the clock pass by `time`.
    fn pass(&mut self, time: Nanos) {
        self.now += time;
        self.clock.set(self.now);
    }

    /// What replaces board `number`: a new device, or only the outputs.
    fn replacement(&self, number: u16, whole: bool) -> Request {
        let plan = &self.plan.devices[usize::from(number)];
        Request::Replace(Replacement {
            device: whole.then(|| build(plan, None).expect("a device")),
            max_silence: Nanos::from_millis(77),
            outputs: plan.outputs.clone(),
        })
    }

    /// Lets every board send one reading.
    fn readings(&mut self, boards: u16) {
        for address in 1..=boards {
            for kind in [0xA, 0xB] {
                let frame = Frame::new(
                    Id::standard(0x300 | address << 4 | kind),
                    &[0, 0x80].repeat(3),
                );
                let frame = frame.at(self.now, StampKind::Software);
                self.script().receives.push_back(Received::Frame(frame));
            }
        }
        self.turns(2 * usize::from(boards));
    }

    fn turns(&mut self, count: usize) {
        for _ in 0..count {
            self.bus.turn(&self.clock);
        }
    }

    /// Frames that are not sent: as the bus counts them, and as the devices do.
    fn unsent(&self) -> (u64, u64) {
        let devices = self.status.devices();
        let unsent = devices.map(|d| d.counters[Counter::Unsent as usize]).sum();
        (self.status.bus().send_failures, unsent)
    }
}

/// Turns in which every board gets all its start commands: each is given when the one before is
/// sent.
const START: usize = 8;

/// The start commands of `boards` boards, in order: of each board one frame waits at a time.
fn start_commands(boards: u32) -> Vec<Frame> {
    let mut rig = Rig::new(boards);
    rig.turns(START);
    let sent = rig.sent();
    assert_eq!(sent.len(), 2 * boards as usize);
    assert_eq!(rig.unsent(), (0, 0));
    sent
}

/// A tare, unless the bus thread takes it after `until`.
fn tare(until: Nanos) -> Request {
    Request::Command {
        command: Command::Tare,
        until,
    }
}

/// Attempts that find the link's queue full.
fn full(count: usize) -> VecDeque<Result<(), TransmitError>> {
    vec![Err(TransmitError::Full); count].into()
}

#[test]
fn a_full_queue_is_tried_again_in_order_while_frames_are_received() {
    let wanted = start_commands(3);
    let mut rig = Rig::new(3);
    rig.script().answers = full(2);
    rig.turns(2);
    assert_eq!((rig.attempts(), rig.sent().len()), (1, 0));
    // Frames are received meanwhile, without another attempt.
    let now = rig.now;
    let other = Frame::new(Id::standard(0x7F0), &[1]).at(now, StampKind::Software);
    rig.script().receives = vec![Received::Frame(other); 20].into();
    rig.turns(20);
    assert_eq!(rig.status.frames.load(Relaxed), 20);
    assert_eq!(rig.attempts(), 1);
    assert_eq!(rig.script().deadline, now + RETRY, "the wait is shortened");
    rig.pass(RETRY);
    rig.turns(1);
    assert_eq!((rig.attempts(), rig.sent().len()), (2, 0));
    // Full again after the second frame.
    rig.script().answers = [Ok(()), Ok(()), Err(TransmitError::Full)].into();
    rig.pass(RETRY);
    rig.turns(1);
    assert_eq!(rig.sent().len(), 2);
    rig.pass(RETRY);
    rig.turns(START);
    assert_eq!(rig.sent(), wanted);
    assert_eq!((rig.status.bus().queue_full, rig.unsent()), (3, (0, 0)));
    rig.turns(1);
    assert!(rig.script().deadline > rig.now + RETRY, "nothing waits");
}

/// More devices than the queue has places, each with a frame, while the link takes none: the frames
/// without a place are counted, and their devices, which are told, give them again later.
#[test]
fn frames_that_find_no_place_in_the_queue_are_refused_and_told() {
    let mut plan = Rig::plan(14);
    for _ in 0..4 {
        plan.devices.extend(Rig::plan(14).devices);
    }
    let devices = plan.devices.len();
    let mut rig = Rig::of(&plan, |link| Box::new(link));
    rig.script().answers = full(2);
    rig.turns(1);
    let surplus = (devices - QUEUE) as u64;
    assert_eq!(rig.unsent(), (surplus, surplus));
    // Of the last devices, not of those that have a place.
    let unsent: Vec<u64> = rig
        .status
        .devices()
        .map(|d| d.counters[Counter::Unsent as usize])
        .collect();
    let expected = (0..devices).map(|number| u64::from(number >= QUEUE));
    assert_eq!(unsent, expected.collect::<Vec<_>>());
    assert_eq!(rig.sent(), []);
    for _ in 0..100 {
        rig.pass(RETRY);
        rig.turns(1);
    }
    assert_eq!(rig.unsent(), (surplus, surplus), "nothing else was lost");
    assert_eq!(rig.sent().len(), 2 * devices, "every board gets its start");
}

#[test]
fn what_is_not_sent_by_its_deadline_is_dropped() {
    let wanted = start_commands(2);
    let mut rig = Rig::new(2);
    rig.script().answers = full(1000);
    rig.turns(2);
    // The commands may be sent within 100 ms.
    rig.pass(Nanos::from_millis(100));
    rig.turns(1);
    assert_eq!(rig.unsent(), (0, 0));
    rig.pass(Nanos(1));
    rig.turns(1);
    assert_eq!(rig.unsent(), (2, 2), "one of each board");
    assert!(rig.sent().is_empty());
    // The boards are started later, with the same commands.
    rig.script().answers.clear();
    rig.pass(RETRY);
    rig.turns(START);
    assert_eq!(rig.sent(), wanted);
    assert_eq!(rig.unsent(), (2, 2));
}

/// After a stall a device catches up with the frames that have waited. What it wants to send
/// meanwhile has as much time as it would have had then.
#[test]
fn what_a_device_sends_while_it_catches_up_is_not_late() {
    let mut rig = Rig::new(1);
    let waited = Frame::new(Id::standard(0x7FF), &[]).at(rig.now, StampKind::Software);
    rig.pass(Nanos::from_millis(500));
    rig.script().receives.push_back(Received::Frame(waited));
    rig.turns(START);
    assert_eq!(rig.sent(), start_commands(1));
    assert_eq!(rig.unsent(), (0, 0));
}

#[test]
fn what_waits_is_dropped_when_the_link_is_lost() {
    let wanted = start_commands(2);
    // One of each board.
    let failures = 2;
    // Told by the state, and by an attempt to send.
    for by_state in [true, false] {
        let mut rig = Rig::new(2);
        rig.script().answers = full(1);
        rig.turns(2);
        if !by_state {
            rig.script().answers = [Err(TransmitError::NotUp)].into();
            rig.pass(RETRY);
            rig.turns(1);
            assert_eq!(rig.unsent(), (failures, failures), "at once");
        }
        for state in [LinkState::Down, LinkState::Gone, LinkState::BusOff] {
            rig.script().state = state;
            rig.script().receives = [Received::StateChanged].into();
            let attempts = rig.attempts();
            for _ in 0..20 {
                rig.turns(1);
                rig.pass(Nanos::from_millis(5));
            }
            assert_eq!(rig.unsent(), (failures, failures), "{state:?}");
            assert_eq!(rig.attempts(), attempts, "nothing while {state:?}");
        }
        // The boards are started again, once.
        rig.script().state = LinkState::Up;
        rig.turns(START);
        assert_eq!(rig.sent(), wanted);
    }
}

/// No device streams over a lost link, whatever it did before.
#[test]
fn nobody_streams_over_a_lost_link() {
    let mut rig = Rig::new(2);
    let states = |rig: &Rig| -> Vec<DeviceState> {
        let devices = rig.status.devices();
        devices.filter_map(|device| device.state.get()).collect()
    };
    rig.turns(START);
    rig.readings(2);
    assert_eq!(states(&rig), [DeviceState::Streaming; 2]);
    for lost in [LinkState::Down, LinkState::Gone, LinkState::BusOff] {
        rig.script().state = lost;
        rig.script().receives.push_back(Received::StateChanged);
        rig.turns(2);
        assert!(!states(&rig).contains(&DeviceState::Streaming), "{lost:?}");
        rig.script().state = LinkState::Up;
        rig.script().receives.push_back(Received::StateChanged);
        rig.turns(START);
        rig.readings(2);
        assert_eq!(states(&rig), [DeviceState::Streaming; 2], "after {lost:?}");
    }
}

#[test]
fn what_the_link_refuses_is_told_to_its_device_alone() {
    let wanted = start_commands(2);
    let mut rig = Rig::new(2);
    rig.script().answers = [Err(TransmitError::Unsupported)].into();
    rig.turns(START);
    let of_board = |address: u16| -> Vec<Frame> {
        let id = Id::standard(0x200 | address);
        wanted
            .iter()
            .filter(|frame| frame.id == id)
            .copied()
            .collect()
    };
    assert_eq!(rig.sent(), of_board(2));
    let unsent: Vec<u64> = rig
        .status
        .devices()
        .map(|d| d.counters[Counter::Unsent as usize])
        .collect();
    assert_eq!((rig.status.bus().send_failures, unsent), (1, vec![1, 0]));
    // It repeats the command that was refused.
    rig.script().sent.clear();
    rig.pass(Nanos::from_millis(20));
    rig.turns(START);
    assert_eq!(rig.sent(), of_board(1));

    let mut rig = Rig::over(2, |link| Box::new(ListenOnly(Box::new(link))));
    rig.turns(START);
    assert_eq!((rig.attempts(), rig.unsent()), (0, (2, 2)));
}

#[test]
fn stop_commands_are_sent_before_the_end() {
    let mut rig = Rig::new(2);
    rig.turns(START);
    rig.script().sent.clear();
    rig.bus.stop(&rig.clock);
    assert_eq!(rig.sent().len(), 2, "one per board");
    assert_eq!(rig.unsent(), (0, 0));
}

#[test]
fn a_replaced_device_stops_its_board_before_the_new_one_starts_it() {
    let (start, boards) = (start_commands(2), 2);
    let mut rig = Rig::new(2);
    rig.turns(START);
    rig.readings(boards);
    rig.script().sent.clear();
    let whole = rig.replacement(0, true);
    assert_eq!(rig.requests.send(0, whole), Ok(()));
    assert!(
        rig.requests.take().is_none(),
        "not before the board is stopped"
    );
    rig.turns(START);
    let to_first = |frames: &[Frame]| -> Vec<Frame> {
        let mine = |frame: &&Frame| frame.id == Id::standard(0x201);
        frames.iter().filter(mine).copied().collect()
    };
    let mut wanted = vec![Frame::new(Id::standard(0x201), &[7, 1])];
    wanted.extend(to_first(&start));
    assert_eq!(rig.sent(), wanted, "nothing is sent to the other board");
    let Some((0, Reply::Replaced(old))) = rig.requests.take() else {
        panic!("no reply")
    };
    assert!(
        old.device
            .is_some_and(|old| old.state() == proprio_drivers::State::Stopped)
    );
    rig.pass(Nanos::from_millis(10));
    rig.readings(boards);

    // New outputs alone: the device goes on, nothing is sent. Only a different one leaves a gap.
    for offset in [0.0, 1.0] {
        rig.script().sent.clear();
        let Request::Replace(mut part) = rig.replacement(1, false) else {
            unreachable!()
        };
        part.outputs[0].map.offset = offset;
        assert_eq!(rig.requests.send(1, Request::Replace(part)), Ok(()));
        rig.turns(2);
        assert!(matches!(rig.requests.take(), Some((1, Reply::Replaced(_)))));
        rig.pass(Nanos::from_millis(10));
        rig.readings(boards);
        assert_eq!(rig.sent(), []);
    }
    // The maximum silence is the new one.
    rig.pass(Nanos::from_millis(70));
    rig.turns(2);
    let silences = |rig: &Rig| -> Vec<u64> {
        let silences = |d: proprio_topics::DeviceHealth| d.counters[Counter::Silences as usize];
        rig.status.devices().map(silences).collect()
    };
    assert_eq!(silences(&rig), [0, 0]);
    rig.pass(Nanos::from_millis(8));
    rig.turns(2);
    assert_eq!(silences(&rig), [0, 1]);

    let memory = rig.bus.into_sink();
    let gaps = |channel: u32| -> Vec<bool> {
        let samples = memory.samples.iter().filter(|s| s.channel == channel);
        samples
            .map(|s| s.header.quality.contains(Quality::GAP_BEFORE))
            .collect()
    };
    assert_eq!(gaps(0), [false, true, false, false]);
    assert_eq!(gaps(1), [false, false, false, true]);
}

#[test]
fn requests_are_answered_over_a_lost_link_too() {
    let mut rig = Rig::new(2);
    rig.turns(START);
    rig.script().state = LinkState::Down;
    rig.script().receives = [Received::StateChanged].into();
    let whole = rig.replacement(0, true);
    assert_eq!(rig.requests.send(0, whole), Ok(()));
    assert_eq!(rig.requests.send(1, tare(rig.now)), Ok(()));
    rig.script().sent.clear();
    rig.turns(3);
    let mut replies: Vec<_> = std::iter::from_fn(|| rig.requests.take()).collect();
    replies.sort_by_key(|(device, _)| *device);
    assert!(matches!(
        replies[..],
        [
            (0, Reply::Replaced(_)),
            (1, Reply::Refused(CommandRefused::NotStreaming))
        ]
    ));
    // A command that the bus takes too late is not begun.
    let late = tare(rig.now - Nanos(1));
    assert_eq!(rig.requests.send(1, late), Ok(()));
    rig.turns(1);
    assert!(matches!(
        rig.requests.take(),
        Some((1, Reply::Ended(Err(CommandFailed::NotSent))))
    ));
    // Back again, the new device starts its board.
    rig.script().state = LinkState::Up;
    rig.turns(START);
    assert_eq!(rig.sent(), start_commands(2));
    // A gateway that stops starts no board again, not even one that was to be replaced.
    let whole = rig.replacement(0, true);
    assert_eq!(rig.requests.send(0, whole), Ok(()));
    rig.turns(2);
    let whole = rig.replacement(1, true);
    assert_eq!(rig.requests.send(1, whole), Ok(()));
    rig.bus.stop(&rig.clock);
    let sent = rig.sent().split_off(start_commands(2).len());
    let stops = [1, 2].map(|board| Frame::new(Id::standard(0x200 | board), &[7, 1]));
    assert_eq!(sent, stops);
    assert!(rig.requests.take().is_none());
}

#[test]
fn error_frames_are_counted_and_let_time_pass() {
    let mut rig = Rig::new(1);
    rig.turns(START);
    let error = |data| {
        let frame = Frame::with_format(Id::extended(4), proprio_drivers::Format::Error, data);
        frame.unwrap().at(rig.now, StampKind::Software)
    };
    let frames = [
        error(&[0, 0x04, 0, 0, 0, 0, 96, 0]),
        error(&[0, 0x31, 0, 0, 0, 0, 7, 135]),
    ];
    rig.script().receives = frames.map(Received::Error).into();
    rig.turns(3);
    let bus = rig.status.bus();
    assert_eq!(
        [BusError::Warning, BusError::Passive, BusError::RxOverflow]
            .map(|cause| bus.errors[cause as usize]),
        [1, 1, 1]
    );
    assert_eq!((bus.dropped, bus.frames), (1, 0));
    let newest = rig.status.newest_error(BusError::Passive).unwrap();
    assert_eq!(newest.data, [0, 0x31, 0, 0, 0, 0, 7, 135]);
    // A stream of nothing but error frames does not stop the bring-up: the board is started again.
    let started = rig.sent().len();
    rig.pass(Nanos::from_millis(600));
    let late = frames[0].at(rig.now, StampKind::Software);
    rig.script().receives = vec![Received::Error(late); 10].into();
    rig.turns(4);
    assert!(rig.sent().len() > started);
}

#[test]
fn a_bus_is_opened_to_listen_only_if_the_configuration_says_so() {
    let plan = |key: &str| {
        let text = format!(
            "schema = 1\nrobot = \"r\"\n[[bus]]\nname = \"b\"\n{key}\n\
             source = {{ kind = \"virtual\", name = \"b\" }}\n"
        );
        Plan::parse(&text, Path::new(".")).map(|plan| plan.buses[0].listen_only)
    };
    assert_eq!(plan(""), Ok(false));
    assert_eq!(plan("listen_only = false"), Ok(false));
    assert_eq!(plan("listen_only = true"), Ok(true));
    assert!(plan("listen_only = 1").is_err());
}
