//! The six equations of every sub-tree as linear functions of parameters, sensor offsets and
//! unknown contacts. Identification uses these equations.

mod columns;

use self::columns::{contact_columns, wrench_columns};
use nalgebra::{Matrix6, Vector6};

use crate::error::{DynamicsError, check_size};
use crate::kinematics::{ExternalWrench, Kinematics, check_external, check_readings};
use crate::least_squares::{LeastSquares, noise_factor, scale_factor};
use crate::regressor::link::{LINK_PARAMETERS, WITH_FORCE, link_rows};
use crate::spatial::{Pose, Wrench};
use crate::structure::{ContactSet, Structure};

/// A present contact and its columns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PresentContact {
    /// Its number in the structure.
    pub contact: usize,
    /// Its first column within the row of the sub-tree.
    pub column: usize,
    /// Number of its columns.
    pub unknowns: usize,
}

/// One sub-tree's six equations, `[Y O -C] [phi; o; x] = measured`, at the origin and in the axes
/// of its top link, rows [torque; force].
///
/// Columns of a row, in this order:
/// - ten per link of the sub-tree ([`SubTreeRegressor::links`]): the net wrench of its links;
/// - six per F/T sensor at its ends ([`SubTreeRegressor::sensors`]), its offset [torque; force] in
///   its measurement frame;
/// - those of each present contact ([`SubTreeRegressor::contacts`]), the unknown wrench on the
///   link, in the axes of the contact's frame: [torque; force] at the frame's origin
///   (`ContactKind::Wrench`); force at the contact's position (`Force`); its size along the
///   direction (`ForceAlong`).
#[derive(Clone, Debug)]
pub struct SubTreeRegressor {
    top: usize,
    links: Vec<usize>,
    sensors: Vec<usize>,
    contacts: Vec<PresentContact>,
    /// Columns of links and offsets.
    known: usize,
    /// Columns of the present contacts.
    unknown: usize,
    /// Distance between rows: enough for the columns of all contacts.
    stride: usize,
    values: Vec<f64>,
    measured: [f64; 6],
    covariance: Matrix6<f64>,
    least: LeastSquares,
    /// The combinations of the six equations to which no contact contributes, their rows and right
    /// sides, and their number.
    projections: [[f64; 6]; 6],
    projected: Vec<f64>,
    projected_measured: [f64; 6],
    remaining: usize,
}

impl SubTreeRegressor {
    fn new(structure: &Structure, number: usize) -> Self {
        let subtree = &structure.subtrees()[number];
        let links: Vec<usize> = structure.links_of(number).collect();
        let sensors: Vec<usize> = subtree.sensors.iter().collect();
        let known = LINK_PARAMETERS * links.len() + 6 * sensors.len();
        let room = subtree
            .contacts
            .iter()
            .map(|contact| structure.contacts()[contact].kind.unknowns())
            .sum();
        let stride = known + room;
        Self {
            top: subtree.top,
            contacts: Vec::with_capacity(subtree.contacts.len()),
            known,
            unknown: 0,
            stride,
            values: vec![0.0; 6 * stride],
            measured: [0.0; 6],
            covariance: Matrix6::zeros(),
            least: LeastSquares::with_capacity(room),
            projections: [[0.0; 6]; 6],
            projected: vec![0.0; 6 * known],
            projected_measured: [0.0; 6],
            remaining: 0,
            links,
            sensors,
        }
    }

    /// The link at whose origin and in whose axes the six equations are written.
    pub fn top(&self) -> usize {
        self.top
    }

    /// Its links, ascending.
    pub fn links(&self) -> &[usize] {
        &self.links
    }

    /// The F/T sensors at its ends, ascending.
    pub fn sensors(&self) -> impl ExactSizeIterator<Item = usize> {
        self.sensors.iter().copied()
    }

    /// Its contacts that were present at the last update, ascending.
    pub fn contacts(&self) -> &[PresentContact] {
        &self.contacts
    }

    /// Number of columns: `10 links + 6 sensors + unknowns of the present contacts`.
    pub fn column_count(&self) -> usize {
        self.known + self.unknown
    }

    /// First column of the sensors' offsets, after those of the links.
    pub fn offset_column(&self) -> usize {
        LINK_PARAMETERS * self.links.len()
    }

    /// First column of the contacts, after those of the offsets.
    pub fn contact_column(&self) -> usize {
        self.known
    }

    /// One of the six rows, [torque; force].
    ///
    /// # Panics
    /// There is no such row.
    pub fn row(&self, row: usize) -> &[f64] {
        &self.values[self.stride * row..][..self.column_count()]
    }

    /// The right side: the raw readings of the sensors, as wrenches by the rest of the robot on
    /// this sub-tree, and the known external wrenches.
    pub fn measured(&self) -> &[f64; 6] {
        &self.measured
    }

    /// Covariance of the six equations from F/T noise, rows and columns [torque; force]; zero
    /// without sensors.
    pub fn covariance(&self) -> &Matrix6<f64> {
        &self.covariance
    }

    /// Number of rows that remain without contact columns: six minus the rank of these columns.
    /// (Contacts count as dependent if a singular value of their columns, weighted as the rows are,
    /// is below 1e-8 of the greatest. Near this limit the solver may disagree.)
    pub fn remaining(&self) -> usize {
        self.remaining
    }

    /// One of the remaining rows, over links and offsets only: whitened, with unit covariance of
    /// F/T noise within the sub-tree. (If the Cholesky factorisation of the covariance fails by
    /// rounding, only the variances are used, as in the solver, and the covariance is only
    /// approximately unit.) Without sensors there is no noise: rows `p` are orthonormal in newtons,
    /// `p diag(d^2, d^2, d^2, 1, 1, 1) p'^T = 1 or 0` with the structure's length scale `d`, about
    /// the origin of the top link.
    ///
    /// # Panics
    /// There is no such row; see [`SubTreeRegressor::remaining`].
    pub fn projected_row(&self, row: usize) -> &[f64] {
        assert!(row < self.remaining, "{} rows remain", self.remaining);
        &self.projected[self.known * row..self.known * (row + 1)]
    }

    /// The combination `p` of the six equations that gives a remaining row:
    /// `projected_row = p [Y O]`, and `p C = 0`.
    ///
    /// # Panics
    /// There is no such row; see [`SubTreeRegressor::remaining`].
    pub fn projection(&self, row: usize) -> &[f64; 6] {
        &self.projections[..self.remaining][row]
    }

    /// Right sides of the remaining rows.
    pub fn projected_measured(&self) -> &[f64] {
        &self.projected_measured[..self.remaining]
    }

    fn update(&mut self, structure: &Structure, kinematics: &Kinematics, active: &ContactSet) {
        let to_top = kinematics.pose(self.top).inverse();
        let stride = self.stride;
        for (place, &link) in self.links.iter().enumerate() {
            let column = LINK_PARAMETERS * place;
            // The pose of the top link is exactly the identity, without rounding from a transform
            // to the base and back.
            let x_tl = if link == self.top {
                Pose::identity()
            } else {
                to_top * *kinematics.pose(link)
            };
            let rows = link_rows(&x_tl, kinematics.motion(link));
            for (number, row) in rows.iter().enumerate() {
                // The other columns of force rows are zero from the start.
                let width = if number < 3 {
                    LINK_PARAMETERS
                } else {
                    WITH_FORCE
                };
                self.values[number * stride + column..][..width].copy_from_slice(&row[..width]);
            }
        }
        let mut column = LINK_PARAMETERS * self.links.len();
        for &sensor in &self.sensors {
            let cut = &structure.sensors()[sensor];
            let child = cut.joint() + 1;
            // The child of a sensor's joint is the top of the sub-tree below the sensor.
            let (x_tm, sign) = if child == self.top {
                (*cut.pose(), cut.sign())
            } else {
                (to_top * *kinematics.pose(child) * *cut.pose(), -cut.sign())
            };
            for unit in wrench_columns(&x_tm) {
                put(&mut self.values, stride, column, unit * sign);
                column += 1;
            }
        }
        let subtree_contacts =
            structure.subtrees()[structure.subtree_of(self.top).unwrap_or(0)].contacts;
        self.contacts.clear();
        for contact in subtree_contacts.intersection(active).iter() {
            let spec = &structure.contacts()[contact];
            let x_tf = to_top * *kinematics.pose(spec.frame.link) * spec.frame.pose;
            let first = column;
            for unit in contact_columns(spec, &x_tf) {
                put(&mut self.values, stride, column, -unit);
                column += 1;
            }
            self.contacts.push(PresentContact {
                contact,
                column: first,
                unknowns: column - first,
            });
        }
        self.unknown = column - self.known;
    }

    /// Right side and covariance from raw readings and known wrenches, after the offset columns: a
    /// reading enters as its offset does.
    fn measure(
        &mut self,
        structure: &Structure,
        kinematics: &Kinematics,
        readings: &[Wrench],
        external: &[ExternalWrench],
    ) {
        self.measured = [0.0; 6];
        self.covariance = Matrix6::zeros();
        for (place, &sensor) in self.sensors.iter().enumerate() {
            let first = LINK_PARAMETERS * self.links.len() + 6 * place;
            let reading = readings[sensor].torque_first();
            let noise = structure.sensors()[sensor].noise();
            let deviations = Wrench::from_parts(noise.force, noise.torque).torque_first();
            for (channel, (value, deviation)) in reading.iter().zip(deviations).enumerate() {
                let column =
                    Vector6::from_fn(|row, _| self.values[row * self.stride + first + channel]);
                for row in 0..6 {
                    self.measured[row] += column[row] * value;
                }
                self.covariance += column * column.transpose() * (deviation * deviation);
            }
        }
        let number = structure.subtree_of(self.top);
        for known in external {
            if structure.subtree_of(known.frame.link) == number {
                let in_top = kinematics
                    .pose(self.top)
                    .wrench_back(&known.in_base(kinematics));
                for (sum, value) in self.measured.iter_mut().zip(in_top.torque_first()) {
                    *sum += value;
                }
            }
        }
    }

    /// Computes the combinations of the six equations to which no present contact contributes, at
    /// most `6 - rank`. They are valid for any wrenches at the contacts.
    fn eliminate(&mut self, structure: &Structure) {
        self.remaining = 0;
        // With a full unknown wrench no row remains.
        if self.contacts.iter().any(|contact| contact.unknowns == 6) {
            return;
        }
        self.least.clear();
        for present in &self.contacts {
            for column in present.column..present.column + present.unknowns {
                let unit = Vector6::from_fn(|row, _| self.values[row * self.stride + column]);
                self.least.push(unit, 1.0);
            }
        }
        let lower = if self.sensors.is_empty() {
            scale_factor(structure.length_scale())
        } else {
            noise_factor(self.covariance)
        };
        self.least.factorise(&lower);
        for weights in self.least.complement() {
            let out = &mut self.projected[self.known * self.remaining..][..self.known];
            out.fill(0.0);
            self.projected_measured[self.remaining] = 0.0;
            for (number, &weight) in weights.iter().enumerate() {
                let row = &self.values[number * self.stride..][..self.known];
                for (sum, value) in out.iter_mut().zip(row) {
                    *sum += weight * value;
                }
                self.projected_measured[self.remaining] += weight * self.measured[number];
            }
            self.projections[self.remaining] = weights.into();
            self.remaining += 1;
        }
    }
}

/// Writes a column.
fn put(values: &mut [f64], stride: usize, column: usize, unit: Wrench) {
    for (row, value) in unit.torque_first().into_iter().enumerate() {
        values[row * stride + column] = value;
    }
}

/// The equations of all sub-trees of a structure.
///
/// Stacked, they are `6 K` rows over the columns
/// `[10 N_B | 6 per sensor | unknowns of each present contact]`: links in the model's order,
/// sensors in the structure's, contacts ascending. A link or a contact appears in one sub-tree
/// only, a sensor's offset in the two that it separates.
///
/// # Noise between sub-trees
/// A sensor is between two sub-trees, so its noise is in the equations of both, with opposite
/// signs: the rows of neighbours are correlated, whitened or not. Least squares on all sub-trees
/// needs the covariance of the whole stack, or of all rows that remain without contacts. Rows of
/// sub-trees that share no sensor are uncorrelated.
///
/// That covariance is singular if some combination of rows contains no sensor. Summed over all
/// sub-trees, about one point, the six equations are those of the whole robot, where the wrench of
/// every sensor cancels. These are six combinations without noise, so the covariance of the `6 K`
/// equations of `K` sub-trees with `K - 1` sensors has rank `6 K - 6`. For the rows that remain
/// without contacts the rank deficiency is `6 - r`, with `r` the rank of the columns of all present
/// contacts together, about one point. It is zero as soon as one full wrench acts anywhere, or if
/// the contacts would hold the robot if it were rigid. A combination without noise is an exact
/// constraint on the parameters (of a robot in free fall, for example); its weight must come from
/// another source, such as model errors.
///
/// The rows do not depend on the base of the kinematics. A sub-tree without sensors has its
/// equations too; unless the robot is free, a contact (such as that of a fixed base) must be
/// declared on it.
#[derive(Clone, Debug)]
pub struct StackedRegressor {
    /// A copy, so that no call can pass a different structure.
    structure: Structure,
    subtrees: Vec<SubTreeRegressor>,
}

impl StackedRegressor {
    /// For a structure, of which it keeps a copy.
    pub fn new(structure: &Structure) -> Self {
        let numbers = 0..structure.subtrees().len();
        Self {
            subtrees: numbers
                .map(|number| SubTreeRegressor::new(structure, number))
                .collect(),
            structure: structure.clone(),
        }
    }

    /// Computes all rows, right sides and covariances, and the rows that remain without contacts
    /// ([`SubTreeRegressor::projected_row`]). `readings` are the raw readings of the
    /// structure's sensors, offsets *not* removed, in their measurement frames; contacts in
    /// `active` are present; `external` wrenches are known.
    ///
    /// # Errors
    /// Kinematics of a model with another number of links, wrong sizes, numbers that are not
    /// finite. Nothing is changed in that case.
    pub fn update(
        &mut self,
        kinematics: &Kinematics,
        readings: &[Wrench],
        active: &ContactSet,
        external: &[ExternalWrench],
    ) -> Result<(), DynamicsError> {
        let (structure, links) = (&self.structure, self.structure.link_count());
        check_size("links of the kinematics", kinematics.link_count(), links)?;
        check_readings(readings, structure.sensors().len())?;
        check_external(external, links)?;
        for subtree in &mut self.subtrees {
            subtree.update(structure, kinematics, active);
            subtree.measure(structure, kinematics, readings, external);
            subtree.eliminate(structure);
        }
        Ok(())
    }

    /// The structure that it was made for.
    pub fn structure(&self) -> &Structure {
        &self.structure
    }

    /// The sub-trees, in the order of the structure.
    pub fn subtrees(&self) -> &[SubTreeRegressor] {
        &self.subtrees
    }
}
