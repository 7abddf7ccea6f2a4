//! The posture of a running robot, and what its sensors measure meanwhile, from shared memory.

use proprio_dynamics::spatial::{Vec3, Wrench};
use proprio_estimator::check::{Posture, PostureReadings};
use proprio_estimator::setup::Setup;
use proprio_identification::robot::ChannelRole;
use proprio_topics::Nanos;
use proprio_topics::ipc::{
    ChannelHandle, Domain, DomainConfig, Presence, RobotReader, Unavailable, monotonic,
};

/// How long all channels are waited for: a new reader gets descriptions within half a second.
const PATIENCE: Nanos = Nanos::from_millis(2000);
/// How long samples are averaged, and how often one is taken.
const WINDOW: Nanos = Nanos::from_millis(500);
const STEP: Nanos = Nanos::from_millis(5);

/// The posture of the robot that runs in this domain; none if its gateway does not run.
///
/// # Errors
/// A text: the gateway runs, but a channel cannot be read.
pub(crate) fn posture(setup: &Setup, domain: &DomainConfig) -> Result<Option<Posture>, String> {
    let Ok(open) = Domain::open_existing(domain) else {
        return Ok(None);
    };
    let mut robots = open.robots().into_iter();
    let runs = robots
        .any(|robot| robot.name == setup.robot.name && matches!(robot.gateway, Presence::Running));
    if !runs {
        return Ok(None);
    }
    let reader = RobotReader::new(domain, &setup.robot.name, PATIENCE);
    let mut reader = reader.map_err(|error| error.to_string())?;
    let channels: Vec<(ChannelRole, &str, ChannelHandle)> = (setup.robot.channels.iter())
        .map(|channel| {
            let handle = reader.channel_handle(channel.kind, &channel.name);
            (channel.role, channel.name.as_str(), handle)
        })
        .collect();
    let begin = monotonic();
    let mut sums = vec![[0.0; 6]; channels.len()];
    // The first positions, and the largest departure from them.
    let (mut first, mut moved) = (None, 0.0_f64);
    let (mut count, mut now) = (0.0, begin);
    let mut until = begin + PATIENCE;
    while now < until {
        let _ = reader.wait_for_sample(now + STEP);
        now = monotonic();
        reader.update(now);
        let all: Result<Vec<[f64; 6]>, String> = (channels.iter())
            .map(|(role, name, handle)| {
                values(&reader, *role, *handle).map_err(|why| format!("{name}: {why}"))
            })
            .collect();
        match all {
            Ok(all) => {
                if count == 0.0 {
                    until = now + WINDOW;
                }
                count += 1.0;
                let start = first.get_or_insert_with(|| all.clone());
                for (((role, ..), now), start) in channels.iter().zip(&all).zip(start) {
                    if let ChannelRole::Joint(_) = role {
                        moved = moved.max((now[0] - start[0]).abs());
                    }
                }
                for (sum, values) in sums.iter_mut().zip(all) {
                    sum.iter_mut()
                        .zip(values)
                        .for_each(|(sum, value)| *sum += value);
                }
            }
            // The channels of the gateway are not all there yet.
            Err(_) if now < until => {}
            Err(why) => return Err(why),
        }
    }
    let mut position = vec![f64::NAN; setup.robot.model.dof_count()];
    let mut measured = PostureReadings {
        wrenches: vec![Wrench::zero(); setup.robot.structure.sensors().len()],
        proper_acceleration: None,
        moved,
    };
    for ((role, ..), sum) in channels.iter().zip(&sums) {
        let [a, b, c, d, e, f] = sum.map(|sum| sum / count);
        match role {
            ChannelRole::Joint(dof) => {
                if let Some(place) = position.get_mut(*dof) {
                    *place = a;
                }
            }
            ChannelRole::Sensor(sensor) => {
                if let Some(place) = measured.wrenches.get_mut(*sensor) {
                    *place = Wrench::from_parts([a, b, c], [d, e, f]);
                }
            }
            ChannelRole::Base => measured.proper_acceleration = Some(Vec3::new(a, b, c)),
        }
    }
    Ok(Some(Posture::measured(position, measured)))
}

/// The numbers of a channel that the posture needs.
fn values(
    reader: &RobotReader,
    role: ChannelRole,
    handle: ChannelHandle,
) -> Result<[f64; 6], Unavailable> {
    Ok(match role {
        ChannelRole::Joint(_) => [
            reader.joint(handle)?.value.position,
            0.0,
            0.0,
            0.0,
            0.0,
            0.0,
        ],
        ChannelRole::Sensor(_) => {
            let wrench = reader.wrench(handle)?.value;
            let ([a, b, c], [d, e, f]) = (wrench.force, wrench.torque);
            [a, b, c, d, e, f]
        }
        ChannelRole::Base => {
            let [a, b, c] = reader.imu(handle)?.value.proper_acceleration;
            [a, b, c, 0.0, 0.0, 0.0]
        }
    })
}
