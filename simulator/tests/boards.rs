//! The simulated boards against the gateway's own devices, without links or clocks: decoded
//! readings equal the truth, boards need to be started, and each fault has its effect.

use proprio_drivers::{Frame, State};
use proprio_gateway::devices::BusDevices;
use proprio_gateway::plan::Plan;
use proprio_gateway::status::BusStatus;
use proprio_simulator::simulator::{
    ACCELERATION_NOISE, ANGULAR_VELOCITY_NOISE, BusCounts, BusSimulator, JOINT_NOISE,
};
use proprio_simulator::{SimulatedRobot, Simulation, SimulationSettings, Simulator};
use proprio_topics::{Counter, Nanos, Quality, Reading, Sample, StampKind};
use std::collections::HashMap;
use std::sync::Arc;

const T0: Nanos = Nanos::from_millis(5_000);

/// Steps of the three families in this robot: icubdeg of the shaft through a ratio of 100; full
/// scale / 32768; BNO055.
const POSITION_LSB: f64 = std::f64::consts::TAU / 65536.0 / 100.0;
const VELOCITY_LSB: f64 = POSITION_LSB * 1000.0;
const FORCE_LSB: f64 = 1804.0 / 32768.0;
const TORQUE_LSB: f64 = 31.0 / 32768.0;
const ACCELERATION_LSB: f64 = 0.01;
const RATE_LSB: f64 = std::f64::consts::PI / 180.0 / 16.0;

fn robot() -> SimulatedRobot {
    SimulatedRobot::open("icub_left_arm").expect("the robot of the source tree")
}

/// The robot with its gateway.toml changed.
fn robot_with(change: impl Fn(&str) -> String) -> SimulatedRobot {
    let mut robot = robot();
    let text = std::fs::read_to_string(robot.folder.join("gateway.toml")).expect("gateway.toml");
    let changed = change(&text);
    assert_ne!(text, changed);
    robot.plan = Plan::parse(&changed, &robot.folder).expect("a plan");
    robot
}

fn settings(faults: &[&str]) -> SimulationSettings {
    let faults = faults.iter().map(|f| f.parse().expect("a fault")).collect();
    SimulationSettings {
        seed: 11,
        cycle: 10.0,
        faults,
        ..SimulationSettings::default()
    }
}

/// The result of a session.
struct Session {
    samples: Vec<Sample>,
    /// Frames that reached the buses.
    frames: Vec<(usize, Frame)>,
    counts: Vec<BusCounts>,
    states: Vec<Vec<State>>,
    /// Per device, the gateway's counters.
    health: HashMap<String, Vec<u64>>,
    channels: Vec<String>,
}

/// Seconds since the start of the simulation.
fn time_of(sample: &Sample) -> f64 {
    (sample.header.acquired - T0).seconds()
}

impl Session {
    fn of<'a>(&'a self, channel: &'a str) -> impl Iterator<Item = &'a Sample> {
        self.samples
            .iter()
            .filter(move |s| self.channels[s.channel as usize] == channel)
    }

    fn times(&self, channel: &str) -> Vec<f64> {
        self.of(channel).map(time_of).collect()
    }

    fn count(&self, device: &str, counter: Counter) -> u64 {
        self.health[device][counter as usize]
    }
}

/// Runs boards and host for `seconds`; the host begins at `start`.
fn session_from(
    robot: &SimulatedRobot,
    settings: &SimulationSettings,
    seconds: f64,
    start: Nanos,
) -> Session {
    let mut simulator = Simulator::new(robot, settings, T0).expect("a simulator");
    let mut hosts: Vec<(BusDevices, Arc<BusStatus>)> = Vec::new();
    for (plan, number) in robot.plan.buses.iter().zip(0..) {
        let status = Arc::new(BusStatus::new(number, plan));
        hosts.push((
            BusDevices::new(number, plan, None, Arc::clone(&status)).expect("devices"),
            status,
        ));
    }
    let (mut samples, mut frames) = (Vec::new(), Vec::new());
    let (mut now, end) = (T0, T0 + Nanos::from_seconds(seconds));
    while now < end {
        if now >= start {
            for (bus, (devices, _)) in hosts.iter_mut().enumerate() {
                let mut commands = Vec::new();
                devices.poll_transmit(now, |device, t| commands.push((device, t.frame)));
                for (device, command) in commands {
                    devices.on_sent(device, &command, Ok(now));
                    simulator.on_frame(bus, &command, now);
                }
            }
        }
        while let Some((bus, frame)) = simulator.poll(now) {
            assert_eq!(frame.t, now);
            frames.push((bus, frame));
            hosts[bus]
                .0
                .on_frame(&frame.at(now, StampKind::Software), |sample| {
                    samples.push(*sample);
                });
        }
        let wakes = hosts
            .iter()
            .filter_map(|(d, _)| d.next_wake())
            .map(|w| w.max(start))
            .chain(simulator.next_wake());
        now = wakes.min().unwrap_or(end).max(now + Nanos(1));
    }
    let health = hosts
        .iter()
        .flat_map(|(_, status)| status.devices().collect::<Vec<_>>());
    Session {
        samples,
        frames,
        counts: simulator.buses().iter().map(BusSimulator::counts).collect(),
        states: hosts.iter().map(|(d, _)| d.states().collect()).collect(),
        health: health
            .map(|h| (h.name.as_str().to_owned(), h.counters.to_vec()))
            .collect(),
        channels: robot.plan.channels.iter().map(|c| c.name.clone()).collect(),
    }
}

fn session(faults: &[&str], seconds: f64) -> Session {
    session_from(&robot(), &settings(faults), seconds, T0)
}

#[test]
fn boards_come_up_when_they_are_started_and_not_before() {
    let session = session_from(&robot(), &settings(&[]), 1.5, T0 + Nanos::from_millis(300));
    for states in &session.states {
        assert!(states.iter().all(|s| *s == State::Streaming), "{states:?}");
    }
    for channel in ["l_arm_ft_sensor", "chest_imu"] {
        let first = session.times(channel)[0];
        assert!(
            first > 0.3 && first < 0.4,
            "{channel} streams from {first} s on"
        );
    }
    // Motor boards are commanded by another program.
    let first = session.times("l_elbow")[0];
    assert!(first < 0.005, "{first}");
}

#[test]
fn a_gateway_that_knows_no_full_scale_asks_for_it() {
    let robot = robot_with(|text| {
        text.lines()
            .filter(|l| !l.trim_start().starts_with("full_scale"))
            .map(|l| format!("{l}\n"))
            .collect()
    });
    let session = session_from(&robot, &settings(&[]), 0.5, T0);
    assert_eq!(session.states[0][0], State::Streaming);
    assert!(session.of("l_arm_ft_sensor").count() > 400);
    // Answers of board 13 to GET_FULL_SCALES, one per axis.
    let answers = session
        .frames
        .iter()
        .filter(|(_, f)| f.id.raw() == 0x2D0 && f.data()[0] == 0x18)
        .count();
    assert_eq!(answers, 6);
}

#[test]
fn a_board_that_the_gateway_only_listens_to_has_been_started_by_somebody() {
    let robot =
        robot_with(|text| text.replacen("address = 13", "address = 13\nlisten_only = true", 1));
    let session = session_from(&robot, &settings(&[]), 0.5, T0);
    assert!(session.of("l_arm_ft_sensor").count() > 450);
}

#[test]
fn what_is_decoded_is_the_truth_within_half_a_step_and_noise() {
    let robot = robot();
    let ft = &robot.config.force_torque[0];
    for noise in [false, true] {
        let settings = SimulationSettings {
            noise,
            ..settings(&[])
        };
        let session = session_from(&robot, &settings, 6.0, T0);
        let mut simulation = Simulation::new(&robot, &settings).unwrap();
        // Normal numbers exceed this many standard deviations once in 10^13; there are about 10^5
        // here.
        let most = if noise { 7.5 } else { 0.0 };
        let near = |measured: f64, truth: f64, lsb: f64, deviation: f64| {
            let off = (measured - truth).abs();
            assert!(
                off <= 0.5 * lsb + most * deviation + 1e-9,
                "{measured} for {truth}: error {off}"
            );
        };
        let mut seen = HashMap::new();
        for sample in &session.samples {
            let name = session.channels[sample.channel as usize].as_str();
            let joint = simulation.joint(name);
            let truth = simulation.at(time_of(sample));
            match sample.reading().unwrap() {
                Reading::Joint(state) => {
                    let joint = truth.joints[joint.unwrap()];
                    near(state.position, joint.position, POSITION_LSB, JOINT_NOISE);
                    near(state.velocity, joint.velocity, VELOCITY_LSB, 0.0);
                }
                Reading::Wrench(wrench) => {
                    for k in 0..3 {
                        near(
                            wrench.force[k],
                            truth.wrenches[0][k],
                            FORCE_LSB,
                            ft.noise_n[k],
                        );
                        near(
                            wrench.torque[k],
                            truth.wrenches[0][k + 3],
                            TORQUE_LSB,
                            ft.noise_nm[k],
                        );
                    }
                }
                Reading::Imu(imu) => {
                    let truth = &truth.imus[0];
                    for k in 0..3 {
                        near(
                            imu.proper_acceleration[k],
                            truth.proper_acceleration[k],
                            ACCELERATION_LSB,
                            ACCELERATION_NOISE,
                        );
                        near(
                            imu.angular_velocity[k],
                            truth.angular_velocity[k],
                            RATE_LSB,
                            ANGULAR_VELOCITY_NOISE,
                        );
                    }
                }
                Reading::Actuator(actuator) => {
                    assert_eq!(actuator.faults, 0);
                    continue;
                }
                other => panic!("unexpected {other:?}"),
            }
            let quality = sample.header.quality;
            assert!(
                !quality.intersects(Quality::SATURATED | Quality::GAP_BEFORE),
                "{name}: {quality}"
            );
            *seen.entry(name.to_owned()).or_insert(0) += 1;
        }
        assert_eq!(seen.len(), 9, "{seen:?}");
        for (name, n) in seen {
            let rate = match name.as_str() {
                "l_arm_ft_sensor" => 1000.0,
                "chest_imu" => 100.0,
                _ => 250.0,
            };
            let expected = rate * 6.0;
            assert!(
                f64::from(n) > 0.98 * expected && f64::from(n) < 1.001 * expected + 1.0,
                "{name}: {n} readings"
            );
        }
    }
}

#[test]
fn noise_has_the_size_that_is_stated() {
    let robot = robot();
    let session = session_from(&robot, &settings(&[]), 6.0, T0);
    let mut simulation = Simulation::new(&robot, &settings(&[])).unwrap();
    let (mut sum, mut n) = ([0.0; 6], 0.0);
    for sample in session.of("l_arm_ft_sensor") {
        let Reading::Wrench(wrench) = sample.reading().unwrap() else {
            continue;
        };
        let truth = simulation.at(time_of(sample)).wrenches[0];
        let parts = wrench.force.into_iter().chain(wrench.torque).zip(truth);
        sum.iter_mut()
            .zip(parts)
            .for_each(|(sum, (measured, truth))| *sum += (measured - truth).powi(2));
        n += 1.0;
    }
    let ft = &robot.config.force_torque[0];
    let stated = ft.noise_n.into_iter().chain(ft.noise_nm);
    let lsb = [FORCE_LSB; 3].into_iter().chain([TORQUE_LSB; 3]);
    for ((sum, stated), lsb) in sum.into_iter().zip(stated).zip(lsb) {
        // Quantisation adds the variance of a uniform number; the standard error of the deviation
        // is 1 % here.
        let expected = f64::sqrt(stated * stated + lsb * lsb / 12.0);
        assert!(
            (f64::sqrt(sum / n) / expected - 1.0).abs() < 0.06,
            "{} for {expected}",
            f64::sqrt(sum / n)
        );
    }
}

#[test]
fn the_same_seed_gives_the_same_frames_and_another_seed_others() {
    let frames = |seed| {
        session_from(
            &robot(),
            &SimulationSettings {
                seed,
                ..settings(&["lost:0.01"])
            },
            1.0,
            T0,
        )
        .frames
    };
    let first = frames(5);
    assert!(first == frames(5), "every frame, its stamp and its data");
    assert!(first != frames(6));
}

#[test]
fn boards_do_not_keep_step() {
    let session = session(&[], 2.0);
    let mut phases: Vec<f64> = Vec::new();
    for joint in ["l_shoulder_pitch", "l_elbow", "l_wrist_yaw"] {
        let times = session.times(joint);
        phases.push(times[0]);
        let gaps: Vec<f64> = times
            .windows(2)
            .map(|w| w[1] - w[0])
            .filter(|g| *g > 0.0)
            .collect();
        let (least, most) = (
            gaps.iter().copied().fold(1.0, f64::min),
            gaps.iter().copied().fold(0.0, f64::max),
        );
        assert!(
            least > 0.0038 && most < 0.0042 && most - least > 5e-5,
            "{joint}: {least} to {most} s"
        );
    }
    assert!(
        (phases[0] - phases[1]).abs() > 1e-6 && (phases[1] - phases[2]).abs() > 1e-6,
        "{phases:?}"
    );
}

#[test]
fn lost_frames_do_not_reach_the_bus_and_are_counted() {
    let whole = session(&[], 3.0);
    let lossy = session(&["lost:0.02@1..2"], 3.0);
    let lost: u64 = lossy.counts.iter().map(|c| c.lost_on_request).sum();
    assert_eq!(lossy.frames.len() as u64 + lost, whole.frames.len() as u64);
    let in_window = whole
        .frames
        .iter()
        .filter(|(_, f)| (1.0..2.0).contains(&(f.t - T0).seconds()))
        .count() as f64;
    let share = lost as f64 / in_window;
    assert!(
        (share - 0.02).abs() < 5.0 * (0.02 / in_window).sqrt(),
        "{share}"
    );
    // Half a wrench yields no reading.
    assert!(lossy.count("l_arm_ft_sensor", Counter::Unpaired) > 0);
    assert!(
        lossy
            .of("l_arm_ft_sensor")
            .any(|s| s.header.quality.contains(Quality::GAP_BEFORE))
    );
    assert_eq!(whole.count("l_arm_ft_sensor", Counter::Unpaired), 0);
}

#[test]
fn a_silent_board_is_silent_and_others_are_not() {
    let session = session(&["silent:l_arm_ft_sensor@1..1.5"], 2.5);
    let times = session.times("l_arm_ft_sensor");
    assert!(times.iter().all(|t| !(1.0..1.5).contains(t)));
    assert!(
        times.iter().any(|t| (1.5..1.6).contains(t)),
        "it continues as before"
    );
    assert_eq!(session.count("l_arm_ft_sensor", Counter::Silences), 1);
    assert!(session.of("l_elbow").count() > 600);
}

/// What a silent board is told, it does not hear: one that is started meanwhile stays off.
#[test]
fn a_silent_board_does_not_listen() {
    let robot = robot();
    let started = |fault: &[&str]| {
        let mut simulator = Simulator::new(&robot, &settings(fault), T0).unwrap();
        let mut devices = BusDevices::new(
            0,
            &robot.plan.buses[0],
            None,
            Arc::new(BusStatus::new(0, &robot.plan.buses[0])),
        )
        .unwrap();
        let (mut commands, mut frames) = (0, 0);
        for ms in 0..1000 {
            let now = T0 + Nanos::from_millis(ms);
            while let Some((bus, _)) = simulator.poll(now) {
                frames += u32::from(bus == 0);
            }
            if ms == 500 {
                let mut all = Vec::new();
                // Each is given when the one before has been sent.
                while {
                    let before = all.len();
                    devices.poll_transmit(now, |device, t| all.push((device, t.frame)));
                    for (device, frame) in &all[before..] {
                        devices.on_sent(*device, frame, Ok(now));
                    }
                    all.len() > before
                } {}
                for (_, frame) in &all {
                    simulator.on_frame(0, frame, now);
                }
                commands = all.len();
            }
        }
        assert!(commands > 0);
        frames
    };
    assert!(started(&[]) > 0);
    let silent = [
        "silent:l_arm_ft_sensor@0.4..0.6",
        "silent:chest_imu@0.4..0.6",
    ];
    assert_eq!(started(&silent), 0);
}

#[test]
fn a_rebooted_board_comes_back_because_it_is_started_again() {
    let imu = session(&["reboot:chest_imu@1"], 4.0);
    let times = imu.times("chest_imu");
    assert!(times.iter().all(|t| !(1.0..1.5).contains(t)));
    assert!(times.iter().any(|t| *t > 1.5), "started again");
    assert!(imu.count("chest_imu", Counter::Starts) >= 2);
    assert_eq!(imu.states[0][1], State::Streaming);
    // A motor board needs no start.
    let motor = session(&["reboot:l_elbow@1"], 2.0);
    let times = motor.times("l_elbow");
    assert!(
        times.iter().all(|t| !(1.0..1.5).contains(t))
            && times.iter().any(|t| (1.5..1.52).contains(t))
    );
}

/// The gateway's own judgement, with the noise of the simulated sensor: about the first fifteen
/// repeated readings are not marked.
#[test]
fn a_sensor_that_freezes_without_a_word_is_found_out() {
    let session = session(&["freeze:l_arm_ft_sensor@3..3.5"], 4.0);
    let (mut marked, mut repeated) = (0_u32, 0_u32);
    let mut last = None;
    for sample in session.of("l_arm_ft_sensor") {
        let t = time_of(sample);
        let frozen = sample.header.quality.contains(Quality::FROZEN);
        // (A frame is on its way for a while.)
        assert!(!frozen || (3.0..3.502).contains(&t), "{t}");
        repeated += u32::from(last == Some(sample.values));
        marked += u32::from(frozen);
        last = Some(sample.values);
    }
    assert!(repeated > 40, "{repeated}");
    assert!(
        (repeated - 30..=repeated - 13).contains(&marked),
        "{marked} of {repeated}"
    );
    assert_eq!(
        session.count("l_arm_ft_sensor", Counter::Frozen),
        u64::from(marked)
    );
}

#[test]
fn a_saturated_sensor_says_so_and_freezes() {
    let session = session(&["saturate:l_arm_ft_sensor@2..2.5"], 3.0);
    let mut frozen = None;
    for sample in session.of("l_arm_ft_sensor") {
        let t = time_of(sample);
        let saturated = sample
            .header
            .quality
            .contains(Quality::SATURATED | Quality::FROZEN);
        assert_eq!(saturated, (2.0..2.5).contains(&t), "{t}");
        if saturated {
            assert_eq!(
                *frozen.get_or_insert(sample.reading().unwrap()),
                sample.reading().unwrap()
            );
        }
    }
    assert!(frozen.is_some());
}

#[test]
fn a_spike_is_one_reading() {
    let (plain, spiked) = (
        session(&[], 2.0),
        session(&["spike:l_arm_ft_sensor@1.5"], 2.0),
    );
    let mut off = 0;
    for (sample, plain) in spiked
        .of("l_arm_ft_sensor")
        .zip(plain.of("l_arm_ft_sensor"))
    {
        let (Reading::Wrench(a), Reading::Wrench(b)) =
            (sample.reading().unwrap(), plain.reading().unwrap())
        else {
            panic!()
        };
        if a != b {
            off += 1;
            assert!((1.5..1.502).contains(&time_of(sample)));
            assert!(
                a.force
                    .iter()
                    .zip(b.force)
                    .all(|(a, b)| (a - b - 200.0).abs() < FORCE_LSB)
            );
            assert!(
                a.torque
                    .iter()
                    .zip(b.torque)
                    .all(|(a, b)| (a - b - 5.0).abs() < TORQUE_LSB)
            );
        }
    }
    assert_eq!(off, 1);
}

#[test]
fn a_late_half_comes_behind_the_next_first_half_and_is_never_paired_wrongly() {
    let one = session(&["late_half:l_arm_ft_sensor@1"], 2.0);
    let order: Vec<u32> = one
        .frames
        .iter()
        .map(|(_, f)| f.id.raw())
        .filter(|id| matches!(id, 0x3DA | 0x3DB))
        .collect();
    // The order F F T T occurs once.
    assert_eq!(order.windows(2).filter(|w| *w == [0x3DA, 0x3DA]).count(), 1);
    assert_eq!(
        order
            .windows(4)
            .filter(|w| *w == [0x3DA, 0x3DA, 0x3DB, 0x3DB])
            .count(),
        1
    );

    let quiet = SimulationSettings {
        noise: false,
        ..settings(&["late_half:l_arm_ft_sensor@1..5"])
    };
    let many = session_from(&robot(), &quiet, 6.0, T0);
    let late = many.count("l_arm_ft_sensor", Counter::Unpaired);
    assert!(late > 400, "{late}");
    // Without noise a wrench equals the truth at its stamp to half a step, unless it mixes two
    // readings.
    let mut simulation = Simulation::new(&robot(), &quiet).unwrap();
    let mut off_by = |torque: [f64; 3], t: f64| {
        let truth = simulation.at(t).wrenches[0];
        torque
            .into_iter()
            .zip(&truth[3..])
            .map(|(measured, truth)| (measured - truth).abs())
            .fold(0.0, f64::max)
    };
    let mut told_apart = 0;
    for sample in many.of("l_arm_ft_sensor") {
        let Reading::Wrench(wrench) = sample.reading().unwrap() else {
            continue;
        };
        assert!(off_by(wrench.torque, time_of(sample)) <= 0.5 * TORQUE_LSB + 1e-9);
        told_apart +=
            usize::from(off_by(wrench.torque, time_of(sample) - 1e-3) > 0.5 * TORQUE_LSB + 1e-9);
    }
    assert!(
        told_apart > 500,
        "a half of the reading before would show in {told_apart} cases only"
    );
}

#[test]
fn a_fault_that_can_not_happen_is_refused() {
    for (fault, expected) in [
        (
            "spike:l_elbow@1",
            "fault spike:l_elbow@1: \"l_elbow\" is not an F/T sensor",
        ),
        (
            "saturate:chest_imu@1..2",
            "\"chest_imu\" is not an F/T sensor",
        ),
        (
            "late_half:l_elbow_motor@1",
            "\"l_elbow_motor\" is not a board that sends a reading in several frames",
        ),
        (
            "silent:r_arm_ft@1..2",
            "no board or channel \"r_arm_ft\"; it has l_arm_ft_sensor, chest_imu, \
             l_shoulder_pitch_motor",
        ),
    ] {
        let message = Simulator::new(&robot(), &settings(&[fault]), T0)
            .unwrap_err()
            .to_string();
        assert!(message.contains(expected), "{message}");
    }
}

#[test]
fn a_stalled_machine_skips_readings_and_sends_no_old_ones() {
    let robot = robot();
    let quiet = SimulationSettings {
        noise: false,
        ..settings(&[])
    };
    let mut simulator = Simulator::new(&robot, &quiet, T0).unwrap();
    // Polled every 50 ms, boards with a period of 4 ms send one reading each time, the current one.
    for k in 1..=20 {
        let now = T0 + Nanos::from_millis(50 * k);
        let mut motions = 0;
        while let Some((bus, frame)) = simulator.poll(now) {
            assert!(bus == 1 && frame.t == now);
            motions += usize::from(frame.id.raw() & 0xF == 0);
        }
        assert_eq!(motions, 7);
    }
    // 250 readings of each board in that second, minus the 20 that were sent.
    let skipped = simulator.buses()[1].counts().skipped;
    assert!((7 * 228..=7 * 231).contains(&skipped), "{skipped}");
}
