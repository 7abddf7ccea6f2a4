//! Touches of a skin, and contacts declared at a place, through the whole pipeline: an arm that
//! stands still on an IMU, a round skin on its forearm, and readings that belong to a push.

use proprio_dynamics::model::Frame;
use proprio_dynamics::spatial::{Vec3, Wrench};
use proprio_dynamics::{ExternalWrench, FrameMotion, InverseDynamics, JointState, Kinematics};
use proprio_estimator::config::{Config, ContactModel, ContactSite, Occurrence, TactileSkin};
use proprio_estimator::offline;
use proprio_estimator::pipeline::{Estimate, Pipeline};
use proprio_estimator::setup::Setup;
use proprio_estimator::skin::{Taxel, TaxelMap};
use proprio_identification::robot::BaseMotion;
use proprio_topics::csv::{Columns, Series, SeriesKind, TableWriter, Value};
use proprio_topics::{
    ContactState, Imu, JointState as Encoder, Kind, Nanos, Quality, Reading, Reason, Skin,
    Wrench as ForceTorque,
};
use proptest::prelude::*;
use std::path::{Path, PathBuf};

/// The distance of neighbouring taxels \[m\].
const PITCH: f64 = 0.006;
/// When the push begins, and when the skin falls silent in some tests \[ms\].
const PUSH: i64 = 1500;

/// 16 triangles around the forearm (a cylinder of 3 cm radius), taxels on a grid.
fn taxels() -> TaxelMap {
    let place = |number: usize| {
        let (triangle, own) = (number / 12, number % 12);
        let around = f64::from((triangle % 4) as u32) * std::f64::consts::FRAC_PI_2
            + (f64::from((own / 4) as u32) - 1.0) * PITCH / 0.03;
        let along = -0.03
            - 4.0 * PITCH * f64::from((triangle / 4) as u32)
            - PITCH * f64::from((own % 4) as u32);
        let normal = Vec3::new(around.cos(), 0.0, around.sin());
        (own != 6 && own != 10).then(|| Taxel {
            position: normal * 0.03 + Vec3::y() * along,
            normal,
        })
    };
    TaxelMap((0..192).map(place).collect())
}

/// Writes the taxels, in the form of iCub's files.
fn taxel_file() -> PathBuf {
    let row = |taxel: &Option<Taxel>| match taxel {
        None => "0 0 0 0 0 0\n".to_owned(),
        Some(Taxel {
            position: p,
            normal: n,
        }) => {
            format!("{} {} {} {} {} {}\n", p.x, p.y, p.z, n.x, n.y, n.z)
        }
    };
    let rows: String = taxels().0.iter().map(row).collect();
    let file = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!(
        "taxels_{}_{:?}.txt",
        std::process::id(),
        std::thread::current().id()
    ));
    std::fs::write(&file, format!("name l_forearm\n[calibration]\n{rows}")).unwrap();
    file
}

/// The arm of the example with exact parameters, and a possible contact of this kind with a skin on
/// its forearm.
fn config(kind: ContactModel) -> Config {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/icub_left_arm");
    let mut config = Config::load(&folder.join("estimator.toml")).unwrap();
    config.identification.urdf_relative_std = 0.0;
    config.output.max_wait_ms = Some(20.0);
    config.contact.last_mut().unwrap().presence = Occurrence::Possible;
    config.contact.push(ContactSite {
        name: Some("forearm".into()),
        link: "l_forearm".into(),
        kind,
        direction: (kind == ContactModel::ForceAlong).then_some([0.0, 0.0, -1.0]),
        position_m: [0.0; 3],
        presence: Occurrence::Possible,
    });
    config.skin.push(TactileSkin {
        channel: "l_forearm_skin".into(),
        link: "l_forearm".into(),
        contact: "forearm".into(),
        taxels: taxel_file(),
        first_taxel: 0,
        noise: 1.0,
        false_alarms_per_hour: 1.0,
        position_std_m: None,
        max_silence_ms: 250.0,
    });
    config
}

fn setup(config: &Config) -> Setup {
    Setup::new(config).unwrap_or_else(|e| panic!("{e}"))
}

const POSITION: f64 = 0.3;

/// What the F/T sensor reads while nothing moves and this wrench acts on the frame.
fn force_torque(setup: &Setup, frame: &Frame, wrench: Wrench) -> Reading {
    let robot = &setup.robot;
    let BaseMotion::Imu(pose) = &robot.base else {
        panic!("an IMU")
    };
    let imu = FrameMotion {
        angular_velocity: Vec3::zeros(),
        angular_acceleration: Vec3::zeros(),
        proper_acceleration: Vec3::new(0.0, 0.0, 9.80665),
    };
    let base = FrameMotion::of_link_from_imu(&imu, pose);
    let (q, zero) = (
        vec![POSITION; robot.model.dof_count()],
        vec![0.0; robot.model.dof_count()],
    );
    let state = JointState {
        position: &q,
        velocity: &zero,
        acceleration: &zero,
    };
    let mut kinematics = Kinematics::new(&robot.model, robot.base_link).unwrap();
    kinematics.update(&robot.model, state, &base).unwrap();
    let mut dynamics = InverseDynamics::new(&robot.model);
    let external = ExternalWrench {
        frame: *frame,
        wrench,
    };
    dynamics
        .update(&robot.model, &kinematics, &[external])
        .unwrap();
    let cut = &robot.structure.sensors()[0];
    let reading = cut.reading(&dynamics.transmitted(&kinematics, cut.joint())) + robot.offsets[0].0;
    Reading::Wrench(ForceTorque {
        force: reading.force.into(),
        torque: reading.torque.into(),
    })
}

/// A push on the forearm: where, along what, and how strong \[N\].
#[derive(Clone, Copy)]
struct Push {
    at: Vec3,
    along: Vec3,
    force: f64,
}

impl Push {
    /// Between taxels of the second triangle, into the skin.
    fn into_the_skin(force: f64) -> Self {
        let Taxel { position, normal } = taxels().0[13].unwrap();
        let at = position + Vec3::new(0.001, 0.002, 0.0);
        Self {
            at,
            along: -normal,
            force,
        }
    }

    fn wrench(&self) -> Wrench {
        let force = self.along * self.force;
        Wrench {
            torque: self.at.cross(&force),
            force,
        }
    }

    /// What the skin reads, less the noise: 10 counts per newton under the middle, at least 10.
    fn skin(&self, triangle: u32, is_on: bool) -> Skin {
        let mut values = [f64::NAN; 12];
        let map = taxels().0;
        for (value, taxel) in values.iter_mut().zip(&map[12 * triangle as usize..]) {
            if let Some(taxel) = taxel {
                let away = (taxel.position - self.at).norm() / PITCH;
                let pressure = (10.0 * self.force).max(10.0) * (-0.5 * away * away).exp();
                *value = if is_on { pressure.round() } else { 0.0 };
            }
        }
        Skin {
            triangle,
            taxels: values,
        }
    }
}

/// A sample: channel, stamp, reading.
type Event = (usize, Nanos, Reading);

/// Two and a half seconds: all channels every 10 ms, the skin every 20 ms with the noise of one
/// count; the push from [`PUSH`] on. The skin is silent from `silent` \[ms\] on.
fn events(setup: &Setup, push: &Push, silent: i64) -> Vec<Event> {
    let frame = setup.robot.model.frame("l_forearm").unwrap();
    let untouched = force_torque(setup, &frame, Wrench::zero());
    let touched = force_torque(setup, &frame, push.wrench());
    let skin = setup.channel(Kind::Skin, "l_forearm_skin");
    let mut events = Vec::new();
    for ms in (0..2500).step_by(10) {
        let (t, is_on) = (Nanos::from_millis(ms), ms >= PUSH);
        for (number, channel) in setup.robot.channels.iter().enumerate() {
            let reading = match channel.kind {
                Kind::Wrench if is_on => touched,
                Kind::Wrench => untouched,
                Kind::Imu => Reading::Imu(Imu {
                    proper_acceleration: [0.0, 0.0, 9.80665],
                    angular_velocity: [0.0; 3],
                    angular_acceleration: [0.0; 3],
                    ..Imu::ABSENT
                }),
                _ => Reading::Joint(Encoder {
                    position: POSITION,
                    velocity: 0.0,
                    acceleration: 0.0,
                    ..Encoder::ABSENT
                }),
            };
            events.push((number, t, reading));
        }
        let Some(skin) = skin.filter(|_| ms % 20 == 10 && ms < silent) else {
            continue;
        };
        for triangle in 0..16_u32 {
            let mut reading = push.skin(triangle, is_on);
            // One count more or less, here and there.
            for (k, value) in reading.taxels.iter_mut().enumerate() {
                let mixed = (ms as usize / 20 * 7 + k * 13 + triangle as usize * 5) % 11;
                *value += match mixed {
                    0 | 1 => 1.0,
                    2 | 3 => -1.0,
                    _ => 0.0,
                };
            }
            // The board sends one triangle after the other.
            let stamp = t + Nanos(i64::from(triangle) * 130_000);
            events.push((skin, stamp, Reading::Skin(reading)));
        }
    }
    events.sort_by_key(|(_, t, _)| *t);
    events
}

/// The estimates of events in this order; `each` is called before each event.
fn run_with(
    setup: Setup,
    events: &[Event],
    mut each: impl FnMut(&mut Pipeline, Nanos),
) -> (Vec<Estimate>, Pipeline) {
    let mut pipeline = Pipeline::new(setup);
    let mut estimates = Vec::new();
    for (channel, t, reading) in events {
        each(&mut pipeline, *t);
        pipeline.push(*channel, *t, reading, Quality::GOOD);
        while let Some(estimate) = pipeline.poll() {
            estimates.push(estimate.clone());
        }
    }
    pipeline.finish();
    while let Some(estimate) = pipeline.poll() {
        estimates.push(estimate.clone());
    }
    (estimates, pipeline)
}

fn run(setup: Setup, events: &[Event]) -> Vec<Estimate> {
    run_with(setup, events, |_, _| {}).0
}

fn at(estimates: &[Estimate], ms: i64) -> &Estimate {
    let found = estimates.iter().find(|e| e.t == Nanos::from_millis(ms));
    found.expect("an estimate")
}

#[test]
fn a_touch_says_where_a_contact_is() {
    for (kind, force) in [
        (ContactModel::Force, 8.0),
        (ContactModel::ForceAlong, 8.0),
        (ContactModel::Wrench, 8.0),
        // So strong that 3 mm are a moment far above the noise: it still explains the readings.
        (ContactModel::Force, 60.0),
        // Too weak for the F/T sensor to show it, where masses are known to 20 %.
        (ContactModel::Force, 0.1),
    ] {
        let (mut config, push) = (config(kind), Push::into_the_skin(force));
        if force < 1.0 {
            config.identification.urdf_relative_std = 0.2;
        }
        let setup = setup(&config);
        let forearm = setup.robot.contact("forearm").unwrap();
        let all = events(&setup, &push, i64::MAX);
        let estimates = run(setup.clone(), &all);
        let before = &at(&estimates, PUSH - 10).contacts.contacts()[forearm];
        assert_eq!(
            (before.reason, before.located),
            (Reason::Absent.in_memory(), 0)
        );
        assert_eq!(before.position, [0.0; 3]);
        let estimate = at(&estimates, 2000);
        let joints = estimate.torques.joints();
        assert!(joints.iter().all(|j| j.valid == 1), "{kind:?} {joints:?}");
        let touched = &estimate.contacts.contacts()[forearm];
        assert_eq!(
            (touched.valid, touched.located, touched.detected),
            (1, 1, 0),
            "{touched:?}"
        );
        let away = (Vec3::from(touched.position) - push.at).norm();
        assert!(away < PITCH, "{kind:?}: {away} m");
        // The wrench is the one of the push, within what is stated.
        let truth = push.wrench().force_first();
        let found = touched.force.iter().chain(&touched.torque);
        let mut largest = 0.0_f64;
        for ((found, truth), std) in found.zip(truth).zip(touched.standard_deviation) {
            assert!(
                std > 0.0 && (found - truth).abs() < 3.0 * std,
                "{found} {truth} {std}"
            );
            largest = largest.max((found - truth).abs() / std);
        }
        // And what is stated is not idle: a strong push is known to a tenth. (Not along the normal
        // alone, from which friction may turn it.)
        let std = touched.standard_deviation[..3]
            .iter()
            .fold(0.0_f64, |a, b| a.max(*b));
        let is_sharp = force < 5.0 || kind == ContactModel::ForceAlong || std < 0.1 * force;
        assert!(is_sharp, "{kind:?}: {std} N");
        eprintln!(
            "{kind:?}, {force} N: {:.1} mm away, deviations up to {largest:.1} of the stated, \
             {std:.2} N",
            1e3 * away
        );
        // Without the skin a weak touch is not seen at all. A strong one is, but a force at the
        // configured place does not explain it: it is taken for one on the hand, or for none.
        let mut without = config.clone();
        without.skin.clear();
        let none = self::setup(&without);
        let of_robot = |event: &&Event| event.0 < none.robot.channels.len();
        let only: Vec<Event> = all.iter().filter(of_robot).copied().collect();
        let blind = run(none.clone(), &only);
        let estimate = at(&blind, 2000);
        let (seen, elbow) = (
            &estimate.contacts.contacts()[forearm],
            &estimate.torques.joints()[3],
        );
        assert_eq!(seen.located, 0);
        match force < 1.0 {
            true => assert_eq!((seen.valid, elbow.valid), (0, 1), "{seen:?} {elbow:?}"),
            false => {
                let hand = none.robot.contact("hand").unwrap();
                let hand = estimate.contacts.contacts()[hand].detected == 1;
                let is_unexplained = elbow.reason == Reason::Unexplained.in_memory();
                assert!(seen.detected == 0 && (hand || is_unexplained), "{seen:?}");
            }
        }
    }
}

/// The estimates depend on the stamps alone: not on when the skin's samples arrive.
#[test]
fn a_replay_with_a_skin_gives_the_live_estimates() {
    let setup = setup(&config(ContactModel::ForceAlong));
    let push = Push::into_the_skin(5.0);
    let mut late = events(&setup, &push, i64::MAX);
    let expected = run(setup.clone(), &late);
    let skin = setup.robot.channels.len();
    late.sort_by_key(|(channel, t, _)| {
        *t + Nanos::from_millis(if *channel == skin { 9 } else { 0 })
    });
    let (arrived, pipeline) = run_with(setup.clone(), &late, |_, _| {});
    assert_eq!(bits(&arrived), bits(&expected));
    assert_eq!(pipeline.counts().late, 0);
    // Half of the wait is the limit.
    late.sort_by_key(|(channel, t, _)| {
        *t + Nanos::from_millis(if *channel == skin { 25 } else { 0 })
    });
    assert!(run_with(setup, &late, |_, _| {}).1.counts().late > 0);
}

/// All numbers of all estimates.
fn bits(estimates: &[Estimate]) -> Vec<Vec<u64>> {
    let bits = |estimate: &Estimate| {
        let contacts = estimate.contacts.contacts().iter().flat_map(|c| {
            let numbers = c
                .force
                .into_iter()
                .chain(c.torque)
                .chain(c.standard_deviation);
            let numbers = numbers.chain(c.position).map(f64::to_bits);
            numbers.chain([
                c.valid.into(),
                c.located.into(),
                c.detected.into(),
                c.cause.into(),
            ])
        });
        let joints = estimate.torques.joints().iter();
        let joints = joints.flat_map(|j| {
            [
                j.torque.to_bits(),
                j.standard_deviation.to_bits(),
                j.valid.into(),
                j.cause.into(),
            ]
        });
        contacts.chain(joints).collect()
    };
    estimates.iter().map(bits).collect()
}

/// A recording holds all that the estimates rest on: the table of samples, skins and declared
/// places gives them to the bit.
#[test]
fn a_table_gives_the_live_estimates() {
    let setup = setup(&config(ContactModel::ForceAlong));
    let push = Push::into_the_skin(5.0);
    let all = events(&setup, &push, 2000);
    let hand = setup.robot.contact("hand").unwrap();
    // A contact of the hand that moves, declared every 7 ms for a while.
    let declared = |ms: i64| ContactState {
        active: ms < 2200,
        position: [0.01, 1e-5 * ms as f64, -0.02],
        position_std: if ms % 2 == 0 { 0.003 } else { f64::NAN },
        direction: [f64::NAN; 3],
    };
    let mut series: Vec<Series> = setup
        .channels()
        .map(|(kind, name)| Series {
            kind: SeriesKind::Channel(kind),
            name: name.into(),
        })
        .collect();
    series.push(Series {
        kind: SeriesKind::Contact,
        name: "hand".into(),
    });
    let mut table = TableWriter::new(Vec::new(), &series, Columns::All).unwrap();
    let mut next = 1900;
    let (live, _) = run_with(setup.clone(), &all, |pipeline, t| {
        while Nanos::from_millis(next) <= t && next < 2300 {
            let (stamp, state) = (Nanos::from_millis(next), declared(next));
            pipeline.declare(hand, stamp, &state);
            next += 7;
        }
    });
    let mut next = 1900;
    for (channel, t, reading) in &all {
        while Nanos::from_millis(next) <= *t && next < 2300 {
            let value = Value::Contact(declared(next));
            table
                .push(Some(Nanos::from_millis(next)), series.len() - 1, &value)
                .unwrap();
            next += 7;
        }
        let value = Value::Reading(*reading, Quality::GOOD);
        table.push(Some(*t), *channel, &value).unwrap();
    }
    let text = table.finish().unwrap();
    let mut out = Vec::new();
    let report = offline::estimate(setup.clone(), text.as_slice(), &mut out, None).unwrap();
    assert_eq!((report.log.bad_rows, report.unused_channels.len()), (0, 0));
    let mut table = offline::EstimateTable::new(Vec::new(), &setup).unwrap();
    for estimate in &live {
        table.write(estimate, None, true).unwrap();
    }
    let table = table.into_inner();
    assert!(table.len() > 10_000 && table == out, "the tables differ");
    // The hand's place is in it, and moves.
    let place = |ms: i64| at(&live, ms).contacts.contacts()[hand].position[1];
    assert!(
        place(2150) > place(2000) && place(2000) > 0.0199,
        "{} {}",
        place(2000),
        place(2150)
    );
    assert_eq!(place(2210), 0.0, "absent: where it is configured");
}

/// A declared place is as good as a configured one.
#[test]
fn a_declared_place_is_as_good_as_a_configured_one() {
    let (place, along) = ([0.01, -0.06, 0.02], [0.3, 0.1, -1.0]);
    let base = |at: [f64; 3], direction: [f64; 3]| {
        let mut config = config(ContactModel::ForceAlong);
        let forearm = config.contact.last_mut().unwrap();
        (forearm.position_m, forearm.direction) = (at, Some(direction));
        config
    };
    let (near, far) = (
        setup(&base(place, along)),
        setup(&base([0.0; 3], [0.0, 0.0, 1.0])),
    );
    let push = Push {
        at: Vec3::from(place),
        along: Vec3::from(along).normalize(),
        force: 6.0,
    };
    let all: Vec<Event> = events(&near, &push, 0);
    let forearm = near.robot.contact("forearm").unwrap();
    let declare = |state: ContactState| {
        move |pipeline: &mut Pipeline, t: Nanos| {
            if t == Nanos::ZERO {
                pipeline.declare(forearm, t, &state);
            }
        }
    };
    let placed = ContactState {
        position: place,
        direction: along,
        ..ContactState::configured(true)
    };
    let (expected, _) = run_with(near.clone(), &all, declare(ContactState::configured(true)));
    let (found, _) = run_with(far.clone(), &all, declare(placed));
    for (a, b) in expected.iter().zip(&found) {
        assert_eq!(a.torques.joints(), b.torques.joints());
        let (a, b) = (
            a.contacts.contacts()[forearm],
            b.contacts.contacts()[forearm],
        );
        assert_eq!((a.force, a.torque, a.valid), (b.force, b.torque, b.valid));
        assert_eq!(a.standard_deviation, b.standard_deviation);
        assert_eq!((a.position, a.located, b.located), (b.position, 0, 1));
    }
    // What is not known so well is stated so.
    let uncertain = ContactState {
        position_std: 0.01,
        ..placed
    };
    let (less, _) = run_with(far.clone(), &all, declare(uncertain));
    let std = |e: &[Estimate]| at(e, 2000).contacts.contacts()[forearm].standard_deviation[5];
    assert!(
        std(&less) > 1.5 * std(&found),
        "{} {}",
        std(&less),
        std(&found)
    );
    // A wrong place does not explain the readings, unless it is said to be uncertain.
    let beside = ContactState {
        position: [0.01, -0.01, 0.02],
        ..placed
    };
    let hand = far.robot.contact("hand").unwrap();
    let needed = [f64::NAN, 0.05].map(|position_std| {
        let state = ContactState {
            position_std,
            ..beside
        };
        let (found, _) = run_with(far.clone(), &all, declare(state));
        // Another contact must then be there, too, and which does what is not determined.
        let contacts = at(&found, 2000).contacts.contacts().to_vec();
        (contacts[hand].detected, contacts[forearm].valid)
    });
    assert_eq!(needed, [(1, 0), (0, 1)]);
    // After a jump, within a tenth of a second, the deviations are those of the new place. Nothing
    // pushes, so that no place is a wrong one.
    let other = ContactState {
        position: [-0.05, -0.1, 0.0],
        ..placed
    };
    let calm = events(&near, &Push { force: 0.0, ..push }, 0);
    let (jumped, _) = run_with(far.clone(), &calm, |pipeline, t| {
        let is_before = t < Nanos::from_millis(2040);
        pipeline.declare(forearm, t, if is_before { &placed } else { &other });
    });
    let [here, there] = [placed, other].map(|state| run_with(far.clone(), &calm, declare(state)).0);
    let stds = |e: &[Estimate]| at(e, 2050).contacts.contacts()[forearm].standard_deviation;
    assert_ne!(stds(&here), stds(&there));
    assert_eq!(stds(&jumped), stds(&there));
    // A place that makes no sense is ignored and counted.
    for wrong in [
        ContactState {
            position: [0.0, f64::INFINITY, 0.0],
            ..placed
        },
        ContactState {
            position: [0.0, f64::NAN, 0.0],
            ..placed
        },
        ContactState {
            direction: [0.0; 3],
            ..placed
        },
        ContactState {
            position_std: -1.0,
            ..placed
        },
    ] {
        let (found, pipeline) = run_with(far.clone(), &all, declare(wrong));
        let contact = &at(&found, 2000).contacts.contacts()[forearm];
        assert_eq!(
            (contact.located, pipeline.counts().not_finite),
            (0, all_zero(&all)),
            "{wrong:?}"
        );
    }
}

/// How many events have stamp 0: one declaration for each.
fn all_zero(events: &[Event]) -> u64 {
    events.iter().filter(|(_, t, _)| *t == Nanos::ZERO).count() as u64
}

/// A skin that falls silent while it is touched: nobody knows whether the contact is still there.
/// Untouched, nothing is lost.
#[test]
fn a_touch_that_is_lost_withholds_what_depends_on_it() {
    let mut config = config(ContactModel::Force);
    config.identification.urdf_relative_std = 0.2;
    // It could be taken for a contact of the hand.
    config.contact.retain(|contact| contact.name() != "hand");
    let setup = setup(&config);
    let (elbow, wrist) = (3, 6);
    let names: Vec<&str> = setup.robot.joint_names().collect();
    assert_eq!((names[elbow], names[wrist]), ("l_elbow", "l_wrist_yaw"));
    let forearm = setup.robot.contact("forearm").unwrap();
    let skin = u32::try_from(setup.channel(Kind::Skin, "l_forearm_skin").unwrap()).unwrap();
    // Too weak for the F/T sensor to show it, where masses are known to 20 %.
    let weak = Push::into_the_skin(0.1);
    let estimates = run(setup.clone(), &events(&setup, &weak, 1800));
    let joint = |ms: i64, dof: usize| at(&estimates, ms).torques.joints()[dof];
    assert!(
        at(&estimates, 2000)
            .torques
            .joints()
            .iter()
            .all(|j| j.valid == 1)
    );
    // The last reading is from 1790; half of the wait is 10 ms.
    let lost = joint(2100, elbow);
    assert_eq!(
        (lost.valid, lost.reason, lost.cause),
        (0, Reason::Stale.in_memory(), skin)
    );
    assert_eq!(joint(2100, wrist).valid, 1, "no contact is near");
    let contact = &at(&estimates, 2100).contacts.contacts()[forearm];
    assert_eq!(
        (contact.reason, contact.located),
        (Reason::Absent.in_memory(), 0)
    );
    // Declared absent, somebody knows.
    let (told, _) = run_with(
        setup.clone(),
        &events(&setup, &weak, 1800),
        |pipeline, t| {
            if t == Nanos::from_millis(2050) {
                pipeline.declare(forearm, t, &ContactState::configured(false));
            }
        },
    );
    assert_eq!(at(&told, 2100).torques.joints()[elbow].valid, 1);
    // Silent before anything touched it.
    let estimates = run(setup.clone(), &events(&setup, &weak, 1400));
    assert!(
        at(&estimates, 2400)
            .torques
            .joints()
            .iter()
            .all(|j| j.valid == 1)
    );
    // Never heard.
    let estimates = run(setup.clone(), &events(&setup, &weak, 0));
    assert!(
        at(&estimates, 2400)
            .torques
            .joints()
            .iter()
            .all(|j| j.valid == 1)
    );
    // A contact that the F/T sensor shows is known to be there.
    let strong = Push {
        at: Vec3::zeros(),
        ..Push::into_the_skin(60.0)
    };
    let mut all = events(&setup, &Push::into_the_skin(60.0), 1800);
    let there = events(&setup, &strong, 0);
    let ft: Vec<&Event> = there
        .iter()
        .filter(|e| matches!(e.2, Reading::Wrench(_)))
        .collect();
    let mut next = ft.into_iter();
    for event in all.iter_mut().filter(|e| matches!(e.2, Reading::Wrench(_))) {
        *event = *next.next().unwrap();
    }
    let estimates = run(setup, &all);
    let contact = &at(&estimates, 2300).contacts.contacts()[forearm];
    assert_eq!((contact.detected, contact.valid), (1, 1), "{contact:?}");
    assert_eq!(at(&estimates, 2300).torques.joints()[elbow].valid, 1);
}

#[test]
fn each_mistake_about_a_skin_has_one_clear_message() {
    let problem = |change: &dyn Fn(&mut Config)| {
        let mut config = config(ContactModel::Force);
        change(&mut config);
        Setup::new(&config).map(|_| ()).unwrap_err()
    };
    type Change<'a> = &'a dyn Fn(&mut Config);
    let cases: [(Change<'_>, &str); 8] = [
        (
            &|c| c.skin[0].link = "l_forarm".into(),
            "skin \"l_forearm_skin\": link: \"l_forarm\" is not a link of the URDF; did you mean \
             \"l_forearm\"?",
        ),
        (
            &|c| c.skin[0].contact = "foream".into(),
            "contact = \"foream\" is not a contact; did you mean \"forearm\"?",
        ),
        (
            &|c| c.skin[0].contact = "hand".into(),
            "contact \"hand\" is on the link \"l_hand\", the skin on \"l_forearm\"",
        ),
        (
            &|c| {
                let again = c.skin[0].clone();
                c.skin.push(again);
            },
            "two skins have this channel",
        ),
        (
            &|c| c.skin[0].channel = "l_elbow".into(),
            "\"l_elbow\" names a joint channel and a skin channel",
        ),
        (&|c| c.skin[0].first_taxel = 192, "first_taxel = 192: "),
        (
            &|c| c.skin[0].taxels = "none.txt".into(),
            "skin \"l_forearm_skin\": taxels: none.txt: cannot be read",
        ),
        (
            &|c| std::fs::write(&c.skin[0].taxels, "1 2 3 0 0 1\n1 2\n").unwrap(),
            "line 2 is \"1 2\": six numbers are needed",
        ),
    ];
    for (change, told) in cases {
        let problem = problem(change);
        assert!(problem.contains(told), "{problem}");
    }
    // Millimetres.
    let mut config = config(ContactModel::Force);
    std::fs::write(&config.skin[0].taxels, "-31 -75 8 0 0 1\n").unwrap();
    assert!(
        setup(&config)
            .warnings()
            .iter()
            .any(|w| w.contains("in metres"))
    );
    config.skin[0].channel = "forearm_skin".into();
    // The channel of a log: told with the most similar one.
    let log = "t,skin/forearm_skn/triangle,skin/forearm_skn/p0\n0,0,1\n";
    let columns = |setup: &Setup| {
        let mut text = String::from("t");
        for (kind, name) in setup.channels().filter(|(kind, _)| *kind != Kind::Skin) {
            let fields = match kind {
                Kind::Joint => "position",
                Kind::Wrench => "fx",
                _ => "ax",
            };
            text += &format!(",{}/{name}/{fields}", kind.word());
        }
        text + log.split_once('\n').unwrap().0.trim_start_matches('t') + "\n"
    };
    let setup = setup(&config);
    let text = columns(&setup);
    let error = offline::estimate(setup, text.as_bytes(), Vec::new(), None).unwrap_err();
    let error = error.to_string();
    assert!(
        error.contains("skin/forearm_skin; did you mean \"forearm_skn\"?"),
        "{error}"
    );
}

/// Taxels that are given in another frame of the link are where they are in the contact's.
#[test]
fn taxels_are_placed_in_the_frame_of_their_contact() {
    let mut config = config(ContactModel::Force);
    (config.skin[0].link, config.skin[0].contact) = ("l_hand_palm".into(), "hand".into());
    let setup = setup(&config);
    let palm = setup.robot.model.frame("l_hand_palm").unwrap().pose;
    let hand = setup.robot.model.frame("l_hand").unwrap().pose;
    assert!((palm.translation - hand.translation).norm() > 0.01);
    let (own, given) = (setup.skins[0].taxels[13].unwrap(), taxels().0[13].unwrap());
    let gap = hand.point(&own.position) - palm.point(&given.position);
    let turn = hand.rotation * own.normal - palm.rotation * given.normal;
    assert!(gap.norm() < 1e-12 && turn.norm() < 1e-12, "{gap} {turn}");
}

/// A plan that says what is read of the skin.
#[test]
fn the_plan_states_what_a_skin_shows() {
    let setup = setup(&config(ContactModel::Force));
    let plan = setup.to_string();
    // 6 mm / sqrt(12); 3.65 standard deviations of 1 count.
    let line = "reads skin l_forearm_skin: 160 taxels, pressed above 3.6; touches of forearm \
                within 1.7 mm";
    assert!(plan.contains(line), "{plan}");
    let description = setup.description();
    let index = description
        .index(proprio_topics::Role::Channel, "l_forearm_skin")
        .unwrap();
    assert_eq!(index as usize, setup.robot.channels.len());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    /// Whatever skins and declarations say, nothing panics, and what is valid is a number.
    #[test]
    fn any_touch_and_any_declaration_give_estimates(
        numbers in prop::collection::vec(any::<[f64; 12]>(), 40),
        states in prop::collection::vec((any::<bool>(), any::<[f64; 7]>()), 20),
        along in any::<bool>(),
    ) {
        let kind = if along { ContactModel::ForceAlong } else { ContactModel::Force };
        let setup = setup(&config(kind));
        let forearm = setup.robot.contact("forearm").unwrap();
        let push = Push::into_the_skin(5.0);
        let mut all = events(&setup, &push, i64::MAX);
        all.retain(|(_, t, _)| *t >= Nanos::from_millis(1300) && *t < Nanos::from_millis(1700));
        let mut next = numbers.iter().cycle();
        for (_, _, reading) in &mut all {
            if let Reading::Skin(skin) = reading && skin.triangle % 3 == 0 {
                skin.taxels = *next.next().unwrap();
            }
        }
        let mut states = states.iter();
        let (estimates, _) = run_with(setup, &all, |pipeline, t| {
            if t.0 % 20_000_000 == 0
                && let Some((active, [a, b, c, d, e, f, g])) = states.next() {
                pipeline.declare(forearm, t, &ContactState {
                    active: *active,
                    position: [*a, *b, *c],
                    position_std: *d,
                    direction: [*e, *f, *g],
                });
            }
        });
        prop_assert!(estimates.len() > 30);
        for estimate in &estimates {
            for contact in estimate.contacts.contacts().iter().filter(|c| c.valid == 1) {
                let numbers = contact.force.iter().chain(&contact.torque);
                prop_assert!(numbers.chain(&contact.standard_deviation).all(|x| x.is_finite()));
                prop_assert!(contact.position.iter().all(|x| x.is_finite()));
            }
            for joint in estimate.torques.joints().iter().filter(|j| j.valid == 1) {
                prop_assert!(joint.torque.is_finite() && joint.standard_deviation.is_finite());
            }
        }
    }
}
