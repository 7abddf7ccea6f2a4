//! What is on the buses beside what the configuration knows: a device that nobody reads, and two
//! devices at one address. Both are told once, in the log.
//!
//! A thread of its own listens to each bus for [`TIME`], 5 s after the start and then each minute,
//! by a link of its own: the bus threads have filters, and do not wait for it. Nothing is sent.
//!
//! - **A device that nobody reads** is one that a scan finds and calls likely, of whose identifiers
//!   no device of the plan has any. The model of a scan takes one bus of 120 without such a device
//!   for one with it, at most (`proprio_drivers::recognise`).
//! - **Two devices at one address**: the readings of a channel come at least one and a half times
//!   as often as the device's period says, and alternate. Of three readings in turn the first and
//!   the third are nearer to each other than the second is to either. Of readings that are noise
//!   one triple of three is so, of smooth ones fewer; [`TRIPLES`] of them in turn are so once in
//!   3^20 = 3.5e9 looks. What is decoded here is what was heard in the look: a device of which only
//!   its own answer tells how to read it, such as a full scale, is not judged unless its keys do.
//!   Nor is one whose frames carry a counter (`icub_imu`): the second counter looks like lost and
//!   unpaired readings, which health counts.

use crate::clock::{Clock, Monotonic, sleep_until};
use crate::config::FrameSource;
use crate::devices::BusDevices;
use crate::link::adapter;
use crate::link::socketcan::SocketCan;
use crate::link::virtual_bus::VirtualBus;
use crate::link::{Link, ListenOnly, Received};
use crate::plan::{BusPlan, Plan};
use crate::scan::devices;
use crate::status::BusStatus;
use proprio_drivers::{Certainty, Claim, Frame, Mode, Traffic};
use proprio_topics::{Nanos, Reading, realtime};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex, PoisonError};

/// How long a look takes: 60 readings of two devices that send 10 a second.
const TIME: Nanos = Nanos::from_millis(3500);
/// From the start to the first look: devices are started then.
const FIRST: Nanos = Nanos::from_millis(5000);
/// Between two looks.
const EACH: Nanos = Nanos::from_millis(60_000);
/// The longest time without a look at the flag that ends the thread.
const PAUSE: Nanos = Nanos::from_millis(50);
/// The triples of readings that must alternate.
const TRIPLES: usize = 20;

/// The plan that the buses are compared with; a reload replaces it.
pub(crate) type WatchedPlan = Arc<Mutex<Plan>>;

/// Starts the thread. It ends after `stop`.
pub(crate) fn start(
    plan: WatchedPlan,
    domain: String,
    stop: Arc<AtomicBool>,
) -> std::io::Result<()> {
    let body = move || {
        let mut reported = BTreeSet::new();
        let mut next = Monotonic.now() + FIRST;
        while !stop.load(Relaxed) {
            let now = Monotonic.now();
            if now < next {
                sleep_until((now + PAUSE).min(next));
                continue;
            }
            next = now + EACH;
            let plan = (plan.lock().unwrap_or_else(PoisonError::into_inner)).clone();
            for (bus, number) in plan.buses.iter().zip(0..) {
                let Some(frames) = listen(&bus.source, &domain, &stop) else {
                    continue;
                };
                for finding in examine(&plan, number, &frames) {
                    if reported.insert((bus.name.clone(), finding.clone())) {
                        tracing::warn!(bus = bus.name, "{finding}");
                    }
                }
            }
        }
    };
    let thread = std::thread::Builder::new()
        .name("watch".into())
        .stack_size(realtime::SMALL_STACK);
    thread.spawn(body).map(drop)
}

/// The frames of a look; `None` of a log, or if there is no link.
fn listen(source: &FrameSource, domain: &str, stop: &AtomicBool) -> Option<Vec<Frame>> {
    let link: Box<dyn Link> = match source {
        FrameSource::SocketCan(named) => {
            let path = Path::new(adapter::SYS);
            Box::new(SocketCan::open_adapter(named, path, &[]).ok()?)
        }
        FrameSource::Virtual { name } => Box::new(VirtualBus::open(domain, name, &[]).ok()?),
        FrameSource::Replay { .. } => return None,
    };
    let mut link = ListenOnly(link);
    let end = Monotonic.now() + TIME;
    let mut frames = Vec::new();
    while Monotonic.now() < end && !stop.load(Relaxed) {
        match link.recv(end.min(Monotonic.now() + PAUSE)) {
            Received::Frame(frame) => frames.push(frame),
            Received::Ended => break,
            Received::Error(_) | Received::TimedOut | Received::StateChanged => {}
        }
    }
    Some(frames)
}

/// What is to be told of bus number `number` with these frames: texts that do not change from look
/// to look.
fn examine(plan: &Plan, number: usize, frames: &[Frame]) -> Vec<String> {
    let Some(bus) = plan.buses.get(number) else {
        return Vec::new();
    };
    let mut all = strangers(bus, frames);
    all.extend(doubled(plan, number, bus, frames));
    all
}

fn strangers(bus: &BusPlan, frames: &[Frame]) -> Vec<String> {
    let mut heard = Traffic::new();
    frames.iter().for_each(|frame| heard.on_frame(frame));
    let built = bus.devices.iter().filter_map(|device| {
        let device = device.options.device(&device.spec.in_mode(Mode::Listen));
        device.ok().map(|device| device.claims().to_vec())
    });
    let claims: Vec<Claim> = built.flatten().collect();
    let mut all = Vec::new();
    for device in devices(&heard, "") {
        let finding = &device.finding;
        let ids = finding.explains.iter().map(|explained| explained.id);
        let known = |id| claims.iter().any(|claim| claim.matches(id));
        let is_sure = finding.certainty() >= Some(Certainty::Likely);
        if !is_sure || ids.clone().any(known) || bus.has(finding.driver, finding.address) {
            continue;
        }
        let ids: Vec<String> = ids.map(|id| id.to_string()).collect();
        let (ids, s) = (ids.join(", "), if ids.len() == 1 { "s" } else { "" });
        let (driver, address, what) = (finding.driver, finding.address, &finding.what);
        all.push(format!(
            "{ids} look{s} like {what} (driver {driver:?}, address {address}), and no device of \
             the configuration reads it: add it (`proprio scan` writes its table), or remove it \
             from the bus"
        ));
    }
    all
}

impl BusPlan {
    /// Whether it has a device of `driver` at `address`: a board may have more devices than are
    /// read.
    fn has(&self, driver: &str, address: u32) -> bool {
        let family = |driver: &str| driver.split('_').next().map(str::to_owned);
        (self.devices.iter())
            .any(|d| family(&d.driver) == family(driver) && d.spec.address == address)
    }
}

/// The numbers of a reading that tell it from those of another device.
fn values(reading: &Reading) -> Option<Vec<f64>> {
    match reading {
        Reading::Joint(joint) => Some(vec![joint.position]),
        Reading::Wrench(wrench) => Some([wrench.force, wrench.torque].concat()),
        Reading::Imu(imu) => {
            let all = [imu.proper_acceleration, imu.angular_velocity].concat();
            Some(all.into_iter().filter(|value| !value.is_nan()).collect())
        }
        _ => None,
    }
}

/// Whether readings alternate between two devices: the last of them, three by three.
fn alternate(readings: &[Vec<f64>]) -> bool {
    let distance = |a: &Vec<f64>, b: &Vec<f64>| -> f64 {
        if a.len() != b.len() {
            return f64::NAN;
        }
        a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum()
    };
    let triples = readings.rchunks_exact(3).take(TRIPLES);
    triples.len() == TRIPLES
        && triples.into_iter().all(|triple| match triple {
            [a, b, c] => {
                let outer = distance(a, c);
                outer < distance(a, b) && outer < distance(b, c)
            }
            _ => false,
        })
}

fn doubled(plan: &Plan, number: usize, bus: &BusPlan, frames: &[Frame]) -> Vec<String> {
    let status = Arc::new(BusStatus::new(0, bus));
    let Ok(mut devices) = BusDevices::new(0, bus, Some(Mode::Listen), status) else {
        return Vec::new();
    };
    let mut channels: BTreeMap<u32, Vec<(Nanos, Vec<f64>)>> = BTreeMap::new();
    for frame in frames {
        devices.poll_transmit(frame.t, |_, _| {});
        devices.on_frame(frame, |sample| {
            if let Some(values) = sample.reading().and_then(|reading| values(&reading)) {
                let channel = channels.entry(sample.channel).or_default();
                channel.push((sample.header.acquired, values));
            }
        });
    }
    let mut all = Vec::new();
    for (device, place) in bus.devices.iter().zip(0..) {
        let board = device
            .options
            .board(&device.spec.in_mode(Mode::Listen))
            .ok();
        let Some(period) = board.and_then(|board| board.period()) else {
            continue;
        };
        let counted = channels.iter().filter(|(channel, _)| {
            let channel = plan.channels.get(**channel as usize);
            channel.is_some_and(|of| (of.bus, of.device) == (number, place))
        });
        let is_doubled = counted.map(|(_, readings)| readings).any(|readings| {
            let (Some((begin, _)), Some((end, _))) = (readings.first(), readings.last()) else {
                return false;
            };
            #[expect(clippy::cast_precision_loss, reason = "a count")]
            let gaps = (readings.len() - 1) as f64;
            let values: Vec<Vec<f64>> = readings.iter().map(|(_, v)| v.clone()).collect();
            gaps * period.seconds() > 1.5 * (*end - *begin).seconds() && alternate(&values)
        });
        if is_doubled {
            all.push(format!(
                "{}: two devices seem to have address {}: readings alternate, and come twice as \
                 often as each {} ms: give one of them another address",
                device.name,
                device.spec.address,
                period.0 / 1_000_000
            ));
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use proprio_drivers::{Board, Frames, Options, Spec};
    use proprio_topics::{JointState, Quality, StampKind, Wrench};

    const ARM: &str = "schema = 1\nrobot = \"r\"\n[[bus]]\nname = \"b\"\n\
        source = { kind = \"virtual\", name = \"v\" }\nlisten_only = true\n\
        [[bus.device]]\ndriver = \"icub_strain\"\nname = \"ft\"\naddress = 13\nperiod_ms = 10\n\
        full_scale_n = [1804, 1804, 1804]\nfull_scale_nm = [31, 31, 31]\n\
        [[bus.device]]\ndriver = \"odrive\"\nname = \"o\"\naddress = 5\nperiod_ms = 10\n\
        [[bus.device.joint]]\nname = \"j\"\nratio = 1.0\n";

    fn plan() -> Plan {
        Plan::parse(ARM, Path::new(".")).unwrap_or_else(|e| panic!("{e}"))
    }

    /// A board that sends, each 10 ms from `at` on, what `reading` says.
    fn board(
        (driver, address): (&str, u32),
        at: f64,
        reading: impl Fn(f64) -> Reading,
    ) -> Vec<Frame> {
        let options = Options::deserialize(driver, toml::Table::new()).unwrap();
        let outputs = match driver {
            "odrive" => [0].into_iter().collect(),
            _ => [].into_iter().collect(),
        };
        let spec = Spec {
            address,
            max_silence: Nanos::from_millis(100),
            mode: Mode::Listen,
            outputs: proprio_drivers::Outputs(outputs),
        };
        let mut board: Box<dyn Board> = options.board(&spec).unwrap();
        let mut frames = Vec::new();
        for turn in 0..350 {
            let t = at + 0.01 * f64::from(turn);
            let mut sent = Frames::new();
            board
                .encode(0, &reading(t), Quality::GOOD, &mut sent)
                .unwrap();
            for (frame, k) in sent.iter().zip(0..) {
                let t = Nanos::from_seconds(100.0 + t + 1e-4 * f64::from(k));
                frames.push(frame.at(t, StampKind::Software));
            }
        }
        frames
    }

    fn wrench(offset: f64) -> impl Fn(f64) -> Reading {
        move |t| {
            let x = offset + (7.0 * t).sin();
            Reading::Wrench(Wrench {
                force: [x, 2.0 * x, 30.0],
                torque: [0.1 * x, 0.2, 0.3],
            })
        }
    }

    fn joint(offset: f64) -> impl Fn(f64) -> Reading {
        move |t| {
            Reading::Joint(JointState {
                position: offset + 0.5 * (7.0 * t).sin(),
                velocity: 3.5 * (7.0 * t).cos(),
                acceleration: 0.0,
                torque: 0.2,
                current: 1.0,
            })
        }
    }

    fn warnings(of: &[Vec<Frame>]) -> Vec<String> {
        let mut frames = of.concat();
        frames.sort_by_key(|frame| frame.t);
        examine(&plan(), 0, &frames)
    }

    #[test]
    fn a_device_that_nobody_reads_is_told() {
        let one = board(("odrive", 5), 0.002, joint(0.0));
        assert_eq!(warnings(std::slice::from_ref(&one)), [""; 0]);
        let other = board(("odrive", 3), 0.004, joint(1.0));
        let said = warnings(&[one, other]);
        let [line] = &said[..] else {
            panic!("{said:?}")
        };
        let parts = [
            "0x069",
            " look",
            " like ODrive (driver \"odrive\", address 3), and no device",
        ];
        assert!(parts.iter().all(|part| line.contains(part)), "{line}");
    }

    #[test]
    fn two_devices_at_one_address_are_told() {
        let strain = |at, offset| board(("icub_strain", 13), at, wrench(offset));
        let odrive = |at, offset| board(("odrive", 5), at, joint(offset));
        assert_eq!(warnings(&[strain(0.0, 5.0), odrive(0.001, 0.0)]), [""; 0]);
        let said = warnings(&[strain(0.0, 5.0), odrive(0.001, 0.0), odrive(0.006, 2.0)]);
        assert!(
            said.len() == 1 && said[0].starts_with("o: two devices"),
            "{said:?}"
        );
        let said = warnings(&[strain(0.0, 5.0), strain(0.004, -20.0), odrive(0.001, 0.0)]);
        assert!(
            said.len() == 1 && said[0].starts_with("ft: two devices"),
            "{said:?}"
        );
    }

    /// Noise alternates by chance, one triple of three; what is smooth does not, however fast.
    #[test]
    fn noise_and_motion_are_one_device() {
        let mut seed = 1_u64;
        let mut noise = || {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            vec![(seed >> 40) as f64]
        };
        let mut triples = 0;
        for _ in 0..1000 {
            let readings: Vec<Vec<f64>> = (0..3 * TRIPLES).map(|_| noise()).collect();
            assert!(!alternate(&readings));
            let [a, b, c] = [0, 1, 2].map(|k| readings[k][0]);
            triples += usize::from((a - c).abs() < (a - b).abs().min((b - c).abs()));
        }
        assert!((250..420).contains(&triples), "{triples}");
        let smooth: Vec<Vec<f64>> = (0..100).map(|k| vec![(0.3 * f64::from(k)).sin()]).collect();
        assert!(!alternate(&smooth));
        let two: Vec<Vec<f64>> = (0..100).map(|k| vec![f64::from(k % 2), 0.0]).collect();
        assert!(alternate(&two));
        assert!(!alternate(&two[..3 * TRIPLES - 1]));
    }
}
