//! The matrix between the motors and the joints of a coupling.
//!
//! With the joints' angles q = M m, power tau_q . dq = tau_m . dm for all motions asks for
//! tau_q = M^-T tau_m. The motors' angles are m = M^-1 q, their torques tau_m = M^T tau_q.

use proprio_topics::JointState;

/// The greatest number of joints in a coupling.
pub const MOST: usize = 8;

/// The greatest condition number, in the maximum norm: so many times more than the motors' relative
/// error can that of the joints be. Mechanisms have less than 10 (iCub's shoulder: 8); beyond 1000,
/// three of the five digits of a 16-bit encoder are lost, and the matrix is probably mistyped.
const CONDITION: f64 = 1e3;

/// Why a matrix cannot be used.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum MatrixError {
    /// It is not square, of the given size.
    #[error(
        "matrix must have {0} rows of {0} numbers: a row for each joint, a column for each motor"
    )]
    Shape(usize),
    /// A number is not finite.
    #[error("matrix must hold finite numbers")]
    NotFinite,
    /// It cannot be inverted.
    #[error(
        "matrix is singular: there is a motion of the motors that moves no joint, so torques and \
         motors cannot be told from the joints"
    )]
    Singular,
    /// It can hardly be inverted.
    #[error(
        "matrix is nearly singular: its condition number is {0:.0}, more than {CONDITION}; two \
         rows or two columns are nearly the same"
    )]
    Condition(f64),
}

/// A square matrix and its inverse.
#[derive(Debug, Clone, PartialEq)]
pub struct Matrix {
    /// By rows.
    forward: Vec<Vec<f64>>,
    inverse: Vec<Vec<f64>>,
}

impl Matrix {
    /// The matrix with these rows, of size `n`.
    ///
    /// # Errors
    /// [`MatrixError`].
    pub fn new(rows: &[Vec<f64>], n: usize) -> Result<Self, MatrixError> {
        if rows.len() != n || rows.iter().any(|row| row.len() != n) {
            return Err(MatrixError::Shape(n));
        }
        if rows.iter().flatten().any(|x| !x.is_finite()) {
            return Err(MatrixError::NotFinite);
        }
        let inverse = inverse(rows).ok_or(MatrixError::Singular)?;
        let this = Self {
            forward: rows.to_vec(),
            inverse,
        };
        let condition = this.condition();
        if condition <= CONDITION {
            Ok(this)
        } else {
            Err(MatrixError::Condition(condition))
        }
    }

    /// Its condition number in the maximum norm.
    #[must_use]
    pub fn condition(&self) -> f64 {
        let norm = |matrix: &[Vec<f64>]| {
            let row = |row: &Vec<f64>| row.iter().map(|x| x.abs()).sum::<f64>();
            matrix.iter().map(row).fold(0.0, f64::max)
        };
        norm(&self.forward) * norm(&self.inverse)
    }

    /// Row `joint`: how much of each motor is in it.
    pub fn row(&self, joint: usize) -> impl Iterator<Item = f64> + Clone + '_ {
        self.forward.get(joint).into_iter().flatten().copied()
    }

    /// Row `joint` of M^-T: how much of each motor's torque is in the joint's.
    pub fn torque_row(&self, joint: usize) -> impl Iterator<Item = f64> + Clone + '_ {
        column(&self.inverse, joint)
    }

    /// The state of joint number `joint` from the motors'; the current is that of the motor of the
    /// same number.
    #[must_use]
    pub fn joint(
        &self,
        joint: usize,
        motors: impl Iterator<Item = JointState> + Clone,
    ) -> JointState {
        state(self.row(joint), self.torque_row(joint), motors, joint)
    }

    /// The state of motor number `motor` from the joints': the inverse of [`Matrix::joint`].
    #[must_use]
    pub fn motor(
        &self,
        motor: usize,
        joints: impl Iterator<Item = JointState> + Clone,
    ) -> JointState {
        let row = self.inverse.get(motor).into_iter().flatten().copied();
        state(row, column(&self.forward, motor), joints, motor)
    }
}

/// A column of a matrix.
fn column(matrix: &[Vec<f64>], number: usize) -> impl Iterator<Item = f64> + Clone + '_ {
    matrix
        .iter()
        .filter_map(move |row| row.get(number))
        .copied()
}

/// The state with motions by `motion` and the torque by `torque`.
fn state(
    motion: impl Iterator<Item = f64> + Clone,
    torque: impl Iterator<Item = f64>,
    of: impl Iterator<Item = JointState> + Clone,
    number: usize,
) -> JointState {
    let moved = |part: fn(JointState) -> f64| sum(motion.clone(), of.clone().map(part));
    JointState {
        position: moved(|s| s.position),
        velocity: moved(|s| s.velocity),
        acceleration: moved(|s| s.acceleration),
        torque: sum(torque, of.clone().map(|s| s.torque)),
        current: of.clone().nth(number).map_or(f64::NAN, |s| s.current),
    }
}

/// The weighted sum; what has no weight may be absent.
fn sum(weights: impl Iterator<Item = f64>, values: impl Iterator<Item = f64>) -> f64 {
    let used = weights.zip(values).filter(|(weight, _)| *weight != 0.0);
    used.map(|(weight, value)| weight * value).sum()
}

/// The inverse, by Gauss and Jordan with the largest pivot of each column; `None` if there is none.
fn inverse(rows: &[Vec<f64>]) -> Option<Vec<Vec<f64>>> {
    let n = rows.len();
    let unit = |i: usize| (0..n).map(move |j| f64::from(u8::from(i == j)));
    let mut work: Vec<Vec<f64>> = (rows.iter().enumerate())
        .map(|(i, row)| row.iter().copied().chain(unit(i)).collect())
        .collect();
    for column in 0..n {
        let size = |row: &Vec<f64>| row.get(column).map_or(0.0, |x| x.abs());
        let largest = (column..n).max_by(|a, b| {
            let row_size = |i: usize| work.get(i).map_or(0.0, size);
            row_size(*a).total_cmp(&row_size(*b))
        })?;
        work.swap(column, largest);
        let mut pivot_row = work.get(column)?.clone();
        let pivot = *pivot_row.get(column)?;
        if pivot == 0.0 {
            return None;
        }
        pivot_row.iter_mut().for_each(|x| *x /= pivot);
        for (i, row) in work.iter_mut().enumerate() {
            let factor = *row.get(column)?;
            if i == column {
                row.clone_from(&pivot_row);
            } else if factor != 0.0 {
                for (x, p) in row.iter_mut().zip(&pivot_row) {
                    *x -= factor * p;
                }
            }
        }
    }
    let mut inverse: Vec<Vec<f64>> = (work
        .into_iter()
        .map(|row| row.into_iter().skip(n).collect()))
    .collect();
    // What is left of differences that should be zero is no dependence.
    let largest = inverse
        .iter()
        .flatten()
        .fold(0.0, |a: f64, x| a.max(x.abs()));
    let negligible = largest * f64::EPSILON * n as f64;
    for x in inverse.iter_mut().flatten() {
        if x.abs() <= negligible {
            *x = 0.0;
        }
    }
    inverse
        .iter()
        .flatten()
        .all(|x| x.is_finite())
        .then_some(inverse)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// iCub's shoulder: pitch, roll, yaw of three motors.
    const SHOULDER: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [1.0, 0.615, 0.0], [0.0, -0.615, 0.615]];

    fn rows<const N: usize>(rows: [[f64; N]; N]) -> Vec<Vec<f64>> {
        rows.iter().map(|row| row.to_vec()).collect()
    }

    fn constant(x: f64) -> JointState {
        JointState {
            position: x,
            velocity: x,
            acceleration: x,
            torque: x,
            current: x,
        }
    }

    #[test]
    fn the_shoulder_of_icub_is_as_computed_by_hand() {
        let matrix = Matrix::new(&rows(SHOULDER), 3).unwrap();
        // (1 + 0.615) * (2 / 0.615 + 1 / 0.615).
        assert!((matrix.condition() - 1.615 * 3.0 / 0.615).abs() < 1e-12);
        let motors = [0.2, 0.4, -0.1].map(constant);
        let joint = |k| matrix.joint(k, motors.into_iter());
        assert!((joint(0).position - 0.2).abs() < 1e-15);
        assert!((joint(1).velocity - (0.2 + 0.615 * 0.4)).abs() < 1e-15);
        assert!((joint(2).acceleration - 0.615 * (-0.1 - 0.4)).abs() < 1e-15);
        // The yaw's motor turns yaw alone; the second one yaw and roll, the first one all three.
        assert!((joint(2).torque - -0.1 / 0.615).abs() < 1e-15);
        assert!((joint(1).torque - (0.4 - 0.1) / 0.615).abs() < 1e-15);
        assert!((joint(0).torque - (0.2 - (0.4 - 0.1) / 0.615)).abs() < 1e-15);
        assert_eq!([0, 1, 2].map(|k| joint(k).current), [0.2, 0.4, -0.1]);
    }

    /// A joint does not depend on a motor that it has no part of.
    #[test]
    fn what_a_joint_does_not_depend_on_may_be_absent() {
        let matrix = Matrix::new(&rows(SHOULDER), 3).unwrap();
        let motors = [constant(1.0), constant(2.0), JointState::ABSENT];
        let joint = |k| matrix.joint(k, motors.into_iter());
        assert!(joint(0).position == 1.0 && joint(1).velocity == 1.0 + 0.615 * 2.0);
        assert!(joint(2).position.is_nan());
        // Its torque is in all of them.
        assert!((0..3).all(|k| joint(k).torque.is_nan()));
        let joints = [constant(1.0), constant(2.0), JointState::ABSENT];
        let motor = |k| matrix.motor(k, joints.into_iter());
        assert!(motor(0).position == 1.0 && motor(1).position.is_finite());
        assert!(motor(2).position.is_nan() && motor(0).torque == 3.0);
    }

    /// What is zero but for rounding is no dependence.
    #[test]
    fn rounding_makes_no_dependence() {
        let wanted = rows([[0.7, 0.0, 0.3], [-0.6, 1.0, 0.7], [0.0, -0.3, 0.4]]);
        let found = inverse(&inverse(&wanted).unwrap()).unwrap();
        for (found, wanted) in found.iter().flatten().zip(wanted.iter().flatten()) {
            assert!((found - wanted).abs() < 1e-14);
            assert_eq!(*found == 0.0, *wanted == 0.0, "{found}");
        }
    }

    #[test]
    fn a_matrix_that_is_no_coupling_is_refused() {
        let condition = |matrix: &[&[f64]]| {
            let rows: Vec<Vec<f64>> = matrix.iter().map(|row| row.to_vec()).collect();
            Matrix::new(&rows, 2).map(|m| m.condition())
        };
        assert_eq!(condition(&[&[1.0, 0.0]]), Err(MatrixError::Shape(2)));
        assert_eq!(
            condition(&[&[1.0, 0.0], &[0.0]]),
            Err(MatrixError::Shape(2))
        );
        assert_eq!(
            condition(&[&[1.0, 0.0], &[0.0, f64::NAN]]),
            Err(MatrixError::NotFinite)
        );
        assert_eq!(
            condition(&[&[1.0, 2.0], &[2.0, 4.0]]),
            Err(MatrixError::Singular)
        );
        assert_eq!(
            condition(&[&[0.0, 0.0], &[1.0, 4.0]]),
            Err(MatrixError::Singular)
        );
        let near = condition(&[&[1.0, 1.0], &[1.0, 1.001]]);
        assert!(matches!(near, Err(MatrixError::Condition(c)) if c > 4000.0 && c < 4010.0));
        // The size of the numbers is no matter.
        assert_eq!(condition(&[&[1e-4, 1e-4], &[-1e-4, 1e-4]]), Ok(2.0));
        assert_eq!(condition(&[&[0.0, 1.0], &[-1.0, 0.0]]), Ok(1.0));
    }

    proptest! {
        /// Power is the same on both sides, and the way back is the inverse.
        #[test]
        fn power_is_conserved(
            n in 1..=MOST,
            numbers in prop::collection::vec(-1.0..1.0_f64, MOST * MOST),
            values in prop::collection::vec(-10.0..10.0_f64, 5 * MOST),
        ) {
            let row = |i: usize| numbers[i * MOST..i * MOST + n].to_vec();
            let made = Matrix::new(&(0..n).map(row).collect::<Vec<_>>(), n);
            // A random matrix may happen to be nearly singular.
            prop_assume!(made.is_ok());
            let matrix = made.unwrap();
            let motor = |k: usize| JointState {
                position: values[5 * k],
                velocity: values[5 * k + 1],
                acceleration: values[5 * k + 2],
                torque: values[5 * k + 3],
                current: values[5 * k + 4],
            };
            let motors: Vec<JointState> = (0..n).map(motor).collect();
            let all = motors.iter().copied();
            let joints: Vec<JointState> = (0..n).map(|k| matrix.joint(k, all.clone())).collect();
            let power = |of: &[JointState]| of.iter().map(|s| s.velocity * s.torque).sum::<f64>();
            let (at_motors, at_joints) = (power(&motors), power(&joints));
            prop_assert!((at_motors - at_joints).abs() < 1e-7, "{at_motors} {at_joints}");
            for (k, motor) in motors.iter().enumerate() {
                let back = matrix.motor(k, joints.iter().copied());
                prop_assert!((back.position - motor.position).abs() < 1e-9);
                prop_assert!((back.velocity - motor.velocity).abs() < 1e-9);
                prop_assert!((back.acceleration - motor.acceleration).abs() < 1e-9);
                prop_assert!((back.torque - motor.torque).abs() < 1e-9);
                prop_assert_eq!(back.current, motor.current);
            }
        }
    }
}
