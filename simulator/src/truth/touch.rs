//! What touches the simulated robot: the push on its hand, the pushes of faults, and what the skins
//! feel of those.

use crate::fault::{InjectedFault, TimeWindow};
use crate::noise::Random;
use crate::robot::{SimulatedRobot, SimulatedRobotError};
use crate::settings::SimulationSettings;
use crate::trajectory::window;
use proprio_dynamics::ExternalWrench;
use proprio_dynamics::model::Frame;
use proprio_dynamics::spatial::{Vec3, Wrench};
use proprio_estimator::config::{ContactModel, ContactSite};
use proprio_estimator::skin::{TRIANGLE, TRIANGLES, Taxel, TaxelMap};
use proprio_topics::Skin;

/// The push on the hand: force \[N\] and torque \[Nm\].
pub(super) const PUSH: (f64, f64) = (10.0, 0.3);
/// Its start and end in a cycle, and the fraction of the push that each flank takes.
const PUSH_TIME: (f64, f64, f64) = (0.4, 0.6, 0.25);

/// Pressure of a taxel under the middle of a push \[counts per N\].
const COUNTS_PER_NEWTON: f64 = 5.0;
/// Width of a push on a skin, a standard deviation \[m\]: that of a finger tip.
const WIDTH: f64 = 0.006;

/// The beginning or end of a touch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TouchEvent {
    /// Time: seconds since the start of the simulation.
    pub t: f64,
    /// The contact's number in estimator.toml.
    pub contact: usize,
    /// Whether the touch begins.
    pub begins: bool,
}

/// The push on the hand, once in every cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlannedPush {
    /// The contact's number in estimator.toml.
    pub contact: usize,
    /// Its largest force \[N\] and torque about the contact's frame \[Nm\].
    pub force: f64,
    /// See `force`.
    pub torque: f64,
    /// Its begin and end in each cycle \[s\].
    pub from: f64,
    /// See `from`.
    pub until: f64,
    /// Duration of a cycle \[s\].
    pub cycle: f64,
}

/// The push on the hand.
#[derive(Debug, Clone, Copy)]
pub(super) struct Push {
    pub(super) contact: usize,
    pub(super) frame: Frame,
    /// The peak wrench, at the frame's origin.
    wrench: Wrench,
    cycle: f64,
}

impl Push {
    /// The push on contact number `contact`.
    pub(super) fn new(
        robot: &SimulatedRobot,
        contacts: &[(String, Frame)],
        contact: usize,
        settings: &SimulationSettings,
    ) -> Option<Self> {
        let (_, frame) = contacts.get(contact)?;
        Some(Self {
            contact,
            frame: *frame,
            wrench: push_wrench(robot.config.contact.get(contact)?, settings.seed),
            cycle: settings.cycle,
        })
    }

    /// Its wrench at `t`; zero at the beginning and end of each cycle.
    pub(super) fn at(&self, t: f64) -> Wrench {
        let (from, until, flank) = PUSH_TIME;
        let x = ((t / self.cycle).rem_euclid(1.0) - from) / (until - from);
        self.wrench * (window(x / flank).0 * window((1.0 - x) / flank).0)
    }

    /// The first beginning or end later than `t`.
    pub(super) fn next_touch(&self, t: f64) -> TouchEvent {
        let (from, until, _) = PUSH_TIME;
        let cycle = (t / self.cycle).floor();
        // The margin keeps rounding from finding the same one twice.
        let later = |x: &f64| *x > t + 1e-9 * self.cycle;
        let changes = [
            (cycle + from, true),
            (cycle + until, false),
            (cycle + 1.0 + from, true),
        ];
        let times = changes.map(|(x, begins)| (x * self.cycle, begins));
        let (t, begins) = times
            .into_iter()
            .find(|(x, _)| later(x))
            .unwrap_or((f64::INFINITY, false));
        TouchEvent {
            t,
            contact: self.contact,
            begins,
        }
    }

    pub(super) fn planned(&self) -> PlannedPush {
        let (from, until, _) = PUSH_TIME;
        PlannedPush {
            contact: self.contact,
            force: self.wrench.force.norm(),
            torque: self.wrench.torque.norm(),
            from: from * self.cycle,
            until: until * self.cycle,
            cycle: self.cycle,
        }
    }
}

/// A push that is possible for a contact of this kind, in a direction drawn from the seed.
fn push_wrench(contact: &ContactSite, seed: u64) -> Wrench {
    let mut random = Random::new(seed, "push", 0);
    let mut unit = || {
        let direction = Vec3::new(random.normal(), random.normal(), random.normal());
        direction.try_normalize(1e-9).unwrap_or_else(Vec3::x)
    };
    let (force, torque) = (unit() * PUSH.0, unit() * PUSH.1);
    let through = |force: Vec3| Wrench {
        force,
        torque: Vec3::from(contact.position_m).cross(&force),
    };
    match (contact.kind, contact.direction) {
        (ContactModel::Wrench, _) => Wrench { force, torque },
        (ContactModel::ForceAlong, Some(direction)) => through(
            Vec3::from(direction)
                .try_normalize(1e-9)
                .unwrap_or_else(Vec3::x)
                * PUSH.0,
        ),
        (ContactModel::Force | ContactModel::ForceAlong, _) => through(force),
    }
}

/// An undeclared push.
#[derive(Debug, Clone, Copy)]
pub(super) struct Poke {
    pub(super) external: ExternalWrench,
    /// Where it acts, in its link's axes.
    point: Vec3,
    pub(super) window: TimeWindow,
}

impl Poke {
    /// The pushes of faults.
    pub(super) fn of_faults(
        robot: &SimulatedRobot,
        faults: &[InjectedFault],
    ) -> Result<Vec<Self>, SimulatedRobotError> {
        let mut pokes = Vec::new();
        for fault in faults {
            let InjectedFault::Push {
                link,
                force,
                at,
                along,
                window,
            } = fault
            else {
                continue;
            };
            let frame = robot.model.frame(link);
            let frame = frame.ok_or_else(|| {
                robot.mismatch(format!("fault {fault}: {link:?} is not a link of the URDF"))
            })?;
            let point = Vec3::from(at.unwrap_or_default());
            let along = Vec3::from(along.unwrap_or([1.0, 0.0, 0.0]));
            let force = along.try_normalize(1e-9).unwrap_or_else(Vec3::x) * *force;
            let torque = point.cross(&force);
            pokes.push(Self {
                external: ExternalWrench {
                    frame,
                    wrench: Wrench { torque, force },
                },
                point: frame.pose.point(&point),
                window: *window,
            });
        }
        Ok(pokes)
    }
}

/// A skin: its taxels, in its link's axes.
#[derive(Debug, Clone)]
pub(super) struct SkinTruth {
    pub(super) name: String,
    link: usize,
    taxels: Vec<Option<Vec3>>,
}

impl SkinTruth {
    pub(super) fn of_robot(robot: &SimulatedRobot) -> Result<Vec<Self>, SimulatedRobotError> {
        let skins = robot.config.skin.iter().map(|skin| {
            let place = format!("skin {:?}", skin.channel);
            let frame = robot.frame(&place, &skin.link)?;
            let map = TaxelMap::load(&skin.taxels)
                .map_err(|e| robot.wrong_config(format!("{place}: {e}")))?;
            let taxels = map.0.iter().skip(skin.first_taxel);
            let point = |taxel: &Taxel| frame.pose.point(&taxel.position);
            Ok(Self {
                name: skin.channel.clone(),
                link: frame.link,
                taxels: (taxels.take(TRIANGLE * TRIANGLES))
                    .map(|taxel| taxel.as_ref().map(point))
                    .collect(),
            })
        });
        skins.collect()
    }

    /// The values of its taxels at `t` seconds, triangle by triangle; NaN where there is no taxel.
    pub(super) fn taxels(&self, pokes: &[Poke], t: f64) -> Vec<Skin> {
        let pushes = || {
            let present = pokes.iter().filter(|poke| poke.window.contains(t));
            present.filter(|poke| poke.external.frame.link == self.link)
        };
        let value = |place: &Vec3| -> f64 {
            let pressures = pushes().map(|poke| {
                let away = (place - poke.point).norm() / WIDTH;
                COUNTS_PER_NEWTON * poke.external.wrench.force.norm() * (-0.5 * away * away).exp()
            });
            pressures.sum()
        };
        let triangles = self.taxels.chunks(TRIANGLE).zip(0..);
        let triangles = triangles.filter(|(places, _)| places.iter().any(Option::is_some));
        triangles
            .map(|(places, triangle)| {
                let mut taxels = [f64::NAN; TRIANGLE];
                for (taxel, place) in taxels.iter_mut().zip(places) {
                    *taxel = place.as_ref().map_or(f64::NAN, value);
                }
                Skin { triangle, taxels }
            })
            .collect()
    }
}
