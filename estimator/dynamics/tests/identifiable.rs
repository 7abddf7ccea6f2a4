//! Comparison of the closed-form identifiable subspaces with sampled regressors (rank by QR with
//! column pivoting), for random trees of 1 to 40 links, cuts, bases and regimes of motion; known
//! ranks; readable sums.
//!
//! The oracle has no formula in common with the closed form: ten evaluations of a body's net wrench
//! per link and state, in random states of the regime.

mod common;

use common::{Random, RandomRobot, State, humanoid, joint_axis, motion};
use nalgebra::{DMatrix, Matrix4};
use proprio_dynamics::model::{Frame, JointKind, MeasurementDirection, MeasurementFrame, Model};
use proprio_dynamics::regressor::identifiable::{
    BaseParameter, BaseRegime, Body, Column, Freedom, Identifiable, JointMotion, Measured, Offsets,
    Regime, Scope, Term,
};
use proprio_dynamics::regressor::{Regressor, StackedRegressor, Weighting};
use proprio_dynamics::spatial::{Mat3, Motion, Pose, RigidInertia, Vec3, Wrench};
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
    measured: Measured,
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

    /// Motion of the base link in one random state of the regime: computed with a small robot of
    /// the joints between the world and the base.
    fn base_motion(&self, random: &mut Random) -> FrameMotion {
        let BaseRegime::Restricted { gravity, joints } = &self.regime.motion else {
            return motion(random);
        };
        let inertial = "<inertial><mass value=\"0\"/>\
            <inertia ixx=\"0\" ixy=\"0\" ixz=\"0\" iyy=\"0\" iyz=\"0\" izz=\"0\"/></inertial>";
        let mut text = format!("<robot name=\"mount\"><link name=\"v0\">{inertial}</link>");
        // Position of the last link's frame in base coordinates, with all joints at zero.
        let mut at = Vec3::zeros();
        let text_of = |v: Vec3| format!("{:e} {:e} {:e}", v.x, v.y, v.z);
        for (number, freedom) in joints.iter().enumerate() {
            let Motion { angular, linear } = freedom.twist;
            let (kind, axis, point) = if angular.norm() > 0.0 {
                (
                    "continuous",
                    angular,
                    angular.cross(&linear) / angular.norm_squared(),
                )
            } else {
                ("prismatic", linear, at)
            };
            text += &format!(
                "<link name=\"v{}\">{inertial}</link><joint name=\"j{number}\" type=\"{kind}\">\
                 <parent link=\"v{number}\"/><child link=\"v{}\"/>\
                 <origin xyz=\"{}\"/><axis xyz=\"{}\"/>\
                 <limit lower=\"-9\" upper=\"9\" effort=\"1\" velocity=\"1\"/></joint>",
                number + 1,
                number + 1,
                text_of(point - at),
                text_of(axis),
            );
            at = point;
        }
        text += &format!(
            "<link name=\"base\"/><joint name=\"last\" type=\"fixed\"><parent \
             link=\"v{}\"/><child link=\"base\"/><origin xyz=\"{}\"/></joint></robot>",
            joints.len(),
            text_of(-at)
        );
        let mount = Model::from_urdf(&text, &[]).expect("a valid mount");
        let motions: Vec<_> = joints.iter().map(|freedom| freedom.motion).collect();
        let state = state(&motions, random);
        let mut kinematics = Kinematics::new(&mount, 0).unwrap();
        kinematics
            .update(&mount, state.get(), &FrameMotion::standing(gravity))
            .unwrap();
        kinematics.frame_motion(&mount.frame("base").unwrap())
    }

    fn sample(&self, random: &mut Random) -> DMatrix<f64> {
        let model = self.model;
        let links: Vec<usize> = (0..model.link_count())
            .filter(|&link| self.piece(link).is_some())
            .collect();
        let sensors: Vec<usize> = match (self.scope, self.offsets) {
            (_, Offsets::Known) => Vec::new(),
            (Scope::Tree, _) => vec![0],
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
        // A wrench has three rows per state that depend on the second moments, a single torque has
        // one row; the part that needs the most states decides.
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
            + if self.measured == Measured::Torques {
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
                        offsets.push(OffsetColumn {
                            column,
                            link: self.regime.base,
                            wrench: offset,
                        });
                        continue;
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
                if self.measured != Measured::Torques {
                    let first = rows.rows.len();
                    rows.wrench(&blocks, &of_piece, &offsets);
                    let six = rows.rows.split_off(first);
                    rows.rows
                        .extend(self.left_by_contacts(number, &kinematics, &six));
                }
            }
            if self.measured != Measured::Wrench {
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
    let of = |random: &mut Random, moving: f64, posed: f64, locked: bool| -> Vec<f64> {
        motions
            .iter()
            .map(|motion| match *motion {
                JointMotion::Moving => random.real(moving),
                JointMotion::Posed => random.real(posed),
                JointMotion::Locked(at) => {
                    if locked {
                        at
                    } else {
                        0.0
                    }
                }
            })
            .collect()
    };
    State([
        of(random, 3.0, 3.0, true),
        of(random, 2.0, 0.0, false),
        of(random, 5.0, 0.0, false),
    ])
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

fn measured(random: &mut Random) -> Measured {
    [Measured::Wrench, Measured::Torques, Measured::Both][random.below(3)]
}

fn rotation(axis: Vec3, point: Vec3, motion: JointMotion) -> Freedom {
    Freedom {
        twist: Motion::rotation(&axis, &point),
        motion,
    }
}

fn translation(axis: Vec3, motion: JointMotion) -> Freedom {
    Freedom {
        twist: Motion::translation(&axis),
        motion,
    }
}

/// A base held to the world in a way that is usual for robots, or at random.
fn restricted(random: &mut Random) -> BaseRegime {
    // Often along the axes of the base link, to which a tidy robot's joints are parallel or
    // perpendicular.
    let (up, across) = if random.chance(60) {
        [
            (Vec3::z(), Vec3::x()),
            (Vec3::y(), Vec3::z()),
            (-Vec3::x(), Vec3::y()),
        ][random.below(3)]
    } else {
        let up = random.vector(1.0).add_scalar(0.05).normalize();
        (
            up,
            up.cross(&random.vector(1.0).add_scalar(0.02)).normalize(),
        )
    };
    let point = if random.chance(50) {
        Vec3::zeros()
    } else {
        random.vector(0.3)
    };
    let (moving, posed) = (JointMotion::Moving, JointMotion::Posed);
    let joints = match random.below(9) {
        0 => Vec::new(),
        1 => vec![rotation(up, point, moving)],
        2 => vec![rotation(across, point, moving)],
        3 => vec![rotation(up, point, moving), rotation(across, point, moving)],
        4 => vec![translation(up, moving)],
        5 => vec![rotation(across, point, posed)],
        6 => vec![rotation(up, point, posed)],
        7 => vec![
            translation(across, moving),
            translation(up.cross(&across), moving),
            rotation(up, point, moving),
        ],
        _ => (0..1 + random.below(3))
            .map(|_| {
                let axis = random.vector(1.0).add_scalar(0.05).normalize();
                let motion = match random.below(4) {
                    0 => posed,
                    1 => JointMotion::Locked(random.real(2.0)),
                    _ => moving,
                };
                if random.chance(60) {
                    rotation(axis, random.vector(0.3), motion)
                } else {
                    translation(axis, motion)
                }
            })
            .collect(),
    };
    BaseRegime::Restricted {
        gravity: up * -GRAVITY,
        joints,
    }
}

/// Joints that are all moving, all posed, or mixed.
fn joint_motions(model: &Model, random: &mut Random) -> Vec<JointMotion> {
    let kind = random.below(3);
    (0..model.dof_count())
        .map(|_| match kind {
            0 => JointMotion::Moving,
            1 => JointMotion::Posed,
            _ => [
                JointMotion::Moving,
                JointMotion::Moving,
                JointMotion::Posed,
                JointMotion::Locked(random.real(2.0)),
            ][random.below(4)],
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

    /// Any restriction of any base, any joints moving, posed or locked, any scope, any measurement,
    /// with offsets and without.
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

/// A case in which some sampled rows are ten thousand times smaller than others.
#[test]
fn small_rows_do_not_hide_the_gap() {
    any_regime(6, 3_047_814_552_523_043_449);
}

fn question<'a>(robot: &'a Robot, random: &mut Random) -> Question<'a> {
    let base = random.below(robot.model.link_count());
    Question {
        model: &robot.model,
        scope: robot.scope(random),
        regime: Regime {
            base,
            motion: if random.chance(15) {
                BaseRegime::Free
            } else {
                restricted(random)
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
    let contacts: Vec<ContactSpec> = (0..1 + random.below(4))
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
    if question.measured != Measured::Wrench {
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
        Measured::Wrench,
        Offsets::Known,
    );
    let answer = question.check(&mut random);
    let mut expected = answer.columns().len();
    for invisible in answer.invisible() {
        let directions = match invisible.joint.map(|joint| model.joints()[joint].kind) {
            None => 0,
            Some(JointKind::Revolute(_)) => 3,
            Some(JointKind::Prismatic(_)) => 6,
            Some(JointKind::Fixed) => 10,
        };
        assert_eq!(invisible.directions, directions);
        expected -= directions;
    }
    assert_eq!(answer.rank(), expected);
    // The projectors agree: the same subspace for any base, and with the torques.
    let projector = |answer: &Identifiable| answer.basis() * answer.basis().transpose();
    let both = ask(
        random.below(model.link_count()),
        Measured::Both,
        Offsets::Known,
    );
    let other = both.check(&mut random);
    assert!((projector(&other) - projector(&answer)).amax() < 1e-10);
    let torques = ask(
        random.below(model.link_count()),
        Measured::Torques,
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
        Measured::Wrench,
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

/// `[parameters | offsets]` of a sub-tree that are in its rows, without contact columns: the rows
/// that no present contact reaches.
struct SubTreeRows {
    links: Vec<usize>,
    sensors: Vec<usize>,
    rows: DMatrix<f64>,
}

/// The crate's rows of one state: of each sub-tree, and of all of them together (for no contact).
fn stacked_rows(
    structure: &Structure,
    kinematics: &Kinematics,
    readings: &[Wrench],
    present: &ContactSet,
) -> (Vec<SubTreeRows>, DMatrix<f64>) {
    let mut regressor = StackedRegressor::new(structure);
    regressor
        .update(kinematics, readings, &ContactSet::EMPTY, &[])
        .unwrap();
    let (rows, columns) = (regressor.row_count(), regressor.column_count());
    let mut stacked = vec![0.0; rows * columns];
    regressor.write_stacked(&mut stacked).unwrap();
    regressor
        .update(kinematics, readings, present, &[])
        .unwrap();
    regressor.eliminate_contacts(Weighting::LengthScale);
    let subtrees = regressor.subtrees().iter().map(|subtree| {
        let projected: Vec<f64> = (0..subtree.remaining())
            .flat_map(|row| subtree.projected_row(row).to_vec())
            .collect();
        SubTreeRows {
            links: subtree.links().to_vec(),
            sensors: subtree.sensors().collect(),
            rows: DMatrix::from_row_slice(
                subtree.remaining(),
                subtree.contact_column(),
                &projected,
            ),
        }
    });
    (
        subtrees.collect(),
        DMatrix::from_row_slice(rows, columns, &stacked),
    )
}

/// The columns of links and sensors, each in this order.
fn columns_of(
    links: impl IntoIterator<Item = usize>,
    sensors: impl IntoIterator<Item = usize>,
) -> Vec<Column> {
    let inertial = links
        .into_iter()
        .flat_map(|link| (0..10).map(move |parameter| Column::Inertial { link, parameter }));
    let offsets = sensors
        .into_iter()
        .flat_map(|sensor| (0..6).map(move |component| Column::Offset { sensor, component }));
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
    let tree = new(Scope::Tree, &regime, Measured::Both, Offsets::Known);
    assert_eq!(tree.columns(), columns_of(0..model.link_count(), []));
    let all = new(
        Scope::SubTrees(&structure),
        &regime,
        Measured::Wrench,
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
            new(scope, &touched, Measured::Wrench, Offsets::Unknown)
        })
        .collect();
    let mut kinematics = Kinematics::new(&model, 0).unwrap();
    let mut regressor = Regressor::new(&model);
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
        unseen(&tree, &regressor.transposed().transpose(), "the whole tree");
        let (subtrees, stacked) = stacked_rows(&structure, &kinematics, &readings, &present);
        unseen(&all, &stacked, "all sub-trees");
        for (part, subtree) in parts.iter().zip(&subtrees) {
            let own = columns_of(
                subtree.links.iter().copied(),
                subtree.sensors.iter().copied(),
            );
            assert_eq!(part.columns(), own);
            unseen(part, &subtree.rows, "a sub-tree");
            if subtree.rows.is_empty() {
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

// -------------------------------------------------------------------------------------------------
// Joints of any type
// -------------------------------------------------------------------------------------------------

/// A 4 x 4 matrix as a function of time, by value and two derivatives.
#[derive(Clone, Copy)]
struct Jet([Matrix4<f64>; 3]);

impl Jet {
    /// `exp(S q)` with `q` as given by value and two derivatives.
    fn exponential(twist: &Motion, [q, dq, ddq]: [f64; 3]) -> Self {
        let s = matrix(&twist.angular.cross_matrix(), &twist.linear, 0.0);
        let value = (s * q).exp();
        Self([
            value,
            s * value * dq,
            s * s * value * (dq * dq) + s * value * ddq,
        ])
    }

    fn constant(pose: &Pose) -> Self {
        Self([
            matrix(&pose.rotation, &pose.translation, 1.0),
            Matrix4::zeros(),
            Matrix4::zeros(),
        ])
    }

    /// Leibniz.
    fn times(&self, other: &Self) -> Self {
        let ([a, da, dda], [b, db, ddb]) = (&self.0, &other.0);
        Self([a * b, da * b + a * db, dda * b + da * db * 2.0 + a * ddb])
    }

    fn pose(&self) -> Pose {
        Pose {
            rotation: self.0[0].fixed_view::<3, 3>(0, 0).into_owned(),
            translation: self.0[0].fixed_view::<3, 1>(0, 3).into_owned(),
        }
    }

    fn motion(&self) -> FrameMotion {
        let inverse = Self::constant(&self.pose().inverse()).0[0];
        let axial = |m: &Matrix4<f64>| {
            Vec3::new(
                m[(2, 1)] - m[(1, 2)],
                m[(0, 2)] - m[(2, 0)],
                m[(1, 0)] - m[(0, 1)],
            ) / 2.0
        };
        let (v, d) = (inverse * self.0[1], inverse * self.0[2]);
        FrameMotion {
            angular_velocity: axial(&v),
            angular_acceleration: axial(&d),
            proper_acceleration: d.fixed_view::<3, 1>(0, 3).into_owned(),
        }
    }
}

fn matrix(block: &Mat3, column: &Vec3, corner: f64) -> Matrix4<f64> {
    let mut matrix = Matrix4::zeros();
    matrix.fixed_view_mut::<3, 3>(0, 0).copy_from(block);
    matrix.fixed_view_mut::<3, 1>(0, 3).copy_from(column);
    matrix[(3, 3)] = corner;
    matrix
}

fn freedom_state(motion: JointMotion, random: &mut Random) -> [f64; 3] {
    match motion {
        JointMotion::Moving => [random.real(3.0), random.real(2.0), random.real(5.0)],
        JointMotion::Posed => [random.real(3.0), 0.0, 0.0],
        JointMotion::Locked(at) => [at, 0.0, 0.0],
    }
}

/// Rows of a mechanism in random states of its regime.
fn mechanism_rows(
    bodies: &[Body],
    motion: &BaseRegime,
    measured: Measured,
    offsets: Offsets,
    random: &mut Random,
) -> DMatrix<f64> {
    let columns = 10 * bodies.len() + if offsets == Offsets::Unknown { 6 } else { 0 };
    let mut rows = Rows {
        columns,
        rows: Vec::new(),
    };
    for _ in 0..columns + 10 {
        let base = match motion {
            BaseRegime::Free => {
                let [omega, alpha, a] = [2.0, 5.0, 10.0].map(|size| random.vector(size));
                let turn = omega.cross_matrix();
                let second = alpha.cross_matrix() + turn * turn;
                Jet([
                    Matrix4::identity(),
                    matrix(&turn, &random.vector(1.0), 0.0),
                    matrix(&second, &a, 0.0),
                ])
            }
            BaseRegime::Restricted { gravity, joints } => {
                let world = Jet([
                    Matrix4::identity(),
                    Matrix4::zeros(),
                    matrix(&Mat3::zeros(), &-gravity, 0.0),
                ]);
                joints.iter().fold(world, |jet, freedom| {
                    jet.times(&Jet::exponential(
                        &freedom.twist,
                        freedom_state(freedom.motion, random),
                    ))
                })
            }
        };
        let in_base = |pose: &Pose| base.pose().inverse() * *pose;
        let mut jets: Vec<Jet> = Vec::new();
        let mut axes = Vec::new();
        for (number, body) in bodies.iter().enumerate() {
            let mut jet = body.parent.map_or(base, |parent| {
                jets[parent].times(&Jet::constant(&body.placement))
            });
            for freedom in body.joint.iter().filter(|_| body.parent.is_some()) {
                jet = jet.times(&Jet::exponential(
                    &freedom.twist,
                    freedom_state(freedom.motion, random),
                ));
                axes.push((number, in_base(&jet.pose()).twist(&freedom.twist)));
            }
            jets.push(jet);
        }
        let blocks: Vec<_> = jets
            .iter()
            .enumerate()
            .map(|(i, jet)| Some((i, block(&in_base(&jet.pose()), &jet.motion()))))
            .collect();
        let mut offset = Vec::new();
        if offsets == Offsets::Unknown {
            for component in 0..6 {
                let mut unit = [0.0; 6];
                unit[component] = 1.0;
                let wrench = Wrench {
                    torque: Vec3::new(unit[0], unit[1], unit[2]),
                    force: Vec3::new(unit[3], unit[4], unit[5]),
                };
                offset.push(OffsetColumn {
                    column: 10 * bodies.len() + component,
                    link: 0,
                    wrench,
                });
            }
        }
        let all: Vec<usize> = (0..bodies.len()).collect();
        if measured != Measured::Torques {
            rows.wrench(&blocks, &all, &offset);
        }
        if measured != Measured::Wrench {
            for (joint, axis) in &axes {
                let is_beyond = |&body: &usize| {
                    std::iter::successors(Some(body), |&b| bodies[b].parent).any(|b| b == *joint)
                };
                let beyond: Vec<usize> = all.iter().copied().filter(is_beyond).collect();
                rows.torque(axis, &blocks, &beyond, &offset);
            }
        }
    }
    rows.matrix()
}

/// The freedoms of a joint of a named type, in its own frame, transformed to the body's frame by
/// `x`.
fn joint_of(kind: &str, x: &Pose, motion: JointMotion, random: &mut Random) -> Vec<Freedom> {
    let zero = Vec3::zeros();
    let turn = |axis: Vec3| Motion::rotation(&axis, &zero);
    let slide = |axis: Vec3| Motion::translation(&axis);
    let (x_axis, y_axis, z_axis) = (Vec3::x(), Vec3::y(), Vec3::z());
    let twists = match kind {
        "fixed" => vec![],
        "revolute" => vec![turn(z_axis)],
        "prismatic" => vec![slide(z_axis)],
        "helical" => vec![Motion {
            angular: z_axis,
            linear: z_axis * (0.02 + random.real(0.1).abs()),
        }],
        "cylindrical" => vec![turn(z_axis), slide(z_axis)],
        "universal" => vec![turn(x_axis), turn(y_axis)],
        "spherical" => vec![turn(x_axis), turn(y_axis), turn(z_axis)],
        "planar" => vec![slide(x_axis), slide(y_axis), turn(z_axis)],
        other => panic!("{other}"),
    };
    twists
        .iter()
        .map(|twist| Freedom {
            twist: x.twist(twist),
            motion,
        })
        .collect()
}

const JOINTS: [(&str, usize); 8] = [
    ("fixed", 10),
    ("revolute", 3),
    ("prismatic", 6),
    ("helical", 1),
    ("cylindrical", 1),
    ("universal", 1),
    ("spherical", 1),
    ("planar", 1),
];

/// With a free base the rule depends on the joint only: `S theta = 0`, dimension k (k + 1) / 2 with
/// k that of the common kernel of its twists.
#[test]
fn invisible_directions_by_joint_type() {
    let mut random = Random::new(5);
    for (kind, directions) in JOINTS {
        for x in [Pose::identity(), random.pose()] {
            let bodies = [
                Body {
                    parent: None,
                    placement: Pose::identity(),
                    joint: Vec::new(),
                },
                Body {
                    parent: Some(0),
                    placement: random.pose(),
                    joint: joint_of(kind, &x, JointMotion::Moving, &mut random),
                },
            ];
            let ask = |measured| {
                Identifiable::of_mechanism(
                    &bodies,
                    &BaseRegime::Free,
                    measured,
                    Offsets::Known,
                    Regime::TOLERANCE,
                )
                .unwrap()
            };
            let answer = ask(Measured::Wrench);
            assert_eq!(answer.invisible()[0].directions, 0);
            assert_eq!(
                (
                    answer.invisible()[1].joint,
                    answer.invisible()[1].directions
                ),
                (Some(0), directions),
                "{kind}"
            );
            assert_eq!(answer.rank(), 20 - directions);
            for measured in [Measured::Wrench, Measured::Both, Measured::Torques] {
                agree(
                    &ask(measured),
                    &mechanism_rows(
                        &bodies,
                        &BaseRegime::Free,
                        measured,
                        Offsets::Known,
                        &mut random,
                    ),
                );
            }
        }
    }
}

fn mechanism(count: usize, seed: u64) {
    let mut random = Random::new(seed);
    let (moving, posed) = (JointMotion::Moving, JointMotion::Posed);
    let motion_of = |random: &mut Random| {
        [
            moving,
            moving,
            moving,
            posed,
            JointMotion::Locked(random.real(2.0)),
        ][random.below(5)]
    };
    let place = |random: &mut Random| {
        if random.chance(50) {
            random.pose()
        } else {
            Pose {
                rotation: Mat3::identity(),
                translation: random.vector(0.3),
            }
        }
    };
    let bodies: Vec<Body> = (0..count)
        .map(|number| {
            let (kind, _) = JOINTS[random.below(JOINTS.len())];
            let x = if random.chance(50) {
                Pose::identity()
            } else {
                place(&mut random)
            };
            let mut joint = joint_of(kind, &x, moving, &mut random);
            joint
                .iter_mut()
                .for_each(|freedom| freedom.motion = motion_of(&mut random));
            Body {
                parent: (number > 0).then(|| random.below(number)),
                placement: place(&mut random),
                joint,
            }
        })
        .collect();
    let motion = if random.chance(20) {
        BaseRegime::Free
    } else {
        let joints = match random.below(3) {
            0 => Vec::new(),
            1 => {
                let (kind, _) = JOINTS[random.below(JOINTS.len())];
                joint_of(kind, &Pose::identity(), motion_of(&mut random), &mut random)
            }
            _ => {
                let (kind, _) = JOINTS[random.below(JOINTS.len())];
                let x = random.pose();
                joint_of(kind, &x, motion_of(&mut random), &mut random)
            }
        };
        let gravity = if random.chance(50) {
            Vec3::z()
        } else {
            random.vector(1.0)
        };
        BaseRegime::Restricted {
            gravity: gravity * -GRAVITY,
            joints,
        }
    };
    let (measured, offsets) = (measured(&mut random), offsets(&mut random));
    let answer =
        Identifiable::of_mechanism(&bodies, &motion, measured, offsets, Regime::TOLERANCE).unwrap();
    agree(
        &answer,
        &mechanism_rows(&bodies, &motion, measured, offsets, &mut random),
    );
    sums(&answer, &mut random);
}

proptest! {
    #![proptest_config(cases(48))]

    /// Any joints anywhere, also between the world and the base, each freedom moving, posed or
    /// locked.
    #[test]
    fn mechanisms_of_any_joints((count, seed) in (1..=6_usize, any::<u64>())) {
        mechanism(count, seed);
    }
}

// -------------------------------------------------------------------------------------------------
// Known robots, known figures
// -------------------------------------------------------------------------------------------------

/// Sensors as the URDF describes them.
fn described(text: &str) -> (Model, Structure) {
    let elements = Model::from_urdf(text, &[]).unwrap().sensors().to_vec();
    let keep: Vec<&str> = elements
        .iter()
        .map(|element| element.joint.as_str())
        .collect();
    let model = Model::from_urdf(text, &keep).unwrap();
    let noise = Noise {
        force: [0.1; 3],
        torque: [0.003; 3],
    };
    let cuts: Vec<_> = elements
        .iter()
        .map(|s| SensorCut::new(&model, &s.joint, s.frame, s.direction, &s.pose, &noise).unwrap())
        .collect();
    let structure = Structure::new(&model, &cuts, &[], Structure::LENGTH_SCALE).unwrap();
    (model, structure)
}

fn left_arm() -> (Model, Structure) {
    described(include_str!("../../../config/icub_left_arm/model.urdf"))
}

/// Five links and four revolute joints beyond the F/T sensor: 50 parameters, 38 identifiable
/// combinations; without the sensor, 8 links and 7 joints: 90 -> 59.
#[test]
fn arm_of_the_repository() {
    let (model, structure) = left_arm();
    let mut random = Random::new(1);
    let ask = |scope, regime, measured, offsets| Question {
        model: &model,
        scope,
        regime,
        measured,
        offsets,
    };
    let free = || Regime::free(&model);
    let beyond = ask(
        Scope::SubTree(&structure, 1),
        free(),
        Measured::Wrench,
        Offsets::Known,
    )
    .check(&mut random);
    assert_eq!((beyond.columns().len(), beyond.rank()), (50, 38));
    assert_eq!(
        beyond.columns()[11],
        Column::Inertial {
            link: model.frame("l_elbow_1").unwrap().link,
            parameter: 1
        }
    );
    assert_eq!(beyond.names()[11], "l_elbow_1.h_x");
    let with = ask(
        Scope::SubTree(&structure, 1),
        free(),
        Measured::Wrench,
        Offsets::Unknown,
    )
    .check(&mut random);
    assert_eq!(
        (with.columns().len(), with.rank(), with.confused()),
        (56, 44, 0)
    );
    assert_eq!(
        with.columns()[55],
        Column::Offset {
            sensor: 0,
            component: 5
        }
    );
    assert_eq!(with.names()[55], "l_arm_ft_sensor.f_z");
    let whole = ask(Scope::Tree, free(), Measured::Wrench, Offsets::Known).check(&mut random);
    assert_eq!((whole.columns().len(), whole.rank()), (90, 90 - 7 * 3 - 10));
    // With the cut at the sensor nothing is lost between the two sides: 90 - 21.
    let cut = ask(
        Scope::SubTrees(&structure),
        free(),
        Measured::Wrench,
        Offsets::Known,
    )
    .check(&mut random);
    assert_eq!(cut.rank(), 69);
    // On its stand the chest is fixed. The arm's F/T sensor still determines everything beyond it,
    // because the shoulder rotates the arm about three axes.
    let stand = Regime::fixed(&model, 0, &Vec3::new(0.0, 0.0, -GRAVITY));
    let arm = ask(
        Scope::SubTree(&structure, 1),
        stand.clone(),
        Measured::Wrench,
        Offsets::Unknown,
    )
    .check(&mut random);
    assert_eq!((arm.rank(), arm.confused()), (44, 0));
    sums(&arm, &mut random);
    // Joint torques alone, and with the wrench on the stand.
    for measured in [Measured::Torques, Measured::Both] {
        ask(Scope::Tree, stand.clone(), measured, Offsets::Unknown).check(&mut random);
    }
}

/// Effect of restricted motion and unknown offsets on the rank: rank without offsets, with them,
/// and the loss, for five links and four revolute joints.
#[test]
fn restricted_motion_and_offsets() {
    let (model, structure) = left_arm();
    let base = model.frame("l_upper_arm").unwrap().link;
    let mut random = Random::new(2);
    let up = Vec3::new(0.3, -0.5, 0.81).normalize();
    let across = up.cross(&Vec3::new(0.9, 0.2, 0.1)).normalize();
    let other = up.cross(&across);
    let (moving, posed, at) = (
        JointMotion::Moving,
        JointMotion::Posed,
        Vec3::new(0.1, 0.02, -0.3),
    );
    let held = |joints| BaseRegime::Restricted {
        gravity: up * -GRAVITY,
        joints,
    };
    let table = [
        ("none", held(vec![]), moving, 29, 32, 3),
        (
            "about a vertical axis",
            held(vec![rotation(up, at, moving)]),
            moving,
            34,
            39,
            1,
        ),
        (
            "about one horizontal axis",
            held(vec![rotation(across, at, moving)]),
            moving,
            35,
            41,
            0,
        ),
        (
            "about two axes",
            held(vec![
                rotation(across, at, moving),
                rotation(other, at * 0.5, moving),
            ]),
            moving,
            38,
            44,
            0,
        ),
        ("free", BaseRegime::Free, moving, 38, 44, 0),
        (
            "vertical translation",
            held(vec![translation(up, moving)]),
            moving,
            29,
            35,
            0,
        ),
        (
            "static postures, tilting",
            held(vec![
                rotation(across, at, posed),
                rotation(other, at, posed),
            ]),
            posed,
            12,
            18,
            0,
        ),
        (
            "static postures, never tilting",
            held(vec![rotation(up, at, posed)]),
            posed,
            11,
            14,
            3,
        ),
        (
            "static postures, sensor at rest",
            held(vec![]),
            posed,
            11,
            14,
            3,
        ),
    ];
    for (name, motion, joints, without, with, lost) in table {
        let regime = Regime {
            base,
            motion,
            joints: vec![joints; model.dof_count()],
            contacts: ContactSet::EMPTY,
            tolerance: Regime::TOLERANCE,
        };
        let ask = |offsets| Question {
            model: &model,
            scope: Scope::SubTree(&structure, 1),
            regime: regime.clone(),
            measured: Measured::Wrench,
            offsets,
        };
        let known = ask(Offsets::Known).check(&mut random);
        let unknown = ask(Offsets::Unknown).check(&mut random);
        assert_eq!(
            (known.rank(), unknown.rank(), unknown.confused()),
            (without, with, lost),
            "{name}"
        );
        assert_eq!(known.confused(), 0);
        sums(&unknown, &mut random);
    }
}

/// The paper's robot before it moves: an arm of four links with mass beyond the sensor, elbow,
/// forearm and a wrist with two axes through one point. From static postures 11 of 40 parameters,
/// and all six offsets if the sensor is tilted.
#[test]
fn gravity_only_subspace_of_the_paper() {
    let posed = JointMotion::Posed;
    let mut random = Random::new(3);
    let at = |x: f64, y: f64, z: f64| Pose {
        rotation: Mat3::identity(),
        translation: Vec3::new(x, y, z),
    };
    let turn = |axis: Vec3| rotation(axis, Vec3::zeros(), posed);
    let body = |parent: usize, placement, joint| Body {
        parent: Some(parent),
        placement,
        joint,
    };
    let bodies = [
        Body {
            parent: None,
            placement: Pose::identity(),
            joint: Vec::new(),
        },
        body(0, at(0.015, 0.0, 0.078), vec![turn(Vec3::y())]),
        body(1, at(-0.015, 0.0, 0.036), vec![turn(Vec3::z())]),
        body(
            2,
            at(0.0, 0.0, 0.106),
            vec![turn(Vec3::y()), turn(Vec3::x())],
        ),
    ];
    let gravity = Vec3::new(0.0, 0.0, -GRAVITY);
    let motion = BaseRegime::Restricted {
        gravity,
        joints: vec![turn(Vec3::x()), turn(Vec3::y())],
    };
    for (offsets, columns, rank) in [(Offsets::Known, 40, 11), (Offsets::Unknown, 46, 17)] {
        let answer = Identifiable::of_mechanism(
            &bodies,
            &motion,
            Measured::Wrench,
            offsets,
            Regime::TOLERANCE,
        )
        .unwrap();
        assert_eq!(
            (answer.columns().len(), answer.rank(), answer.confused()),
            (columns, rank, 0)
        );
        agree(
            &answer,
            &mechanism_rows(&bodies, &motion, Measured::Wrench, offsets, &mut random),
        );
    }
}

/// A whole iCub: 39 links, 32 joints, 6 F/T sensors. The robot's URDF may not be redistributed
/// here, so the test runs only where it is available: `PROPRIO_ICUB_MODELS` names the folder with
/// iCubGazeboV2_5.urdf (of the PyPI package icub-models 3.2.0).
#[test]
fn whole_icub() {
    let Ok(models) = std::env::var("PROPRIO_ICUB_MODELS") else {
        println!("skipped: PROPRIO_ICUB_MODELS does not say where the robot is");
        return;
    };
    let text =
        std::fs::read_to_string(std::path::Path::new(&models).join("iCubGazeboV2_5.urdf")).unwrap();
    let (model, structure) = described(&text);
    known_humanoid(&model, &structure);
}

/// A generated robot with the tree of an iCub: the figures follow from the tree alone, as long as
/// its joints are in general position.
#[test]
fn humanoid_of_the_same_tree() {
    let (text, sensors) = humanoid();
    let keep: Vec<&str> = sensors.iter().map(String::as_str).collect();
    let model = Model::from_urdf(&text, &keep).unwrap();
    let noise = Noise {
        force: [0.1; 3],
        torque: [0.003; 3],
    };
    let (frame, direction) = (MeasurementFrame::Child, MeasurementDirection::ChildToParent);
    let cut = |joint: &&str| {
        SensorCut::new(&model, joint, frame, direction, &Pose::identity(), &noise).unwrap()
    };
    let cuts: Vec<_> = keep.iter().map(cut).collect();
    let structure = Structure::new(&model, &cuts, &[], Structure::LENGTH_SCALE).unwrap();
    known_humanoid(&model, &structure);

    // On a stand that holds the root with an unmeasured wrench: the torso's six rows are removed,
    // and with them all combinations that only they determine.
    let support = ContactSpec {
        frame: Frame {
            link: 0,
            pose: Pose::identity(),
        },
        kind: ContactKind::Wrench,
        position: Vec3::zeros(),
    };
    let structure = Structure::new(&model, &cuts, &[support], Structure::LENGTH_SCALE).unwrap();
    let stand = Regime {
        contacts: ContactSet::first(1),
        ..Regime::free(&model)
    };
    let ask = |scope| {
        Identifiable::new(&model, scope, &stand, Measured::Wrench, Offsets::Known)
            .unwrap()
            .rank()
    };
    assert_eq!(ask(Scope::SubTree(&structure, 0)), 0);
    assert_eq!(ask(Scope::SubTrees(&structure)), 294 - 122);
}

/// 39 links, 32 joints, six sensors: torso and head of 16 joints, limbs of four, feet of none.
fn known_humanoid(model: &Model, structure: &Structure) {
    assert_eq!(
        (
            model.link_count(),
            model.dof_count(),
            structure.sensors().len()
        ),
        (39, 32, 6)
    );
    let mut random = Random::new(4);
    let ask = |scope, offsets| Question {
        model,
        scope,
        regime: Regime::free(model),
        measured: Measured::Wrench,
        offsets,
    };
    let tree = ask(Scope::Tree, Offsets::Known).check(&mut random);
    assert_eq!((tree.columns().len(), tree.rank()), (390, 234));
    let mut ranks = Vec::new();
    for number in 0..7 {
        let part = ask(Scope::SubTree(structure, number), Offsets::Known).check(&mut random);
        ranks.push(part.rank());
    }
    assert_eq!(ranks[0], 122, "torso and head");
    ranks.sort_unstable();
    assert_eq!(ranks, [10, 10, 38, 38, 38, 38, 122]);
    let stacked = ask(Scope::SubTrees(structure), Offsets::Known).check(&mut random);
    assert_eq!(stacked.rank(), 294);
    let with = ask(Scope::SubTrees(structure), Offsets::Unknown).check(&mut random);
    assert_eq!((with.rank(), with.confused()), (294 + 36, 0));
    sums(&tree, &mut random);
    sums(&with, &mut random);
}

/// A real arm on a fixed base whose joint torques are measured: `PROPRIO_DATA` names the folder
/// with kuka_lwr4.urdf.
#[test]
fn kuka_from_joint_torques() {
    let Ok(data) = std::env::var("PROPRIO_DATA") else {
        println!("skipped: PROPRIO_DATA does not say where the robot is");
        return;
    };
    let file = std::path::Path::new(&data).join("kuka_lwr4.urdf");
    if !file.exists() {
        println!("skipped: PROPRIO_DATA has no kuka_lwr4.urdf");
        return;
    }
    let model = Model::from_file(&file, &[]).unwrap();
    let mut random = Random::new(6);
    let regime = Regime::fixed(&model, 0, &Vec3::new(0.0, 0.0, -GRAVITY));
    let question = Question {
        model: &model,
        scope: Scope::Tree,
        regime,
        measured: Measured::Torques,
        offsets: Offsets::Known,
    };
    let answer = question.check(&mut random);
    assert_eq!(answer.rank(), 43);
    sums(&answer, &mut random);
}

// -------------------------------------------------------------------------------------------------
// Readable sums
// -------------------------------------------------------------------------------------------------

/// A chain: a turntable about the vertical, an arm that rotates about y at a distance `length` [m]
/// from it, and a slide along x at the end.
fn hand_made(length: f64) -> Model {
    let inertial = "<inertial><mass value=\"1\"/>\
        <inertia ixx=\"1\" ixy=\"0\" ixz=\"0\" iyy=\"1\" iyz=\"0\" izz=\"1\"/></inertial>";
    let joint = |number: usize, kind: &str, xyz: &str, axis: &str| {
        format!(
            "<joint name=\"j{number}\" type=\"{kind}\"><parent link=\"{}\"/><child link=\"{}\"/>\
             <origin xyz=\"{xyz}\"/><axis xyz=\"{axis}\"/>\
             <limit lower=\"-1\" upper=\"1\" effort=\"1\" velocity=\"1\"/></joint>",
            NAMES[number],
            NAMES[number + 1]
        )
    };
    const NAMES: [&str; 4] = ["base", "table", "arm", "slide"];
    let links: String = NAMES
        .iter()
        .map(|name| format!("<link name=\"{name}\">{inertial}</link>"))
        .collect();
    let text = format!(
        "<robot name=\"chain\">{links}{}{}{}</robot>",
        joint(0, "revolute", "0 0 0.5", "0 0 1"),
        joint(1, "revolute", &format!("0 {length:e} 0"), "0 1 0"),
        joint(2, "prismatic", "0.1 0 0", "1 0 0"),
    );
    Model::from_urdf(&text, &[]).unwrap()
}

/// By hand: a mass on a revolute joint's axis, its first moment and second moment along the axis
/// may belong to either link, so `m`, `h` along the axis and one of the `I` across it are added to
/// the inner link, transformed to its frame. The second moments of a sliding body keep their axes,
/// but its mass and first moment are identifiable.
#[test]
fn sums_are_readable() {
    let model = hand_made(0.25);
    let ask = |regime: &Regime, measured, offsets| {
        let answer = Identifiable::new(&model, Scope::Tree, regime, measured, offsets).unwrap();
        answer
            .base_parameters()
            .iter()
            .map(ToString::to_string)
            .collect::<Vec<_>>()
    };
    let inertia_across = "0.25 table.m + table.h_z + table.I_xx + 0.3125 arm.m + 0.5 arm.h_y \
        + arm.I_xx + slide.I_xx";
    let free = [
        "base.m + table.m + arm.m",
        "base.h_x",
        "base.h_y",
        "base.h_z + 0.5 table.m + table.h_z + 0.5 arm.m",
        &format!("base.I_xx + {inertia_across}"),
        "base.I_xy",
        "base.I_xz",
        &format!("base.I_yy + {inertia_across}"),
        "base.I_yz",
        "base.I_zz",
        "table.h_x",
        "table.h_y + 0.25 arm.m + arm.h_y",
        "table.I_xy",
        "table.I_xz",
        "table.I_yy - table.I_xx - 0.0625 arm.m - 0.5 arm.h_y - arm.I_xx - slide.I_xx",
        "table.I_yz",
        "table.I_zz + 0.0625 arm.m + 0.5 arm.h_y + arm.I_xx + slide.I_xx",
        "arm.h_x",
        "arm.h_z",
        "arm.I_xy + slide.I_xy",
        "arm.I_xz + slide.I_xz",
        "arm.I_yy + slide.I_yy",
        "arm.I_yz + slide.I_yz",
        "arm.I_zz - arm.I_xx - slide.I_xx + slide.I_zz",
        "slide.m",
        "slide.h_x",
        "slide.h_y",
        "slide.h_z",
    ];
    assert_eq!(
        ask(&Regime::free(&model), Measured::Wrench, Offsets::Known),
        free
    );

    // On a stand: of the I_xx, I_yy, I_zz and I_xy of the body that rotates about the vertical only
    // I_zz is identifiable; the rest of the base's inertia has no effect. From the joint torques
    // the base is unobservable, and so is the table's first moment, because its axis is along
    // gravity.
    let stand = Regime::fixed(&model, 0, &Vec3::new(0.0, 0.0, -GRAVITY));
    let torques: Vec<&str> = free[16..].to_vec();
    assert_eq!(
        ask(&stand, Measured::Torques, Offsets::Unknown)[..12],
        torques
    );
    let wrench: Vec<&str> = [
        "base.m + table.m + arm.m + 0.102 base.f_z",
        "base.h_x - 0.102 base.t_y",
        "base.h_y + 0.102 base.t_x",
        "table.h_x",
        "table.h_y + 0.25 arm.m + arm.h_y",
        "table.I_xz",
        "table.I_yz",
    ]
    .into_iter()
    .chain(torques)
    .chain(["base.t_z", "base.f_x", "base.f_y"])
    .collect();
    assert_eq!(ask(&stand, Measured::Wrench, Offsets::Unknown), wrench);
}

/// A link of 30 m would give factors of 900 m^2: other parameters are eliminated there.
#[test]
fn factors_stay_small() {
    let model = hand_made(30.0);
    let regime = Regime::free(&model);
    let answer = Identifiable::new(
        &model,
        Scope::Tree,
        &regime,
        Measured::Wrench,
        Offsets::Known,
    )
    .unwrap();
    assert_eq!(answer.rank(), 28);
    sums(&answer, &mut Random::new(1));
    let sums = answer.base_parameters();
    assert!(
        sums.iter().any(|sum| sum.kept.name == "arm.m"),
        "eliminated where links are short"
    );
}

#[test]
fn small_numbers_print_short() {
    let term = |coefficient, name: &str| Term {
        coefficient,
        column: 0,
        name: name.to_owned(),
    };
    let sum = BaseParameter {
        kept: term(1.0, "a.m"),
        terms: vec![
            term(-1.0, "b.m"),
            term(0.123_456, "c.m"),
            term(-2e-6, "d.m"),
            term(7.0, "e.m"),
            term(1.000_01, "f.m"),
        ],
    };
    assert_eq!(
        sum.to_string(),
        "a.m - b.m + 0.1235 c.m - 2e-6 d.m + 7 e.m + f.m"
    );
}

// -------------------------------------------------------------------------------------------------
// Tolerance, errors
// -------------------------------------------------------------------------------------------------

/// A right angle written as 1.5708 is not exact: an axis meant to be vertical has a gravity torque
/// of four parts in a million. A larger tolerance treats it as vertical.
#[test]
#[allow(clippy::approx_constant, reason = "rounded on purpose, as URDFs are")]
fn tolerance_forgives_rounded_angles() {
    let rank = |angle: f64, tolerance| {
        let base = Body {
            parent: None,
            placement: Pose::identity(),
            joint: Vec::new(),
        };
        let turned = Body {
            parent: Some(0),
            placement: Pose::from_xyz_rpy([0.1, 0.0, 0.2], [angle, 0.0, 0.0]),
            joint: vec![rotation(Vec3::y(), Vec3::zeros(), JointMotion::Moving)],
        };
        let stand = BaseRegime::Restricted {
            gravity: Vec3::new(0.0, 0.0, -GRAVITY),
            joints: Vec::new(),
        };
        Identifiable::of_mechanism(
            &[base, turned],
            &stand,
            Measured::Torques,
            Offsets::Known,
            tolerance,
        )
        .unwrap()
        .rank()
    };
    assert_eq!(rank(std::f64::consts::FRAC_PI_2, Regime::TOLERANCE), 1);
    assert_eq!(rank(1.570796327, Regime::TOLERANCE), 1);
    assert_eq!(rank(1.5708, Regime::TOLERANCE), 3);
    assert_eq!(rank(1.5708, 1e-4), 1);
}

#[test]
fn bad_input_is_refused() {
    let (model, structure) = left_arm();
    let new = |scope, regime: &Regime| {
        Identifiable::new(&model, scope, regime, Measured::Both, Offsets::Unknown)
            .map(|answer| answer.rank())
    };
    let free = Regime::free(&model);
    assert!(new(Scope::Tree, &free).is_ok());
    assert_eq!(
        new(
            Scope::Tree,
            &Regime {
                base: 9,
                ..free.clone()
            }
        ),
        Err(DynamicsError::NoLink(9))
    );
    assert_eq!(
        new(Scope::SubTree(&structure, 2), &free),
        Err(DynamicsError::Index {
            what: "sub-trees",
            index: 2,
            count: 2
        })
    );
    let short = Regime {
        joints: vec![JointMotion::Moving; 3],
        ..free.clone()
    };
    assert!(matches!(
        new(Scope::Tree, &short),
        Err(DynamicsError::Size {
            got: 3,
            expected: 7,
            ..
        })
    ));
    let other = hand_made(0.1);
    let other = Structure::new(&other, &[], &[], Structure::LENGTH_SCALE).unwrap();
    assert!(matches!(
        new(Scope::SubTrees(&other), &free),
        Err(DynamicsError::Size {
            got: 4,
            expected: 9,
            ..
        })
    ));
    for bad in [f64::NAN, f64::INFINITY, 1e200] {
        let gravity = Vec3::new(0.0, bad, 0.0);
        let (what, index) = ("gravity of regime", 0);
        assert_eq!(
            new(Scope::Tree, &Regime::fixed(&model, 0, &gravity)),
            Err(if bad.is_finite() {
                DynamicsError::OutOfRange { what, index }
            } else {
                DynamicsError::NotFinite { what, index }
            })
        );
    }
    for bad in [f64::NAN, f64::INFINITY] {
        assert!(matches!(
            new(
                Scope::Tree,
                &Regime {
                    tolerance: bad,
                    ..free.clone()
                }
            ),
            Err(DynamicsError::NotFinite { .. })
        ));
        let mut joints = free.joints.clone();
        joints[2] = JointMotion::Locked(bad);
        assert!(matches!(
            new(
                Scope::Tree,
                &Regime {
                    joints,
                    ..free.clone()
                }
            ),
            Err(DynamicsError::NotFinite { .. })
        ));
        let motion = BaseRegime::Restricted {
            gravity: Vec3::z(),
            joints: vec![translation(Vec3::new(bad, 0.0, 0.0), JointMotion::Moving)],
        };
        assert!(matches!(
            new(
                Scope::Tree,
                &Regime {
                    motion,
                    ..free.clone()
                }
            ),
            Err(DynamicsError::NotFinite { .. })
        ));
    }
    assert_eq!(
        new(
            Scope::Tree,
            &Regime {
                tolerance: -1.0,
                ..free.clone()
            }
        ),
        new(Scope::Tree, &free)
    );
    // No gravity, no freedom, no motion: only the offset is identifiable.
    let still = Regime {
        joints: vec![JointMotion::Locked(0.3); 7],
        ..Regime::fixed(&model, 0, &Vec3::zeros())
    };
    assert_eq!(new(Scope::Tree, &still), Ok(6));

    let of = |bodies: &[Body]| {
        Identifiable::of_mechanism(
            bodies,
            &BaseRegime::Free,
            Measured::Wrench,
            Offsets::Known,
            Regime::TOLERANCE,
        )
        .map(|answer| answer.rank())
    };
    let body = |parent| Body {
        parent,
        placement: Pose::identity(),
        joint: Vec::new(),
    };
    assert_eq!(of(&[]), Err(DynamicsError::NoLink(0)));
    assert_eq!(of(&[body(None)]), Ok(10));
    assert_eq!(
        of(&[body(None), body(Some(1))]),
        Err(DynamicsError::NoLink(1))
    );
    assert_eq!(of(&[body(None), body(None)]), Err(DynamicsError::NoLink(1)));
    // A zero twist allows no motion: ten directions between the two bodies are unobservable.
    let mut idle = body(Some(0));
    idle.joint.push(Freedom {
        twist: Motion::zero(),
        motion: JointMotion::Moving,
    });
    assert_eq!(of(&[body(None), idle]), Ok(10));
}

/// Finite numbers that are too large, and large ones that are valid: never a panic, never a basis
/// that is not finite.
#[test]
fn absurd_numbers_are_refused_or_harmless() {
    let pair = |placement, joint| {
        [
            Body {
                parent: None,
                placement: Pose::identity(),
                joint: Vec::new(),
            },
            Body {
                parent: Some(0),
                placement,
                joint,
            },
        ]
    };
    let held = |joints| BaseRegime::Restricted {
        gravity: Vec3::new(0.0, 0.0, -GRAVITY),
        joints,
    };
    let ask = |bodies: &[Body], motion: &BaseRegime| {
        let answer = Identifiable::of_mechanism(
            bodies,
            motion,
            Measured::Both,
            Offsets::Unknown,
            Regime::TOLERANCE,
        )?;
        assert!(
            answer
                .basis()
                .iter()
                .chain(&answer.null())
                .all(|x| x.is_finite())
        );
        Ok(answer)
    };
    let at = Pose::from_xyz_rpy([0.1, 0.2, -0.3], [0.4, 0.5, 0.6]);
    let turn = |motion| rotation(Vec3::z(), Vec3::new(0.1, 0.0, 0.0), motion);

    // An angle of any size is valid.
    for motion in [BaseRegime::Free, held(vec![turn(JointMotion::Moving)])] {
        for angle in [1e10, 1e150, -1e300] {
            let far = ask(&pair(at, vec![turn(JointMotion::Locked(angle))]), &motion).unwrap();
            let reduced = f64::atan2(angle.sin(), angle.cos());
            let near = ask(&pair(at, vec![turn(JointMotion::Locked(reduced))]), &motion).unwrap();
            assert!(
                (far.basis() * far.basis().transpose() - near.basis() * near.basis().transpose())
                    .amax()
                    < 1e-12
            );
            let tilt = |angle| {
                held(vec![rotation(
                    Vec3::x(),
                    Vec3::zeros(),
                    JointMotion::Locked(angle),
                )])
            };
            let [far, near] =
                [angle, reduced].map(|angle| ask(&pair(at, Vec::new()), &tilt(angle)).unwrap());
            assert!(
                (far.basis() * far.basis().transpose() - near.basis() * near.basis().transpose())
                    .amax()
                    < 1e-12
            );
        }
    }
    // A slide or a screw of that size is not.
    let screw = Motion {
        angular: Vec3::z(),
        linear: Vec3::z() * 0.01,
    };
    for twist in [Motion::translation(&Vec3::x()), screw] {
        let joint = vec![Freedom {
            twist,
            motion: JointMotion::Locked(1e150),
        }];
        let error = Err(DynamicsError::OutOfRange {
            what: "joint to link",
            index: 1,
        });
        assert_eq!(
            ask(&pair(at, joint.clone()), &BaseRegime::Free).map(|_| ()),
            error
        );
        let error = Err(DynamicsError::OutOfRange {
            what: "joint of the base",
            index: 0,
        });
        assert_eq!(ask(&pair(at, Vec::new()), &held(joint)).map(|_| ()), error);
    }
    // The size of a twist has no influence.
    let ranks = |size: f64| {
        let freedom = |motion| {
            let Motion { angular, linear } = turn(motion).twist;
            Freedom {
                twist: Motion {
                    angular: angular * size,
                    linear: linear * size,
                },
                motion,
            }
        };
        let moving = freedom(JointMotion::Moving);
        let locked = freedom(JointMotion::Locked(0.5 / size));
        [vec![moving], vec![locked], vec![moving, locked]].map(|joint| {
            let base = held(vec![freedom(JointMotion::Posed)]);
            ask(&pair(at, joint), &base).unwrap().rank()
        })
    };
    for size in [1e-200, 1e-3, 1e200] {
        assert_eq!(ranks(size), ranks(1.0), "{size:e}");
    }
    // Invalid poses.
    let mirror = Mat3::from_diagonal(&Vec3::new(1.0, 1.0, -1.0));
    for rotation in [
        Mat3::identity() * 1e200,
        Mat3::identity() * 1.001,
        Mat3::zeros(),
        mirror,
    ] {
        let no_pose = Pose { rotation, ..at };
        assert_eq!(
            ask(&pair(no_pose, Vec::new()), &BaseRegime::Free).map(|_| ()),
            Err(DynamicsError::NoRotation {
                what: "placement of link",
                index: 1
            })
        );
    }
    let far = Pose {
        translation: Vec3::new(0.0, 1e150, 0.0),
        ..at
    };
    assert!(matches!(
        ask(&pair(far, Vec::new()), &BaseRegime::Free),
        Err(DynamicsError::OutOfRange { index: 1, .. })
    ));
    // Distances that are rounding errors, and negligible gravity, do not set units.
    let near = Pose {
        translation: Vec3::new(1e-200, 0.0, 1e-17),
        ..at
    };
    let weightless = BaseRegime::Restricted {
        gravity: Vec3::new(0.0, 0.0, 1e-300),
        joints: vec![turn(JointMotion::Moving)],
    };
    let none = BaseRegime::Restricted {
        gravity: Vec3::zeros(),
        joints: vec![turn(JointMotion::Moving)],
    };
    let exact = Pose {
        translation: Vec3::zeros(),
        ..at
    };
    assert_eq!(
        ask(&pair(near, vec![turn(JointMotion::Moving)]), &weightless)
            .unwrap()
            .rank(),
        ask(&pair(exact, vec![turn(JointMotion::Moving)]), &none)
            .unwrap()
            .rank()
    );
    // In a model the error has the joint's link, wherever the pass begins.
    let model = hand_made(0.25);
    let mut regime = Regime::free(&model);
    regime.base = 2;
    regime.joints[2] = JointMotion::Locked(1e150);
    assert_eq!(
        Identifiable::new(
            &model,
            Scope::Tree,
            &regime,
            Measured::Wrench,
            Offsets::Known
        )
        .map(|_| ()),
        Err(DynamicsError::OutOfRange {
            what: "joint to link",
            index: 3
        })
    );
    for tolerance in [0.0, -1.0, 1e300] {
        let regime = Regime {
            tolerance,
            ..Regime::free(&model)
        };
        let answer = Identifiable::new(
            &model,
            Scope::Tree,
            &regime,
            Measured::Wrench,
            Offsets::Known,
        )
        .unwrap();
        assert!(answer.basis().iter().all(|x| x.is_finite()));
    }
}

/// Contacts without a closed form are errors.
#[test]
fn contacts_without_closed_form_are_refused() {
    let (model, plain) = left_arm();
    let (top, hand) = (plain.subtrees()[1].top, model.link_count() - 1);
    let contact = |link, kind| ContactSpec {
        frame: Frame {
            link,
            pose: Pose::identity(),
        },
        kind,
        position: Vec3::new(0.02, 0.0, 0.01),
    };
    let contacts = [
        contact(hand, ContactKind::Force),
        contact(hand, ContactKind::Wrench),
        contact(top, ContactKind::Force),
        contact(0, ContactKind::Force),
    ];
    let structure =
        Structure::new(&model, plain.sensors(), &contacts, Structure::LENGTH_SCALE).unwrap();
    let rank = |scope, contacts: &[usize], measured| {
        let regime = Regime {
            contacts: contacts.iter().copied().collect(),
            ..Regime::free(&model)
        };
        Identifiable::new(&model, scope, &regime, measured, Offsets::Known)
            .map(|answer| answer.rank())
    };
    let arm = Scope::SubTree(&structure, 1);
    assert_eq!(rank(arm, &[], Measured::Wrench), Ok(38));
    assert_eq!(
        rank(arm, &[0], Measured::Wrench),
        Err(DynamicsError::Contact(0))
    );
    assert_eq!(rank(arm, &[1], Measured::Wrench), Ok(0));
    assert_eq!(
        rank(arm, &[1], Measured::Both),
        Err(DynamicsError::Contact(1))
    );
    assert_eq!(
        rank(arm, &[1], Measured::Torques),
        Err(DynamicsError::Contact(1))
    );
    // On another sub-tree it removes nothing; all together lose the combinations that only the
    // chest's rows determine.
    assert_eq!(rank(arm, &[3], Measured::Wrench), Ok(38));
    assert_eq!(
        rank(Scope::SubTrees(&structure), &[1], Measured::Wrench),
        Ok(69 - 38)
    );
    // Three equations are left. With the arm moving freely they determine everything except masses
    // and centre-of-mass offsets that a force hides.
    let left = rank(arm, &[2], Measured::Wrench).unwrap();
    assert!(0 < left && left < 38, "{left}");
    let error = |index, count| {
        Err(DynamicsError::Index {
            what: "contacts",
            index,
            count,
        })
    };
    assert_eq!(rank(arm, &[4], Measured::Wrench), error(4, 4));
    assert_eq!(rank(Scope::Tree, &[0], Measured::Wrench), error(0, 0));
}
