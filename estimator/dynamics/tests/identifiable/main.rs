//! Comparison of the closed-form identifiable subspaces with sampled regressors (rank by QR with
//! column pivoting), for random trees of 1 to 40 links, cuts, bases and regimes of motion; known
//! ranks; readable sums.
//!
//! The oracle has no formula in common with the closed form: ten evaluations of a body's net wrench
//! per link and state, in random states of the regime.

#[path = "../common/mod.rs"]
mod common;
mod known;
mod refusals;

use common::{Random, RandomRobot, State, humanoid, joint_axis, motion};
use nalgebra::DMatrix;
use proprio_dynamics::model::{Frame, JointKind, MeasurementDirection, MeasurementFrame, Model};
use proprio_dynamics::regressor::identifiable::{
    BaseParameter, BaseRegime, Identifiable, JointMotion, Measurement, Offsets, ParameterColumn,
    Regime, Scope, Term,
};
use proprio_dynamics::regressor::{Regressor, StackedRegressor, SubTreeRegressor};
use proprio_dynamics::spatial::{Motion, Pose, RigidInertia, Vec3, Wrench};
use proprio_dynamics::{
    ContactKind, ContactSet, ContactSpec, DynamicsError, FrameMotion, Kinematics, Noise, SensorCut,
    Structure,
};
use proptest::prelude::*;

/// Rounding errors of a null space beside rows of one ten thousandth of the others.
const EXACT: f64 = 1e-9;
const GRAVITY: f64 = 9.80665;

// -------------------------------------------------------------------------------------------------
// The oracle
// -------------------------------------------------------------------------------------------------

type Block = [Wrench; 10];

/// `X* A_l`: the net wrench of each of a body's ten parameters, in base coordinates.
fn block(pose: &Pose, motion: &FrameMotion) -> Block {
    std::array::from_fn(|k| {
        let mut unit = [0.0; 10];
        unit[k] = 1.0;
        pose.wrench(&RigidInertia::from_parameters(&unit).net_wrench(
            &motion.angular_velocity,
            &motion.angular_acceleration,
            &motion.proper_acceleration,
        ))
    })
}

fn components(wrench: &Wrench) -> [f64; 6] {
    let (n, f) = (&wrench.torque, &wrench.force);
    [n.x, n.y, n.z, f.x, f.y, f.z]
}

/// The rows of one state. `pieces`: per separately measured part its links; `offsets`: columns,
/// link and wrench in base coordinates per offset component.
struct Rows {
    columns: usize,
    rows: Vec<Vec<f64>>,
}

struct OffsetColumn {
    column: usize,
    link: usize,
    wrench: Wrench,
}

impl Rows {
    fn wrench(
        &mut self,
        blocks: &[Option<(usize, Block)>],
        links: &[usize],
        offsets: &[OffsetColumn],
    ) {
        let first = self.rows.len();
        self.rows.extend((0..6).map(|_| vec![0.0; self.columns]));
        for &link in links {
            let Some((column, block)) = &blocks[link] else {
                continue;
            };
            for (k, wrench) in block.iter().enumerate() {
                for (i, x) in components(wrench).into_iter().enumerate() {
                    self.rows[first + i][10 * column + k] = x;
                }
            }
        }
        for offset in offsets.iter().filter(|offset| links.contains(&offset.link)) {
            for (i, x) in components(&offset.wrench).into_iter().enumerate() {
                self.rows[first + i][offset.column] += x;
            }
        }
    }

    fn torque(
        &mut self,
        axis: &Motion,
        blocks: &[Option<(usize, Block)>],
        beyond: &[usize],
        offsets: &[OffsetColumn],
    ) {
        let mut row = vec![0.0; self.columns];
        for &link in beyond {
            let Some((column, block)) = &blocks[link] else {
                continue;
            };
            for (k, wrench) in block.iter().enumerate() {
                row[10 * column + k] = axis.dot(wrench);
            }
        }
        for offset in offsets
            .iter()
            .filter(|offset| beyond.contains(&offset.link))
        {
            row[offset.column] += axis.dot(&offset.wrench);
        }
        self.rows.push(row);
    }

    fn matrix(&self) -> DMatrix<f64> {
        DMatrix::from_fn(self.rows.len(), self.columns, |i, k| self.rows[i][k])
    }
}

/// The arguments of the closed form, and the data that sampling needs.
struct Question<'a> {
    model: &'a Model,
    scope: Scope<'a>,
    regime: Regime,
    measured: Measurement,
    offsets: Offsets,
}

impl Question<'_> {
    fn answer(&self) -> Identifiable {
        Identifiable::new(
            self.model,
            self.scope,
            &self.regime,
            self.measured,
            self.offsets,
        )
        .expect("valid")
    }

    fn piece(&self, link: usize) -> Option<usize> {
        match self.scope {
            Scope::Tree => Some(0),
            Scope::SubTree(structure, number) => {
                structure.subtree_of(link).filter(|&of| of == number)
            }
            Scope::SubTrees(structure) => structure.subtree_of(link),
        }
    }

    /// Motion of the base link in one random state of the regime.
    fn base_motion(&self, random: &mut Random) -> FrameMotion {
        match &self.regime.motion {
            BaseRegime::Free => motion(random),
            BaseRegime::Fixed(gravity) => FrameMotion::standing(gravity),
        }
    }

    fn sample(&self, random: &mut Random) -> DMatrix<f64> {
        let model = self.model;
        let links: Vec<usize> = (0..model.link_count())
            .filter(|&link| self.piece(link).is_some())
            .collect();
        let sensors: Vec<usize> = match (self.scope, self.offsets) {
            (_, Offsets::Known) => Vec::new(),
            (Scope::Tree, _) => Vec::new(),
            (Scope::SubTree(structure, number), _) => {
                structure.subtrees()[number].sensors.iter().collect()
            }
            (Scope::SubTrees(structure), _) => (0..structure.sensors().len()).collect(),
        };
        let columns = 10 * links.len() + 6 * sensors.len();
        let mut rows = Rows {
            columns,
            rows: Vec::new(),
        };
        let mut kinematics = Kinematics::new(model, self.regime.base).unwrap();
        // A wrench has three rows per state that depend on the second moments. A single torque has
        // one row, and contacts that are always present may leave no more. The part that needs the
        // most states decides.
        let most = (0..columns)
            .filter_map(|piece| {
                Some(
                    links
                        .iter()
                        .filter(|&&link| self.piece(link) == Some(piece))
                        .count(),
                )
                .filter(|&n| n > 0)
            })
            .max();
        let most = 10 * most.unwrap_or(0) + 6 * sensors.len();
        let states = 10
            + if self.measured == Measurement::Torques || !self.regime.contacts.is_empty() {
                most
            } else {
                most / 2
            };
        for _ in 0..states {
            let state = state(&self.regime.joints, random);
            kinematics
                .update(model, state.get(), &self.base_motion(random))
                .unwrap();
            let blocks: Vec<_> = (0..model.link_count())
                .map(|link| {
                    let column = links.iter().position(|&l| l == link)?;
                    Some((
                        column,
                        block(kinematics.pose(link), kinematics.motion(link)),
                    ))
                })
                .collect();
            let mut offsets = Vec::new();
            for (number, &sensor) in sensors.iter().enumerate() {
                for component in 0..6 {
                    let column = 10 * links.len() + 6 * number + component;
                    let mut unit = [0.0; 6];
                    unit[component] = 1.0;
                    let offset = Wrench {
                        torque: Vec3::new(unit[0], unit[1], unit[2]),
                        force: Vec3::new(unit[3], unit[4], unit[5]),
                    };
                    let (Scope::SubTree(structure, _) | Scope::SubTrees(structure)) = self.scope
                    else {
                        unreachable!("a whole tree has no offsets")
                    };
                    // reading = true + offset. The true reading is the wrench by the parent on the
                    // child, so the offset is added for the child and subtracted for the parent.
                    let cut = &structure.sensors()[sensor];
                    let joint = &model.joints()[cut.joint()];
                    let wrench = kinematics
                        .pose(joint.child)
                        .wrench(&cut.transmitted(&offset));
                    offsets.push(OffsetColumn {
                        column,
                        link: joint.child,
                        wrench,
                    });
                    offsets.push(OffsetColumn {
                        column,
                        link: joint.parent,
                        wrench: -wrench,
                    });
                }
            }
            let numbers: std::collections::BTreeSet<usize> =
                links.iter().filter_map(|&link| self.piece(link)).collect();
            for &number in &numbers {
                let of_piece: Vec<usize> = links
                    .iter()
                    .copied()
                    .filter(|&link| self.piece(link) == Some(number))
                    .collect();
                if self.measured != Measurement::Torques {
                    let first = rows.rows.len();
                    rows.wrench(&blocks, &of_piece, &offsets);
                    let six = rows.rows.split_off(first);
                    rows.rows
                        .extend(self.left_by_contacts(number, &kinematics, &six));
                }
            }
            if self.measured != Measurement::Wrench {
                for joint in model.joints() {
                    let piece = self.piece(joint.child);
                    let Some(axis) = joint_axis(&kinematics, joint) else {
                        continue;
                    };
                    if piece.is_none() || self.piece(joint.parent) != piece {
                        continue;
                    }
                    let below = |link: usize| {
                        std::iter::successors(Some(link), |&l| {
                            (l > 0).then(|| model.joints()[l - 1].parent)
                        })
                        .any(|l| l == joint.child)
                    };
                    let base_below = below(self.regime.base);
                    let beyond: Vec<usize> = links
                        .iter()
                        .copied()
                        .filter(|&link| self.piece(link) == piece && below(link) != base_below)
                        .collect();
                    rows.torque(&axis, &blocks, &beyond, &offsets);
                }
            }
        }
        rows.matrix()
    }

    /// Combinations of a part's six rows to which its present contacts do not contribute:
    /// eigenvectors of `C C^T` with eigenvalue zero.
    fn left_by_contacts(
        &self,
        piece: usize,
        kinematics: &Kinematics,
        six: &[Vec<f64>],
    ) -> Vec<Vec<f64>> {
        let (Scope::SubTree(structure, _) | Scope::SubTrees(structure)) = self.scope else {
            return six.to_vec();
        };
        let mut gram = nalgebra::Matrix6::zeros();
        for contact in self.regime.contacts.iter() {
            let spec = &structure.contacts()[contact];
            if self.piece(spec.frame.link) != Some(piece) {
                continue;
            }
            let x_bf = *kinematics.pose(spec.frame.link) * spec.frame.pose;
            let forces = match spec.kind {
                ContactKind::ForceAlong(direction) => vec![direction],
                ContactKind::Wrench | ContactKind::Force => vec![Vec3::x(), Vec3::y(), Vec3::z()],
            };
            let mut push = |torque: Vec3, force: Vec3| {
                let column =
                    nalgebra::Vector6::from(components(&x_bf.wrench(&Wrench { torque, force })))
                        .normalize();
                gram += column * column.transpose();
            };
            for force in forces {
                push(spec.position.cross(&force), force);
                if spec.kind == ContactKind::Wrench {
                    push(force, Vec3::zeros());
                }
            }
        }
        let eigen = nalgebra::SymmetricEigen::new(gram);
        let left = (0..6).filter(|&k| eigen.eigenvalues[k] < 1e-10);
        left.map(|k| {
            let weights = eigen.eigenvectors.column(k);
            (0..six[0].len())
                .map(|column| (0..6).map(|row| weights[row] * six[row][column]).sum())
                .collect()
        })
        .collect()
    }

    /// Closed form and sampling agree: see [`agree`].
    fn check(&self, random: &mut Random) -> Identifiable {
        let answer = self.answer();
        agree(&answer, &self.sample(random));
        answer
    }
}

/// A state in which every joint moves as in `motions`.
fn state(motions: &[JointMotion], random: &mut Random) -> State {
    let mut draw = |moving: f64, locked: f64| -> Vec<f64> {
        motions
            .iter()
            .map(|motion| match *motion {
                JointMotion::Moving => random.real(moving),
                JointMotion::Locked(at) => locked * at,
            })
            .collect()
    };
    State([draw(3.0, 1.0), draw(2.0, 0.0), draw(5.0, 0.0)])
}

/// The closed form's basis is orthonormal and perpendicular to its null vectors, these are
/// independent and in the kernel of every sampled row; the sampled rows have exactly its rank, with
/// a clear gap.
fn agree(answer: &Identifiable, rows: &DMatrix<f64>) {
    let (basis, null) = (answer.basis(), answer.null());
    let columns = answer.columns().len();
    assert_eq!(basis.nrows(), columns);
    assert_eq!(rows.ncols(), columns);
    assert_eq!(answer.rank() + null.ncols(), columns);
    assert_eq!(answer.names().len(), columns);
    let identity = DMatrix::identity(answer.rank(), answer.rank());
    assert!(
        (basis.tr_mul(basis) - identity).amax() < 1e-11,
        "orthonormal"
    );
    let size = null.amax().max(1.0);
    assert!(
        null.is_empty() || (basis.tr_mul(&null)).amax() < 1e-11 * size,
        "{}",
        basis.tr_mul(&null).amax()
    );
    if columns == 0 || rows.nrows() == 0 {
        assert_eq!(answer.rank(), 0);
        return;
    }
    let invisible = rows * &null;
    for (row, product) in rows.row_iter().zip(invisible.row_iter()) {
        assert!(
            null.is_empty() || product.amax() < EXACT * size * (1.0 + row.norm()),
            "{} of {}",
            product.amax(),
            row.norm()
        );
    }
    // Rows are scaled to unit length, so that wrenches and torques, fast and slow states have equal
    // weight.
    let mut unit = rows.clone();
    // Rows that are small by chance are not scaled, because that would amplify their rounding
    // errors.
    let greatest = unit.row_iter().map(|row| row.norm()).fold(0.0, f64::max);
    for mut row in unit.row_iter_mut() {
        let norm = row.norm();
        // All rows are rounding errors where nothing is identifiable.
        if greatest > 1e-9 {
            row /= if norm > 1e-6 * greatest {
                norm
            } else {
                greatest
            };
        }
    }
    let norms = pivoted(unit);
    let (first, rank) = (norms.first().copied().unwrap_or(0.0), answer.rank());
    let least = if rank == 0 {
        f64::INFINITY
    } else {
        norms.get(rank - 1).copied().unwrap_or(0.0)
    };
    let next = norms.get(rank).copied().unwrap_or(0.0);
    assert!(
        least > 1e-9 * first && least > 1e4 * next && next < 1e-9 * first.max(1.0),
        "rank {rank} of {columns}: {first:e} .. {least:e} | {next:e}\n{:?}",
        norms.get(rank.saturating_sub(3)..(rank + 6).min(norms.len()))
    );
}

/// Norms of the pivots of an orthogonalisation with column pivoting: the diagonal of R.
fn pivoted(mut a: DMatrix<f64>) -> Vec<f64> {
    let mut norms = Vec::new();
    for k in 0..a.ncols().min(a.nrows()) {
        let (most, _) = (k..a.ncols())
            .map(|i| (i, a.column(i).norm_squared()))
            .max_by(|x, y| x.1.total_cmp(&y.1))
            .expect("a column");
        a.swap_columns(k, most);
        let (done, mut rest) = a.columns_range_pair_mut(0..k, k..);
        let mut unit = rest.column(0).into_owned();
        // Orthogonalised again, because the first projection leaves rounding errors.
        let along = done.tr_mul(&unit);
        unit.gemv(-1.0, &done, &along, 1.0);
        let norm = unit.norm();
        norms.push(norm);
        if norm == 0.0 {
            break;
        }
        unit /= norm;
        let along = rest.tr_mul(&unit);
        rest.ger(-1.0, &unit, &along, 1.0);
        rest.set_column(0, &unit);
    }
    norms
}

// -------------------------------------------------------------------------------------------------
// Random trees
// -------------------------------------------------------------------------------------------------

struct Robot {
    model: Model,
    structure: Structure,
}

/// A tree whose axes are parallel, perpendicular or meet, as on real robots: there spans are
/// smaller than on a tree in general position. `fixed`: percentage of fixed joints, most of them
/// with a sensor.
fn tidy(count: usize, fixed: usize, random: &mut Random) -> RandomRobot {
    let mut robot = RandomRobot::new(count, random);
    (robot.joints, robot.cuts) = (Vec::new(), Vec::new());
    let quarter =
        |random: &mut Random| (random.below(4) as f64 - 1.0) * std::f64::consts::FRAC_PI_2;
    for link in 1..count {
        let parent = if random.chance(75) {
            link - 1
        } else {
            random.below(link)
        };
        let kind = if random.chance(fixed) {
            "fixed"
        } else {
            ["revolute", "revolute", "revolute", "prismatic"][random.below(4)]
        };
        let name = format!("joint{link}");
        if kind == "fixed" && random.chance(80) {
            robot.cuts.push(name.clone());
        }
        let axis = ["1 0 0", "0 1 0", "0 0 1", "0 0 -1"][random.below(4)];
        let length = random.real(0.4);
        let xyz = match random.below(5) {
            0 => format!("{length:e} 0 0"),
            1 => format!("0 {length:e} 0"),
            2 => format!("0 0 {length:e}"),
            3 => format!("{length:e} 0 {:e}", random.real(0.4)),
            _ => "0 0 0".to_owned(),
        };
        let [r, p, y] = [(); 3].map(|()| {
            if random.chance(30) {
                quarter(random)
            } else {
                0.0
            }
        });
        robot.joints.push(format!(
            "<joint name=\"{name}\" type=\"{kind}\"><parent link=\"link{parent}\"/>\
             <child link=\"link{link}\"/>\
             <origin xyz=\"{xyz}\" rpy=\"{r:e} {p:e} {y:e}\"/><axis xyz=\"{axis}\"/>\
             <limit lower=\"-3\" upper=\"3\" effort=\"1\" velocity=\"1\"/></joint>"
        ));
    }
    robot
}

impl Robot {
    fn new(links: usize, random: &mut Random) -> Self {
        let robot = match random.below(3) {
            0 => RandomRobot::new(links, random),
            1 => tidy(links, 20, random),
            _ => tidy(links, 40, random),
        };
        let model = robot.model();
        let sensors = robot.sensors(&model, random);
        let structure = Structure::new(&model, &sensors, &[], Structure::LENGTH_SCALE).unwrap();
        Self { model, structure }
    }

    fn scope(&self, random: &mut Random) -> Scope<'_> {
        match random.below(3) {
            0 => Scope::Tree,
            1 => Scope::SubTree(
                &self.structure,
                random.below(self.structure.subtrees().len()),
            ),
            _ => Scope::SubTrees(&self.structure),
        }
    }
}

fn offsets(random: &mut Random) -> Offsets {
    [Offsets::Known, Offsets::Unknown][random.below(2)]
}

fn measured(random: &mut Random) -> Measurement {
    [Measurement::Wrench, Measurement::Torques, Measurement::Both][random.below(3)]
}

/// A base at rest, often upright along an axis of its link, to which a tidy robot's joints are
/// parallel or perpendicular.
fn at_rest(random: &mut Random) -> BaseRegime {
    let up = if random.chance(60) {
        [Vec3::z(), Vec3::y(), -Vec3::x()][random.below(3)]
    } else {
        random.vector(1.0).add_scalar(0.05).normalize()
    };
    BaseRegime::Fixed(up * -GRAVITY)
}

/// Joints that are all moving, or some of them locked.
fn joint_motions(model: &Model, random: &mut Random) -> Vec<JointMotion> {
    let locked = if random.chance(50) { 0 } else { 30 };
    (0..model.dof_count())
        .map(|_| {
            if random.chance(locked) {
                JointMotion::Locked(random.real(2.0))
            } else {
                JointMotion::Moving
            }
        })
        .collect()
}

fn cases(count: u32) -> ProptestConfig {
    ProptestConfig {
        cases: count,
        failure_persistence: None,
        ..ProptestConfig::default()
    }
}

proptest! {
    #![proptest_config(cases(48))]

    /// A free base: dim I = 10 N_B - sum n_j, three for a revolute joint, six for a prismatic one,
    /// ten for a fixed one; the same from any base (Lemma 1); and joint torques add nothing
    /// (Proposition 1, eq. (14)).
    #[test]
    fn free_base_is_the_closed_form((links, seed) in (1..=14_usize, any::<u64>())) {
        free_base(links, seed);
    }

    /// Any base, free or at rest, any joints moving or locked, any scope, any measurement, with
    /// offsets and without.
    #[test]
    fn restricted_regimes((links, seed) in (1..=9_usize, any::<u64>())) {
        any_regime(links, seed);
    }

    /// Unknown offsets of several sensors: coupled through the sub-trees that they share.
    #[test]
    fn offsets_at_both_ends((links, seed) in (3..=8_usize, any::<u64>())) {
        sensors_at_both_ends(links, seed);
    }

    /// Unknown contacts that are always present remove rows.
    #[test]
    fn constant_contacts_remove_rows((links, seed) in (1..=8_usize, any::<u64>())) {
        always_touched(links, seed);
    }

    /// The null space of the closed form is in the kernel of the crate's regressors, whose columns
    /// have the same order.
    #[test]
    fn own_regressors_do_not_see_it((links, seed) in (1..=12_usize, any::<u64>())) {
        joined(links, seed);
    }

    /// Readable sums are a basis of the subspace, with bounded factors.
    #[test]
    fn base_parameters_lose_nothing((links, seed) in (1..=12_usize, any::<u64>())) {
        let mut random = Random::new(seed);
        let robot = Robot::new(links, &mut random);
        let question = question(&robot, &mut random);
        sums(&question.answer(), &mut random);
    }
}

fn question<'a>(robot: &'a Robot, random: &mut Random) -> Question<'a> {
    let base = random.below(robot.model.link_count());
    Question {
        model: &robot.model,
        scope: robot.scope(random),
        regime: Regime {
            base,
            motion: if random.chance(40) {
                BaseRegime::Free
            } else {
                at_rest(random)
            },
            joints: joint_motions(&robot.model, random),
            contacts: ContactSet::EMPTY,
            tolerance: Regime::TOLERANCE,
        },
        measured: measured(random),
        offsets: offsets(random),
    }
}

/// Sub-trees with sensors at both ends, whose offsets are unknown.
fn sensors_at_both_ends(links: usize, seed: u64) {
    let mut random = Random::new(seed);
    let robot = loop {
        let robot = tidy(links, 40, &mut random);
        let model = robot.model();
        let sensors = robot.sensors(&model, &mut random);
        if !sensors.is_empty() {
            let structure = Structure::new(&model, &sensors, &[], Structure::LENGTH_SCALE).unwrap();
            break Robot { model, structure };
        }
    };
    let mut question = question(&robot, &mut random);
    question.offsets = Offsets::Unknown;
    question.scope = if random.chance(50) {
        Scope::SubTrees(&robot.structure)
    } else {
        let most = |&number: &usize| robot.structure.subtrees()[number].sensors.len();
        Scope::SubTree(
            &robot.structure,
            (0..robot.structure.subtrees().len())
                .max_by_key(most)
                .unwrap(),
        )
    };
    if random.chance(50) {
        question.regime.joints.fill(JointMotion::Moving);
    }
    let answer = question.check(&mut random);
    sums(&answer, &mut random);
}

/// A structure with unknown contacts where there is a closed form, of any kind on the top links,
/// full wrenches anywhere; and those that are present.
fn with_contacts(
    robot: &RandomRobot,
    model: &Model,
    random: &mut Random,
) -> (Structure, ContactSet) {
    let sensors = robot.sensors(model, random);
    let plain = Structure::new(model, &sensors, &[], Structure::LENGTH_SCALE).unwrap();
    let contacts: Vec<ContactSpec> = (0..=random.below(4))
        .map(|_| {
            let (mut contact, _) = common::contact(model, random);
            if contact.kind != ContactKind::Wrench {
                contact.frame.link = plain.subtrees()[random.below(plain.subtrees().len())].top;
            }
            contact
        })
        .collect();
    let structure = Structure::new(model, &sensors, &contacts, Structure::LENGTH_SCALE).unwrap();
    let present = (0..contacts.len()).filter(|_| random.chance(70)).collect();
    (structure, present)
}

/// Contacts that are always present, in every sub-tree.
fn always_touched(links: usize, seed: u64) {
    let mut random = Random::new(seed);
    let robot = tidy(links, 40, &mut random);
    let model = robot.model();
    let (structure, present) = with_contacts(&robot, &model, &mut random);
    let robot = Robot { model, structure };
    let mut question = question(&robot, &mut random);
    question.scope = if random.chance(70) {
        Scope::SubTrees(&robot.structure)
    } else {
        Scope::SubTree(
            &robot.structure,
            random.below(robot.structure.subtrees().len()),
        )
    };
    question.regime.base = 0;
    question.regime.contacts = present;
    // With measured torques, contacts must be on the links where the pass begins.
    let tops = |contact: &usize| {
        let link = robot.structure.contacts()[*contact].frame.link;
        robot
            .structure
            .subtrees()
            .iter()
            .any(|subtree| subtree.top == link)
    };
    if question.measured != Measurement::Wrench {
        question.regime.contacts = present.iter().filter(tops).collect();
    }
    let answer = question.check(&mut random);
    sums(&answer, &mut random);
}

fn any_regime(links: usize, seed: u64) {
    let mut random = Random::new(seed);
    let robot = Robot::new(links, &mut random);
    question(&robot, &mut random).check(&mut random);
}

fn free_base(links: usize, seed: u64) {
    let mut random = Random::new(seed);
    let robot = Robot::new(links, &mut random);
    let (model, scope) = (&robot.model, robot.scope(&mut random));
    let ask = |base, measured, offsets| Question {
        model,
        scope,
        regime: Regime {
            base,
            ..Regime::free(model)
        },
        measured,
        offsets,
    };
    let question = ask(
        random.below(model.link_count()),
        Measurement::Wrench,
        Offsets::Known,
    );
    let answer = question.check(&mut random);
    let mut expected = answer.columns().len();
    for joint in model.joints() {
        let part = question.piece(joint.child);
        if part.is_some() && part == question.piece(joint.parent) {
            expected -= match joint.kind {
                JointKind::Revolute(_) => 3,
                JointKind::Prismatic(_) => 6,
                JointKind::Fixed => 10,
            };
        }
    }
    assert_eq!(answer.rank(), expected);
    // The projectors agree: the same subspace for any base, and with the torques.
    let projector = |answer: &Identifiable| answer.basis() * answer.basis().transpose();
    let both = ask(
        random.below(model.link_count()),
        Measurement::Both,
        Offsets::Known,
    );
    let other = both.check(&mut random);
    assert!((projector(&other) - projector(&answer)).amax() < 1e-10);
    let torques = ask(
        random.below(model.link_count()),
        Measurement::Torques,
        Offsets::Known,
    );
    let part = torques.check(&mut random);
    assert!(
        (answer.basis() * answer.basis().tr_mul(part.basis()) - part.basis()).amax() < 1e-10,
        "a part of it"
    );
    // Offsets: separable from all parameters, but not from those beyond a joint that leaves a
    // wrench unchanged.
    let with = ask(
        random.below(model.link_count()),
        Measurement::Wrench,
        Offsets::Unknown,
    )
    .check(&mut random);
    assert_eq!(
        with.rank() + with.confused(),
        answer.rank() + with.columns().len() - answer.columns().len()
    );
}

fn sums(answer: &Identifiable, random: &mut Random) {
    let sums = answer.base_parameters();
    let columns = answer.columns().len();
    assert_eq!(sums.len(), answer.rank());
    let mut matrix = DMatrix::zeros(sums.len(), columns);
    for (i, sum) in sums.iter().enumerate() {
        assert_eq!(sum.kept.coefficient, 1.0);
        assert_eq!(sum.kept.name, answer.names()[sum.kept.column]);
        matrix[(i, sum.kept.column)] = 1.0;
        for term in &sum.terms {
            assert!(term.coefficient.abs() <= BaseParameter::LARGEST);
            assert!(
                sums.iter().all(|other| other.kept.column != term.column),
                "what is eliminated is not kept"
            );
            matrix[(i, term.column)] = term.coefficient;
        }
        assert!(sum.terms.is_sorted_by_key(|term| term.column));
    }
    // The kept columns are the identity, so the rank is full; that they lie in the subspace makes
    // them a basis of it.
    let inside = (&matrix * answer.basis()) * answer.basis().transpose();
    assert!(
        sums.is_empty() || (inside - &matrix).amax() < 1e-8 * (1.0 + matrix.amax()),
        "in the subspace"
    );
    let phi = random.reals(columns, 1.0);
    let seen = answer.basis()
        * answer
            .basis()
            .tr_mul(&DMatrix::from_column_slice(columns, 1, &phi));
    for sum in &sums {
        let [all, shown] =
            [&phi, seen.as_slice()].map(|columns| sum.value(columns).expect("every column"));
        assert!((all - shown).abs() < 1e-6 * (1.0 + all.abs()));
        assert_eq!(sum.value(&phi[..sum.kept.column]), None, "too few columns");
    }
}

/// A sub-tree's rows over the columns of the whole robot, `[10 N_B | 6 per sensor]`.
fn spread(tree: &SubTreeRegressor, structure: &Structure) -> DMatrix<f64> {
    let offsets = 10 * structure.link_count();
    let links = tree.links().iter().map(|&link| (10 * link, 10));
    let sensors = tree.sensors().map(|sensor| (offsets + 6 * sensor, 6));
    let mut all = DMatrix::zeros(6, offsets + 6 * structure.sensors().len());
    let mut from = 0;
    for (to, width) in links.chain(sensors) {
        for row in 0..6 {
            let values = &tree.row(row)[from..from + width];
            all.view_mut((row, to), (1, width)).copy_from_slice(values);
        }
        from += width;
    }
    all
}

/// The columns of links and sensors, each in this order.
fn columns_of(
    links: impl IntoIterator<Item = usize>,
    sensors: impl IntoIterator<Item = usize>,
) -> Vec<ParameterColumn> {
    let inertial = links.into_iter().flat_map(|link| {
        (0..10).map(move |parameter| ParameterColumn::Inertial { link, parameter })
    });
    let offsets = sensors.into_iter().flat_map(|sensor| {
        (0..6).map(move |component| ParameterColumn::Offset { sensor, component })
    });
    inertial.chain(offsets).collect()
}

fn unseen(answer: &Identifiable, rows: &DMatrix<f64>, what: &str) {
    let null = answer.null();
    assert_eq!(rows.ncols(), null.nrows(), "{what}");
    if null.is_empty() || rows.is_empty() {
        return;
    }
    let product = (rows * &null).amax();
    assert!(
        product < EXACT * (1.0 + rows.amax()) * null.amax().max(1.0),
        "{what}: {product:e}"
    );
    assert!(
        rows.amax() == 0.0 || (rows * answer.basis()).amax() > 0.0,
        "{what}"
    );
}

fn joined(links: usize, seed: u64) {
    let mut random = Random::new(seed);
    let robot = if random.chance(50) {
        tidy(links, 40, &mut random)
    } else {
        RandomRobot::new(links, &mut random)
    };
    let model = robot.model();
    let (structure, present) = with_contacts(&robot, &model, &mut random);
    let gravity = random.vector(9.8);
    let is_free = random.chance(50);
    let regime = if is_free {
        Regime::free(&model)
    } else {
        Regime::fixed(&model, 0, &gravity)
    };
    let new = |scope, regime: &Regime, measured, offsets| {
        Identifiable::new(&model, scope, regime, measured, offsets).unwrap()
    };
    let tree = new(Scope::Tree, &regime, Measurement::Both, Offsets::Known);
    assert_eq!(tree.columns(), columns_of(0..model.link_count(), []));
    let all = new(
        Scope::SubTrees(&structure),
        &regime,
        Measurement::Wrench,
        Offsets::Unknown,
    );
    let sensors = structure.sensors().len();
    assert_eq!(all.columns(), columns_of(0..model.link_count(), 0..sensors));
    let touched = Regime {
        contacts: present,
        ..regime.clone()
    };
    let parts: Vec<_> = (0..structure.subtrees().len())
        .map(|number| {
            let scope = Scope::SubTree(&structure, number);
            new(scope, &touched, Measurement::Wrench, Offsets::Unknown)
        })
        .collect();
    let mut kinematics = Kinematics::new(&model, 0).unwrap();
    let mut regressor = Regressor::new(&model);
    let mut stacked = StackedRegressor::new(&structure);
    let readings: Vec<Wrench> = (0..sensors).map(|_| random.wrench()).collect();
    for _ in 0..3 {
        let base = if is_free {
            motion(&mut random)
        } else {
            FrameMotion::standing(&gravity)
        };
        let state = State::new(&model, &mut random);
        kinematics.update(&model, state.get(), &base).unwrap();
        regressor.update(&model, &kinematics).unwrap();
        let count = 6 + model.dof_count();
        let rows: Vec<f64> = (0..count)
            .flat_map(|row| regressor.row(row).to_vec())
            .collect();
        let rows = DMatrix::from_row_slice(count, 10 * model.link_count(), &rows);
        unseen(&tree, &rows, "the whole tree");
        stacked
            .update(&kinematics, &readings, &ContactSet::EMPTY, &[])
            .unwrap();
        for tree in stacked.subtrees() {
            unseen(&all, &spread(tree, &structure), "all sub-trees");
        }
        stacked
            .update(&kinematics, &readings, &present, &[])
            .unwrap();
        for (part, tree) in parts.iter().zip(stacked.subtrees()) {
            let columns = columns_of(tree.links().iter().copied(), tree.sensors());
            assert_eq!(part.columns(), columns);
            let rows: Vec<f64> = (0..tree.remaining())
                .flat_map(|row| tree.projected_row(row).to_vec())
                .collect();
            let rows = DMatrix::from_row_slice(tree.remaining(), tree.contact_column(), &rows);
            unseen(part, &rows, "a sub-tree");
            if rows.is_empty() {
                assert_eq!(part.rank(), 0, "nothing is left");
            }
        }
    }
}

/// A few large trees, up to 40 links.
#[test]
fn large_trees() {
    for (links, seed) in [(40, 11), (33, 12), (25, 13)] {
        free_base(links, seed);
        any_regime(links, seed);
    }
}
