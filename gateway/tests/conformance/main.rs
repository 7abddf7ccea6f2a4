//! A conformance suite of properties that runs against all three links, and tests of each link's
//! own features.
//!
//! The SocketCAN link is tested on vcan0 if PROPRIO_VCAN=1 is set (`tests/vcan/with-vcan` provides
//! vcan0).

mod replay;
mod socketcan;

use proprio_drivers::{Claim, Format, Frame, Id};
use proprio_gateway::clock::{Clock, Monotonic, sleep_until};
use proprio_gateway::link::replay::{Pace, Replay};
use proprio_gateway::link::socketcan::SocketCan;
use proprio_gateway::link::virtual_bus::VirtualBus;
use proprio_gateway::link::{Link, ListenOnly, OpenError, Received, TransmitError, send_by};
use proprio_gateway::log::candump::write_log_line;
use proprio_topics::{LinkState, Nanos, StampKind};
use std::path::PathBuf;
use std::process::Command;
use std::sync::atomic::{AtomicU32, Ordering};

/// Time-out for an arrival on a busy machine; not reached if all is well.
const PATIENCE: Nanos = Nanos(20_000_000_000);
/// Time to listen for frames that must not arrive.
const SILENCE: Nanos = Nanos(60_000_000);

fn now() -> Nanos {
    Monotonic.now()
}

fn unique() -> String {
    static COUNT: AtomicU32 = AtomicU32::new(0);
    format!(
        "{}-{}",
        std::process::id(),
        COUNT.fetch_add(1, Ordering::Relaxed)
    )
}

/// Sends a frame; waits while the queue is full.
fn send(link: &mut dyn Link, frame: &Frame) {
    send_by(link, frame, now() + PATIENCE).unwrap();
}

/// A bus for testing one kind of link.
trait Fixture {
    /// Whether links of one bus can send to each other; a log's cannot.
    fn live(&self) -> bool;

    /// A participant, if there can be several.
    fn join(&self, claims: &[Claim]) -> Box<dyn Link>;

    /// A participant that was open when another one sent `frames`.
    fn play(&self, claims: &[Claim], frames: &[Frame]) -> Box<dyn Link> {
        let link = self.join(claims);
        let mut peer = self.join(&[]);
        for frame in frames {
            send(&mut *peer, frame);
        }
        assert_eq!(peer.counters().sent, frames.len() as u64);
        link
    }
}

/// A separate virtual bus for each test.
struct Virtual {
    domain: String,
}

impl Virtual {
    fn new() -> Self {
        Self {
            domain: format!("conformance-{}", unique()),
        }
    }
}

impl Fixture for Virtual {
    fn live(&self) -> bool {
        true
    }

    fn join(&self, claims: &[Claim]) -> Box<dyn Link> {
        Box::new(VirtualBus::open(&self.domain, "arm", claims).unwrap())
    }
}

/// A log of the frames that are sent.
struct Log {
    folder: tempfile::TempDir,
    pace: Pace,
}

/// The recorded stamps start here and are a millisecond apart.
const RECORDED: Nanos = Nanos(1_479_121_923_123_456_789);

impl Log {
    fn new(pace: Pace) -> Self {
        Self {
            folder: tempfile::tempdir().unwrap(),
            pace,
        }
    }

    fn write(&self, lines: &[u8]) -> PathBuf {
        let path = self.folder.path().join(unique());
        std::fs::write(&path, lines).unwrap();
        path
    }
}

impl Fixture for Log {
    fn live(&self) -> bool {
        false
    }

    fn join(&self, _claims: &[Claim]) -> Box<dyn Link> {
        unreachable!("a log has no participants")
    }

    fn play(&self, claims: &[Claim], frames: &[Frame]) -> Box<dyn Link> {
        let mut log = Vec::new();
        for (i, frame) in frames.iter().enumerate() {
            write_log_line(
                &mut log,
                RECORDED + Nanos::from_millis(i as i64),
                "can0",
                frame,
            )
            .unwrap();
        }
        Box::new(Replay::open(&self.write(&log), self.pace, None, claims).unwrap())
    }
}

/// A CAN interface of the kernel.
struct Can {
    interface: String,
}

impl Fixture for Can {
    fn live(&self) -> bool {
        true
    }

    fn join(&self, claims: &[Claim]) -> Box<dyn Link> {
        Box::new(SocketCan::open(&self.interface, claims).unwrap())
    }
}

/// The next frame, within the time-out; anything else fails.
fn frame(link: &mut dyn Link) -> Frame {
    match link.recv(now() + PATIENCE) {
        Received::Frame(frame) => frame,
        other => panic!("{other:?} instead of a frame"),
    }
}

/// Exactly `count` frames, and no more.
fn exactly(link: &mut dyn Link, count: usize) -> Vec<Frame> {
    let frames = (0..count).map(|_| frame(link)).collect();
    silent(link);
    frames
}

fn silent(link: &mut dyn Link) {
    match link.recv(now() + SILENCE) {
        Received::TimedOut | Received::Ended => {}
        other => panic!("{other:?} instead of nothing"),
    }
}

/// The same frame without its stamp.
fn bare(frame: &Frame) -> Frame {
    frame.at(Nanos::ZERO, StampKind::None)
}

fn fd(id: Id, bit_rate_switch: bool, error_state: bool, data: &[u8]) -> Frame {
    Frame::with_format(
        id,
        Format::Fd {
            bit_rate_switch,
            error_state,
        },
        data,
    )
    .unwrap()
}

/// Frames of every kind, in which no two are equal.
fn variety() -> Vec<Frame> {
    let bytes: Vec<u8> = (0..64).map(|i| 255 - i * 3).collect();
    let mut frames = Vec::new();
    for id in [
        Id::standard(0),
        Id::standard(0x123),
        Id::standard(0x7FF),
        Id::extended(0x123),
        Id::extended(0x1FFF_FFFF),
    ] {
        for len in 0..=8 {
            frames.push(Frame::new(id, &bytes[..len]));
            frames.push(Frame::remote(id, len as u8));
        }
        // The valid lengths of CAN FD.
        for len in [0, 1, 8, 12, 16, 20, 24, 32, 48, 64] {
            frames.push(fd(id, len % 3 == 0, len % 2 == 0, &bytes[..len]));
        }
    }
    frames
}

/// Distinct frames with standard identifiers.
fn numbered(count: u32) -> Vec<Frame> {
    (0..count)
        .map(|i| Frame::new(Id::standard((i % 0x700) as u16), &i.to_le_bytes()))
        .collect()
}

fn order_and_values_are_kept(bus: &dyn Fixture) {
    let sent = variety();
    let received: Vec<Frame> = exactly(&mut *bus.play(&[], &sent), sent.len())
        .iter()
        .map(bare)
        .collect();
    assert_eq!(received, sent);
    // More than one batch.
    let sent = numbered(200);
    let mut link = bus.play(&[], &sent);
    let received: Vec<Frame> = exactly(&mut *link, sent.len()).iter().map(bare).collect();
    assert_eq!(received, sent);
    let counters = link.counters();
    assert_eq!(
        (
            counters.received,
            counters.dropped,
            counters.error_frames,
            counters.losses
        ),
        (200, 0, 0, 0)
    );
}

fn exactly_the_claims_pass(bus: &dyn Fixture) {
    let masked = |id, mask| Claim {
        mask,
        ..Claim::shared(id)
    };
    let claims = [
        Claim::exclusive(Id::standard(0x123)),
        masked(Id::standard(0x200), 0x7F0),
        Claim::shared(Id::extended(0x456)),
        masked(Id::extended(0x1234_0000), 0x1FFF_0000),
    ];
    let data = [1, 2, 3];
    let (standard, extended) = (
        |id| Frame::new(Id::standard(id), &data),
        |id| Frame::new(Id::extended(id), &data),
    );
    let cases = [
        (true, standard(0x123)),
        (false, extended(0x123)),
        (false, standard(0x122)),
        (true, standard(0x200)),
        (true, standard(0x20F)),
        (false, standard(0x210)),
        (false, extended(0x200)),
        (true, extended(0x456)),
        (false, standard(0x456)),
        (true, extended(0x1234_FFFF)),
        (false, extended(0x1235_0000)),
        (false, extended(0x1000_0123)),
        (false, Frame::remote(Id::standard(0x123), 0)),
        (true, fd(Id::standard(0x123), true, false, &data)),
        (true, Frame::new(Id::standard(0x123), &[])),
    ];
    let sent: Vec<Frame> = cases.iter().map(|(_, frame)| *frame).collect();
    let expected: Vec<Frame> = cases
        .iter()
        .filter(|(passes, _)| *passes)
        .map(|(_, frame)| *frame)
        .collect();
    let mut link = bus.play(&claims, &sent);
    assert_eq!(
        exactly(&mut *link, expected.len())
            .iter()
            .map(bare)
            .collect::<Vec<_>>(),
        expected
    );
    assert_eq!(link.counters().received, expected.len() as u64);

    // More claims than the kernel takes filters.
    let even: Vec<Claim> = (0..600)
        .map(|i| Claim::exclusive(Id::standard(i * 2)))
        .collect();
    let sent: Vec<Frame> = (0..40).map(|i| Frame::new(Id::standard(i), &[])).collect();
    let expected: Vec<Frame> = sent
        .iter()
        .copied()
        .filter(|f| f.id.raw() % 2 == 0)
        .collect();
    assert_eq!(
        exactly(&mut *bus.play(&even, &sent), 20)
            .iter()
            .map(bare)
            .collect::<Vec<_>>(),
        expected
    );
}

fn stamps_are_monotone_and_true(bus: &dyn Fixture) {
    let sent = numbered(100);
    let before = now();
    let mut link = bus.play(&[], &sent);
    let received = exactly(&mut *link, sent.len());
    let after = now();
    assert!(
        received.windows(2).all(|w| w[0].t <= w[1].t),
        "stamps run backwards"
    );
    if bus.live() {
        assert!(
            received
                .iter()
                .all(|f| matches!(f.stamp, StampKind::Software | StampKind::Hardware))
        );
        // The kernel stamps with another clock; this tolerance covers the error of comparing the
        // two.
        let tolerance = Nanos::from_millis(1);
        assert!(
            received
                .iter()
                .all(|f| f.t >= before - tolerance && f.t <= after)
        );
    } else {
        assert!(received.iter().all(|f| f.stamp == StampKind::Log));
    }
}

fn deadlines_are_honoured(bus: &dyn Fixture) {
    let mut link = bus.join(&[]);
    let deadline = now() + Nanos::from_millis(30);
    assert_eq!(link.recv(deadline), Received::TimedOut);
    assert!(now() >= deadline, "too early");
    for past in [deadline, Nanos::ZERO, Nanos(-5), Nanos::MIN] {
        assert_eq!(link.recv(past), Received::TimedOut);
    }
    // Frames that have arrived are returned even if the deadline has passed.
    let mut peer = bus.join(&[]);
    send(&mut *peer, &Frame::new(Id::standard(1), &[]));
    let give_up = now() + PATIENCE;
    while link.recv(Nanos::ZERO) == Received::TimedOut {
        assert!(now() < give_up, "it never arrives");
    }
}

fn own_frames_do_not_come_back(bus: &dyn Fixture) {
    let (mut a, mut b) = (bus.join(&[]), bus.join(&[]));
    let frame = |who: u16, i: u8| Frame::new(Id::standard(who), &[i]);
    for i in 0..40 {
        send(&mut *a, &frame(1, i));
        send(&mut *b, &frame(2, i));
    }
    let expected = |who| (0..40).map(|i| frame(who, i)).collect::<Vec<_>>();
    assert_eq!(
        exactly(&mut *a, 40).iter().map(bare).collect::<Vec<_>>(),
        expected(2)
    );
    assert_eq!(
        exactly(&mut *b, 40).iter().map(bare).collect::<Vec<_>>(),
        expected(1)
    );
}

fn all_participants_see_the_same(bus: &dyn Fixture) {
    let mut links: Vec<Box<dyn Link>> = (0..4).map(|_| bus.join(&[])).collect();
    let sent = numbered(60);
    for (i, frame) in sent.iter().enumerate() {
        send(&mut *links[i % 2], frame);
    }
    for (i, link) in links.iter_mut().enumerate() {
        let expected: Vec<Frame> = sent
            .iter()
            .enumerate()
            .filter(|(from, _)| from % 2 != i)
            .map(|(_, frame)| *frame)
            .collect();
        assert_eq!(
            exactly(&mut **link, expected.len())
                .iter()
                .map(bare)
                .collect::<Vec<_>>(),
            expected,
            "participant {i}"
        );
    }
    // A participant that leaves does not disturb the others.
    links.pop();
    send(&mut *links[0], &sent[0]);
    assert_eq!(bare(&frame(&mut *links[2])), sent[0]);
}

fn what_a_flood_drops_is_counted(bus: &dyn Fixture) {
    let mut link = bus.join(&[]);
    let mut peer = bus.join(&[]);
    // More than the enlarged buffer holds; without privileges it is smaller.
    let flood = 25_000_u64;
    for i in 0..flood {
        send(&mut *peer, &Frame::new(Id::standard(1), &i.to_le_bytes()));
    }
    let mut last = None;
    let mut drain = |link: &mut dyn Link| {
        let mut count = 0;
        while let Received::Frame(frame) = link.recv(now() + SILENCE) {
            let number = u64::from_le_bytes(frame.data().try_into().unwrap());
            assert!(last < Some(number), "in order");
            last = Some(number);
            count += 1;
        }
        count
    };
    let first = drain(&mut *link);
    assert!(first > 0 && first < flood, "{first} of {flood} fit");
    // The drop count arrives with the next frame after the loss.
    send(
        &mut *peer,
        &Frame::new(Id::standard(1), &flood.to_le_bytes()),
    );
    assert_eq!(drain(&mut *link), 1);
    let counters = link.counters();
    assert_eq!(counters.received, first + 1);
    assert_eq!(counters.received + counters.dropped, flood + 1);
    assert_eq!(peer.counters().sent, flood + 1);
}

fn what_can_not_be_sent_is_refused(bus: &dyn Fixture) {
    let mut link = bus.play(&[], &[]);
    let error = Frame::with_format(Id::extended(4), Format::Error, &[0; 8]).unwrap();
    assert_eq!(link.send(&error), Err(TransmitError::Unsupported));
    if !bus.live() {
        assert_eq!(
            link.send(&Frame::new(Id::standard(1), &[])),
            Err(TransmitError::Unsupported)
        );
    }
    assert_eq!(link.counters().sent, 0);
}

fn the_state_tells_whether_more_can_come(bus: &dyn Fixture) {
    let mut link = bus.play(&[], &numbered(3));
    assert_eq!(link.state(), LinkState::Up);
    for _ in 0..3 {
        frame(&mut *link);
    }
    for _ in 0..2 {
        let (received, state) = if bus.live() {
            (Received::TimedOut, LinkState::Up)
        } else {
            (Received::Ended, LinkState::Ended)
        };
        assert_eq!(link.recv(now() + SILENCE), received);
        assert_eq!(link.state(), state);
    }
}

fn sending_never_waits(bus: &dyn Fixture) {
    let mut link = bus.play(&[], &[]);
    let mut took: Vec<Nanos> = numbered(500)
        .iter()
        .map(|frame| {
            let before = now();
            let _ = link.send(frame);
            now() - before
        })
        .collect();
    // Some are interrupted by other programs.
    took.sort();
    assert!(took[450] < Nanos::from_millis(1), "{:?}", took[450]);
}

fn a_link_that_only_listens_sends_nothing(bus: &dyn Fixture) {
    let mut link = ListenOnly(bus.join(&[]));
    let mut peer = bus.join(&[]);
    let frame = Frame::new(Id::standard(1), &[1]);
    assert_eq!(link.send(&frame), Err(TransmitError::ListenOnly));
    silent(&mut *peer);
    assert_eq!((link.state(), link.counters().sent), (LinkState::Up, 0));
    send(&mut *peer, &frame);
    assert_eq!(exactly(&mut link, 1).len(), 1);
    assert_eq!(link.counters().received, 1);
}

type Property = fn(&dyn Fixture);

/// Not when it is read: a gateway that was not scheduled for a while has true stamps.
fn a_frame_is_stamped_when_it_comes(bus: &dyn Fixture) {
    let mut link = bus.join(&[]);
    let mut peer = bus.join(&[]);
    let before = now();
    send(&mut *peer, &Frame::new(Id::standard(7), &[1]));
    let sent = now();
    sleep_until(sent + Nanos::from_millis(100));
    let frame = frame(&mut *link);
    assert_ne!(frame.stamp, StampKind::User);
    // The two clocks are not read at the same instant.
    let slack = Nanos::from_millis(1);
    assert!(frame.t > before - slack, "{} before {before}", frame.t);
    assert!(
        frame.t < sent + Nanos::from_millis(50),
        "{} after {sent}",
        frame.t
    );
}

/// Properties of every link.
const EVERY: [Property; 6] = [
    sending_never_waits,
    order_and_values_are_kept,
    exactly_the_claims_pass,
    stamps_are_monotone_and_true,
    what_can_not_be_sent_is_refused,
    the_state_tells_whether_more_can_come,
];

/// Properties of links to a bus with other participants.
const LIVE: [Property; 6] = [
    a_frame_is_stamped_when_it_comes,
    a_link_that_only_listens_sends_nothing,
    deadlines_are_honoured,
    own_frames_do_not_come_back,
    all_participants_see_the_same,
    what_a_flood_drops_is_counted,
];

#[test]
fn a_log_at_once_is_a_link() {
    for property in EVERY {
        property(&Log::new(Pace::Fast));
    }
}

#[test]
fn a_log_at_its_pace_is_a_link() {
    for property in EVERY {
        property(&Log::new(Pace::Recorded));
    }
}

#[test]
fn the_virtual_bus_is_a_link() {
    for property in EVERY.into_iter().chain(LIVE) {
        property(&Virtual::new());
    }
}

/// Whether there are virtual CAN interfaces; prints a note if not.
fn vcan() -> bool {
    let there = std::env::var("PROPRIO_VCAN").is_ok_and(|v| v == "1");
    if !there {
        println!("skipped: PROPRIO_VCAN=1 is not set (tests/vcan/with-vcan provides vcan0)");
    }
    there
}

#[test]
fn socketcan_is_a_link() {
    if vcan() {
        for property in EVERY.into_iter().chain(LIVE) {
            property(&Can {
                interface: "vcan0".to_owned(),
            });
        }
    }
}

#[test]
fn virtual_buses_do_not_mix() {
    let domain = format!("mix-{}", unique());
    let mut links: Vec<VirtualBus> = [
        (&*domain, "a"),
        (&*domain, "b"),
        ("another", "a"),
        (&*domain, "a"),
    ]
    .into_iter()
    .map(|(domain, name)| VirtualBus::open(domain, name, &[]).unwrap())
    .collect();
    send(&mut links[0], &Frame::new(Id::standard(1), &[]));
    assert_eq!(exactly(&mut links[3], 1).len(), 1);
    silent(&mut links[1]);
    silent(&mut links[2]);
    for (domain, name) in [
        ("d", ""),
        ("d", "a\0b"),
        ("a\0b", "c"),
        (&*"d".repeat(200), "a"),
    ] {
        assert!(
            matches!(
                VirtualBus::open(domain, name, &[]),
                Err(OpenError::System { .. })
            ),
            "{name:?}"
        );
    }
}

/// A namespace with only the loopback interface up: there is no route for multicast.
#[test]
fn the_virtual_bus_needs_only_the_loopback_interface() {
    const INSIDE: &str = "PROPRIO_TEST_LOOPBACK_ONLY";
    if std::env::var_os(INSIDE).is_some() {
        for property in EVERY.into_iter().chain(LIVE) {
            property(&Virtual::new());
        }
        return;
    }
    let lo_up = "PATH=$PATH:/usr/sbin:/sbin; ip link set lo up && exec \"$@\"";
    let inside = |unshare: &[&str], then: &[&std::ffi::OsStr]| {
        let mut command = Command::new("unshare");
        command
            .args(unshare)
            .args(["--net", "sh", "-c", lo_up, "sh"])
            .args(then);
        command.env(INSIDE, "1").output()
    };
    let root = inside(&[], &["true".as_ref()]);
    let unshare: &[&str] = if root.is_ok_and(|o| o.status.success()) {
        &[]
    } else {
        &["--user", "--map-root-user"]
    };
    if !inside(unshare, &["true".as_ref()]).is_ok_and(|o| o.status.success()) {
        println!("skipped: no permission to create a network namespace");
        return;
    }
    let me = std::env::current_exe().unwrap();
    let test = [
        "--exact",
        "the_virtual_bus_needs_only_the_loopback_interface",
        "--nocapture",
    ]
    .map(std::ffi::OsStr::new);
    let output = inside(unshare, &[&[me.as_os_str()][..], &test].concat()).unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(
        output.status.success() && text.contains("1 passed"),
        "{text}{}",
        String::from_utf8_lossy(&output.stderr)
    );
}

#[test]
fn a_past_deadline_does_not_sleep() {
    // `sleep_until` with instants in the past.
    for past in [Nanos::MIN, Nanos(-1), Nanos::ZERO, Nanos(1)] {
        sleep_until(past);
    }
    assert!(now() > Nanos::ZERO);
}
