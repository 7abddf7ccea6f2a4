//! Which inputs cause the variance of a torque: the parts of a sum that
//! [`Propagation::update`](super::Propagation::update) takes as a whole.
//!
//! With the columns of the root in parts, `U = [U_1 U_2 ...]`, and a torque's row in the same
//! parts, `y = sum of U_i t_i`, and the variance is `|y|^2`. The share of part `i`, `y . U_i t_i`,
//! is the covariance of its error with that of the torque. The shares sum to the variance. That of
//! a part that is correlated with others may be negative: its error cancels a part of theirs.

use super::Propagation;
use super::subtree::SubtreeRoot;
use super::vectors::{ColumnBlock, Covariance6, LANES, Member, Six};
use super::vectors::{add_reading, dot, numbers, times};
use proprio_dynamics::regressor::{LINK_PARAMETERS, link_rows};
use proprio_dynamics::spatial::{Motion, Pose};
use proprio_dynamics::{Kinematics, Solver, Structure};
use proprio_topics::Source;

impl Propagation {
    /// Gives the shares of links and sensors in the variance of a torque [Nm^2 or N^2], for the
    /// last update and its solution: [`Source::Link`] with its number; [`Source::Offset`],
    /// [`Source::Gain`] and [`Source::Drift`] with the number of the sensor. Some come in several
    /// parts. Allocates nothing.
    pub fn torque_shares(
        &mut self,
        structure: &Structure,
        (solver, kinematics): (&Solver, &Kinematics),
        dof: usize,
        mut share: impl FnMut(Source, usize, f64),
    ) {
        let whole = self.torque.get(dof).copied().unwrap_or(0.0);
        let (readings, sum) = (&self.readings, &mut self.sum);
        for part in &self.subtrees {
            for index in 1..part.links.len() {
                let link = part.links[index].link;
                if structure.dof_of(link) != Some(dof) {
                    continue;
                }
                let (axis, response) = solver.torque_rows(link);
                let motion = |at: usize| match structure.below(link).contains(&part.links[at].link)
                {
                    true => *axis - *response,
                    false => -*response,
                };
                let mut variance = 0.0;
                let mut shares = |each: &mut dyn FnMut(Source, usize, f64)| {
                    part.shares((solver, kinematics), &motion, (readings, sum), each);
                };
                shares(&mut |_, _, own| variance += own);
                if variance > 0.0 {
                    // Deviations of several sub-trees add. Some wrenches were computed a little
                    // earlier.
                    let factor = whole / variance.sqrt();
                    shares(&mut |source, number, own| share(source, number, factor * own));
                }
            }
        }
    }
}

impl SubtreeRoot {
    /// The shares of a result that has this motion at the link with each index; `sum` is memory.
    fn shares(
        &self,
        (solver, kinematics): (&Solver, &Kinematics),
        motion: &dyn Fn(usize) -> Motion,
        (readings, sum): (&[[f64; 6]], &mut [f32]),
        share: &mut dyn FnMut(Source, usize, f64),
    ) {
        let of_link = |link: usize, index: usize| {
            let rows = link_rows(kinematics.pose(link), kinematics.motion(link));
            let motion = numbers(&motion(index));
            let coefficient = |i: usize| (0..6).map(|axis| rows[axis][i] * motion[axis]).sum();
            std::array::from_fn::<f64, LINK_PARAMETERS, _>(coefficient)
        };
        let each = || self.column_blocks.iter();
        let coefficients = |block: &ColumnBlock| match block.what {
            Member::Link(link) => of_link(link, block.link_index),
            Member::Sensor(sensor, is_positive) => {
                let motion = motion(block.link_index);
                let motion = if is_positive { motion } else { -motion };
                let [own @ .., _, _] = in_sensor(solver.sensor_pose(sensor), &motion);
                std::array::from_fn(|i| own.get(i).copied().unwrap_or(0.0))
            }
            Member::Calibration => [0.0; LINK_PARAMETERS],
        };
        sum.fill(0.0);
        for block in each() {
            let rows = &mut sum[LANES * block.rows.start..];
            for (column, factor) in block.columns_of(&block.columns).zip(coefficients(block)) {
                let column = column.as_flattened().iter();
                rows.iter_mut()
                    .zip(column)
                    .for_each(|(y, u)| *y += *u * super::vectors::single(factor));
            }
        }
        for block in each() {
            let (rows, factors) = (&sum[LANES * block.rows.start..], coefficients(block));
            let with_rows = |column: &[f32]| {
                let products = column.iter().zip(rows);
                products
                    .map(|(u, y)| f64::from(*u) * f64::from(*y))
                    .sum::<f64>()
            };
            let product = |columns| {
                let columns = block.columns_of(columns).zip(factors);
                columns
                    .map(|(column, factor)| factor * with_rows(column.as_flattened()))
                    .sum::<f64>()
            };
            let variance = product(&block.columns);
            match (block.what, &block.calibration) {
                (Member::Link(link), _) => share(Source::Link, link, variance),
                (Member::Sensor(sensor, _), None) => share(Source::Offset, sensor, variance),
                (Member::Sensor(sensor, _), Some(calibration)) => {
                    let offset = product(&calibration.offset);
                    share(Source::Offset, sensor, offset);
                    share(Source::Gain, sensor, variance - offset);
                }
                (Member::Calibration, _) => {}
            }
        }
        for (link, index, root) in &self.independent {
            let factors = of_link(*link, *index);
            let row = |row: &[f64; LINK_PARAMETERS]| {
                let sum: f64 = row.iter().zip(factors).map(|(u, factor)| u * factor).sum();
                sum * sum
            };
            share(Source::Link, *link, root.iter().map(row).sum());
        }
        for end in &self.ends {
            let (mut covariance, pose) = (Covariance6::default(), solver.sensor_pose(end.sensor));
            add_reading(&mut covariance, pose, &readings[end.sensor]);
            let motion = numbers(&motion(end.link_index));
            let variance = dot(&motion, &times(&covariance, &motion));
            share(Source::Drift, end.sensor, variance);
        }
    }
}

/// A motion in the axes and at the origin of a sensor at `x_bm`: what one unit of each channel
/// [torque; force] adds to its product with the sensor's wrench.
fn in_sensor(x_bm: &Pose, motion: &Motion) -> Six {
    numbers(&x_bm.twist_back(motion))
}
