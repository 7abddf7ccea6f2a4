//! What the covariance of parameters and offsets comes to in the solver's results: a standard deviation for every torque and every component of a
//! contact's wrench, at every instant.
//!
//! [`super::EstimateRows`] has the rows `T` for it: variance = `t P t^T`. Written out row by row that is a product with a large triangle per result. Here the
//! triangle is multiplied once per sub-tree instead, with the six rows of wrenches, in base coordinates:
//!
//! ```text
//! P = U^T U                                          U: the covariance's root in the sub-tree's columns, upper triangular
//! G_l = U_l A_l^T          (rows x 6)                of each link, A_l its regressor; of each sensor likewise, A_s its offset's wrench
//! W_l = sum of G below l   (rows x 6)                so that Cov(F_l, F_k) = W_l^T W_k, as F_l is the sum of wrenches below l
//! var(tau_j) = |W_j s_j - W_b h_j|^2                 tau_j = s_j . F_j - h_j . b   (top of dynamics/solver.rs)
//! var(x_i)   = |W_b k_i|^2                           x_i = k_i . b
//! ```
//!
//! A link whose parameters are correlated with nothing else in its sub-tree needs no rows there: `C_l = G_l^T G_l` is six by six, and independent covariances add,
//! `var(tau_j) = s_j^T C s_j - 2 s_j^T C h_j + h_j^T C_b h_j` with `C` summed over what is below `j`, `C_b` over all. So what is known from the URDF alone costs little.
//!
//! Where a sensor's calibration is uncertain, too ([`crate::calibration`]), its columns `U_c` count as its offset's by what it reads: `U_s` becomes `U_s - U_E r + U_k (T - T0)` at each
//! instant ([`Propagation::set_reading`]).
//!
//! Loops over rows use the widest instructions of the processor, in a portable build too.
//!
//! Columns are ordered sensors first, then links from the tips to the top: what lies below a joint has short columns in the triangle. `U` and `W` are
//! single precision: a standard deviation needs three digits, and has them even where parameters cancel to a hundred-thousandth of what each would do.
//!
//! Measured on iCub V2.5 (39 bodies, 426 columns), kinematics, solution and all deviations of 32 torques and seven full contact wrenches, one core of a
//! two-core virtual machine (AMD EPYC with AVX-512), plain x86-64 build, fastest of 100, with contacts / without (`cargo bench -p proprio-estimator --bench regressor`): each
//! link uncertain by itself 9.4 / 12.0 us; the limbs beyond the sensors and all offsets correlated 14.2 / 14.9 us; all 426 columns correlated 15.6 / 17.1 us.

use std::ops::Range;

use nalgebra::{Cholesky, DMatrix, Matrix6, Vector6};
use proprio_topics::Nanos;
use pulp::{Arch, Simd, WithSimd};

use super::link::{LinkRows, WIDTH, WITH_FORCE, link_rows};
use crate::calibration::{Kind, Unknown};
use crate::dynamics::{DynamicsError, Kinematics, Solver, Structure, check_size};
use crate::spatial::{Motion, Pose, Wrench};

/// Rows that are kept together: as many as a vector of the widest processor has numbers, and a multiple of those of any other.
const LANES: usize = 16;
type Lanes = [f32; LANES];

/// Covariance `P` of inertial parameters and F/T offsets, in blocks that are independent of each other, each as a root `U`, `P = U^T U`.
///
/// What is in no block is known exactly.
#[derive(Clone, Debug, PartialEq)]
pub struct Covariance {
    blocks: Vec<Block>,
    drifts: Vec<Drift>,
    /// Which links and which sensors are in a block.
    links: Vec<bool>,
    sensors: Vec<bool>,
}

/// Links and sensors whose parameters and offsets are correlated.
#[derive(Clone, Debug, PartialEq)]
struct Block {
    links: Vec<usize>,
    sensors: Vec<usize>,
    calibrations: Vec<(usize, Kind)>,
    root: DMatrix<f64>,
}

/// How an offset wanders from what it was known to be.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Drift {
    /// Variance that each channel [torque; force] gains per second [Nm^2/s, N^2/s].
    rate: [f64; 6],
    /// When it was known.
    known: Known,
}

/// When an offset was known.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Known {
    /// By the clock that is running.
    At(Nanos),
    /// At the end of a log, from its first stamp to its last, whose clock may have been another one.
    InLog(Nanos, Nanos),
}

impl Known {
    /// For how long an offset may have wandered by `t`, when the first instant of this run was `begun` \[s\].
    fn elapsed(self, t: Nanos, begun: Nanos) -> f64 {
        let between = |a: Nanos, b: Nanos| a.saturating_sub(b).seconds().abs();
        match self {
            Self::At(known) => between(t, known),
            // A clock that has not come so far yet is another one, and what it shows is no measure of what has passed.
            Self::InLog(first, _) if t < first => between(t, begun),
            // It may be the same, or another that has come about as far: not less than since the run began.
            Self::InLog(_, last) => between(t, last).max(between(t, begun)),
        }
    }
}

impl Covariance {
    /// Of a model with so many links, cut at so many sensors: everything is known exactly.
    pub fn exact(links: usize, sensors: usize) -> Self {
        let still = Drift {
            rate: [0.0; 6],
            known: Known::At(Nanos::ZERO),
        };
        Self {
            blocks: Vec::new(),
            drifts: vec![still; sensors],
            links: vec![false; links],
            sensors: vec![false; sensors],
        }
    }

    /// Adds a block: columns ten per link, then six per sensor [torque; force], both in the order given; `root` is any matrix `U` with `U^T U` their
    /// covariance.
    ///
    /// # Errors
    /// A link or sensor that is not there or has a block already; a root of another width, or one that is not finite. Nothing is changed then.
    pub fn add(&mut self, links: &[usize], sensors: &[usize], root: DMatrix<f64>) -> Result<(), DynamicsError> {
        self.add_calibrated(links, sensors, &[], root)
    }

    /// The same where calibrations of some of these sensors are uncertain, too: after the offsets' columns those of [`Kind::unknowns`], sensor by sensor as given.
    ///
    /// # Errors
    /// As [`Covariance::add`]; a calibration of a sensor that is not among `sensors`.
    pub fn add_calibrated(
        &mut self,
        links: &[usize],
        sensors: &[usize],
        calibrations: &[(usize, Kind)],
        root: DMatrix<f64>,
    ) -> Result<(), DynamicsError> {
        let of_calibrations: usize = calibrations.iter().map(|(_, kind)| kind.count()).sum();
        check_size(
            "columns of a covariance",
            root.ncols(),
            WIDTH * links.len() + 6 * sensors.len() + of_calibrations,
        )?;
        if let Some((sensor, _)) = calibrations.iter().find(|(sensor, _)| !sensors.contains(sensor)) {
            return Err(DynamicsError::Index {
                what: "sensors with an offset in the same covariance",
                index: *sensor,
                count: sensors.len(),
            });
        }
        if let Some(index) = root.iter().position(|value| !value.is_finite()) {
            return Err(DynamicsError::NotFinite {
                what: "number of a covariance",
                index,
            });
        }
        let (mut with_links, mut with_sensors) = (self.links.clone(), self.sensors.clone());
        mark("links without a covariance", links, &mut with_links)?;
        mark("sensors without a covariance", sensors, &mut with_sensors)?;
        (self.links, self.sensors) = (with_links, with_sensors);
        self.blocks.push(Block {
            links: links.to_vec(),
            sensors: sensors.to_vec(),
            calibrations: calibrations.to_vec(),
            root,
        });
        Ok(())
    }

    /// Says how fast a sensor's offset wanders from what it was known to be at `known`, by the clock that is running: standard deviations [torque; force] after one
    /// second [Nm/s^½, N/s^½]. They grow with the square root of the time since, or until, then.
    ///
    /// # Errors
    /// There is no such sensor, or a number is not finite or negative.
    pub fn set_drift(&mut self, sensor: usize, rate: [f64; 6], known: Nanos) -> Result<(), DynamicsError> {
        self.drift(sensor, rate, Known::At(known))
    }

    /// The same of an offset that was known at the end of a log, given its first and last stamp. Its clock need not be the one that is running (another machine, or the same after a
    /// restart): time counts from the first instant that [`Propagation::update`] is given, or from the end of the log, whichever is longer ago; and from the first instant alone where the
    /// running clock is before the log's first stamp, which it would not be if it were the same.
    ///
    /// # Errors
    /// As for [`Covariance::set_drift`].
    pub fn set_drift_of_log(
        &mut self,
        sensor: usize,
        rate: [f64; 6],
        (first, last): (Nanos, Nanos),
    ) -> Result<(), DynamicsError> {
        self.drift(sensor, rate, Known::InLog(first, last))
    }

    fn drift(&mut self, sensor: usize, rate: [f64; 6], known: Known) -> Result<(), DynamicsError> {
        let count = self.drifts.len();
        let place = self.drifts.get_mut(sensor).ok_or(DynamicsError::Index {
            what: "sensors",
            index: sensor,
            count,
        })?;
        if let Some(index) = rate.iter().position(|rate| !(rate.is_finite() && *rate >= 0.0)) {
            return Err(DynamicsError::NotFinite {
                what: "rate of a drift",
                index,
            });
        }
        *place = Drift {
            rate: rate.map(|rate| rate * rate),
            known,
        };
        Ok(())
    }

    /// Whether something is said of a link's parameters.
    pub fn has_link(&self, link: usize) -> bool {
        self.links.get(link).is_some_and(|there| *there)
    }

    /// All of `P`, over `[10 per link | 6 per sensor]`, without what offsets have wandered and without calibrations.
    pub fn dense(&self) -> DMatrix<f64> {
        let (links, sensors) = (self.links.len(), self.sensors.len());
        let mut all = DMatrix::zeros(WIDTH * links + 6 * sensors, WIDTH * links + 6 * sensors);
        for block in &self.blocks {
            let columns: Vec<usize> = block.model_columns(links).collect();
            let covariance = block.root.transpose() * &block.root;
            for (i, &row) in columns.iter().enumerate() {
                for (j, &column) in columns.iter().enumerate() {
                    all[(row, column)] = covariance[(i, j)];
                }
            }
        }
        all
    }
}

fn mark(what: &'static str, numbers: &[usize], places: &mut [bool]) -> Result<(), DynamicsError> {
    let count = places.len();
    for &index in numbers {
        match places.get_mut(index) {
            Some(taken) if !*taken => *taken = true,
            _ => return Err(DynamicsError::Index { what, index, count }),
        }
    }
    Ok(())
}

impl Block {
    /// Its columns among those of the whole model.
    fn model_columns(&self, links: usize) -> impl Iterator<Item = usize> {
        let of_links = self.links.iter().flat_map(|&l| WIDTH * l..WIDTH * (l + 1));
        let of_sensors = self
            .sensors
            .iter()
            .flat_map(move |&s| WIDTH * links + 6 * s..WIDTH * links + 6 * (s + 1));
        of_links.chain(of_sensors)
    }
}

/// The standard deviations that a [`Covariance`] gives the solver's results; holds them and all the room it needs.
#[derive(Clone, Debug)]
pub struct Propagation {
    parts: Vec<Part>,
    drifts: Vec<Drift>,
    /// Per sensor, what else each channel [torque; force] of its offset is uncertain by at present: a variance.
    widened: Vec<[f64; 6]>,
    /// The first instant that was computed.
    begun: Option<Nanos>,
    torque: Vec<f64>,
    contacts: Vec<[f64; 6]>,
    /// Of each sub-tree that a sensor measures, the covariance of its imbalance.
    imbalances: Vec<Matrix6<f64>>,
}

/// A sub-tree: its part of the root, and room for the wrenches' roots.
#[derive(Clone, Debug)]
struct Part {
    /// Rows of all of it, in units of [`LANES`].
    rows: usize,
    links: Vec<Link>,
    /// What is correlated.
    pieces: Vec<Piece>,
    /// Links that are correlated with nothing else here: number, place, and the rows of their roots, each from the diagonal on.
    alone: Vec<(usize, usize, Box<Root>)>,
    /// Per link, the covariance of the wrenches below it that `alone` makes.
    below: Vec<Covariance6>,
    /// Every sensor at its ends.
    ends: Vec<End>,
    /// `W` of each link: six columns of `rows` each.
    wrenches: Vec<Lanes>,
}

type Root = [[f64; WIDTH]; WIDTH];
/// Symmetric; [torque; force].
type Covariance6 = [[f64; 6]; 6];

/// A link of a sub-tree.
#[derive(Clone, Debug)]
struct Link {
    link: usize,
    /// Place of its parent in the sub-tree; its own for the top.
    parent: usize,
    /// The rows in which its `W` is not zero.
    rows: Range<usize>,
}

/// The columns of a link or of a sensor's offset in the root: those rows that are not zero.
#[derive(Clone, Debug)]
struct Piece {
    what: Member,
    /// Place in the sub-tree of the link where it enters.
    place: usize,
    rows: Range<usize>,
    columns: Vec<Lanes>,
    /// Of a sensor whose calibration is uncertain, too. Then `columns` hold both, for what it reads.
    calibration: Option<Box<Calibrated>>,
}

/// The root's columns of an offset alone, and of what is unknown of its sensor's calibration, in the rows of the offset's.
#[derive(Clone, Debug)]
struct Calibrated {
    offset: Vec<Lanes>,
    unknowns: Vec<(Unknown, Vec<Lanes>)>,
}

impl Piece {
    /// Puts the columns of offset and calibration together: an unknown of the calibration is as an offset, by so much as is read.
    fn calibrate(&mut self, corrected: &[f64; 6], kelvin: f64) {
        let Some(calibration) = &self.calibration else { return };
        self.columns.copy_from_slice(&calibration.offset);
        let count = self.rows.len();
        for (unknown, own) in &calibration.unknowns {
            let factor = single(unknown.as_offset(corrected, kelvin));
            let sums = self.columns.as_flattened_mut().iter_mut();
            let sums = sums.skip(LANES * count * unknown.channel());
            sums.zip(own.as_flattened())
                .for_each(|(sum, value)| *sum += factor * value);
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Member {
    /// What is unknown of a sensor's calibration: before its offset, so that this has as many rows as it.
    Calibration,
    Link(usize),
    /// A sensor and the sign with which its offset enters what the links need.
    Sensor(usize, bool),
}

/// A sensor at an end of a sub-tree.
#[derive(Clone, Copy, Debug)]
struct End {
    sensor: usize,
    /// The link where it enters.
    link: usize,
    /// Whether its offset counts with a plus.
    plus: bool,
}

impl Propagation {
    /// For a structure.
    ///
    /// # Errors
    /// The covariance is of another number of links or sensors.
    pub fn new(structure: &Structure, covariance: &Covariance) -> Result<Self, DynamicsError> {
        check_size(
            "links of the covariance",
            covariance.links.len(),
            structure.link_count(),
        )?;
        check_size(
            "sensors of the covariance",
            covariance.sensors.len(),
            structure.sensors().len(),
        )?;
        Ok(Self {
            parts: (0..structure.subtrees().len())
                .map(|number| Part::new(structure, number, covariance))
                .collect(),
            drifts: covariance.drifts.clone(),
            widened: vec![[0.0; 6]; covariance.drifts.len()],
            begun: None,
            torque: vec![0.0; structure.dof_count()],
            contacts: vec![[0.0; 6]; structure.contacts().len()],
            imbalances: vec![Matrix6::zeros(); structure.subtrees().len()],
        })
    }

    /// Says what a sensor reads, corrected but with its offset, and how far its board is from the reference temperature \[K\]: what an uncertain calibration comes to. Before any: nothing.
    pub fn set_reading(&mut self, sensor: usize, corrected: &Wrench, kelvin: f64) {
        let corrected = corrected.torque_first();
        for piece in self.parts.iter_mut().flat_map(|part| &mut part.pieces) {
            if matches!(piece.what, Member::Sensor(own, _) if own == sensor) {
                piece.calibrate(&corrected, kelvin);
            }
        }
    }

    /// Says what, at present, a sensor's offset is uncertain by beyond the covariance: a variance of each channel [torque; force] [Nm^2, N^2], independent of all else. Before any: none.
    pub fn set_widened(&mut self, sensor: usize, variance: [f64; 6]) {
        if let Some(place) = self.widened.get_mut(sensor) {
            *place = variance;
        }
    }

    /// Computes all standard deviations, for the solver's last solution at instant `t`.
    ///
    /// # Errors
    /// As [`super::EstimateRows::new`]. Nothing is changed then.
    pub fn update(
        &mut self,
        structure: &Structure,
        solver: &Solver,
        kinematics: &Kinematics,
        t: Nanos,
    ) -> Result<(), DynamicsError> {
        solver.check_structure(structure)?;
        let links = structure.link_count();
        check_size("links of the kinematics", kinematics.link_count(), links)?;
        check_size("sub-trees", self.parts.len(), structure.subtrees().len())?;
        check_size("degrees of freedom", self.torque.len(), structure.dof_count())?;
        check_size("contacts", self.contacts.len(), structure.contacts().len())?;
        check_size("sensors", self.drifts.len(), structure.sensors().len())?;
        if !solver.is_solved(structure, kinematics) {
            return Err(DynamicsError::NotSolved);
        }
        let begun = *self.begun.get_or_insert(t);
        Arch::new().dispatch(Update {
            propagation: self,
            structure,
            solver,
            kinematics,
            times: (t, begun),
        });
        Ok(())
    }

    /// Standard deviations of the torques [Nm or N], by degree of freedom. Zero where nothing uncertain enters.
    pub fn torque(&self) -> &[f64] {
        &self.torque
    }

    /// Covariance of each sub-tree's imbalance `b` [torque; force], at the origin of base coordinates [Nm, N]; zero where no sensor measures it.
    pub fn imbalances(&self) -> &[Matrix6<f64>] {
        &self.imbalances
    }

    /// Standard deviations of the contacts' wrenches, `[fx fy fz tx ty tz]` [N, Nm], in the order of the structure's.
    pub fn contacts(&self) -> &[[f64; 6]] {
        &self.contacts
    }
}

/// All that [`Propagation::update`] does once it is clear that it can, in the instructions that the processor has.
struct Update<'a> {
    propagation: &'a mut Propagation,
    structure: &'a Structure,
    solver: &'a Solver,
    kinematics: &'a Kinematics,
    times: (Nanos, Nanos),
}

impl WithSimd for Update<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self {
            propagation,
            structure,
            solver,
            kinematics,
            times,
        } = self;
        let Propagation {
            parts,
            drifts,
            widened,
            torque,
            contacts,
            imbalances,
            ..
        } = propagation;
        for ((part, subtree), imbalance) in parts.iter_mut().zip(structure.subtrees()).zip(imbalances) {
            part.update(simd, solver, kinematics);
            if !part.ends.is_empty() {
                *imbalance = part.covariance_of_all(simd);
                for end in &part.ends {
                    let variances = uncertain((&drifts[end.sensor], &widened[end.sensor]), times);
                    add_turned(imbalance, solver.sensor_pose(end.sensor), &variances);
                }
            }
            let wandered = |motion: &dyn Fn(usize) -> Motion| -> f64 {
                let of = |end: &End| {
                    wander(
                        (&drifts[end.sensor], &widened[end.sensor]),
                        times,
                        solver.sensor_pose(end.sensor),
                        || motion(end.link),
                    )
                };
                part.ends.iter().map(of).sum()
            };
            for (place, link) in part.links.iter().enumerate().skip(1) {
                let Some(dof) = structure.dof_of(link.link) else {
                    continue;
                };
                let (axis, response) = solver.torque_motions(dof);
                let below = structure.below(link.link);
                let moved = wandered(&|other| {
                    if below.contains(&other) {
                        *axis - *response
                    } else {
                        -*response
                    }
                });
                torque[dof] = (part.variance(simd, place, axis, response) + moved).sqrt();
            }
            for contact in subtree.contacts.iter() {
                let motions = solver.contact_motions(contact);
                for (deviation, motion) in contacts[contact].iter_mut().zip(motions) {
                    *deviation = (part.variance_of_all(simd, motion) + wandered(&|_| *motion)).sqrt();
                }
            }
        }
    }
}

/// Variance that what an offset has wandered by `t`, and is uncertain by beside, gives to a result that sees it with a motion; the run began at `begun`.
fn wander(
    (drift, widened): (&Drift, &[f64; 6]),
    (t, begun): (Nanos, Nanos),
    x_bm: &Pose,
    motion: impl Fn() -> Motion,
) -> f64 {
    if drift.rate == [0.0; 6] && *widened == [0.0; 6] {
        return 0.0;
    }
    let variances = uncertain((drift, widened), (t, begun));
    let seen = x_bm.twist_back(&motion());
    let squares = seen.angular.iter().chain(seen.linear.iter()).zip(variances);
    squares.map(|(m, variance)| m * m * variance).sum()
}

/// What an offset has wandered by `t`, and is uncertain by beside: a variance of each channel [torque; force].
fn uncertain((drift, widened): (&Drift, &[f64; 6]), (t, begun): (Nanos, Nanos)) -> [f64; 6] {
    let seconds = drift.known.elapsed(t, begun);
    std::array::from_fn(|i| seconds * drift.rate[i] + widened[i])
}

/// Adds the covariance of a sensor whose channels [torque; force] have these variances, at the origin.
fn add_turned(covariance: &mut Matrix6<f64>, x_bm: &Pose, variances: &[f64; 6]) {
    for (channel, variance) in variances.iter().enumerate().filter(|(_, variance)| **variance > 0.0) {
        let mut unit = [0.0; 6];
        unit[channel] = 1.0;
        let [tx, ty, tz, fx, fy, fz] = unit;
        let column = x_bm.wrench(&Wrench::from_parts([fx, fy, fz], [tx, ty, tz]));
        let column = Vector6::from(column.torque_first());
        *covariance += *variance * column * column.transpose();
    }
}

impl Part {
    fn new(structure: &Structure, number: usize, covariance: &Covariance) -> Self {
        let subtree = &structure.subtrees()[number];
        let numbers: Vec<usize> = structure.links_of(number).collect();
        let place_of = |link: usize| numbers.iter().position(|&other| other == link);
        let ends: Vec<End> = subtree
            .sensors
            .iter()
            .map(|sensor| {
                let cut = &structure.sensors()[sensor];
                let child = cut.joint() + 1;
                let is_above = structure.subtree_of(child) == Some(number);
                End {
                    sensor,
                    link: if is_above { child } else { structure.parent_of(child) },
                    plus: is_above == (cut.sign() > 0.0),
                }
            })
            .collect();
        let (mut pieces, mut alone, mut rows) = (Vec::new(), Vec::new(), 0);
        for block in &covariance.blocks {
            // Where the columns of each link and sensor of this sub-tree are in the block's root.
            let mut members = Vec::new();
            for end in &ends {
                if let Some(i) = block.sensors.iter().position(|&s| s == end.sensor) {
                    let first = WIDTH * block.links.len() + 6 * i;
                    let mut own = WIDTH * block.links.len() + 6 * block.sensors.len();
                    for (sensor, kind) in &block.calibrations {
                        if *sensor == end.sensor {
                            members.push((Member::Calibration, end.link, own..own + kind.count()));
                        }
                        own += kind.count();
                    }
                    members.push((Member::Sensor(end.sensor, end.plus), end.link, first..first + 6));
                }
            }
            for &link in numbers.iter().rev() {
                if let Some(i) = block.links.iter().position(|&l| l == link) {
                    members.push((Member::Link(link), link, WIDTH * i..WIDTH * (i + 1)));
                }
            }
            let wanted: Vec<usize> = members.iter().flat_map(|(_, _, columns)| columns.clone()).collect();
            if wanted.is_empty() || block.root.nrows() == 0 {
                continue;
            }
            let root = triangle(block.root.select_columns(&wanted));
            if let [(Member::Link(number), link, _)] = members.as_slice() {
                let at = |i, j| if i < root.nrows() && i <= j { root[(i, j)] } else { 0.0 };
                let own = std::array::from_fn(|i| std::array::from_fn(|j| at(i, j)));
                alone.push((*number, place_of(*link).unwrap_or(0), Box::new(own)));
                continue;
            }
            let mut first = 0;
            let mut calibration: Vec<Vec<Lanes>> = Vec::new();
            for (what, link, columns) in members {
                let end = (first + columns.len()).min(root.nrows());
                let count = end.div_ceil(LANES);
                // Too large for single precision is infinite, and makes a deviation infinite.
                #[allow(clippy::cast_possible_truncation, reason = "single precision suffices")]
                let at = |row: usize, column: usize| if row < end { root[(row, column)] as f32 } else { 0.0 };
                let lanes_of =
                    |column: usize| (0..count).map(move |chunk| std::array::from_fn(|i| at(LANES * chunk + i, column)));
                let lanes = first..first + columns.len();
                first += columns.len();
                if what == Member::Calibration {
                    calibration = lanes.map(|column| lanes_of(column).collect()).collect();
                    continue;
                }
                let lanes: Vec<Lanes> = lanes.flat_map(lanes_of).collect();
                let own = std::mem::take(&mut calibration);
                let kind = block
                    .calibrations
                    .iter()
                    .find(|(sensor, _)| matches!(what, Member::Sensor(own, _) if own == *sensor));
                pieces.push(Piece {
                    what,
                    place: place_of(link).unwrap_or(0),
                    rows: rows..rows + count,
                    calibration: kind.map(|(_, kind)| {
                        Box::new(Calibrated {
                            offset: lanes.clone(),
                            unknowns: kind.unknowns().zip(own).collect(),
                        })
                    }),
                    columns: lanes,
                });
            }
            rows += root.nrows().div_ceil(LANES);
        }
        let mut links: Vec<Link> = numbers
            .iter()
            .enumerate()
            .map(|(place, &link)| Link {
                link,
                parent: if place == 0 {
                    0
                } else {
                    place_of(structure.parent_of(link)).unwrap_or(0)
                },
                rows: 0..0,
            })
            .collect();
        for piece in &pieces {
            let link = &mut links[piece.place];
            link.rows = hull(&link.rows, &piece.rows);
        }
        for place in (1..links.len()).rev() {
            let (parent, below) = (links[place].parent, links[place].rows.clone());
            links[parent].rows = hull(&links[parent].rows, &below);
        }
        Self {
            wrenches: vec![[0.0; LANES]; 6 * rows * links.len()],
            below: if alone.is_empty() {
                Vec::new()
            } else {
                vec![[[0.0; 6]; 6]; links.len()]
            },
            rows,
            links,
            pieces,
            alone,
            ends,
        }
    }

    /// Computes `W` of every link.
    #[inline(always)]
    fn update<S: Simd>(&mut self, simd: S, solver: &Solver, kinematics: &Kinematics) {
        let rows = self.rows;
        for (link, wrenches) in self.links.iter().zip(self.wrenches.chunks_exact_mut((6 * rows).max(1))) {
            for column in wrenches.chunks_exact_mut(rows.max(1)) {
                column[link.rows.clone()].fill([0.0; LANES]);
            }
        }
        for piece in &self.pieces {
            let out = &mut self.wrenches[6 * rows * piece.place..][..6 * rows];
            match piece.what {
                Member::Link(link) => {
                    let coefficients = link_rows(kinematics.pose(link), kinematics.motion(link));
                    add_link(simd, out, rows, piece, &coefficients);
                }
                Member::Sensor(sensor, plus) => {
                    add_offset(simd, out, rows, piece, solver.sensor_pose(sensor), plus);
                }
                // Part of its sensor's.
                Member::Calibration => {}
            }
        }
        self.below.fill([[0.0; 6]; 6]);
        for (link, place, root) in &self.alone {
            let coefficients = link_rows(kinematics.pose(*link), kinematics.motion(*link));
            add_alone(&mut self.below[*place], root, &coefficients);
        }
        for place in (1..self.below.len()).rev() {
            let (below, parent) = (self.below[place], self.links[place].parent);
            for (sums, values) in self.below[parent].iter_mut().zip(&below) {
                sums.iter_mut().zip(values).for_each(|(sum, value)| *sum += value);
            }
        }
        for place in (1..self.links.len()).rev() {
            let Link {
                parent, rows: range, ..
            } = self.links[place].clone();
            if range.is_empty() {
                continue;
            }
            let (before, after) = self.wrenches.split_at_mut(6 * rows * place);
            for axis in 0..6 {
                let below = &after[axis * rows..][range.clone()];
                let above = &mut before[6 * rows * parent + axis * rows..][range.clone()];
                let (above, below) = (vectors_mut::<S>(above), vectors::<S>(below));
                for (sum, value) in above.iter_mut().zip(below) {
                    *sum = simd.add_f32s(*sum, *value);
                }
            }
        }
    }

    /// `|W_l s - W_b h|^2`, `l` being the link at `place`.
    #[inline(always)]
    fn variance<S: Simd>(&self, simd: S, place: usize, axis: &Motion, response: &Motion) -> f64 {
        self.correlated(simd, place, axis, response) + self.independent(place, axis, response)
    }

    fn independent(&self, place: usize, axis: &Motion, response: &Motion) -> f64 {
        let (Some(below), Some(all)) = (self.below.get(place), self.below.first()) else {
            return 0.0;
        };
        let (s, h) = (numbers(axis), numbers(response));
        if *response == Motion::zero() {
            return form(&s, below, &s);
        }
        // Of a side where nothing is, rounding leaves a little, of either sign.
        (form(&s, below, &s) - 2.0 * form(&s, below, &h) + form(&h, all, &h)).max(0.0)
    }

    #[inline(always)]
    fn correlated<S: Simd>(&self, simd: S, place: usize, axis: &Motion, response: &Motion) -> f64 {
        let own = self.links[place].rows.clone();
        let mut sum = simd.splat_f32s(0.0);
        if *response == Motion::zero() {
            let s = splat(simd, axis);
            let below = self.axes::<S>(place, &own);
            for i in 0..below[0].len() {
                let y = along(simd, &below, i, &s);
                sum = simd.mul_add_e_f32s(y, y, sum);
            }
        } else {
            let (s, minus_h) = (splat(simd, axis), splat(simd, &-*response));
            // Below it are no other rows than there are in all.
            let rows = self.links[0].rows.clone();
            for (part, is_own) in [
                (rows.start..own.start, false),
                (own.clone(), true),
                (own.end..rows.end, false),
            ] {
                let (all, below) = (self.axes::<S>(0, &part), self.axes::<S>(place, &part));
                for i in 0..all[0].len() {
                    let mut y = along(simd, &all, i, &minus_h);
                    if is_own {
                        y = simd.add_f32s(y, along(simd, &below, i, &s));
                    }
                    sum = simd.mul_add_e_f32s(y, y, sum);
                }
            }
        }
        f64::from(simd.reduce_sum_f32s(sum))
    }

    /// `W_b^T W_b`.
    #[inline(always)]
    fn covariance_of_all<S: Simd>(&self, simd: S) -> Matrix6<f64> {
        let mut covariance = Matrix6::zeros();
        let Some(link) = self.links.first() else {
            return covariance;
        };
        let axes = self.axes::<S>(0, &link.rows);
        for i in 0..6 {
            for j in i..6 {
                let mut sum = simd.splat_f32s(0.0);
                for (a, b) in axes[i].iter().zip(axes[j]) {
                    sum = simd.mul_add_e_f32s(*a, *b, sum);
                }
                let alone = self.below.first().map_or(0.0, |below| below[i][j]);
                let sum = f64::from(simd.reduce_sum_f32s(sum)) + alone;
                (covariance[(i, j)], covariance[(j, i)]) = (sum, sum);
            }
        }
        covariance
    }

    /// `|W_b k|^2`.
    #[inline(always)]
    fn variance_of_all<S: Simd>(&self, simd: S, motion: &Motion) -> f64 {
        if self.links.is_empty() || *motion == Motion::zero() {
            return 0.0;
        }
        self.variance(simd, 0, motion, &Motion::zero())
    }

    /// Some rows of the six columns of a link's `W`.
    #[inline(always)]
    fn axes<S: Simd>(&self, place: usize, rows: &Range<usize>) -> [&[S::f32s]; 6] {
        let all = &self.wrenches[6 * self.rows * place..][..6 * self.rows];
        let mut axes: [&[S::f32s]; 6] = [&[]; 6];
        if !rows.is_empty() {
            for (axis, column) in axes.iter_mut().zip(all.chunks_exact(self.rows)) {
                *axis = vectors::<S>(&column[rows.clone()]);
            }
        }
        axes
    }
}

/// The upper triangle `R` with `R^T R = U^T U`. By the product if that is positive definite: it loses nothing that single precision would keep, and is quick.
fn triangle(root: DMatrix<f64>) -> DMatrix<f64> {
    match Cholesky::new(root.transpose() * &root) {
        Some(factor) => factor.l().transpose(),
        None => root.qr().r(),
    }
}

fn hull(a: &Range<usize>, b: &Range<usize>) -> Range<usize> {
    match (a.is_empty(), b.is_empty()) {
        (true, _) => b.clone(),
        (_, true) => a.clone(),
        _ => a.start.min(b.start)..a.end.max(b.end),
    }
}

fn numbers(motion: &Motion) -> [f64; 6] {
    let (n, v) = (&motion.angular, &motion.linear);
    [n.x, n.y, n.z, v.x, v.y, v.z]
}

#[allow(clippy::cast_possible_truncation, reason = "single precision suffices")]
fn single(value: f64) -> f32 {
    value as f32
}

#[inline(always)]
fn splat<S: Simd>(simd: S, motion: &Motion) -> [S::f32s; 6] {
    let mut all = [simd.splat_f32s(0.0); 6];
    for (to, value) in all.iter_mut().zip(numbers(motion)) {
        *to = simd.splat_f32s(single(value));
    }
    all
}

/// Rows as vectors of the processor: a whole number of them.
#[inline(always)]
fn vectors<S: Simd>(rows: &[Lanes]) -> &[S::f32s] {
    S::as_simd_f32s(rows.as_flattened()).0
}

#[inline(always)]
fn vectors_mut<S: Simd>(rows: &mut [Lanes]) -> &mut [S::f32s] {
    S::as_mut_simd_f32s(rows.as_flattened_mut()).0
}

/// `a^T C b`.
#[inline(always)]
fn form(a: &[f64; 6], covariance: &Covariance6, b: &[f64; 6]) -> f64 {
    let mut product = [0.0; 6];
    for (row, a) in covariance.iter().zip(a) {
        for (sum, value) in product.iter_mut().zip(row) {
            *sum += a * value;
        }
    }
    product.iter().zip(b).map(|(x, y)| x * y).sum()
}

/// Adds `A P A^T` of a link, `P = U^T U`.
fn add_alone(out: &mut Covariance6, root: &Root, coefficients: &LinkRows) {
    let columns: [[f64; 6]; WIDTH] = std::array::from_fn(|c| std::array::from_fn(|axis| coefficients[axis][c]));
    for (first, row) in root.iter().enumerate() {
        let mut wrench = [0.0; 6];
        for (u, column) in row.iter().zip(&columns).skip(first) {
            for (sum, value) in wrench.iter_mut().zip(column) {
                *sum += u * value;
            }
        }
        for (sums, a) in out.iter_mut().zip(wrench) {
            for (sum, b) in sums.iter_mut().zip(wrench) {
                *sum += a * b;
            }
        }
    }
}

/// One vector of `W m`.
#[inline(always)]
fn along<S: Simd>(simd: S, axes: &[&[S::f32s]; 6], i: usize, motion: &[S::f32s; 6]) -> S::f32s {
    let mut sum = simd.splat_f32s(0.0);
    for (axis, m) in axes.iter().zip(motion) {
        sum = simd.mul_add_e_f32s(axis[i], *m, sum);
    }
    sum
}

/// Adds `U_l A_l^T`.
#[inline(always)]
fn add_link<S: Simd>(simd: S, out: &mut [Lanes], rows: usize, piece: &Piece, coefficients: &LinkRows) {
    let mut a = [[0.0; 6]; WIDTH];
    for (axis, row) in coefficients.iter().enumerate() {
        for (a, value) in a.iter_mut().zip(row) {
            a[axis] = single(*value);
        }
    }
    let mut out = out.chunks_exact_mut(rows);
    let mut next = || {
        out.next()
            .and_then(|column| column.get_mut(piece.rows.clone()))
            .unwrap_or_default()
    };
    let [t0, t1, t2, f0, f1, f2] = [next(), next(), next(), next(), next(), next()];
    let torques = vectors_mut::<S>(t0)
        .iter_mut()
        .zip(vectors_mut::<S>(t1))
        .zip(vectors_mut::<S>(t2));
    let forces = vectors_mut::<S>(f0)
        .iter_mut()
        .zip(vectors_mut::<S>(f1))
        .zip(vectors_mut::<S>(f2));
    let columns = vectors::<S>(&piece.columns);
    let count = columns.len() / WIDTH;
    for (i, (((t0, t1), t2), ((f0, f1), f2))) in torques.zip(forces).enumerate() {
        let (mut torque, mut force) = ([*t0, *t1, *t2], [*f0, *f1, *f2]);
        for (c, a) in a.iter().enumerate() {
            let u = columns[c * count + i];
            for axis in 0..3 {
                torque[axis] = simd.mul_add_e_f32s(u, simd.splat_f32s(a[axis]), torque[axis]);
            }
            // The tensor of inertia makes no force.
            if c < WITH_FORCE {
                for axis in 0..3 {
                    force[axis] = simd.mul_add_e_f32s(u, simd.splat_f32s(a[axis + 3]), force[axis]);
                }
            }
        }
        ([*t0, *t1, *t2], [*f0, *f1, *f2]) = (torque, force);
    }
}

/// Adds `U_s A_s^T`: a sensor's offset as the wrench, in base coordinates, that the links need more because of it.
#[inline(always)]
fn add_offset<S: Simd>(simd: S, out: &mut [Lanes], rows: usize, piece: &Piece, x_bm: &Pose, plus: bool) {
    let sign = if plus { 1.0 } else { -1.0 };
    let turn = x_bm.rotation * sign;
    let levered = x_bm.translation.cross_matrix() * turn;
    let columns = vectors::<S>(&piece.columns);
    let count = columns.len() / 6;
    let (torques, forces) = out.split_at_mut(3 * rows);
    let out = torques.chunks_exact_mut(rows).zip(forces.chunks_exact_mut(rows));
    for (axis, (torque, force)) in out.enumerate() {
        let torque = vectors_mut::<S>(&mut torque[piece.rows.clone()]);
        let force = vectors_mut::<S>(&mut force[piece.rows.clone()]);
        for channel in 0..3 {
            let turn = simd.splat_f32s(single(turn[(axis, channel)]));
            let levered = simd.splat_f32s(single(levered[(axis, channel)]));
            let (n, f) = (
                &columns[channel * count..][..count],
                &columns[(channel + 3) * count..][..count],
            );
            for (((torque, force), n), f) in torque.iter_mut().zip(force.iter_mut()).zip(n).zip(f) {
                *torque = simd.mul_add_e_f32s(*n, turn, simd.mul_add_e_f32s(*f, levered, *torque));
                *force = simd.mul_add_e_f32s(*f, turn, *force);
            }
        }
    }
}
