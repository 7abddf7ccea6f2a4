//! What SocketCAN alone has: interfaces that go and come, error frames, and full queues.

use super::{PATIENCE, SILENCE, bare, fd, frame, now, send, silent, vcan};
use proprio_drivers::{Claim, Frame, Id};
use proprio_gateway::link::adapter::Adapter;
use proprio_gateway::link::error_frame::ErrorFrame;
use proprio_gateway::link::interface::{Interfaces as _, Netlink};
use proprio_gateway::link::socketcan::SocketCan;
use proprio_gateway::link::{Link, OpenError, Received, TransmitError};
use proprio_topics::{BusError, Controller, LinkState, Nanos};
use std::process::Command;
use std::sync::atomic::{AtomicU32, Ordering};

/// A separate interface for this test, which it may take down.
struct OwnInterface {
    name: String,
}

impl OwnInterface {
    fn new() -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let name = format!(
            "pv{}.{}",
            std::process::id(),
            COUNT.fetch_add(1, Ordering::Relaxed)
        );
        let this = Self { name };
        this.create();
        this
    }

    fn create(&self) {
        self.ip("link add dev NAME type vcan");
        self.ip("link set dev NAME mtu 72 up");
    }

    fn ip(&self, words: &str) {
        let words = words
            .split(' ')
            .map(|word| if word == "NAME" { &*self.name } else { word });
        let path = format!(
            "{}:/usr/sbin:/sbin",
            std::env::var("PATH").unwrap_or_default()
        );
        assert!(
            Command::new("ip")
                .args(words)
                .env("PATH", path)
                .status()
                .unwrap()
                .success()
        );
    }

    fn peer_sends(&self, frame: &Frame) {
        send(&mut SocketCan::open(&self.name, &[]).unwrap(), frame);
    }
}

impl Drop for OwnInterface {
    fn drop(&mut self) {
        let _ = Command::new("/usr/sbin/ip")
            .args(["link", "del", "dev", &self.name])
            .status();
    }
}

/// Receives until the state changes to `state`.
fn changes_to(link: &mut dyn Link, state: LinkState) {
    let give_up = now() + PATIENCE;
    while link.state() != state {
        let received = link.recv(now() + SILENCE);
        assert!(
            matches!(received, Received::TimedOut | Received::StateChanged),
            "{received:?}"
        );
        assert!(
            now() < give_up,
            "still {:?} instead of {state:?}",
            link.state()
        );
    }
}

#[test]
fn a_lost_interface_is_told_and_found_again() {
    if !vcan() {
        return;
    }
    let interface = OwnInterface::new();
    let mut link = SocketCan::open(&interface.name, &[Claim::exclusive(Id::standard(7))]).unwrap();
    let wanted = Frame::new(Id::standard(7), &[1]);
    interface.peer_sends(&wanted);
    assert_eq!(bare(&frame(&mut link)), wanted);

    interface.ip("link set dev NAME down");
    assert_eq!(link.recv(now() + PATIENCE), Received::StateChanged);
    assert_eq!(link.state(), LinkState::Down);
    assert_eq!(link.send(&wanted), Err(TransmitError::NotUp));
    // Down from the start.
    assert_eq!(
        SocketCan::open(&interface.name, &[]).unwrap().state(),
        LinkState::Down
    );
    silent(&mut link);
    interface.ip("link set dev NAME up");
    changes_to(&mut link, LinkState::Up);
    interface.peer_sends(&Frame::new(Id::standard(8), &[]));
    interface.peer_sends(&wanted);
    assert_eq!(
        bare(&frame(&mut link)),
        wanted,
        "with the same filters, and nothing stale"
    );

    for _ in 0..2 {
        interface.ip("link del dev NAME");
        assert_eq!(link.recv(now() + PATIENCE), Received::StateChanged);
        assert_eq!(link.state(), LinkState::Gone);
        assert_eq!(link.send(&wanted), Err(TransmitError::NotUp));
        silent(&mut link);
        assert_eq!(link.recv(Nanos::ZERO), Received::TimedOut);
        interface.create();
        changes_to(&mut link, LinkState::Up);
        interface.peer_sends(&Frame::new(Id::extended(7), &[]));
        interface.peer_sends(&wanted);
        assert_eq!(bare(&frame(&mut link)), wanted);
        silent(&mut link);
    }
    // Detected when sending, reported when receiving.
    interface.ip("link del dev NAME");
    assert_eq!(link.send(&wanted), Err(TransmitError::NotUp));
    assert_eq!(
        (link.state(), link.recv(Nanos::ZERO)),
        (LinkState::Gone, Received::StateChanged)
    );
    // Created again, but down.
    interface.ip("link add dev NAME type vcan");
    changes_to(&mut link, LinkState::Down);
    interface.ip("link set dev NAME mtu 16 up");
    changes_to(&mut link, LinkState::Up);
    // Without mtu 72 there is no CAN FD.
    assert_eq!(
        link.send(&fd(Id::standard(7), false, false, &[])),
        Err(TransmitError::Unsupported)
    );
    assert_eq!(link.send(&wanted), Ok(()));
    let counters = link.counters();
    assert_eq!(
        (counters.losses, counters.received, counters.sent),
        (4, 4, 1)
    );
}

/// An adapter is unplugged, and comes back as another interface.
#[test]
fn an_adapter_is_found_again_under_another_name() {
    if !vcan() {
        return;
    }
    let (first, second) = (OwnInterface::new(), OwnInterface::new());
    let sys = tempfile::tempdir().unwrap();
    let device = sys.path().join("devices/usb1/1-2");
    std::fs::create_dir_all(device.join("1-2:1.0")).unwrap();
    std::fs::write(device.join("idVendor"), "1d50\n").unwrap();
    std::fs::write(device.join("serial"), "0042\n").unwrap();
    let plugged = |name: &str| {
        let net = sys.path().join("class/net");
        let _ = std::fs::remove_dir_all(&net);
        std::fs::create_dir_all(net.join(name)).unwrap();
        std::fs::write(net.join(name).join("type"), "280\n").unwrap();
        std::os::unix::fs::symlink(device.join("1-2:1.0"), net.join(name).join("device")).unwrap();
    };
    plugged(&first.name);
    let named = Adapter::Serial {
        serial: "0042".into(),
        channel: None,
    };
    let mut link = SocketCan::open_adapter(&named, sys.path(), &[]).unwrap();
    assert_eq!(link.interface(), first.name);
    let wanted = Frame::new(Id::standard(7), &[1]);
    first.peer_sends(&wanted);
    assert_eq!(bare(&frame(&mut link)), wanted);
    first.ip("link del dev NAME");
    changes_to(&mut link, LinkState::Gone);
    // The old name is somebody else's now.
    plugged(&second.name);
    first.create();
    changes_to(&mut link, LinkState::Up);
    assert_eq!(link.interface(), second.name);
    first.peer_sends(&Frame::new(Id::standard(8), &[]));
    second.peer_sends(&wanted);
    assert_eq!(bare(&frame(&mut link)), wanted);
    assert_eq!(link.counters().losses, 1);
    let other = Adapter::Serial {
        serial: "0043".into(),
        channel: None,
    };
    let missing = SocketCan::open_adapter(&other, sys.path(), &[]).unwrap_err();
    assert!(
        missing.to_string().contains("serial = \"0042\""),
        "{missing}"
    );
}

/// The next error frame, within the time-out; anything else fails.
fn error_frame(link: &mut dyn Link) -> ErrorFrame {
    match link.recv(now() + PATIENCE) {
        Received::Error(frame) => ErrorFrame::of(&frame).unwrap(),
        other => panic!("{other:?} instead of an error frame"),
    }
}

#[test]
fn error_frames_are_handed_on_and_set_the_state() {
    if !vcan() {
        return;
    }
    let interface = OwnInterface::new();
    let mut link = SocketCan::open(&interface.name, &[Claim::exclusive(Id::standard(7))]).unwrap();
    // A driver sends these frames; on a virtual interface any program may.
    let error = |classes: &str, data: &str| {
        let frame = format!("{classes}#{data}");
        assert!(
            Command::new("cansend")
                .args([&interface.name, &frame])
                .status()
                .unwrap()
                .success()
        );
    };
    let none = "0000000000000000";
    // Error passive in both directions, with the error counters.
    error("20000204", "0030000000008087");
    let passive = error_frame(&mut link);
    assert_eq!(
        (passive.classes, passive.data),
        (0x204, [0, 0x30, 0, 0, 0, 0, 0x80, 0x87])
    );
    assert_eq!(
        (link.state(), link.counters().error_frames),
        (LinkState::Up, 1)
    );
    // Until it is believed nothing is sent.
    error("20000040", none);
    assert!(error_frame(&mut link).reports(BusError::BusOff));
    assert_eq!(
        link.send(&Frame::new(Id::standard(7), &[])),
        Err(TransmitError::Full)
    );
    changes_to(&mut link, LinkState::BusOff);
    assert_eq!(
        link.send(&Frame::new(Id::standard(7), &[])),
        Err(TransmitError::NotUp)
    );
    error("20000100", none);
    assert!(error_frame(&mut link).reports(BusError::Restarted));
    assert_eq!(link.state(), LinkState::Up);
    // A controller that has restarted automatically and counts errors again is up too.
    error("20000040", none);
    error_frame(&mut link);
    changes_to(&mut link, LinkState::BusOff);
    error("20000004", none);
    error_frame(&mut link);
    assert_eq!(link.state(), LinkState::Up);
    // Received frames show it as well, and none of them is lost.
    error("20000040", none);
    error_frame(&mut link);
    changes_to(&mut link, LinkState::BusOff);
    let wanted = Frame::new(Id::standard(7), &[1]);
    interface.peer_sends(&wanted);
    assert_eq!(
        (link.recv(now() + PATIENCE), link.state()),
        (Received::StateChanged, LinkState::Up)
    );
    assert_eq!(bare(&frame(&mut link)), wanted);
    let counters = link.counters();
    assert_eq!(
        (counters.error_frames, counters.losses, counters.received),
        (6, 3, 1)
    );
}

/// The kernel's flags end it, if neither an error frame nor a received one does.
#[test]
fn bus_off_ends_while_there_is_a_carrier() {
    if !vcan() {
        return;
    }
    let interface = OwnInterface::new();
    let mut link = SocketCan::open(&interface.name, &[]).unwrap();
    assert!(
        Command::new("cansend")
            .args([&interface.name, "20000040#0000000000000000"])
            .status()
            .unwrap()
            .success()
    );
    assert!(error_frame(&mut link).reports(BusError::BusOff));
    let since = now();
    changes_to(&mut link, LinkState::BusOff);
    changes_to(&mut link, LinkState::Up);
    // The flags of a real controller lag behind by up to a second.
    assert!(now() - since > Nanos::from_millis(1000));
    // Down is not bus-off, and up again is up.
    interface.ip("link set dev NAME down");
    changes_to(&mut link, LinkState::Down);
    interface.ip("link set dev NAME up");
    changes_to(&mut link, LinkState::Up);
}

/// A pair of interfaces, each of which has a carrier only while the other is up.
#[test]
fn an_interface_without_a_carrier_is_not_up() {
    if !vcan() {
        return;
    }
    let interface = OwnInterface {
        name: format!("px{}", std::process::id()),
    };
    let peer = OwnInterface {
        name: format!("py{}", std::process::id()),
    };
    let add = format!(
        "link add dev {} type vxcan peer name {}",
        interface.name, peer.name
    );
    let made = Command::new("/usr/sbin/ip").args(add.split(' ')).status();
    if !made.is_ok_and(|status| status.success()) {
        println!("skipped: this kernel has no vxcan");
        return;
    }
    interface.ip("link set dev NAME up");
    let mut link = SocketCan::open(&interface.name, &[]).unwrap();
    assert_eq!(link.state(), LinkState::NoCarrier);
    let frame = Frame::new(Id::standard(7), &[1]);
    assert_eq!(link.send(&frame), Err(TransmitError::NotUp));
    peer.ip("link set dev NAME up");
    changes_to(&mut link, LinkState::Up);
    assert_eq!(link.send(&frame), Ok(()));
    peer.ip("link set dev NAME down");
    changes_to(&mut link, LinkState::NoCarrier);
    peer.ip("link set dev NAME up");
    changes_to(&mut link, LinkState::Up);
    assert_eq!(link.counters().losses, 1);
}

/// An interface that sends about eight frames a second and queues ten.
#[test]
fn a_full_queue_is_told_at_once() {
    if !vcan() {
        return;
    }
    let interface = OwnInterface::new();
    let shape = format!(
        "qdisc add dev {} root tbf rate 1kbit burst 16b limit 160b",
        interface.name
    );
    let made = Command::new("/usr/sbin/tc").args(shape.split(' ')).status();
    if !made.is_ok_and(|status| status.success()) {
        println!("skipped: this kernel has no tbf");
        return;
    }
    let mut link = SocketCan::open(&interface.name, &[]).unwrap();
    let frame = Frame::new(Id::standard(7), &[1]);
    let full = (0..40).find(|_| link.send(&frame) == Err(TransmitError::Full));
    assert!((8..20).contains(&full.unwrap()), "{full:?}");
    let mut took: Vec<Nanos> = (0..20)
        .map(|_| {
            let before = now();
            assert_eq!(link.send(&frame), Err(TransmitError::Full));
            now() - before
        })
        .collect();
    took.sort();
    assert!(took[10] < Nanos::from_millis(1), "{took:?}");
    // There is room after a while.
    let sent = link.counters().sent;
    send(&mut link, &frame);
    assert_eq!(
        (link.state(), link.counters().sent),
        (LinkState::Up, sent + 1)
    );
}

/// Totals and modes of a virtual interface, which has no controller.
#[test]
fn the_kernel_tells_what_it_knows_of_an_interface() {
    if !vcan() {
        return;
    }
    let interface = OwnInterface::new();
    let mut netlink = Netlink::default();
    let before = netlink.ask(&interface.name).unwrap();
    interface.peer_sends(&Frame::new(Id::standard(7), &[1]));
    let after = netlink.ask(&interface.name).unwrap();
    assert_eq!(after.tx_frames, before.tx_frames + 1);
    assert_eq!(
        (after.fd, after.controller.get()),
        (1, Some(Controller::Unknown))
    );
    interface.ip("link set dev NAME down");
    interface.ip("link set dev NAME mtu 16");
    assert_eq!(netlink.ask(&interface.name).unwrap().fd, 0);
}

#[test]
fn what_can_not_be_opened_is_explained() {
    let missing = SocketCan::open("nosuchcan0", &[]).unwrap_err();
    assert!(missing.to_string().contains("virtual"), "{missing}");
    if vcan() {
        assert!(
            matches!(missing, OpenError::NoInterface { .. }),
            "{missing}"
        );
        assert!(matches!(
            SocketCan::open("lo", &[]),
            Err(OpenError::NotCan { .. })
        ));
        assert!(matches!(
            SocketCan::open("", &[]),
            Err(OpenError::NoInterface { .. })
        ));
        assert!(matches!(
            SocketCan::open("much-too-long-for-an-interface", &[]),
            Err(OpenError::NoInterface { .. })
        ));
    }
}
