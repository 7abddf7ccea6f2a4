//! Errors of torques and contact wrenches because a contact is not exactly where it is taken to be.
//!
//! A contact of force `f` is taken to be at `p`, along `d`, but acts at `p + dp`, along `d + dd`.
//! Then its wrench differs by `w` from the one that the solver attributes to it (base coordinates,
//! [torque; force] about the origin, `r` the contact's position):
//!
//! ```text
//! w = [dp x f + r x df; df],    df = |f| dd    (of a force along a direction; else 0)
//! error of tau_j = ([contact below j] s_j - h_j) . w      tau_j = s_j . F_j - h_j . b  (solver)
//! error of x_i   = (k_i - e_i) . w                        x_i = k_i . b, in truth e_i . (A x + w)
//! ```
//!
//! With equal standard deviations of `dp` along each axis, and of `dd` across `d`, the covariance
//! of `w` follows, and from it those of all results. A full wrench has no such error: its torque is
//! unknown, too.

use crate::error::{DynamicsError, check_size};
use crate::kinematics::Kinematics;
use crate::solver::Solver;
use crate::spatial::{Mat3, Motion, stack, symmetric};
use crate::structure::{ContactKind, Structure};
use nalgebra::Matrix6;

/// How well the place of a contact is known.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PlaceStd {
    /// Standard deviation of its position, each axis \[m\].
    pub position: f64,
    /// Standard deviation of a `ForceAlong`'s direction, each axis across it \[rad\].
    pub direction: f64,
}

/// Standard deviations of the results of a [`Solver`] from errors of the contacts' places, with the
/// memory to compute them.
#[derive(Clone, Debug)]
pub struct PlaceErrors {
    /// Variances while they are added up, then standard deviations.
    torque: Vec<f64>,
    contacts: Vec<[f64; 6]>,
    /// Per sub-tree, the covariance of its imbalance.
    imbalances: Vec<Matrix6<f64>>,
}

impl PlaceErrors {
    /// For a structure; all contacts are exactly in their places.
    pub fn new(structure: &Structure) -> Self {
        Self {
            torque: vec![0.0; structure.dof_count()],
            contacts: vec![[0.0; 6]; structure.contacts().len()],
            imbalances: vec![Matrix6::zeros(); structure.subtrees().len()],
        }
    }

    /// Computes the standard deviations for the solver's last solution; `std` is that of each
    /// contact. Errors of different contacts are independent. Does not allocate.
    ///
    /// # Errors
    /// The structure is another one, or the solver has no solution for these kinematics.
    pub fn update(
        &mut self,
        structure: &Structure,
        solver: &Solver,
        kinematics: &Kinematics,
        std: impl Fn(usize) -> PlaceStd,
    ) -> Result<(), DynamicsError> {
        solver.check_structure(structure)?;
        let (dofs, contacts) = (structure.dof_count(), structure.contacts().len());
        check_size("degrees of freedom", self.torque.len(), dofs)?;
        check_size("contacts", self.contacts.len(), contacts)?;
        if !solver.is_solved(structure, kinematics) {
            return Err(DynamicsError::NotSolved);
        }
        self.torque.fill(0.0);
        self.contacts.fill([0.0; 6]);
        self.imbalances.fill(Matrix6::zeros());
        for contact in 0..contacts {
            let std = std(contact);
            if std == PlaceStd::default() {
                continue;
            }
            if let Some(covariance) = covariance(structure, solver, kinematics, contact, std) {
                self.add(structure, solver, kinematics, contact, &covariance);
            }
        }
        self.torque.iter_mut().for_each(|sum| *sum = sum.sqrt());
        let of_contacts = self.contacts.iter_mut().flatten();
        of_contacts.for_each(|sum| *sum = sum.sqrt());
        Ok(())
    }

    /// Adds the effect of one contact.
    fn add(
        &mut self,
        structure: &Structure,
        solver: &Solver,
        kinematics: &Kinematics,
        contact: usize,
        covariance: &Matrix6<f64>,
    ) {
        let frame = &structure.contacts()[contact].frame;
        let variance = |motion: &Motion| variance(covariance, motion);
        let Some(number) = structure.subtree_of(frame.link) else {
            return;
        };
        self.imbalances[number] += covariance;
        for link in structure.links_of(number) {
            let Some(dof) = structure.dof_of(link) else {
                continue;
            };
            let variance = variance(&torque_motion(structure, solver, link, frame.link));
            if let [_] = structure.moved_by(dof) {
                self.torque[dof] += variance;
            } else {
                // The deviation of the sum of their torques is at most that of each together.
                let sum = self.torque[dof].sqrt() + variance.sqrt();
                self.torque[dof] = sum * sum;
            }
        }
        let x_bf = kinematics.frame_pose(frame);
        for other in structure.subtrees()[number].contacts.iter() {
            let rows = solver.contact_rows(other);
            for (i, (sum, row)) in self.contacts[other].iter_mut().zip(rows).enumerate() {
                let axis = x_bf.rotation.column(i % 3).into_owned();
                let shift = match i < 3 {
                    true => Motion::translation(&axis),
                    false => Motion::rotation(&axis, &x_bf.translation),
                };
                *sum += variance(&if other == contact { *row - shift } else { *row });
            }
        }
    }

    /// The variance of a torque from the place of one contact, as [`Self::update`] adds it up: for
    /// the solver's last solution [Nm^2 or N^2].
    pub fn torque_variance(
        structure: &Structure,
        solver: &Solver,
        kinematics: &Kinematics,
        dof: usize,
        (contact, std): (usize, PlaceStd),
    ) -> f64 {
        let link = structure.contacts()[contact].frame.link;
        let number = structure.subtree_of(link);
        let Some(covariance) = covariance(structure, solver, kinematics, contact, std) else {
            return 0.0;
        };
        let moved = structure.moved_by(dof).iter();
        let moved_here = moved.filter(|moved| structure.subtree_of(**moved) == number);
        let of_link = |moved: &usize| {
            variance(&covariance, &torque_motion(structure, solver, *moved, link)).sqrt()
        };
        let sum: f64 = moved_here.map(of_link).sum();
        sum * sum
    }

    /// Standard deviation of each torque [Nm or N], by degree of freedom.
    pub fn torque_std(&self) -> &[f64] {
        &self.torque
    }

    /// Standard deviations of each contact's wrench, `[fx fy fz tx ty tz]` [N, Nm].
    pub fn contact_std(&self) -> &[[f64; 6]] {
        &self.contacts
    }

    /// Covariance of each sub-tree's imbalance `b` less its contacts' wrenches [torque; force], at
    /// the origin of base coordinates [Nm, N].
    pub fn imbalance_covariances(&self) -> &[Matrix6<f64>] {
        &self.imbalances
    }
}

/// `[contact below j] s_j - h_j`, of the joint above `link`.
fn torque_motion(structure: &Structure, solver: &Solver, link: usize, touched: usize) -> Motion {
    // The joint above the top link belongs to no sub-tree: it is a sensor's, and fixed.
    let (axis, response) = solver.torque_rows(link);
    match structure.below(link).contains(&touched) {
        true => *axis - *response,
        false => -*response,
    }
}

/// The variance of `motion . w`.
fn variance(covariance: &Matrix6<f64>, motion: &Motion) -> f64 {
    let m = stack(&motion.angular, &motion.linear);
    (covariance * m).dot(&m).max(0.0)
}

/// Covariance of `w`; none for a full wrench.
fn covariance(
    structure: &Structure,
    solver: &Solver,
    kinematics: &Kinematics,
    contact: usize,
    std: PlaceStd,
) -> Option<Matrix6<f64>> {
    let spec = &structure.contacts()[contact];
    let x_bf = kinematics.frame_pose(&spec.frame);
    let force = x_bf.rotation * solver.contacts()[contact].wrench.force;
    // |f|^2 times the projection across f.
    let across = Mat3::from_diagonal_element(force.norm_squared()) - force * force.transpose();
    let direction = match spec.kind {
        ContactKind::Wrench => return None,
        ContactKind::Force => 0.0,
        ContactKind::ForceAlong(_) => std.direction,
    };
    let arm = x_bf.point(&spec.position).cross_matrix();
    let turned = across * direction.powi(2);
    let mixed = arm * turned;
    let torque = across * std.position.powi(2) + mixed * arm.transpose();
    Some(symmetric(&torque, &mixed, &turned))
}
