//! The share of a bus's time that frames take. [`of_bus`] is what its devices need, from their own
//! frames: `--check` shows it, and a configuration that cannot work is refused by it. `Meter` is
//! what is measured while the gateway runs.

use proprio_drivers::{
    Board, Decoded, EncodeError, Format, Frame, Frames, Id, Mode, Options, Spec, SpecError,
};
use proprio_topics::{
    Actuator, Gauges, Imu, JointState, Kind, Nanos, Quality, Reading, Skin, StampKind, Temperature,
    Wrench,
};
use std::collections::VecDeque;

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
pub struct BusLoad {
    /// Frames per second.
    pub frames: f64,
    /// The share of time that they need, with as many stuff bits as a frame can have; 1 is all of
    /// it.
    pub share: f64,
}

impl BusLoad {
    /// A usual limit in design: above it frames of low priority may wait for several periods, and
    /// commands and repeated frames find no room.
    const HIGH: f64 = 0.7;

    /// Below this, a bus that was nearly full is so no longer: a tenth of the bus less, so that a
    /// load near the limit is told once.
    const NO_LONGER: f64 = 0.6;

    /// Whether the bus is nearly full.
    #[must_use]
    pub(crate) fn is_high(self) -> bool {
        self.share > Self::HIGH
    }

    /// Whether a bus whose share was high before still is.
    #[must_use]
    pub(crate) fn stays_high(share: f64, was_high: bool) -> bool {
        share
            > if was_high {
                Self::NO_LONGER
            } else {
                Self::HIGH
            }
    }
}

/// The most bits that a frame can have on a bus, with the interframe space.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WireBits {
    /// At the nominal rate.
    pub nominal: u32,
    /// At the rate of the data phase of CAN FD.
    pub data: u32,
}

/// The most bits of `frame`.
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
#[allow(clippy::cast_possible_truncation)] // at most 64 bytes
pub fn bits_on_wire(frame: &Frame) -> WireBits {
    let bytes = frame.data().len() as u32;
    let extended = matches!(frame.id, Id::Extended(_));
    let stuffed = |bits: u32| (bits - 1) / 4;
    match frame.format {
        Format::Classic | Format::Remote | Format::Error => {
            let bits = if extended { 54 } else { 34 } + 8 * bytes;
            WireBits {
                nominal: bits + 13 + stuffed(bits),
                data: 0,
            }
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
            match bit_rate_switch {
                true => WireBits {
                    nominal: slow,
                    data: fast,
                },
                false => WireBits {
                    nominal: slow + fast,
                    data: 0,
                },
            }
        }
    }
}

/// The longest time that `frame` needs on a bus \[s\], with the interframe space.
#[must_use]
pub(crate) fn seconds_on_wire(frame: &Frame, rates: BitRates) -> f64 {
    let WireBits { nominal, data } = bits_on_wire(frame);
    f64::from(nominal) / f64::from(rates.nominal) + f64::from(data) / f64::from(rates.data)
}

/// What has been on a bus until an instant: totals, of which differences are taken.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Totals {
    /// Frames that the gateway has received and sent.
    pub frames: u64,
    /// Their bits at the nominal rate ([`bits_on_wire`]).
    pub nominal_bits: u64,
    /// Their bits at the rate of the data phase.
    pub data_bits: u64,
    /// Frames that the interface has received and sent, for all programs: also those that the
    /// gateway's filters hide. 0: not known.
    pub all_frames: u64,
    /// The bytes of data in these.
    pub all_bytes: u64,
}

/// Measures the load of one bus over the last [`Meter::WINDOW`].
///
/// Where the kernel tells of all frames on the bus, those that filters hide are counted, too: as
/// classic frames with 11-bit identifiers, from their number and bytes. The greater of this and of
/// the gateway's own frames is the load.
#[derive(Debug, Clone)]
pub(crate) struct Meter {
    /// The newest first.
    past: VecDeque<(Nanos, Totals)>,
    /// The last load that was far enough apart to be measured.
    load: BusLoad,
}

impl Meter {
    /// The time over which the load is measured.
    pub(crate) const WINDOW: Nanos = Nanos::from_millis(1000);
    /// A shorter time tells no rate yet.
    const LEAST: Nanos = Nanos::from_millis(200);

    /// A bus of which nothing was measured.
    #[must_use]
    pub(crate) const fn new() -> Self {
        Self {
            past: VecDeque::new(),
            load: BusLoad {
                frames: 0.0,
                share: f64::NAN,
            },
        }
    }

    /// The load of the time before `now`, with the totals until then. Without `rates` the share is
    /// NaN.
    pub(crate) fn measure(
        &mut self,
        now: Nanos,
        totals: Totals,
        rates: Option<BitRates>,
    ) -> BusLoad {
        // An interface that was set up again counts from zero; one that was not asked yet, or did
        // not answer, tells zero.
        if let Some((_, last)) = self.past.front()
            && (last.all_frames > totals.all_frames
                || last.frames > totals.frames
                || (last.all_frames == 0) != (totals.all_frames == 0))
        {
            self.past.clear();
        }
        self.past.push_front((now, totals));
        // The last one that is at least the window ago is the one to compare with.
        while let [.., (before, _), _] = self.past.make_contiguous()
            && now - *before >= Self::WINDOW
        {
            self.past.pop_back();
        }
        let Some((then, before)) = self.past.back().filter(|(t, _)| now - *t >= Self::LEAST) else {
            return self.load;
        };
        let seconds = (now - *then).seconds();
        let growth = |part: fn(&Totals) -> u64| part(&totals).saturating_sub(part(before)) as f64;
        let (all, bytes) = (growth(|t| t.all_frames), growth(|t| t.all_bytes));
        let share = rates.map_or(f64::NAN, |rates| {
            let (nominal, data) = (f64::from(rates.nominal), f64::from(rates.data));
            let on_wire = growth(|t| t.nominal_bits) / nominal + growth(|t| t.data_bits) / data;
            // As `bits_on_wire`: 47 + 8 n bits and a quarter of 33 + 8 n.
            let hidden = (55.25 * all + 10.0 * bytes) / nominal;
            on_wire.max(hidden) / seconds
        });
        self.load = BusLoad {
            frames: growth(|t| t.frames).max(all) / seconds,
            share,
        };
        self.load
    }
}

impl Default for Meter {
    fn default() -> Self {
        Self::new()
    }
}

/// A device: its driver with its keys, its settings, and the numbers and kinds of its outputs in
/// use.
#[derive(Debug, Clone)]
pub struct Participant<'p> {
    /// The driver with its keys.
    pub options: &'p Options,
    /// Address, silence, joints.
    pub spec: &'p Spec,
    /// The outputs in use.
    pub outputs: Vec<(u8, Kind)>,
}

/// The load of a bus with these devices: boards that stream send each period; what the others send,
/// and the host, is counted for a second. Devices whose period nobody knows are left out.
///
/// # Errors
/// [`SpecError`]: a device that its driver cannot build.
pub fn of_bus(members: &[Participant<'_>], rates: BitRates) -> Result<BusLoad, SpecError> {
    let mut all = BusLoad::default();
    let mut add = |frames: &[Frame], period: f64| {
        all.frames += frames.len() as f64 / period;
        let time: f64 = frames.iter().map(|f| seconds_on_wire(f, rates)).sum();
        all.share += time / period;
    };
    let mut polled = Vec::new();
    let known = members.iter().filter(|m| m.options.states_period());
    for member in known {
        // A board that has been started.
        let mut board = member.options.board(&member.spec.in_mode(Mode::Listen))?;
        match board.period() {
            Some(period) => add(&at_once(&member.outputs, &mut *board), period.seconds()),
            None => polled.push(member),
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
fn conversation(members: &[&Participant<'_>]) -> Result<Vec<Frame>, SpecError> {
    const STEP: Nanos = Nanos::from_micros(500);
    const BEGIN: i64 = 20_000;
    const END: i64 = BEGIN + 2_000;
    let (mut hosts, mut boards) = (Vec::new(), Vec::new());
    for member in members {
        let spec = member.spec.in_mode(Mode::Supervise);
        hosts.push(member.options.device(&spec)?);
        let mut board = member.options.board(&spec)?;
        for &(output, kind) in &member.outputs {
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
        let folder = tempfile::tempdir().unwrap();
        let live = |source: &str, devices: &str, more: &str| {
            let file = folder.path().join("gateway.toml");
            let text = format!(
                "schema = 1\nrobot = \"r\"\n[[bus]]\nname = \"b\"\nsource = {source}\n\
                 {more}\n{devices}"
            );
            std::fs::write(&file, text).unwrap();
            Plan::load_live(&file)
                .map(|_| ())
                .map_err(|e| e.to_string())
        };
        let can = "{ kind = \"socketcan\", interface = \"can0\" }";
        let problem = live(can, &boards(5), "").unwrap_err();
        assert!(
            problem.contains("bus \"b\": its devices need up to 115 % of 1 Mbit/s"),
            "{problem}"
        );
        let problem = live(can, &boards(3), "bit_rate = 500000").unwrap_err();
        assert!(problem.contains("up to 138 % of 500 kbit/s"), "{problem}");
        // What was recorded, or is sent anyway, was carried.
        let log = "{ kind = \"replay\", log = \"a.log\", pace = \"recorded\" }";
        assert_eq!(live(log, &boards(5), ""), Ok(()));
        assert_eq!(live(can, &boards(5), "listen_only = true"), Ok(()));
        assert!(plan(&boards(5), "").is_ok());
        let problem = plan(&boards(1), "bit_rate = 5").unwrap_err();
        assert!(problem.contains("bit_rate = 5 must be"), "{problem}");
    }

    /// A second of frames of 135 bits, one per millisecond.
    fn traffic(ms: i64) -> Totals {
        let ms = ms.unsigned_abs();
        Totals {
            frames: ms,
            nominal_bits: 135 * ms,
            ..Totals::default()
        }
    }

    #[test]
    fn the_load_is_that_of_the_last_second() {
        let mut meter = Meter::new();
        let mut measure =
            |ms: i64, totals| meter.measure(Nanos::from_millis(ms), totals, Some(RATES));
        assert!(measure(0, traffic(0)).share.is_nan());
        assert!(
            measure(100, traffic(100)).share.is_nan(),
            "too short a time"
        );
        let close = |load: BusLoad, frames: f64, share: f64| {
            assert!((load.frames - frames).abs() < 1e-6, "{load:?}");
            assert!((load.share - share).abs() < 1e-9, "{load:?}");
        };
        for ms in (200..3000).step_by(100) {
            close(measure(ms, traffic(ms)), 1000.0, 0.135);
        }
        // Then silence: after half a second half of it is left, after one nothing.
        for (ms, rest) in [(3400, 0.5), (3900, 0.0)] {
            for now in ((ms - 400)..=ms).step_by(100) {
                let load = measure(now, traffic(2900));
                if now == ms {
                    close(load, 1000.0 * rest, 0.135 * rest);
                }
            }
        }
        // Without a bit rate the frames are counted all the same.
        let load = meter.measure(Nanos::from_millis(4900), traffic(3900), None);
        assert!(
            load.share.is_nan() && (load.frames - 1000.0).abs() < 1e-6,
            "{load:?}"
        );
    }

    #[test]
    fn frames_that_the_filters_hide_are_counted() {
        let at = |seconds: u64| Totals {
            frames: 100 * seconds,
            nominal_bits: 100 * 115 * seconds,
            // 5000 frames of 8 bytes.
            all_frames: 5000 * seconds,
            all_bytes: 40_000 * seconds,
            ..Totals::default()
        };
        let mut meter = Meter::new();
        let mut load = BusLoad::default();
        for second in 0..3 {
            let now = Nanos::from_seconds(second as f64);
            load = meter.measure(now, at(second), Some(RATES));
        }
        assert!((load.frames - 5000.0).abs() < 1e-6, "{load:?}");
        // 135 bits each, to a bit.
        assert!((load.share - 0.675).abs() < 0.002, "{load:?}");
        // An interface that was set up again counts from zero.
        let load = meter.measure(Nanos::from_seconds(3.0), at(0), Some(RATES));
        assert!((load.frames - 5000.0).abs() < 1e-6, "{load:?}");
        let load = meter.measure(Nanos::from_seconds(4.0), at(1), Some(RATES));
        assert!((load.share - 0.675).abs() < 0.002, "{load:?}");
    }

    #[test]
    fn a_load_near_the_limit_is_told_once() {
        let mut high = false;
        let told = [
            0.5,
            0.69,
            0.71,
            0.69,
            0.72,
            0.61,
            0.59,
            0.69,
            f64::NAN,
            0.9,
            f64::NAN,
        ]
        .map(|share| {
            high = BusLoad::stays_high(share, high);
            high
        });
        let expected = [
            false, false, true, true, true, true, false, false, false, true, false,
        ];
        assert_eq!(told, expected);
    }

    #[test]
    fn the_bits_of_fd_frames_are_counted_by_their_rate() {
        let format = Format::Fd {
            bit_rate_switch: true,
            error_state: false,
        };
        let frame = Frame::with_format(Id::standard(1), format, &[0; 64]).unwrap();
        let bits = bits_on_wire(&frame);
        assert_eq!((bits.nominal, bits.data), (34, 678));
        let plan = plan("", "").unwrap();
        let status = crate::status::BusStatus::new(0, &plan.buses[0]);
        status.on_wire(&frame);
        status.on_wire(&Frame::new(Id::standard(1), &[0; 8]));
        let totals = status.totals();
        assert_eq!((totals.nominal_bits, totals.data_bits), (34 + 135, 678));
    }
}
