//! One sub-tree that can be free of contacts, and all hypotheses about it.

use crate::online::bank::evidence::{
    Branch, HypothesisPosterior, LASTING, SharedDesign, SubtreeUnknowns,
};
use crate::readings::{Hypothesis, MotionReading, WrenchReading, quarter_turns, wrench_readings};
use crate::robot::{BaseMotion, Robot, dofs_above, dofs_between};
use proprio_dynamics::ContactSet;
use proprio_dynamics::model::{JointKind, Model};
use proprio_dynamics::regressor::LINK_PARAMETERS;
use proprio_dynamics::spatial::Vec3;

/// Prior odds of a contact since the start.
pub(super) const CONTACT: f64 = 0.1;
/// Prior odds of each hypothesis about the setup. It takes evidence of 6.4 to need cover, and 16 to
/// be the likeliest. Errors of a model are not among the hypotheses, and look like them: those of a
/// real leg, with F/T errors of ten times the stated noise, are worth up to 8 for the likeliest
/// one.
const STRUCTURAL: f64 = 1e-7;
/// The same where something is estimated, which adapts to errors of a model: on that leg it gains
/// up to 6.9.
const ESTIMATED: f64 = 1e-8;
/// Odds below which a hypothesis needs no cover: it is no likelier than an error of more than four
/// deviations.
const UNLIKELY: f64 = 6.3e-5;
/// Evidence below which a hypothesis is refuted: one in ten thousand. That is how often at most a
/// true one is ever refuted, however long it is observed (Ville's inequality).
const REFUTED: f64 = 1e-4;
/// Force of a contact since the start that does not matter, as a share of the expected one.
const LITTLE: f64 = 0.1;
/// Share of the expected tilt, or error of an encoder, that is covered, where more is withheld:
/// floors and mountings are usually level to 0.1 rad, zeros and gears right to 0.07.
const USUAL: f64 = 1.0 / 3.0;

/// See the [module](self).
#[derive(Clone, Debug)]
pub(super) struct SubtreeHypotheses {
    pub(super) component: usize,
    pub(super) subtree: usize,
    pub(super) columns: SubtreeUnknowns,
    /// The first branch of the first one is that everything is as stated.
    pub(super) fits: Vec<SharedDesign>,
    at_start: Vec<SharedDesign>,
    /// The number of ticks from which on it is weighed again.
    weigh_from: usize,
    /// How much a tick counts: what exceeds the stated noise is a misfit, which lasts.
    share: f64,
}

impl SubtreeHypotheses {
    pub(super) fn new(
        component: usize,
        subtree: usize,
        columns: SubtreeUnknowns,
        at_start: Vec<SharedDesign>,
    ) -> Self {
        Self {
            component,
            subtree,
            columns,
            fits: at_start.clone(),
            at_start,
            weigh_from: 1,
            share: 1.0,
        }
    }

    /// Drops everything that was learnt.
    pub(super) fn begin_anew(&mut self) {
        self.fits.clone_from(&self.at_start);
        self.weigh_from = 1;
    }

    /// What is stated; with other offsets from now on; then with each contact that may begin now.
    pub(super) fn changes(&self) -> Vec<SharedDesign> {
        let contacts = self.at_start.iter().filter_map(|fit| fit.contact).map(Some);
        let continued = |contact| self.fits[0].continued(&self.columns, contact);
        let all = [None, None].into_iter().chain(contacts);
        let mut fits: Vec<SharedDesign> = all.map(continued).collect();
        fits[1].forget(&self.offsets());
        fits
    }

    /// The columns of the offsets.
    pub(super) fn offsets(&self) -> Vec<usize> {
        (LINK_PARAMETERS * self.columns.links.len()..self.columns.count()).collect()
    }

    /// Those of the links without children.
    pub(super) fn loads(&self, model: &Model) -> Vec<usize> {
        let has_child = |link: usize| model.joints().iter().any(|joint| joint.parent == link);
        let links = self.columns.links.iter().enumerate();
        links
            .filter(|(_, link)| !has_child(**link))
            .flat_map(|(place, _)| LINK_PARAMETERS * place..LINK_PARAMETERS * (place + 1))
            .collect()
    }

    /// Forgets these unknowns: they have other values from now on.
    pub(super) fn forget(&mut self, unknowns: &[usize]) {
        self.fits.iter_mut().for_each(|fit| fit.forget(unknowns));
        self.weigh_from = 0;
    }

    /// Brings the evidence of all hypotheses up to date, if a twentieth more is known than the last
    /// time, or [`LASTING`] ticks more.
    pub(super) fn weigh(&mut self) {
        let ticks = self.fits[0].ticks();
        if ticks < self.weigh_from {
            return;
        }
        self.weigh_from = ticks + (ticks / 20).clamp(1, LASTING as usize);
        let Self { columns, fits, .. } = self;
        fits.iter_mut().for_each(|fit| fit.weigh(columns));
        let of_all = fits.iter().flat_map(|fit| &fit.branches);
        let likeliest = of_all
            .filter(|branch| !branch.is_refuted)
            .max_by(|a, b| a.log_evidence.total_cmp(&b.log_evidence));
        let noise = likeliest.map_or(1.0, |branch| branch.noise);
        self.share = 1.0 / (1.0 + (LASTING - 1.0) * (1.0 - 1.0 / noise));
    }

    /// Of what is not refuted here, how much likelier the readings are if it is the case than as
    /// stated, with or without a contact.
    pub(super) fn evidence(&self) -> Vec<(MotionReading, WrenchReading, f64)> {
        let as_stated = (self.fits.iter())
            .filter(|fit| fit.motion_reading == MotionReading::AsStated)
            .map(|fit| fit.branches[0].log_evidence)
            .fold(f64::NEG_INFINITY, f64::max);
        let without_contact = self.fits.iter().filter(|fit| fit.contact.is_none());
        without_contact
            .flat_map(|fit| {
                let open = fit.branches.iter().filter(|branch| !branch.is_refuted);
                open.map(move |branch| {
                    let evidence = self.share * (branch.log_evidence - as_stated);
                    (fit.motion_reading, branch.wrench_reading, evidence)
                })
            })
            .collect()
    }

    /// Sets the odds, with the evidence of other sub-trees for what matters to them too, and drops
    /// what is refuted.
    pub(super) fn decide(&mut self, elsewhere: impl Fn(MotionReading, WrenchReading) -> f64) {
        let share = self.share;
        let mut best = f64::NEG_INFINITY;
        for fit in &mut self.fits {
            for branch in fit.branches.iter_mut().filter(|branch| !branch.is_refuted) {
                let other = match (fit.motion_reading, branch.wrench_reading) {
                    (MotionReading::AsStated, WrenchReading::AsStated) => 0.0,
                    (motion_reading, wrench_reading) => elsewhere(motion_reading, wrench_reading),
                };
                branch.log_odds = branch.log_prior + share * branch.log_evidence + other;
                best = best.max(branch.log_odds);
            }
        }
        for (number, fit) in self.fits.iter_mut().enumerate() {
            for (place, branch) in fit.branches.iter_mut().enumerate() {
                branch.log_odds -= best;
                // What is stated may become likely again.
                let is_refuted = branch.log_odds < branch.log_prior + REFUTED.ln();
                branch.is_refuted |= is_refuted && (number, place) != (0, 0);
            }
        }
        let mut number = 0;
        self.fits.retain(|fit| {
            number += 1;
            number == 1 || fit.branches.iter().any(|branch| !branch.is_refuted)
        });
    }

    /// The odds of what is stated, or differs from it by something harmless.
    fn stated(&self) -> f64 {
        let odds = |fit: &SharedDesign| fit.branches[0].log_odds;
        let own = odds(&self.fits[0]);
        let likelier = self.fits.iter().filter(|fit| odds(fit) > own);
        let harmless = likelier.filter(|fit| self.is_harmless(fit));
        harmless.map(odds).fold(own, f64::max)
    }

    /// Whether it is a contact with next to no force, a small tilt of the base, or a small error of
    /// an encoder.
    fn is_harmless(&self, fit: &SharedDesign) -> bool {
        match (fit.contact, fit.motion_reading.unknowns()) {
            (Some(_), _) => fit.extent(&self.columns) <= LITTLE,
            (None, 0) => false,
            (None, _) => fit.extent(&self.columns) <= USUAL,
        }
    }

    /// Whether another hypothesis is likelier than what is stated.
    pub(super) fn is_doubtful(&self) -> bool {
        self.stated() < 0.0
    }

    /// The likeliest hypothesis, with its estimate, if what is stated is refuted beside it.
    pub(super) fn leading(&self) -> Option<Hypothesis> {
        if self.stated() > UNLIKELY.ln() {
            return None;
        }
        let open = self.all().filter(|(_, _, branch)| !branch.is_refuted);
        let best = open.max_by(|a, b| a.2.log_odds.total_cmp(&b.2.log_odds));
        let (fit, number, _) = best?;
        Some(fit.posterior(&self.columns, number)?.hypothesis)
    }

    /// Whether everything is as stated, as far as is known.
    pub(super) fn is_settled(&self) -> bool {
        let is_open = |fit: &SharedDesign| {
            let mut structural = fit.branches.iter().filter(|branch| {
                fit.motion_reading != MotionReading::AsStated
                    || branch.wrench_reading != WrenchReading::AsStated
            });
            structural.any(Branch::needs_cover) && !self.is_harmless(fit)
        };
        !self.fits.iter().any(is_open) && !self.may_have_begun_in_contact()
    }

    /// Whether there may have been a contact since the start, with a force that matters. One with
    /// next to no force is never refuted, and does no harm.
    pub(super) fn may_have_begun_in_contact(&self) -> bool {
        let mut contacts = self.fits.iter().filter(|fit| fit.contact.is_some());
        contacts.any(|fit| !self.is_harmless(fit))
    }

    /// All hypotheses that need cover, but the stated one.
    pub(super) fn alternatives(&self) -> Vec<HypothesisPosterior> {
        let others = self.all().filter(|(fit, _, branch)| {
            branch.needs_cover() && fit.hypothesis(branch) != Hypothesis::AS_STATED
        });
        others
            .filter_map(|(fit, number, _)| fit.posterior(&self.columns, number))
            .collect()
    }

    /// All hypotheses: the fit, and the number of its branch.
    fn all(&self) -> impl Iterator<Item = (&SharedDesign, usize, &Branch)> {
        self.fits.iter().flat_map(|fit| {
            let branches = fit.branches.iter().enumerate();
            branches.map(move |(number, branch)| (fit, number, branch))
        })
    }
}

impl Branch {
    /// Whether torques must cover it.
    fn needs_cover(&self) -> bool {
        !self.is_refuted && self.log_odds > UNLIKELY.ln()
    }
}

/// All hypotheses about a sub-tree with these columns and contacts that come and go.
pub(super) fn hypotheses(
    columns: &SubtreeUnknowns,
    robot: &Robot,
    contacts: &ContactSet,
) -> Vec<SharedDesign> {
    let sensor_count = robot.structure.sensors().len();
    let branch = |wrench_reading, prior| Branch::new(wrench_reading, prior, &columns.sensors);
    let mut first = vec![branch(WrenchReading::AsStated, 1.0)];
    for &sensor in &columns.sensors {
        let others = (0..sensor_count).filter(|other| *other != sensor);
        let swapped =
            others.map(|other| WrenchReading::Swapped(sensor.min(other), sensor.max(other)));
        let all = wrench_readings(sensor).into_iter().chain(swapped);
        first.extend(all.map(|wrench_reading| branch(wrench_reading, STRUCTURAL)));
    }
    let stated = MotionReading::AsStated;
    let mut fits = vec![SharedDesign::new(stated, None, columns, first)];
    let count = contacts.iter().count() as f64;
    fits.extend(contacts.iter().map(|contact| {
        let branches = vec![branch(WrenchReading::AsStated, CONTACT / count)];
        SharedDesign::new(stated, Some(contact), columns, branches)
    }));
    fits.extend(
        motion_readings(robot, &columns.links)
            .into_iter()
            .map(|motion_reading| {
                let prior = match motion_reading.unknowns() {
                    0 => STRUCTURAL,
                    _ => ESTIMATED,
                };
                let branches = vec![branch(WrenchReading::AsStated, prior)];
                SharedDesign::new(motion_reading, None, columns, branches)
            }),
    );
    fits
}

/// How the motion of joints and base may have to be taken, other than stated, as far as it concerns
/// these links.
fn motion_readings(robot: &Robot, links: &[usize]) -> Vec<MotionReading> {
    let model = &robot.model;
    let dofs: Vec<usize> = dofs_between(model, robot.base_link, links).collect();
    let all = || dofs.iter().copied();
    let is_turning = |dof: &usize| {
        let joint = model
            .dof_joint(*dof)
            .and_then(|joint| model.joints().get(joint));
        joint.is_some_and(|joint| matches!(joint.kind, JointKind::Revolute(_)))
    };
    let mut motion_readings: Vec<MotionReading> = all().map(MotionReading::Reversed).collect();
    motion_readings.extend(all().filter(is_turning).map(MotionReading::Degrees));
    // Of a limb's encoders any two may be swapped.
    for b in 0..model.dof_count() {
        let link = model.dof_joint(b).map_or(0, |joint| joint + 1);
        let limb = dofs_above(model, link).into_iter().filter(|a| *a != b);
        let concerned = limb.filter(|a| dofs.contains(a) || dofs.contains(&b));
        motion_readings.extend(concerned.map(|a| MotionReading::Swapped(a.min(b), a.max(b))));
    }
    motion_readings.extend(all().map(|dof| MotionReading::Encoder(dof, [0.0; 2])));
    motion_readings.push(MotionReading::BaseTurned(Vec3::zeros()));
    match &robot.base {
        BaseMotion::Imu(pose) => {
            let to_base = |turn| pose.rotation * turn * pose.rotation.transpose();
            let turns = quarter_turns().into_iter();
            motion_readings.extend(turns.map(|turn| MotionReading::ImuTurned(to_base(turn))));
            motion_readings.push(MotionReading::ImuInG);
        }
        BaseMotion::Standing(motion) => {
            let axes = [Vec3::x(), Vec3::y(), Vec3::z()];
            let axes = axes.into_iter().flat_map(|axis| [axis, -axis]);
            let stated = motion.proper_acceleration.normalize();
            // The nearest one is as good as stated.
            let others = axes.filter(|axis| axis.dot(&stated) < 0.9);
            motion_readings.extend(others.map(MotionReading::Upright));
        }
        BaseMotion::Stance(_) => {}
    }
    motion_readings
}
