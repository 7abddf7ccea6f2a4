//! The inertial parameters, F/T offsets and calibrations in use, and their covariance. At first
//! they come from the URDF and the configuration, then from off-line or on-line identification.

use crate::parameters::{Offset, Parameters, ParametersError};
use crate::uncertainty::propagation::Covariance;
use nalgebra::DMatrix;
use proprio_dynamics::Structure;
use proprio_dynamics::calibration::{
    Calibration, Gain, Kind as Calibrated, UNKNOWN_OFFSET, Unknown,
};
use proprio_dynamics::model::Model;
use proprio_dynamics::spatial::{RigidInertia, Wrench};
use proprio_identification::Robot;
use proprio_identification::prior::link_cad_root;
use proprio_topics::Nanos;

/// Standard deviation of the gain of an F/T sensor that was not calibrated here, relative: usual
/// sensors state errors of 1 to 2 %. On-line, a sensor that reads too much and bodies that are as
/// much heavier than in the CAD give the same readings.
const GAIN: f64 = 0.02;

/// The parameters in use.
#[derive(Debug, Clone)]
pub struct InertialState {
    /// The model with the inertial parameters in use.
    pub model: Model,
    /// Per F/T sensor, its corrected reading without load.
    pub offsets: Vec<Wrench>,
    /// Per F/T sensor, the variance that its readings were found to have beyond the configured
    /// noise [torque; force] \[Nm^2, N^2\].
    pub excess_variance: Vec<[f64; 6]>,
    /// Per F/T sensor, its calibration.
    pub calibrations: Vec<Calibration>,
    /// The covariance of inertial parameters and offsets.
    pub covariance: Covariance,
    identified: Option<Parameters>,
}

/// The posterior of one component of on-line identification: links and sensors whose parameters and
/// offsets are correlated.
#[derive(Debug, Clone, Copy)]
pub struct PosteriorBlock<'a> {
    /// The links.
    pub links: &'a [usize],
    /// Their inertias.
    pub bodies: &'a [RigidInertia],
    /// The F/T sensors.
    pub sensors: &'a [usize],
    /// The root `U` of the covariance `U^T U` over [ten per link | torque, force per sensor]; none
    /// before the first solution.
    pub root: Option<&'a DMatrix<f64>>,
    /// Per sensor, its offset.
    pub offsets: &'a [Wrench],
    /// Per sensor, the drift of its offset: standard deviation after one second [torque; force].
    pub drift_std: &'a [[f64; 6]],
    /// The instant of the offsets.
    pub known: Nanos,
}

impl InertialState {
    /// The inertial parameters of the URDF, and offsets and calibrations as configured.
    #[must_use]
    pub fn configured(robot: &Robot) -> Self {
        let sensors = robot.offsets.len();
        let mut state = Self {
            offsets: Vec::new(),
            excess_variance: vec![[0.0; 6]; sensors],
            calibrations: Vec::new(),
            covariance: Covariance::exact(robot.model.link_count(), sensors),
            identified: None,
            model: robot.model.clone(),
        };
        state.rebuild(robot);
        state
    }

    /// Takes the identified inertial parameters and F/T offsets. All others stay those of the URDF
    /// and the configuration.
    ///
    /// # Errors
    /// They belong to another robot, or were identified with another model. Nothing is changed
    /// then.
    pub fn apply(&mut self, robot: &Robot, parameters: &Parameters) -> Result<(), ParametersError> {
        parameters.check_robot(robot)?;
        self.identified = Some(parameters.clone());
        self.rebuild(robot);
        Ok(())
    }

    /// Computes inertias, offsets, calibrations and covariance again. The inputs were checked when
    /// they were made, so errors are not possible.
    fn rebuild(&mut self, robot: &Robot) {
        let (links, sensors) = (robot.model.inertias().len(), robot.offsets.len());
        self.covariance = Covariance::exact(links, sensors);
        self.offsets = robot.offsets.iter().map(|(offset, _)| *offset).collect();
        self.calibrations.clone_from(&robot.calibrations);
        self.excess_variance.fill([0.0; 6]);
        for (link, cad) in robot.model.inertias().iter().enumerate() {
            let identified = self
                .identified
                .as_ref()
                .and_then(|parameters| parameters.inertia(link));
            let _ = self.model.set_inertia(link, identified.unwrap_or(*cad));
        }
        let (mut measured, mut calibrated) = (Vec::new(), Vec::new());
        if let Some(parameters) = &self.identified {
            for offset in parameters.offsets() {
                let Some(sensor) = robot.sensor(&offset.sensor) else {
                    continue;
                };
                if let Some(slot) = self.offsets.get_mut(sensor) {
                    *slot = offset.reading;
                }
                let noise = offset.noise.torque_first().map(|x| x * x);
                if let Some(slot) = self.excess_variance.get_mut(sensor) {
                    *slot = excess(&robot.structure, sensor, &noise);
                }
                if let (Some(slot), Some(found)) =
                    (self.calibrations.get_mut(sensor), &offset.calibrated)
                {
                    *slot = found.calibration;
                    calibrated.push((sensor, found.kind));
                }
                let ([fx, fy, fz], [tx, ty, tz]) =
                    (offset.drift.force.into(), offset.drift.torque.into());
                let log = parameters
                    .provenance()
                    .logs
                    .iter()
                    .find(|log| log.end == offset.known);
                let first = log.map_or(offset.known, |log| log.start);
                let _ = self.covariance.set_drift_of_log(
                    sensor,
                    [tx, ty, tz, fx, fy, fz],
                    (first, offset.known),
                );
                measured.push(sensor);
            }
            let identified: Vec<usize> = parameters.identified().collect();
            let _ = self.covariance.add_calibrated(
                &identified,
                &measured,
                &calibrated,
                parameters.root(),
            );
        }
        let mut covariance = std::mem::replace(&mut self.covariance, Covariance::exact(0, 0));
        self.add_prior(robot, &mut covariance, &measured);
        self.covariance = covariance;
    }

    /// Adds the prior covariance of every link that has none, from the URDF's relative standard
    /// deviation, and of every sensor that is not in `measured`, from the configuration.
    fn add_prior(&self, robot: &Robot, covariance: &mut Covariance, measured: &[usize]) {
        for (link, cad) in robot.model.inertias().iter().enumerate() {
            if !covariance.has_link(link) && robot.urdf_relative_std > 0.0 {
                let _ = covariance.add(&[link], &[], prior_root(cad, robot.urdf_relative_std));
            }
        }
        for (sensor, (_, deviation)) in robot.offsets.iter().enumerate() {
            if !measured.contains(&sensor) {
                self.add_offset(robot, covariance, sensor, deviation);
            }
        }
    }

    /// Adds the covariance of a sensor's offset, and of its identified calibration.
    fn add_offset(
        &self,
        robot: &Robot,
        covariance: &mut Covariance,
        sensor: usize,
        deviation: &[f64; 6],
    ) {
        let calibrated = self.calibrated_among(robot, &[sensor]);
        let known: Vec<f64> = deviation
            .iter()
            .chain(calibrated.iter().flat_map(|(_, d)| *d))
            .copied()
            .collect();
        if known.iter().any(|deviation| *deviation != 0.0) {
            let kinds: Vec<(usize, Calibrated)> =
                calibrated.iter().map(|(kind, _)| *kind).collect();
            let root = DMatrix::from_fn(known.len(), known.len(), |i, j| {
                if i == j { known[i] } else { 0.0 }
            });
            let _ = covariance.add_calibrated(&[], &[sensor], &kinds, root);
        }
    }

    /// The identified calibrations among these sensors: which parts were identified, and their
    /// standard deviations.
    fn calibrated_among(
        &self,
        robot: &Robot,
        sensors: &[usize],
    ) -> Vec<((usize, Calibrated), &[f64])> {
        let Some(parameters) = &self.identified else {
            return Vec::new();
        };
        let deviation = |(index, offset): (usize, &Offset)| {
            let sensor = robot
                .sensor(&offset.sensor)
                .filter(|sensor| sensors.contains(sensor))?;
            let kind = offset.calibrated.as_ref()?.kind;
            Some(((sensor, kind), parameters.calibration_deviation(index)))
        };
        parameters
            .offsets()
            .iter()
            .enumerate()
            .filter_map(deviation)
            .collect()
    }

    /// The covariance when some links and sensors are identified on-line. A group without a root
    /// has no solution yet: its links have the prior covariance of identification, and its offsets
    /// are unknown.
    ///
    /// Calibrations are not identified on-line. Those identified off-line keep their covariance and
    /// are independent of the rest, with one exception: an offset found on-line was found with the
    /// present gain, so it absorbs the effect of the gain error `E` on the offset itself. The
    /// remaining effect is on the load, `E (r - o)`. All other sensors have an error of their gain,
    /// too, and bodies that one sensor alone has weighed have the same.
    pub fn covariance_with<'a>(
        &self,
        robot: &Robot,
        groups: impl Iterator<Item = PosteriorBlock<'a>>,
    ) -> Covariance {
        let mut covariance = Covariance::exact(robot.model.inertias().len(), robot.offsets.len());
        let mut measured = Vec::new();
        // No errors: the numbers are those of the model, and each is in one group only.
        for group in groups {
            measured.extend_from_slice(group.sensors);
            if let Some(root) = group.root {
                let calibrated = self.calibrated_among(robot, group.sensors);
                let kinds = calibrated.iter().map(|(kind, _)| *kind).collect();
                let root = with_calibrations(&group, root, &calibrated);
                let (root, kinds) = with_gains(robot, &group, &root, kinds);
                let _ = covariance.add_calibrated(group.links, group.sensors, &kinds, root);
                for (&sensor, drift_std) in group.sensors.iter().zip(group.drift_std) {
                    let _ = covariance.set_drift(sensor, *drift_std, group.known);
                }
                continue;
            }
            for &link in group.links {
                if let Some(cad) = robot
                    .model
                    .inertias()
                    .get(link)
                    .filter(|_| robot.urdf_relative_std > 0.0)
                {
                    let _ = covariance.add(&[link], &[], prior_root(cad, robot.urdf_relative_std));
                }
            }
            for &sensor in group.sensors {
                self.add_offset(robot, &mut covariance, sensor, &UNKNOWN_OFFSET);
            }
        }
        self.add_prior(robot, &mut covariance, &measured);
        covariance
    }

    /// The parameters identified off-line, if they are used.
    #[must_use]
    pub fn identified(&self) -> Option<&Parameters> {
        self.identified.as_ref()
    }

    /// Whether a link's parameters were identified off-line.
    pub(crate) fn is_identified(&self, link: usize) -> bool {
        let parameters = self.identified.as_ref();
        parameters.is_some_and(|parameters| parameters.inertia(link).is_some())
    }
}

/// The excess of the variance `found` of a sensor's readings over the stated one [torque; force].
pub(crate) fn excess(structure: &Structure, sensor: usize, found: &[f64; 6]) -> [f64; 6] {
    let Some(cut) = structure.sensors().get(sensor) else {
        return [0.0; 6];
    };
    let stated = Wrench::from_parts(cut.noise().force, cut.noise().torque).torque_first();
    std::array::from_fn(|i| (found[i] - stated[i] * stated[i]).max(0.0))
}

/// A group's root, extended by one row and one column for each unknown of its sensors'
/// calibrations.
fn with_calibrations(
    group: &PosteriorBlock<'_>,
    root: &DMatrix<f64>,
    calibrated: &[((usize, Calibrated), &[f64])],
) -> DMatrix<f64> {
    let more: usize = calibrated.iter().map(|((_, kind), _)| kind.count()).sum();
    let (rows, columns) = root.shape();
    let mut all = DMatrix::zeros(rows + more, columns + more);
    all.view_mut((0, 0), (rows, columns)).copy_from(root);
    let mut next = 0;
    for ((sensor, kind), deviations) in calibrated {
        let index = group
            .sensors
            .iter()
            .position(|other| other == sensor)
            .unwrap_or(0);
        let offset = group
            .offsets
            .get(index)
            .map_or([0.0; 6], Wrench::torque_first);
        for (unknown, deviation) in kind.unknowns().zip(*deviations) {
            all[(rows + next, columns + next)] = *deviation;
            if let Unknown::Gain { channel, .. } = unknown {
                // Without load the gain error is already contained in the offset.
                let column = 10 * group.links.len() + 6 * index + channel;
                all[(rows + next, column)] = -deviation * unknown.as_offset(&offset, 0.0);
            }
            next += 1;
        }
    }
    all
}

/// A group's root, extended by a row and six columns for the gain of each sensor that has no
/// identified calibration among `calibrated`; and all uncertain calibrations.
fn with_gains(
    robot: &Robot,
    group: &PosteriorBlock<'_>,
    root: &DMatrix<f64>,
    mut calibrated: Vec<(usize, Calibrated)>,
) -> (DMatrix<f64>, Vec<(usize, Calibrated)>) {
    let is_other = |sensor: &usize| calibrated.iter().all(|(known, _)| known != sensor);
    let others: Vec<usize> = group.sensors.iter().copied().filter(is_other).collect();
    let (rows, columns) = root.shape();
    let mut all = DMatrix::zeros(rows + others.len(), columns + 6 * others.len());
    all.view_mut((0, 0), (rows, columns)).copy_from(root);
    for (number, &sensor) in others.iter().enumerate() {
        let kind = Calibrated {
            gain: Gain::Diagonal,
            temperature: false,
        };
        calibrated.push((sensor, kind));
        let mut row = all.row_mut(rows + number);
        row.columns_mut(columns + 6 * number, 6).fill(GAIN);
        for (index, (other, offset)) in group.sensors.iter().zip(group.offsets).enumerate() {
            if *other == sensor {
                let values = offset.torque_first().map(|channel| GAIN * channel);
                let first = 10 * group.links.len() + 6 * index;
                row.columns_mut(first, 6).copy_from_slice(&values);
            }
        }
        for (index, (&link, body)) in group.links.iter().zip(group.bodies).enumerate() {
            let subtree = robot.structure.subtree_of(link);
            let subtree = subtree.and_then(|number| robot.structure.subtrees().get(number));
            if subtree.is_some_and(|own| own.sensors.iter().eq([sensor])) {
                let values = body.parameters().map(|parameter| GAIN * parameter);
                row.columns_mut(10 * index, 10).copy_from_slice(&values);
            }
        }
    }
    (all, calibrated)
}

/// The root of a link's prior covariance.
fn prior_root(cad: &RigidInertia, relative: f64) -> DMatrix<f64> {
    let root = link_cad_root(cad, relative);
    DMatrix::from_fn(10, 10, |i, j| root[(i, j)])
}
