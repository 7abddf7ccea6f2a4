//! The share of a bus's time that its devices need, from their own frames: what `--check` shows,
//! and what a configuration that cannot work is refused by.

use proprio_drivers::{
    Board, Decoded, EncodeError, Format, Frame, Frames, Id, Mode, Options, Spec, SpecError,
};
use proprio_topics::{
    Actuator, Gauges, Imu, JointState, Kind, Nanos, Quality, Reading, Skin, StampKind, Temperature,
    Wrench,
};

/// Bit rates of a bus \[bit/s\].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BitRates {
    /// Of the arbitration phase, and of classic frames.
    pub nominal: u32,
    /// Of the data phase of CAN FD.
    pub data: u32,
}

/// The load of a bus.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Load {
    /// Frames per second.
    pub frames: f64,
    /// The share of time that they need, with as many stuff bits as a frame can have; 1 is all of
    /// it.
    pub share: f64,
}

impl Load {
    /// A usual limit in design: above it frames of low priority may wait for several periods, and
    /// commands and repeated frames find no room.
    const HIGH: f64 = 0.7;

    /// Whether the bus is nearly full.
    #[must_use]
    pub fn is_high(self) -> bool {
        self.share > Self::HIGH
    }
}

/// The longest time that `frame` needs on a bus \[s\], with the interframe space.
///
/// Classic: a standard frame with n bytes has 47 + 8 n bits, of which 34 + 8 n are stuffed: after
/// the first five at most one in four (Davis et al., Controller Area Network schedulability
/// analysis, Real-Time Systems 35, 2007). An extended frame has 20 bits more.
///
/// CAN FD (ISO 11898-1:2015): of a standard frame, 17 bits before the data phase and 13 after it
/// are sent at the nominal rate; the data phase has 5 + 8 n bits, a stuff count of 4, a checksum of
/// 17 (21 above 16 bytes), and a fixed stuff bit before each four of these. Bits before the stuff
/// count are stuffed as above; the stuff bits are counted where they can fall. An extended frame
/// has 19 bits more in arbitration.
#[must_use]
pub fn seconds_on_wire(frame: &Frame, rates: BitRates) -> f64 {
    let bytes = frame.data().len();
    let (nominal, data) = (f64::from(rates.nominal), f64::from(rates.data));
    let extended = matches!(frame.id, Id::Extended(_));
    let stuffed = |bits: usize| (bits - 1) / 4;
    match frame.format {
        Format::Classic | Format::Remote | Format::Error => {
            let bits = if extended { 54 } else { 34 } + 8 * bytes;
            (bits + 13 + stuffed(bits)) as f64 / nominal
        }
        Format::Fd {
            bit_rate_switch, ..
        } => {
            let arbitration = if extended { 36 } else { 17 };
            let payload = 5 + 8 * bytes;
            let checksum = 4 + if bytes > 16 { 21 } else { 17 };
            let fast = payload + checksum + checksum.div_ceil(4) + stuffed(arbitration + payload)
                - stuffed(arbitration);
            let slow = arbitration + stuffed(arbitration) + 13;
            let fast_rate = if bit_rate_switch { data } else { nominal };
            slow as f64 / nominal + fast as f64 / fast_rate
        }
    }
}

/// A device: its driver with its keys, its settings, and the numbers and kinds of its outputs in
/// use.
#[derive(Debug, Clone, Copy)]
pub struct Member<'p> {
    /// The driver with its keys.
    pub options: &'p Options,
    /// Address, silence, joints.
    pub spec: &'p Spec,
    /// The outputs in use.
    pub outputs: &'p [(u8, Kind)],
}

/// The load of a bus with these devices: boards that stream send each period; what the others send,
/// and the host, is counted for a second.
///
/// # Errors
/// [`SpecError`]: a device that its driver cannot build.
pub fn of_bus(members: &[Member<'_>], rates: BitRates) -> Result<Load, SpecError> {
    let mut all = Load::default();
    let mut add = |frames: &[Frame], period: f64| {
        all.frames += frames.len() as f64 / period;
        let time: f64 = frames.iter().map(|f| seconds_on_wire(f, rates)).sum();
        all.share += time / period;
    };
    let mut polled = Vec::new();
    for member in members {
        // A board that has been started.
        let mode = Mode::Listen;
        let mut board = member.options.board(&Spec {
            mode,
            ..member.spec.clone()
        })?;
        match board.period() {
            Some(period) => add(&at_once(member.outputs, &mut *board), period.seconds()),
            None => polled.push(*member),
        }
    }
    if !polled.is_empty() {
        add(&conversation(&polled)?, 1.0);
    }
    Ok(all)
}

/// The frames of one period of a board that streams.
fn at_once(outputs: &[(u8, Kind)], board: &mut dyn Board) -> Vec<Frame> {
    let mut frames = Vec::new();
    for &(output, kind) in outputs {
        let mut send = |reading| -> Result<(), EncodeError> {
            let mut sent = Frames::new();
            board.encode(output, &reading, Quality::GOOD, &mut sent)?;
            frames.extend(sent);
            Ok(())
        };
        let first = at_rest(kind);
        let _ = send(first);
        match first {
            // Beside the joint's state, its drive's.
            Reading::Joint(_) => drop(send(at_rest(Kind::Actuator))),
            // One reading per triangle.
            Reading::Skin(skin) => {
                for triangle in 1..16 {
                    let _ = send(Reading::Skin(Skin { triangle, ..skin }));
                }
            }
            _ => {}
        }
    }
    frames
}

/// The frames of a second between devices that ask, or that others ask, and their boards.
fn conversation(members: &[Member<'_>]) -> Result<Vec<Frame>, SpecError> {
    const STEP: Nanos = Nanos::from_micros(500);
    const BEGIN: i64 = 20_000;
    const END: i64 = BEGIN + 2_000;
    let (mut hosts, mut boards) = (Vec::new(), Vec::new());
    for member in members {
        let mode = Mode::Supervise;
        let spec = Spec {
            mode,
            ..member.spec.clone()
        };
        hosts.push(member.options.device(&spec)?);
        let mut board = member.options.board(&spec)?;
        for &(output, kind) in member.outputs {
            board.present(output, &at_rest(kind), Quality::GOOD);
        }
        boards.push(board);
    }
    let (mut frames, mut out) = (Vec::new(), Decoded::new());
    // The start is over by then: boards may wait for six seconds before they are asked.
    for step in 0..END {
        let now = Nanos(step * STEP.0);
        for number in 0..hosts.len() {
            while let Some(sent) = hosts
                .get_mut(number)
                .and_then(|host| host.poll_transmit(now, &mut out))
            {
                let mut on_bus = vec![sent.frame];
                for board in &mut boards {
                    let mut answers = Frames::new();
                    board.on_frame(&sent.frame, &mut answers);
                    on_bus.extend(answers);
                }
                for (at, host) in hosts.iter_mut().enumerate() {
                    let heard = sent.frame.at(now, StampKind::Software);
                    match at == number {
                        true => host.on_sent(&sent.frame, Ok(now)),
                        false => host.overhear(&heard, &mut out),
                    }
                    for frame in on_bus.iter().skip(1) {
                        if host.claims().iter().any(|claim| claim.matches(frame.id)) {
                            host.on_frame(&frame.at(now, StampKind::Software), &mut out);
                        }
                    }
                }
                out.clear();
                if step >= BEGIN {
                    frames.extend(on_bus);
                }
            }
        }
        out.clear();
    }
    Ok(frames)
}

/// A reading of a robot that does nothing.
fn at_rest(kind: Kind) -> Reading {
    match kind {
        Kind::Joint => Reading::Joint(JointState {
            position: 0.0,
            velocity: 0.0,
            acceleration: 0.0,
            torque: 0.0,
            current: 0.0,
        }),
        Kind::Wrench => Reading::Wrench(Wrench {
            force: [0.0; 3],
            torque: [0.0; 3],
        }),
        Kind::Imu => Reading::Imu(Imu {
            proper_acceleration: [0.0, 0.0, 9.81],
            angular_velocity: [0.0; 3],
            angular_acceleration: [0.0; 3],
            magnetic_field: [0.0; 3],
            orientation: [1.0, 0.0, 0.0, 0.0],
        }),
        Kind::Gauges => Reading::Gauges(Gauges { counts: [0; 6] }),
        Kind::Temperature => Reading::Temperature(Temperature { celsius: 20.0 }),
        Kind::Actuator => Reading::Actuator(Actuator {
            duty: 0.0,
            mode: 0,
            encoder: 0,
            faults: 0,
        }),
        Kind::Skin => Reading::Skin(Skin {
            triangle: 0,
            taxels: [0.0; 12],
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::Plan;
    use std::fmt::Write as _;
    use std::path::Path;

    const RATES: BitRates = BitRates {
        nominal: 1_000_000,
        data: 5_000_000,
    };

    /// The numbers of bits in the literature: 135 for 8 bytes, 160 with an extended identifier.
    #[test]
    fn classic_frames_have_as_many_bits_as_published() {
        let bits = |id, bytes: usize| {
            let frame = Frame::new(id, &[0; 8][..bytes]);
            (seconds_on_wire(&frame, RATES) * 1e6).round()
        };
        let (standard, extended) = (Id::standard(1), Id::extended(1));
        assert_eq!([0, 6, 8].map(|n| bits(standard, n)), [55.0, 115.0, 135.0]);
        assert_eq!([0, 8].map(|n| bits(extended, n)), [80.0, 160.0]);
        let remote = Frame::remote(standard, 8);
        assert_eq!((seconds_on_wire(&remote, RATES) * 1e6).round(), 55.0);
    }

    /// A frame of 64 bytes: 34 bits at the nominal rate (17, four stuff bits, 13), and 678 at the
    /// other: 517 with 129 stuff bits, 4 + 21 with 7 fixed ones.
    #[test]
    fn the_data_of_fd_frames_is_sent_at_their_own_rate() {
        let fd = |bit_rate_switch| {
            let error_state = false;
            let format = Format::Fd {
                bit_rate_switch,
                error_state,
            };
            let frame = Frame::with_format(Id::standard(1), format, &[0; 64]).unwrap();
            seconds_on_wire(&frame, RATES) * 1e6
        };
        assert!(
            (fd(true) - (34.0 + 678.0 / 5.0)).abs() < 1e-9,
            "{}",
            fd(true)
        );
        assert!((fd(false) - (34.0 + 678.0)).abs() < 1e-9, "{}", fd(false));
    }

    fn plan(devices: &str, keys: &str) -> Result<Plan, String> {
        let text = format!(
            "schema = 1\nrobot = \"r\"\n[[bus]]\nname = \"b\"\n{keys}\n\
             source = {{ kind = \"virtual\", name = \"b\" }}\n{devices}"
        );
        Plan::parse(&text, Path::new("."))
    }

    fn strain(address: u32, period_ms: u32) -> String {
        format!(
            "[[bus.device]]\ndriver = \"icub_strain\"\nname = \"ft{address}\"\n\
             address = {address}\nperiod_ms = {period_ms}\n"
        )
    }

    #[test]
    fn the_load_of_a_bus_is_that_of_its_boards() {
        // Two frames of 6 bytes each millisecond.
        let one = plan(&strain(1, 1), "").unwrap();
        let load = one.buses[0].load;
        assert!((load.share - 0.23).abs() < 1e-9 && (load.frames - 2000.0).abs() < 1e-9);
        assert!(
            one.to_string()
                .contains("load at most 23 % of 1 Mbit/s (assumed)"),
            "{one}"
        );
        let motor = "[[bus.device]]\ndriver = \"icub_motor\"\nname = \"m\"\naddress = 3\n\
                     period_ms = 4\n[[bus.device.joint]]\nname = \"elbow\"\n";
        let load = plan(motor, "").unwrap().buses[0].load;
        assert!((load.share - 2.0 * 135e-6 / 4e-3).abs() < 1e-9, "{load:?}");
        let skin = "[[bus.device]]\ndriver = \"icub_skin\"\nname = \"s\"\naddress = 3\n\
                    triangles = [4, 13]\n";
        let load = plan(skin, "").unwrap().buses[0].load;
        assert!((load.frames - 20.0 / 0.05).abs() < 1e-9, "{load:?}");
    }

    /// The sensor is asked 250 times a second: three frames of 55, 135 and 115 bits. The two drives
    /// answer each SYNC (55 bits) with frames of 7 and 4 bytes: 125 and 95 bits.
    #[test]
    fn the_load_of_devices_that_are_asked_is_that_of_questions_and_answers() {
        let sensor = "[[bus.device]]\ndriver = \"ati_netcanoem\"\nname = \"ft\"\nperiod_ms = 4\n";
        let load = plan(sensor, "").unwrap().buses[0].load;
        assert!((load.share - 250.0 * 305e-6).abs() < 2e-3, "{load:?}");
        let mut devices =
            "[[bus.device]]\ndriver = \"canopen_sync\"\nname = \"s\"\nperiod_ms = 4.0\n".to_owned();
        for node in [1, 2] {
            write!(
                devices,
                "[[bus.device]]\ndriver = \"canopen_drive\"\nname = \"d{node}\"\naddress = {node}\n\
                 sync = 1\n[[bus.device.joint]]\nname = \"j{node}\"\n"
            )
            .unwrap();
        }
        let load = plan(&devices, "").unwrap().buses[0].load;
        assert!((load.frames - 1250.0).abs() < 10.0, "{load:?}");
        assert!((load.share - 250.0 * 495e-6).abs() < 2e-3, "{load:?}");
    }

    #[test]
    fn a_bus_that_can_not_carry_its_boards_is_refused() {
        let boards = |n| {
            (1..=n)
                .map(|address| strain(address, 1))
                .collect::<String>()
        };
        let full = plan(&boards(4), "").unwrap().to_string();
        assert!(full.contains("load at most 92 %"), "{full}");
        assert!(full.contains("above 70 %"), "{full}");
        assert!(
            !plan(&boards(3), "")
                .unwrap()
                .to_string()
                .contains("above 70 %")
        );
        let problem = plan(&boards(5), "").unwrap_err();
        assert!(
            problem.contains("bus \"b\": its devices need up to 115 % of 1 Mbit/s"),
            "{problem}"
        );
        let problem = plan(&boards(3), "bit_rate = 500000").unwrap_err();
        assert!(problem.contains("up to 138 % of 500 kbit/s"), "{problem}");
        let problem = plan(&boards(1), "bit_rate = 5").unwrap_err();
        assert!(problem.contains("bit_rate = 5 must be"), "{problem}");
    }
}
