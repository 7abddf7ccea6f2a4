//! The reordered recursive Newton-Euler algorithm: it computes joint torques and unknown contact
//! wrenches from F/T readings.
//!
//! Per sub-tree, in base coordinates: sum the net wrenches of the links and subtract the wrenches
//! of the F/T sensors and the known external wrenches. The sum over the whole sub-tree is the
//! imbalance `b`; the sum over the links below joint `j` is `F_j`.
//!
//! ```text
//! unknowns:  A x = b,  x = K b        weighted by C = sum over sensors of X Sigma X^T
//! residual:  r = b - A K b            distributed over the sensors: e_k = C_k C^-1 r
//! torque:    tau_j = s_j . (F_j - contacts and corrections below j) = s_j . F_j - h_j . b
//! ```
//!
//! `K` is computed by `least_squares.rs`. The corrections `e_k` follow the noise of the sensors, so
//! that the balance holds exactly.
//!
//! `h_j` depends on the side of the joint without unknown contacts ([`Route`]):
//!
//! - `0` from the side of the child;
//! - `s_j` from that of the parent;
//! - `C^-1 C_j s_j` fused;
//! - `K^T A_j^T s_j + P C_j s_j` for the whole sub-tree, with `P = C^-1 (1 - A K)`. `A_j` and `C_j`
//!   contain only the contacts and sensors below `j`.
//!
//! So the two sides of a joint give the same torque, and the noise of a torque is that of
//! `s_j . F_j - h_j . b`: a sensor at `k` enters with the motion `h_j - [k below j] s_j`.
//!
//! Fused, it is the component along the axis of the mean of the two sides' *wrenches*, weighted by
//! inverse covariance: of all `s_j . F_j - h . b` the one of least variance (Gauss-Markov).
//!
//! One full unknown wrench in a sub-tree, the paper's case, needs no linear solve: it is `b`, moved
//! to the contact.

mod estimates;
mod unknowns;

pub use estimates::{Balance, ContactSolution, Determinacy};
pub use unknowns::unknowns;

use nalgebra::{Matrix6, Vector6};

use crate::error::{DynamicsError, check_sizes};
use crate::kinematics::{ExternalWrench, Kinematics, check_external, check_readings};
use crate::least_squares::{LeastSquares, noise_factor, scale_factor};
use crate::model::Model;
use crate::spatial::{Mat3, Motion, Pose, Vec3, Wrench, stack, symmetric};
use crate::structure::{ContactKind, ContactSet, Route, SensorCut, Structure};

/// A value counts as determined if at most this fraction of it comes from the least-norm choice.
const UNDETERMINED: f64 = 1e-9;

/// Torques and contact wrenches from F/T readings. It owns its results and all working storage.
#[derive(Clone, Debug)]
pub struct Solver {
    // Results.
    torque: Vec<f64>,
    torque_deviation: Vec<f64>,
    torque_certainty: Vec<Determinacy>,
    contacts: Vec<ContactSolution>,
    balances: Vec<Balance>,
    // From `solve`, for `update_deviations`, in base coordinates.
    /// The contacts that were present; `None` before the first solution.
    active: Option<ContactSet>,
    /// Per link: `F_j`, the net wrench of it and of the links below it in its sub-tree, minus the
    /// known wrenches.
    wrenches: Vec<Wrench>,
    /// Per link, `s_j` of the joint above it.
    axes: Vec<Motion>,
    /// Per link, `h_j` of the joint above it.
    torque_rows: Vec<Motion>,
    /// Per contact, its rows of `K`, as the contact's wrench is reported.
    contact_rows: Vec<[Motion; 6]>,
    sensor_poses: Vec<Pose>,
    // Scratch.
    least: LeastSquares,
    columns: Vec<Vector6<f64>>,
    owners: Vec<usize>,
}

/// How the part of a sub-tree's imbalance that no contact explains is distributed; a single full
/// wrench leaves none.
struct ResidualWeight {
    /// The point about which the six equations are written.
    point: Vec3,
    /// `P`; none without sensors.
    weight: Option<Matrix6<f64>>,
}

impl Solver {
    /// For a structure.
    pub fn new(structure: &Structure) -> Self {
        let (dofs, contacts) = (structure.dof_count(), structure.contacts().len());
        let still = Motion::zero();
        Self {
            torque: vec![0.0; dofs],
            torque_deviation: vec![0.0; dofs],
            torque_certainty: vec![Determinacy::Assumed; dofs],
            contacts: vec![ContactSolution::absent(); contacts],
            balances: vec![
                Balance {
                    residual: Wrench::zero(),
                    chi_square: None,
                    degrees: 6
                };
                structure.subtrees().len()
            ],
            active: None,
            wrenches: vec![Wrench::zero(); structure.link_count()],
            axes: vec![still; structure.link_count()],
            torque_rows: vec![still; structure.link_count()],
            contact_rows: vec![[still; 6]; contacts],
            sensor_poses: vec![Pose::identity(); structure.sensors().len()],
            least: LeastSquares::with_capacity(6 * contacts),
            columns: Vec::with_capacity(6 * contacts),
            owners: Vec::with_capacity(6 * contacts),
        }
    }

    /// Solves all sub-trees. `readings` are those of the structure's sensors, offsets removed, in
    /// their measurement frames; the contacts in `active` are present, the others are assumed
    /// absent; `external` wrenches are known.
    ///
    /// Every set of contacts has a solution: least squares with fewer unknowns than equations,
    /// least norm with more. [`Determinacy`] states which values depend on the least-norm choice.
    /// [`Balance`] has the part of the readings that no wrenches of the declared kinds explain.
    /// Results are finite unless a number overflows (beyond about 1e100).
    ///
    /// # Errors
    /// Objects made for another model or structure, wrong sizes, numbers that are not finite.
    /// Results are unchanged in that case.
    pub fn solve(
        &mut self,
        model: &Model,
        structure: &Structure,
        kinematics: &Kinematics,
        readings: &[Wrench],
        active: &ContactSet,
        external: &[ExternalWrench],
    ) -> Result<(), DynamicsError> {
        let links = self.wrenches.len();
        check_sizes([
            ("links of the model", model.link_count(), links),
            ("links of the kinematics", kinematics.link_count(), links),
        ])?;
        self.check_structure(structure)?;
        check_readings(readings, structure.sensors().len())?;
        check_external(external, links)?;

        self.active = Some(*active);
        self.wrenches.copy_from_slice(kinematics.net_wrenches());
        for wrench in external {
            self.wrenches[wrench.frame.link] -= wrench.in_base(kinematics);
        }
        for ((sensor, reading), x_bm) in structure
            .sensors()
            .iter()
            .zip(readings)
            .zip(&mut self.sensor_poses)
        {
            let child = sensor.joint() + 1;
            let pose = kinematics.pose(child);
            *x_bm = *pose * *sensor.pose();
            let by_parent_on_child = pose.wrench(&sensor.transmitted(reading));
            self.wrenches[child] -= by_parent_on_child;
            self.wrenches[structure.places[child].parent] += by_parent_on_child;
        }
        for link in (1..self.wrenches.len()).rev() {
            let place = &structure.places[link];
            if !place.is_top {
                let below = self.wrenches[link];
                self.wrenches[place.parent] += below;
            }
        }
        // Of several joints with one degree of freedom, the torques add up.
        self.torque.fill(0.0);
        self.torque_certainty.fill(Determinacy::Determined);
        for number in 0..structure.subtrees().len() {
            self.solve_subtree(number, model, structure, kinematics, active);
        }
        Ok(())
    }

    /// Checks that a structure has the sizes of the one that this was made for.
    ///
    /// # Errors
    /// [`DynamicsError::Size`].
    pub fn check_structure(&self, structure: &Structure) -> Result<(), DynamicsError> {
        let (links, dofs) = (structure.link_count(), structure.dof_count());
        let (contacts, sensors) = (structure.contacts().len(), structure.sensors().len());
        let subtrees = structure.subtrees().len();
        check_sizes([
            ("links of the structure", links, self.wrenches.len()),
            (
                "degrees of freedom of the structure",
                dofs,
                self.torque.len(),
            ),
            ("contacts of the structure", contacts, self.contacts.len()),
            ("sensors of the structure", sensors, self.sensor_poses.len()),
            ("sub-trees of the structure", subtrees, self.balances.len()),
        ])
    }

    fn solve_subtree(
        &mut self,
        number: usize,
        model: &Model,
        structure: &Structure,
        kinematics: &Kinematics,
        active: &ContactSet,
    ) {
        let subtree = &structure.subtrees()[number];
        let present = subtree.contacts.intersection(active);
        for contact in subtree.contacts.difference(active).iter() {
            self.contacts[contact] = ContactSolution::absent();
            self.contact_rows[contact] = [Motion::zero(); 6];
        }
        let b = self.wrenches[subtree.top];
        let residual = match (present.iter().next(), present.len()) {
            (Some(contact), 1) if structure.contacts()[contact].kind == ContactKind::Wrench => {
                self.solve_single(number, contact, structure, kinematics)
            }
            _ => self.solve_unknowns(number, &present, structure, kinematics),
        };
        for link in structure.links_of(number) {
            if link == subtree.top {
                continue;
            }
            let joint = &model.joints()[link - 1];
            let (Some(dof), Some(axis)) = (joint.dof, kinematics.joint_axis(joint)) else {
                continue;
            };
            let route = structure.route_above(link, active);
            let (response, is_determined) = match route {
                Route::Child => {
                    let is_unmeasured = present.is_empty() && subtree.sensors.is_empty();
                    (Motion::zero(), !is_unmeasured)
                }
                Route::Parent => (axis, true),
                Route::Fused => (
                    self.response(structure, link, &axis, &residual, false).0,
                    true,
                ),
                Route::Whole => self.response(structure, link, &axis, &residual, true),
            };
            self.torque[dof] += match route {
                Route::Child => axis.dot(&self.wrenches[link]),
                Route::Parent => axis.dot(&(self.wrenches[link] - b)),
                _ => axis.dot(&self.wrenches[link]) - response.dot(&b),
            };
            if !is_determined {
                self.torque_certainty[dof] = Determinacy::Assumed;
            }
            self.axes[link] = axis;
            self.torque_rows[link] = response;
        }
    }

    /// One full unknown wrench: it is the imbalance, moved to the contact.
    fn solve_single(
        &mut self,
        number: usize,
        contact: usize,
        structure: &Structure,
        kinematics: &Kinematics,
    ) -> ResidualWeight {
        let subtree = &structure.subtrees()[number];
        let x_bf = kinematics.frame_pose(&structure.contacts()[contact].frame);
        self.contacts[contact] = ContactSolution {
            wrench: x_bf.wrench_back(&self.wrenches[subtree.top]),
            deviation: [0.0; 6],
            certainty: Determinacy::Determined,
        };
        for axis in 0..3 {
            let direction = x_bf.rotation.column(axis).into_owned();
            self.contact_rows[contact][axis] = Motion::translation(&direction);
            self.contact_rows[contact][axis + 3] = Motion::rotation(&direction, &x_bf.translation);
        }
        self.balances[number] = Balance {
            residual: Wrench::zero(),
            chi_square: (!subtree.sensors.is_empty()).then_some(0.0),
            degrees: 0,
        };
        ResidualWeight {
            point: Vec3::zeros(),
            weight: None,
        }
    }

    /// `h_j` of the joint above a link from the residual and, if contacts are on both sides of it
    /// (`is_whole`), from those below; and whether measurements determine the torque.
    fn response(
        &self,
        structure: &Structure,
        link: usize,
        axis: &Motion,
        ResidualWeight { point, weight }: &ResidualWeight,
        is_whole: bool,
    ) -> (Motion, bool) {
        let place = &structure.places[link];
        let about_point = axis.linear - point.cross(&axis.angular);
        let s = stack(&axis.angular, &about_point);
        let mut h = Vector6::zeros();
        if let Some(weight) = weight {
            let mut noise = Wrench::zero();
            for sensor in place.sensors_below.iter() {
                let x_bm = &self.sensor_poses[sensor];
                let scaled = structure.sensors()[sensor].covariance_times(&x_bm.twist_back(axis));
                noise += x_bm.wrench(&scaled);
            }
            let noise = noise.about(point);
            h += weight * stack(&noise.torque, &noise.force);
        }
        let mut is_determined = true;
        if is_whole {
            let below = |j: usize| place.contacts_below.contains(self.owners[j]);
            for (j, column) in self.columns.iter().enumerate() {
                if below(j) {
                    h += self.least.gain(j) * column.dot(&s);
                }
            }
            let gradient = |j: usize| {
                let column = &self.columns[j];
                if below(j) {
                    (column.dot(&s), column.abs().dot(&s.abs()))
                } else {
                    (0.0, 0.0)
                }
            };
            let balanced = self.least.rank() == 6 || weight.is_some();
            is_determined = balanced && self.least.determines(gradient, UNDETERMINED);
        }
        (about_origin(&h, point), is_determined)
    }

    /// Mean position of the sensors, or of the contacts if there is no sensor: near them the
    /// covariance is best conditioned. Their order matters only by rounding.
    fn reference_point(
        &self,
        structure: &Structure,
        kinematics: &Kinematics,
        sensors: &ContactSet,
        present: &ContactSet,
    ) -> Vec3 {
        let (sum, count) = if sensors.is_empty() {
            let sum = present.iter().fold(Vec3::zeros(), |sum, contact| {
                let spec = &structure.contacts()[contact];
                sum + kinematics.frame_pose(&spec.frame).point(&spec.position)
            });
            (sum, present.len())
        } else {
            let sum = sensors.iter().fold(Vec3::zeros(), |sum, k| {
                sum + self.sensor_poses[k].translation
            });
            (sum, sensors.len())
        };
        sum / count.max(1) as f64
    }

    /// Writes the columns of the unknowns of the present contacts, and factorises them.
    fn load_unknowns(
        &mut self,
        number: usize,
        present: &ContactSet,
        structure: &Structure,
        kinematics: &Kinematics,
    ) -> Vec3 {
        let sensors = &structure.subtrees()[number].sensors;
        let point = self.reference_point(structure, kinematics, sensors, present);
        let length = structure.length_scale;
        self.least.clear();
        self.columns.clear();
        self.owners.clear();
        for contact in present.iter() {
            let spec = &structure.contacts()[contact];
            for (column, weight) in unknowns(spec, kinematics, &point, length) {
                self.columns.push(column);
                self.owners.push(contact);
                self.least.push(column, weight);
            }
        }
        // Without sensors there is no covariance: the equations are weighted by the length scale,
        // about the contacts.
        let lower = if sensors.is_empty() {
            scale_factor(length)
        } else {
            noise_factor(self.noise(structure, number, &point))
        };
        self.least.factorise(&lower);
        point
    }

    /// Solves any set of contacts: least squares of least norm. The residual has a weight if there
    /// are sensors over which to distribute it.
    fn solve_unknowns(
        &mut self,
        number: usize,
        present: &ContactSet,
        structure: &Structure,
        kinematics: &Kinematics,
    ) -> ResidualWeight {
        let point = self.load_unknowns(number, present, structure, kinematics);
        let subtree = &structure.subtrees()[number];
        let measured = !subtree.sensors.is_empty();
        let b = self.wrenches[subtree.top].about(&point);
        let b = stack(&b.torque, &b.force);
        let mut residual = b;
        let mut start = 0;
        for contact in present.iter() {
            let spec = &structure.contacts()[contact];
            let mut determined = self.least.rank() == 6 || measured;
            // Force and torque about the contact's position, each as a motion whose product with b
            // gives it.
            let mut rows = [Vector6::zeros(); 6];
            for i in 0..spec.kind.unknowns() {
                let gain = self.least.gain(start + i);
                residual -= self.columns[start + i] * gain.dot(&b);
                let one = |j| if j == start + i { 1.0 } else { 0.0 };
                determined &= self.least.determines(|j| (one(j), one(j)), UNDETERMINED);
                if let ContactKind::ForceAlong(direction) = spec.kind {
                    (0..3).for_each(|axis| rows[axis] = gain * direction[axis]);
                } else {
                    rows[i] = gain;
                }
            }
            // Torque from the contact's position to the frame's origin: n + position x f.
            let p = &spec.position;
            let force = [rows[0], rows[1], rows[2]];
            for axis in 0..3 {
                let (next, last) = ((axis + 1) % 3, (axis + 2) % 3);
                rows[axis + 3] += force[last] * p[next] - force[next] * p[last];
            }
            let value = rows.map(|row| row.dot(&b));
            self.contacts[contact] = ContactSolution {
                wrench: Wrench::from_parts(
                    [value[0], value[1], value[2]],
                    [value[3], value[4], value[5]],
                ),
                deviation: [0.0; 6],
                certainty: if determined {
                    Determinacy::Determined
                } else {
                    Determinacy::Assumed
                },
            };
            self.contact_rows[contact] = rows.map(|row| about_origin(&row, &point));
            start += spec.kind.unknowns();
        }

        let weight = self.least.unexplained();
        let residual = Wrench {
            torque: residual.fixed_rows::<3>(0).into_owned(),
            force: residual.fixed_rows::<3>(3).into_owned(),
        };
        // From the reference point to base coordinates, then to the top link.
        let residual = kinematics
            .pose(subtree.top)
            .wrench_back(&residual.about(&-point));
        let chi_square = measured.then(|| (weight * b).dot(&b));
        self.balances[number] = Balance {
            residual,
            chi_square,
            degrees: 6 - self.least.rank(),
        };
        ResidualWeight {
            point,
            weight: measured.then_some(weight),
        }
    }

    /// Computes the standard deviations of torques and contact wrenches that F/T noise causes, for
    /// the last solution. Inertial parameters are taken as exact; so are the least-norm choice and
    /// the declared absence of a contact.
    ///
    /// # Errors
    /// The structure is not the one that was solved.
    pub fn update_deviations(&mut self, structure: &Structure) -> Result<(), DynamicsError> {
        self.check_structure(structure)?;
        for dof in 0..self.torque_deviation.len() {
            let sensors = 0..structure.sensors().len();
            let sum: f64 = sensors
                .map(|sensor| self.torque_noise(structure, dof, sensor))
                .sum();
            self.torque_deviation[dof] = sum.sqrt();
        }
        for subtree in structure.subtrees() {
            for contact in subtree.contacts.iter() {
                self.contacts[contact].deviation = self.contact_rows[contact].map(|row| {
                    let sensors = subtree.sensors.iter();
                    let variances = sensors.map(|sensor| {
                        variance(structure, sensor, &self.sensor_poses[sensor], &row)
                    });
                    variances.sum::<f64>().sqrt()
                });
            }
        }
        Ok(())
    }

    /// The variance of a torque from the noise of one F/T sensor, for the last solution [Nm^2 or
    /// N^2].
    #[inline]
    pub fn torque_noise(&self, structure: &Structure, dof: usize, sensor: usize) -> f64 {
        let child = structure.sensors()[sensor].joint() + 1;
        let mut motion = None::<Motion>;
        for &link in structure.moved_by(dof) {
            let place = &structure.places[link];
            if !structure.subtrees()[place.subtree].sensors.contains(sensor) {
                continue;
            }
            let (s, h) = (self.axes[link], self.torque_rows[link]);
            let part = if place.sensors_below.contains(sensor) {
                h - s
            } else {
                h
            };
            // What the sensor transmits has opposite signs on its two sides.
            let is_beyond = structure.places[child].subtree == place.subtree;
            let part = if is_beyond { -part } else { part };
            motion = Some(motion.map_or(part, |sum| sum + part));
        }
        motion.map_or(0.0, |motion| {
            variance(structure, sensor, &self.sensor_poses[sensor], &motion)
        })
    }

    /// `s_j` and `h_j` of the joint above a link in the last solution, in base coordinates:
    /// `tau_j = s_j . F_j - h_j . b` (see the top of this file). The torque of a degree of freedom
    /// is the sum over its joints; `s_j` includes the joint's ratio.
    pub fn torque_rows(&self, link: usize) -> (&Motion, &Motion) {
        (&self.axes[link], &self.torque_rows[link])
    }

    /// Rows `k` of the last solution in base coordinates, `x_i = k_i . b`, force first, as the
    /// contact's wrench is reported.
    pub fn contact_rows(&self, contact: usize) -> &[Motion; 6] {
        &self.contact_rows[contact]
    }

    /// Imbalance `b` of a sub-tree, in base coordinates: the net wrenches of its links minus its
    /// sensors' and the known external wrenches, without contacts.
    pub fn imbalance(&self, structure: &Structure, number: usize) -> Wrench {
        self.wrenches[structure.subtrees()[number].top]
    }

    /// Covariance of `b` [torque; force] from F/T noise, about `point`.
    pub fn noise(&self, structure: &Structure, number: usize, point: &Vec3) -> Matrix6<f64> {
        let sensors = structure.subtrees()[number].sensors.iter();
        sensors.fold(Matrix6::zeros(), |sum, sensor| {
            sum + covariance(
                &structure.sensors()[sensor],
                &self.sensor_poses[sensor],
                point,
            )
        })
    }

    /// Whether the last solution is for these kinematics, judged by the poses of the F/T sensors.
    /// False before the first solution.
    pub fn is_solved(&self, structure: &Structure, kinematics: &Kinematics) -> bool {
        // The same product of the same numbers has the same bits.
        let mut poses = structure.sensors().iter().zip(&self.sensor_poses);
        self.active.is_some()
            && poses.all(|(sensor, x_bm)| {
                *kinematics.pose(sensor.joint() + 1) * *sensor.pose() == *x_bm
            })
    }

    /// Measurement frame of a sensor in base coordinates, `x_bm`, at the last solution.
    pub fn sensor_pose(&self, sensor: usize) -> &Pose {
        &self.sensor_poses[sensor]
    }

    /// Joint torques [Nm or N], by degree of freedom: along the URDF axis, exerted by the parent on
    /// the child, on the link side.
    pub fn torque(&self) -> &[f64] {
        &self.torque
    }

    /// Standard deviations of the torques from F/T noise [Nm or N]; see
    /// [`Solver::update_deviations`]. Zero where no sensor's reading enters: at a free end, or in a
    /// sub-tree without sensors. The error of the torque is unknown there, and
    /// [`Structure::torque_dependence`] names no sensor.
    pub fn torque_deviation(&self) -> &[f64] {
        &self.torque_deviation
    }

    /// The basis of each torque.
    pub fn torque_certainty(&self) -> &[Determinacy] {
        &self.torque_certainty
    }

    /// The contact estimates, in the order of the structure's contacts.
    pub fn contacts(&self) -> &[ContactSolution] {
        &self.contacts
    }

    /// The balance of each sub-tree, in the order of the structure's sub-trees.
    pub fn balances(&self) -> &[Balance] {
        &self.balances
    }
}

/// Variance that a sensor at `x_bm` adds to `motion . wrench`.
#[inline]
fn variance(structure: &Structure, sensor: usize, x_bm: &Pose, motion: &Motion) -> f64 {
    let in_sensor = x_bm.twist_back(motion);
    in_sensor.dot(&structure.sensors()[sensor].covariance_times(&in_sensor))
}

/// A row of motion coordinates about `point`, as a motion about the origin.
fn about_origin(row: &Vector6<f64>, point: &Vec3) -> Motion {
    let angular = row.fixed_rows::<3>(0).into_owned();
    Motion {
        angular,
        linear: row.fixed_rows::<3>(3) + point.cross(&angular),
    }
}

/// `X Sigma X^T` of a sensor at `x_bm`, about `point`.
fn covariance(cut: &SensorCut, x_bm: &Pose, point: &Vec3) -> Matrix6<f64> {
    let r = &x_bm.rotation;
    let units = cut.covariance_times(&Motion {
        angular: Vec3::repeat(1.0),
        linear: Vec3::repeat(1.0),
    });
    let turned = |variances: &Vec3| r * Mat3::from_diagonal(variances) * r.transpose();
    let (torque, force) = (turned(&units.torque), turned(&units.force));
    let arm = (x_bm.translation - point).cross_matrix();
    let mixed = arm * force;
    symmetric(&(torque + mixed * arm.transpose()), &mixed, &force)
}
