//! Torques on the motor side: coupled joints, rotor inertia and friction.
//!
//! A joint torque of the rigid-body regressor is on the link side. Measured motor torques
//! (currents) also accelerate the rotor and overcome friction. Where several motors drive several
//! joints together (the shoulder and the torso of the iCub), a motor torque does not belong to one
//! joint alone.

use nalgebra::{DMatrix, DMatrixView};

use super::tree::transposed_view;
use crate::error::{DynamicsError, check_size};
use crate::kinematics::JointState;

/// Greatest condition number of the equilibrated matrix at which it counts as invertible.
const WORST_CONDITION: f64 = 1e10;

/// Joints that a group of the same number of motors drives together: `dq_motor = matrix * dq_joint`
/// within the group.
#[derive(Clone, Debug, PartialEq)]
pub struct Coupling {
    /// Name of the group in error messages.
    pub name: String,
    /// Its degrees of freedom. The motors of the group have the same numbers: row `i` is for motor
    /// `dofs[i]`.
    pub dofs: Vec<usize>,
    /// Motor rates from joint rates; it may include gear ratios.
    pub matrix: DMatrix<f64>,
}

/// Why a description of motors is invalid.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum MotorError {
    /// The matrix is not square, or its size differs from that of the group.
    #[error("coupled joints {group}: a {rows} x {columns} matrix for {dofs} joints")]
    Shape {
        /// The group.
        group: String,
        /// Rows of the matrix.
        rows: usize,
        /// Columns of the matrix.
        columns: usize,
        /// Joints of the group.
        dofs: usize,
    },
    /// A degree of freedom that the robot does not have.
    #[error("coupled joints {group}: there is no degree of freedom {dof}")]
    NoDof {
        /// The group.
        group: String,
        /// The number.
        dof: usize,
    },
    /// A degree of freedom that occurs twice.
    #[error("coupled joints {group}: degree of freedom {dof} is already in a group")]
    Twice {
        /// The group of the second occurrence.
        group: String,
        /// The number.
        dof: usize,
    },
    /// The matrix cannot be inverted, or has an entry that is not finite.
    #[error("coupled joints {group}: the matrix from joint rates to motor rates is singular")]
    Singular {
        /// The group.
        group: String,
    },
    /// Too few or too many actuators.
    #[error("{got} actuators for {expected} motors")]
    Actuators {
        /// How many were given.
        got: usize,
        /// How many motors there are.
        expected: usize,
    },
    /// The speed that smooths Coulomb friction is not positive.
    #[error(
        "motor {motor}: Coulomb friction is smoothed over {speed}; it must be positive and finite"
    )]
    Speed {
        /// The motor.
        motor: usize,
        /// The given value.
        speed: f64,
    },
}

#[derive(Clone, Debug)]
struct Group {
    dofs: Vec<usize>,
    /// `M`, and `M^-T`.
    matrix: DMatrix<f64>,
    inverse_transposed: DMatrix<f64>,
}

/// Between joint and motor coordinates: `dq_m = M dq_j`, `tau_m = M^-T tau_j`, so that
/// `tau_m . dq_m = tau_j . dq_j`. Block by block; a joint in no group has its own motor, with the
/// same rate and torque. The number of motors is that of the degrees of freedom.
#[derive(Clone, Debug)]
pub struct Transmission {
    groups: Vec<Group>,
    /// Per degree of freedom, and per motor of the same number: its group and its index there.
    places: Vec<Option<(usize, usize)>>,
}

impl Transmission {
    /// Every joint has its own motor.
    pub fn direct(dofs: usize) -> Self {
        Self {
            groups: Vec::new(),
            places: vec![None; dofs],
        }
    }

    /// For a robot with `dofs` degrees of freedom and these groups of coupled joints.
    ///
    /// # Errors
    /// [`MotorError`] with the name of the group: a matrix of wrong shape or singular, a joint that
    /// does not exist or is in two groups.
    pub fn new(dofs: usize, couplings: &[Coupling]) -> Result<Self, MotorError> {
        let mut places = vec![None; dofs];
        let mut groups = Vec::with_capacity(couplings.len());
        for (number, coupling) in couplings.iter().enumerate() {
            let group = || coupling.name.clone();
            let (rows, columns) = coupling.matrix.shape();
            if rows != coupling.dofs.len() || columns != coupling.dofs.len() {
                return Err(MotorError::Shape {
                    group: group(),
                    rows,
                    columns,
                    dofs: coupling.dofs.len(),
                });
            }
            for (place, &dof) in coupling.dofs.iter().enumerate() {
                let slot = places.get_mut(dof).ok_or_else(|| MotorError::NoDof {
                    group: group(),
                    dof,
                })?;
                if slot.replace((number, place)).is_some() {
                    return Err(MotorError::Twice {
                        group: group(),
                        dof,
                    });
                }
            }
            let inverse =
                invert(&coupling.matrix).ok_or_else(|| MotorError::Singular { group: group() })?;
            groups.push(Group {
                dofs: coupling.dofs.clone(),
                matrix: coupling.matrix.clone(),
                inverse_transposed: inverse.transpose(),
            });
        }
        Ok(Self { groups, places })
    }

    /// Number of motors and of degrees of freedom.
    pub fn motor_count(&self) -> usize {
        self.places.len()
    }

    /// Rates or accelerations of the motors from those of the joints: `M dq_j`.
    ///
    /// # Errors
    /// The length of a slice is not the number of motors. Nothing is changed in that case.
    pub fn motor_rates(&self, joints: &[f64], motors: &mut [f64]) -> Result<(), DynamicsError> {
        self.apply(joints, motors, |group, i, j| group.matrix[(i, j)])
    }

    /// Torques of the motors from those of the joints: `M^-T tau_j`.
    ///
    /// # Errors
    /// The length of a slice is not the number of motors. Nothing is changed in that case.
    pub fn motor_torques(&self, joints: &[f64], motors: &mut [f64]) -> Result<(), DynamicsError> {
        self.apply(joints, motors, |group, i, j| {
            group.inverse_transposed[(i, j)]
        })
    }

    /// Torques of the joints from those of the motors: `M^T tau_m`.
    ///
    /// # Errors
    /// The length of a slice is not the number of motors. Nothing is changed in that case.
    pub fn joint_torques(&self, motors: &[f64], joints: &mut [f64]) -> Result<(), DynamicsError> {
        self.apply(motors, joints, |group, i, j| group.matrix[(j, i)])
    }

    fn apply(
        &self,
        from: &[f64],
        to: &mut [f64],
        entry: impl Fn(&Group, usize, usize) -> f64,
    ) -> Result<(), DynamicsError> {
        for count in [from.len(), to.len()] {
            check_size("joints or motors", count, self.places.len())?;
        }
        for (number, out) in to.iter_mut().enumerate() {
            *out = match self.group_of(number) {
                None => from[number],
                Some((group, row)) => {
                    let parts = group.dofs.iter().enumerate();
                    parts
                        .map(|(column, &other)| entry(group, row, column) * from[other])
                        .sum()
                }
            };
        }
        Ok(())
    }

    /// The group of a joint or motor and its index there; `None` if it is in no group.
    fn group_of(&self, number: usize) -> Option<(&Group, usize)> {
        self.places[number].map(|(group, place)| (&self.groups[group], place))
    }
}

/// The inverse, unless the matrix is singular. Rows are motors and columns joints, in any units:
/// each is first scaled to a greatest entry of 1.
fn invert(matrix: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    if !matrix.iter().all(|x| x.is_finite()) {
        return None;
    }
    let mut scaled = matrix.clone();
    let (mut rows, mut columns) = (Vec::new(), Vec::new());
    for mut row in scaled.row_iter_mut() {
        let size = row.amax();
        row /= size;
        rows.push(size);
    }
    for mut column in scaled.column_iter_mut() {
        let size = column.amax();
        column /= size;
        columns.push(size);
    }
    // A row or column of zeros has become NaN here; the comparison rejects NaN.
    let norm = |m: &DMatrix<f64>| m.row_iter().map(|row| row.lp_norm(1)).fold(0.0, f64::max);
    let size = norm(&scaled);
    let mut inverse = scaled.try_inverse()?;
    let sound = inverse.iter().all(|x| x.is_finite()) && size * norm(&inverse) < WORST_CONDITION;
    for (joint, column) in columns.iter().enumerate() {
        for (motor, row) in rows.iter().enumerate() {
            inverse[(joint, motor)] /= column * row;
        }
    }
    (sound && inverse.iter().all(|x| x.is_finite())).then_some(inverse)
}

/// The terms of a motor besides the links, one column each. By default there are none.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Actuator {
    /// Inertia of the rotor, reflected to the motor's coordinate.
    pub rotor_inertia: bool,
    /// Coulomb friction, with the speed `v0` [rad/s or m/s] over which its sign is smoothed.
    pub coulomb: Option<f64>,
    /// Viscous friction.
    pub viscous: bool,
    /// A constant torque: bias of the current sensor, or asymmetric friction.
    pub offset: bool,
}

/// One column of a motor, and the parameter that belongs to it with its unit (for a rotary motor).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MotorTerm {
    /// Acceleration of the motor; rotor inertia [kg m^2].
    RotorInertia,
    /// `tanh(rate / v0)`; Coulomb friction [Nm].
    Coulomb,
    /// Rate of the motor; viscous friction [Nm s/rad].
    Viscous,
    /// One; offset [Nm].
    Offset,
}

impl Actuator {
    /// The columns in their order, each with its value for a rate and an acceleration of the motor.
    fn columns(&self, rate: f64, acceleration: f64) -> impl Iterator<Item = (MotorTerm, f64)> {
        let terms = [
            self.rotor_inertia
                .then_some((MotorTerm::RotorInertia, acceleration)),
            self.coulomb
                .map(|speed| (MotorTerm::Coulomb, (rate / speed).tanh())),
            self.viscous.then_some((MotorTerm::Viscous, rate)),
            self.offset.then_some((MotorTerm::Offset, 1.0)),
        ];
        terms.into_iter().flatten()
    }
}

/// The torques of all motors as linear functions of the parameters of the links and of the motors:
///
/// ```text
/// tau_m = M^-T Y_c phi + J ddq_m + F_c tanh(dq_m / v0) + F_v dq_m + F_0
/// dq_m = M dq_j
/// ```
///
/// One row per motor, in the order of the model's degrees of freedom. Columns: those of the given
/// joint rows ([`super::Regressor::joint_row`], or [`super::EstimateRows::torque_row`] expanded),
/// then those of each motor ([`Actuator`], in the order of [`MotorTerm`]), motor by motor.
///
/// The part of the links is valid under the conditions of the joint rows: those of
/// [`super::Regressor`] are valid only while the base link is the only link in contact with the
/// environment.
///
/// The spin of a rotor enters the row of its own motor only: `J ddq_m` is the torque that changes
/// the spin *relative to the link that carries the motor*. Other effects of a fast rotor on that
/// link are neglected, as is usual for high gear ratios (Spong 1987): the gyroscopic torque when
/// the link rotates, and the part of the angular momentum due to the angular acceleration of the
/// link along the rotor's axis. The mass of the rotor and its inertia when locked belong to the ten
/// parameters of the link that carries it.
#[derive(Clone, Debug)]
pub struct MotorRegressor {
    transmission: Transmission,
    actuators: Vec<Actuator>,
    /// Per motor: the first of its columns.
    firsts: Vec<usize>,
    values: Vec<f64>,
    /// Number of columns of the joint rows.
    links: usize,
    /// Number of all columns.
    stride: usize,
    rates: Vec<f64>,
    accelerations: Vec<f64>,
}

impl MotorRegressor {
    /// For joint rows of `columns` numbers each; `actuators` has one entry per motor.
    ///
    /// # Errors
    /// [`MotorError`]: the number of actuators is wrong, or a smoothing speed is not positive.
    pub fn new(
        columns: usize,
        transmission: Transmission,
        actuators: &[Actuator],
    ) -> Result<Self, MotorError> {
        let motors = transmission.motor_count();
        if actuators.len() != motors {
            return Err(MotorError::Actuators {
                got: actuators.len(),
                expected: motors,
            });
        }
        let links = columns;
        let mut stride = links;
        let mut firsts = Vec::with_capacity(motors);
        for (motor, actuator) in actuators.iter().enumerate() {
            if let Some(speed) = actuator.coulomb
                && !(speed.is_finite() && speed > 0.0)
            {
                return Err(MotorError::Speed { motor, speed });
            }
            firsts.push(stride);
            stride += actuator.columns(0.0, 0.0).count();
        }
        Ok(Self {
            transmission,
            actuators: actuators.to_vec(),
            firsts,
            values: vec![0.0; motors * stride],
            links,
            stride,
            rates: vec![0.0; motors],
            accelerations: vec![0.0; motors],
        })
    }

    /// Computes all rows from those of the joints, by degree of freedom, and the state of the same
    /// joints: `motors.update(|dof| regressor.joint_row(dof), state)`.
    ///
    /// # Errors
    /// A joint has no row, sizes do not fit, or a velocity or acceleration is not finite. Nothing
    /// is changed in that case.
    pub fn update<'r>(
        &mut self,
        joint_row: impl Fn(usize) -> Option<&'r [f64]>,
        state: JointState<'_>,
    ) -> Result<(), DynamicsError> {
        let motors = self.actuators.len();
        for dof in 0..motors {
            let missing = DynamicsError::Index {
                what: "joints with a row",
                index: dof,
                count: motors,
            };
            check_size(
                "columns of a joint's row",
                joint_row(dof).ok_or(missing)?.len(),
                self.links,
            )?;
        }
        for (what, values) in [
            ("joint velocities", state.velocity),
            ("joint accelerations", state.acceleration),
        ] {
            check_size(what, values.len(), motors)?;
            if let Some(index) = values.iter().position(|x| !x.is_finite()) {
                return Err(DynamicsError::NotFinite { what, index });
            }
        }
        self.transmission
            .motor_rates(state.velocity, &mut self.rates)?;
        self.transmission
            .motor_rates(state.acceleration, &mut self.accelerations)?;
        for (motor, out) in self.values.chunks_exact_mut(self.stride).enumerate() {
            let (links, own) = out.split_at_mut(self.links);
            match self.transmission.group_of(motor) {
                None => links.copy_from_slice(joint_row(motor).unwrap_or_default()),
                Some((group, place)) => {
                    links.fill(0.0);
                    for (column, &dof) in group.dofs.iter().enumerate() {
                        let factor = group.inverse_transposed[(place, column)];
                        for (sum, value) in links.iter_mut().zip(joint_row(dof).unwrap_or_default())
                        {
                            *sum += factor * value;
                        }
                    }
                }
            }
            let columns =
                self.actuators[motor].columns(self.rates[motor], self.accelerations[motor]);
            for (slot, (_, value)) in own[self.firsts[motor] - self.links..]
                .iter_mut()
                .zip(columns)
            {
                *slot = value;
            }
        }
        Ok(())
    }

    /// Number of columns: those of the links, then the motors'.
    pub fn column_count(&self) -> usize {
        self.stride
    }

    /// Column of a motor's term; `None` if it does not have one.
    pub fn column(&self, motor: usize, term: MotorTerm) -> Option<usize> {
        let place = self
            .actuators
            .get(motor)?
            .columns(0.0, 0.0)
            .position(|(own, _)| own == term)?;
        Some(self.firsts[motor] + place)
    }

    /// The row of a motor's torque.
    ///
    /// # Panics
    /// There is no such motor.
    pub fn row(&self, motor: usize) -> &[f64] {
        &self.values[self.stride * motor..self.stride * (motor + 1)]
    }

    /// All rows, one per motor, as the columns of a view.
    pub fn transposed(&self) -> DMatrixView<'_, f64> {
        transposed_view(&self.values, self.stride, self.actuators.len(), self.stride)
    }

    /// Between joint and motor coordinates.
    pub fn transmission(&self) -> &Transmission {
        &self.transmission
    }
}
