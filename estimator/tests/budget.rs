//! The budget of a torque: its parts sum to the square of its deviation, and each is what an error
//! of that input as large as its deviation does to the torque.

use proprio_estimator::config::Config;
use proprio_estimator::differentiate::Window;
use proprio_estimator::pipeline::Pipeline;
use proprio_estimator::setup::Setup;
use proprio_identification::prior::link_cad_root;
use proprio_topics::csv::{Row, SeriesKind, TableReader, Value};
use proprio_topics::{Nanos, Reading, Source, TorqueBudget};
use std::cell::{Cell, RefCell};
use std::path::Path;

/// The standard deviations of the F/T offsets \[N, Nm\].
const OFFSET: [f64; 2] = [0.7, 0.03];

/// The arm of the golden log.
fn setup() -> Setup {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let mut config = Config::load(&root.join("config/icub_left_arm/estimator.toml")).unwrap();
    for ft in &mut config.force_torque {
        (ft.offset_n, ft.offset_nm) = (Some([0.0; 3]), Some([0.0; 3]));
        (ft.offset_std_n, ft.offset_std_nm) = (Some([OFFSET[0]; 3]), Some([OFFSET[1]; 3]));
    }
    config.output.max_wait_ms = Some(1.0);
    config.input.max_silence_ms = 4e3 * STEP;
    Setup::new(&config).unwrap()
}

/// Changes a reading of the channel of this name; true for the last one.
type Alter<'a> = &'a dyn Fn(&str, bool, &mut Reading);

/// What is changed about a run.
#[derive(Default)]
struct Change<'a> {
    setup: Option<&'a dyn Fn(&mut Setup)>,
    reading: Option<Alter<'a>>,
}

/// The torques of the golden log's last row, and the budgets of all joints.
fn last(change: &Change<'_>) -> (Vec<f64>, Vec<TorqueBudget>) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let log = root.join("tests/oracle/icub_left_arm_mujoco_contact.csv");
    let log = std::fs::read(log).unwrap();
    let mut setup = setup();
    if let Some(change) = change.setup {
        change(&mut setup);
    }
    let mut pipeline = Pipeline::new(setup);
    let mut reader = TableReader::new(&log[..]).unwrap();
    let (series, mut row, mut rows) = (reader.series().to_vec(), Row::default(), Vec::new());
    while reader.next_row(&mut row).unwrap() {
        rows.push(row.clone());
    }
    for (number, row) in rows.iter().enumerate() {
        for item in &row.items {
            let series = &series[item.series];
            let (SeriesKind::Channel(kind), Value::Reading(mut reading, quality)) =
                (series.kind, item.value)
            else {
                continue;
            };
            if let Some(change) = change.reading {
                change(&series.name, number + 1 == rows.len(), &mut reading);
            }
            if let Some(channel) = pipeline.setup().robot.channel(kind, &series.name) {
                pipeline.push(channel, row.t.unwrap(), &reading, quality);
            }
        }
        pipeline.poll();
    }
    pipeline.finish();
    while pipeline.poll().is_some() {}
    let budgets: Vec<TorqueBudget> = (0..7)
        .map(|joint| *pipeline.budget(joint).unwrap())
        .collect();
    assert!(pipeline.budget(7).is_none());
    (
        budgets.iter().map(|own| own.torque.torque).collect(),
        budgets,
    )
}

/// The sum over errors of the squares of the changes of each torque.
fn squares(errors: impl Iterator<Item = Vec<f64>>, stated: &[f64]) -> Vec<f64> {
    errors.fold(vec![0.0; stated.len()], |mut sums, torques| {
        let changes = torques.iter().zip(stated).map(|(now, before)| now - before);
        sums.iter_mut()
            .zip(changes)
            .for_each(|(sum, x)| *sum += x * x);
        sums
    })
}

fn share(budget: &TorqueBudget, source: Source, name: &str) -> f64 {
    let is_it =
        |part: &&proprio_topics::BudgetPart| part.source == source && part.name.as_str() == name;
    budget
        .parts()
        .iter()
        .find(is_it)
        .map_or(0.0, |part| part.variance)
}

/// Asserts that the budgets have these shares of an input, and that some matter.
fn assert_shares(budgets: &[TorqueBudget], source: Source, name: &str, wanted: &[f64]) {
    let mut largest: f64 = 0.0;
    for (budget, want) in budgets.iter().zip(wanted) {
        let (got, all) = (share(budget, source, name), budget.deviation.powi(2));
        assert!(
            (got - want).abs() < 0.02 * want + 1e-6 * all,
            "{source} {name} of joint {}: {got}, not {want} of {all}",
            budget.joint
        );
        largest = largest.max(want / all);
    }
    assert!(
        largest > 1e-4,
        "{source} {name} matters nowhere: {wanted:?}"
    );
}

#[test]
fn the_parts_sum_to_the_square_of_the_deviation() {
    let (_, budgets) = last(&Change::default());
    for budget in &budgets {
        let sum: f64 = budget.parts().iter().map(|part| part.variance).sum();
        let published = budget.torque.standard_deviation;
        assert!(
            budget.torque.valid == 1 && published == budget.deviation,
            "{budget:?}"
        );
        assert!(
            (sum / published.powi(2) - 1.0).abs() < 1e-3,
            "{sum} {published}"
        );
        let shares = budget.parts().iter().map(|part| part.variance.abs());
        assert!(shares.is_sorted_by(|a, b| a >= b));
    }
}

#[test]
fn each_part_is_what_an_error_of_its_input_does() {
    let (stated, budgets) = last(&Change::default());
    let with_reading = |change: Alter<'_>| {
        let change = Change {
            reading: Some(change),
            ..Change::default()
        };
        last(&change).0
    };
    let with_setup = |change: &dyn Fn(&mut Setup)| {
        let change = Change {
            setup: Some(change),
            ..Change::default()
        };
        last(&change).0
    };
    let setup = setup();
    let robot = &setup.robot;
    // An error of each channel of the F/T sensor: noise of the last reading, and an offset.
    let noise = robot.structure.sensors()[0].noise();
    let of_channel = |deviations: [f64; 6], is_last: bool| {
        let changed = (0..6).map(|channel| {
            with_reading(&|name, last, reading| {
                if let Reading::Wrench(wrench) = reading
                    && name == "l_arm_ft_sensor"
                    && (last || !is_last)
                {
                    let all = wrench.force.iter_mut().chain(&mut wrench.torque);
                    all.zip(deviations)
                        .enumerate()
                        .filter(|(number, _)| *number == channel)
                        .for_each(|(_, (value, std))| *value += std);
                }
            })
        });
        squares(changed, &stated)
    };
    let ([fx, fy, fz], [tx, ty, tz]) = (noise.force, noise.torque);
    let wanted = of_channel([fx, fy, fz, tx, ty, tz], true);
    assert_shares(&budgets, Source::Noise, "l_arm_ft_sensor", &wanted);
    let [force, torque] = OFFSET;
    let wanted = of_channel([force, force, force, torque, torque, torque], false);
    assert_shares(&budgets, Source::Offset, "l_arm_ft_sensor", &wanted);
    // The inertial parameters of links on both sides of the sensor.
    for link in ["l_upper_arm", "l_shoulder_2", "l_forearm"] {
        let number = (0..robot.model.link_count())
            .find(|number| robot.model.link_name(*number) == link)
            .unwrap();
        let root = link_cad_root(&robot.model.inertias()[number], robot.urdf_relative_std);
        let changed = (0..10).map(|row| {
            with_setup(&|setup| {
                let mut parameters = setup.initial.model.inertias()[number].parameters();
                for (column, parameter) in parameters.iter_mut().enumerate() {
                    *parameter += root[(row, column)];
                }
                let inertia = proprio_dynamics::spatial::RigidInertia::from_parameters(&parameters);
                setup.initial.model.set_inertia(number, inertia).unwrap();
            })
        });
        assert_shares(&budgets, Source::Link, link, &squares(changed, &stated));
    }
    // The zero of an encoder, of a third of a degree, and its noise.
    for joint in ["l_shoulder_roll", "l_shoulder_yaw"] {
        let changed = with_reading(&|name, _, reading| {
            if let Reading::Joint(state) = reading
                && name == joint
            {
                state.position += f64::hypot(0.005, 1.5e-4);
            }
        });
        let wanted = squares([changed].into_iter(), &stated);
        assert_shares(&budgets, Source::Position, joint, &wanted);
    }
    // The proper acceleration of the base.
    let changed = (0..3).map(|axis| {
        with_reading(&|_, _, reading| {
            if let Reading::Imu(imu) = reading {
                imu.proper_acceleration[axis] += 0.1;
            }
        })
    });
    assert_shares(&budgets, Source::Base, "", &squares(changed, &stated));
}

/// The time between two rows of the log \[s\].
const STEP: f64 = 0.05;

#[test]
fn an_acceleration_that_is_differentiated_has_the_share_of_its_error() {
    let setup = setup();
    // The elbow swings, unlike in the log; its last acceleration may be given.
    let swinging = |given: f64| {
        let (rows, window) = (
            Cell::new(0_i32),
            RefCell::new(Window::<1>::new(setup.joint_settings).unwrap()),
        );
        let change = |name: &str, is_last: bool, reading: &mut Reading| {
            if let (Reading::Joint(state), "l_elbow") = (reading, name) {
                let t = STEP * f64::from(rows.replace(rows.get() + 1));
                state.position = 0.8 + 0.4 * (9.0 * t).sin();
                state.velocity = 3.6 * (9.0 * t).cos();
                state.acceleration = if is_last { given } else { f64::NAN };
                let at = (Nanos::from_seconds(t), [state.position]);
                window.borrow_mut().push(at.0, at.1).unwrap();
            }
        };
        let change = Change {
            reading: Some(&change),
            ..Change::default()
        };
        let (torques, budgets) = last(&change);
        let now = window.borrow().newest().unwrap().0;
        let estimate = window.borrow().at_using(now, now).unwrap();
        (torques, budgets, estimate.second[0], estimate.second_std[0])
    };
    let (_, budgets, acceleration, std) = swinging(f64::NAN);
    assert!(std > 0.0);
    let changed = swinging(acceleration + std).0;
    let wanted = squares([changed].into_iter(), &swinging(acceleration).0);
    assert_shares(&budgets, Source::Acceleration, "l_elbow", &wanted);
}

#[test]
fn what_a_torque_rests_on_is_complete() {
    let (_, budgets) = last(&Change::default());
    let has = |joint: usize, source: Source, name: &str| {
        let mut parts = budgets[joint].parts().iter();
        parts.any(|part| part.source == source && part.name.as_str() == name)
    };
    let (shoulder, elbow) = (0, 3);
    assert!(
        has(elbow, Source::Link, "l_upper_arm"),
        "between sensor and joint"
    );
    assert!(
        !has(elbow, Source::Link, "l_hand"),
        "beyond, with what is on the hand"
    );
    assert!(
        !has(elbow, Source::Link, "l_shoulder_2"),
        "before the sensor"
    );
    assert!(!has(elbow, Source::Position, "l_wrist_pitch"));
    assert!(has(shoulder, Source::Link, "l_shoulder_2"));
    assert!(!has(shoulder, Source::Link, "chest"));
    // Each encoder has moved as far as the log says.
    let parts = budgets[shoulder].parts().iter();
    let travel = parts
        .filter(|part| part.source == Source::Position)
        .map(|part| part.travel);
    assert!(
        travel.clone().all(|travel| (0.05..1.0).contains(&travel)),
        "{:?}",
        Vec::from_iter(travel)
    );
}
