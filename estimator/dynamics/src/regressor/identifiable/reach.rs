//! The closed form: linear spans of the quantities that a body can attain in a regime of motion,
//! and their recursion from body to body.
//!
//! Everything here is in *scaled* units (lengths, masses and accelerations of order one:
//! `super::pass::Units`) and in the frame of one body with every joint at its reference position. A
//! wrench `[n; f]` and a transfer of inertia are 4 x 4 matrices as in the documentation of the
//! parent module.

use nalgebra::{Matrix3, Matrix4, Matrix4x3};

use crate::spatial::{Mat3, Motion, Pose, Vec3};

/// A subspace of `R^N` by an orthonormal basis; by default that of the zero alone.
#[derive(Clone, Debug, Default)]
pub(super) struct Subspace<const N: usize>(Vec<[f64; N]>);

impl<const N: usize> Subspace<N> {
    /// All of `R^N`.
    fn full() -> Self {
        Self(
            (0..N)
                .map(|k| std::array::from_fn(|i| f64::from(u8::from(i == k))))
                .collect(),
        )
    }

    /// The orthogonal complement of the span of `vectors`, each of length one.
    pub(super) fn without(vectors: Vec<[f64; N]>, tolerance: f64) -> Self {
        let mut taken = Self::default();
        taken.add(vectors, tolerance);
        // The basis is completed by unit vectors. Each addition is the one with the largest part
        // outside the span, at least 1 / sqrt(N); the added vectors are the complement.
        let count = taken.0.len();
        taken.add(Self::full().0, 1e-3);
        Self(taken.0.split_off(count))
    }

    fn is_full(&self) -> bool {
        self.0.len() == N
    }

    pub(super) fn basis(&self) -> &[[f64; N]] {
        &self.0
    }

    /// The sum of this subspace and the span of `vectors`, which are of order one.
    fn add(&mut self, mut vectors: Vec<[f64; N]>, tolerance: f64) {
        span_more(&mut self.0, &mut vectors, N, tolerance);
    }

    /// The sum of both subspaces.
    pub(super) fn join(&mut self, other: &Self, tolerance: f64) {
        self.add(other.0.clone(), tolerance);
    }

    /// The smallest subspace that contains this one and is invariant under `generator`, a linear
    /// map.
    fn close(&mut self, generator: impl Fn(&[f64; N]) -> [f64; N], tolerance: f64) {
        let mut done = 0;
        while done < self.0.len() && !self.is_full() {
            let images = self.0[done..].iter().map(&generator).collect();
            done = self.0.len();
            self.add(images, tolerance);
        }
    }

    /// Its image under an invertible linear map; no decision about rank is needed.
    fn map(&self, map: impl Fn(&[f64; N]) -> [f64; N]) -> Self {
        if self.is_full() {
            return self.clone();
        }
        let mut image = Self(Vec::with_capacity(self.0.len()));
        for vector in &self.0 {
            let mut unit = map(vector);
            for _ in 0..2 {
                image.0.iter().for_each(|old| take_out(&mut unit, old, N));
            }
            let norm = dot(&unit, &unit).sqrt();
            unit.iter_mut().for_each(|x| *x /= norm);
            image.0.push(unit);
        }
        image
    }
}

/// Adds to `units`, which are orthonormal, the span of `vectors`, counting only the first `width`
/// entries of each. Each step adds the vector with the largest part outside, until no such part
/// exceeds `tolerance`. The parts outside of the other vectors stay.
pub(super) fn span_more<V: AsRef<[f64]> + AsMut<[f64]> + Clone>(
    units: &mut Vec<V>,
    vectors: &mut Vec<V>,
    width: usize,
    tolerance: f64,
) {
    let size = |vector: &V| dot(&vector.as_ref()[..width], vector.as_ref());
    let take_out = |vector: &mut V, unit: &V| take_out(vector.as_mut(), unit.as_ref(), width);
    for vector in &mut *vectors {
        units.iter().for_each(|unit| take_out(vector, unit));
    }
    while units.len() < width {
        let sizes = vectors.iter().map(size).enumerate();
        let Some((most, _)) = sizes.max_by(|a, b| a.1.total_cmp(&b.1)) else {
            return;
        };
        let mut unit = vectors[most].clone();
        // Projected again: the rounding of the first projection may be large relative to a small
        // remainder.
        units.iter().for_each(|old| take_out(&mut unit, old));
        let norm = size(&unit).sqrt();
        if norm <= tolerance {
            return;
        }
        vectors.swap_remove(most);
        unit.as_mut().iter_mut().for_each(|x| *x /= norm);
        vectors
            .iter_mut()
            .for_each(|vector| take_out(vector, &unit));
        units.push(unit);
    }
}

/// The product of two vectors, as far as both go.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Subtracts the multiple of a unit vector that is in the first `width` entries of `vector`.
fn take_out(vector: &mut [f64], unit: &[f64], width: usize) {
    let along = dot(&vector[..width], unit);
    let pairs = vector.iter_mut().zip(unit);
    pairs.for_each(|(x, u)| *x -= along * u);
}

/// A linear functional of a transfer `(theta, O)`: `tr(M theta) + e . [n; f]`, ten entries of the
/// symmetric 4 x 4 matrix `M`, then six of a twist `e`.
///
/// A row of a regressor restricted to one body is such a functional: the component of its net
/// wrench along a twist `E` is `tr(sym(E^T D) J)`, and that of a sensor's offset is the power
/// `e . [n; f]`.
type Row = [f64; 16];

/// The twist that a joint allows, as matrices.
struct JointTwist {
    angular: Vec3,
    /// `S`.
    s: Matrix4<f64>,
    /// `S^2`.
    square: Matrix4<f64>,
    /// Its rotation, `S(omega)`.
    turn: Mat3,
}

impl JointTwist {
    fn new(Motion { angular, linear }: &Motion) -> Self {
        let (w, v) = (angular, linear);
        let s = twist_matrix(&[w.x, w.y, w.z, v.x, v.y, v.z]);
        Self {
            angular: *angular,
            square: s * s,
            turn: s.fixed_view::<3, 3>(0, 0).into_owned(),
            s,
        }
    }

    /// The change of a row with the position of the joint.
    fn turned_row(&self, vector: &Row) -> Row {
        let (m, e) = row_matrices(vector);
        row(&(m * self.s * 2.0), &(e * self.s - self.s * e))
    }
}

/// Spans of the quantities that a body attains over all states of the regime.
#[derive(Clone, Debug, Default)]
pub(super) struct Reach {
    /// Of `(D, 1)`: three rows of `D = [S(alpha) + S(omega)^2, a]`, then the 1 that multiplies
    /// offsets.
    acceleration: Subspace<13>,
    /// Of angular velocities `omega`.
    omega: Subspace<3>,
    /// Of the twists `E` along which a net wrench is measured.
    axes: Subspace<6>,
    /// Of the first three columns of `E^T S(omega)`, `E` and `omega` of one state.
    mixed: Subspace<12>,
    /// Of the rows `(sym(E^T D), E)`: the measured functionals of this body's parameters and of the
    /// offsets beyond it.
    rows: Subspace<16>,
}

impl Reach {
    /// Of a body that moves freely.
    pub(super) fn free() -> Self {
        Self {
            acceleration: Subspace::full(),
            omega: Subspace::full(),
            ..Self::default()
        }
    }

    /// Of a body at rest with proper acceleration `proper`.
    pub(super) fn standing(proper: &Vec3) -> Self {
        let mut one = [0.0; 13];
        (one[3], one[7], one[11], one[12]) = (proper.x, proper.y, proper.z, 1.0);
        let norm = dot(&one, &one).sqrt();
        Self {
            acceleration: Subspace(vec![one.map(|x| x / norm)]),
            ..Self::default()
        }
    }

    /// Starts a separately measured part of the robot: its net wrench is measured here along these
    /// constant twists.
    pub(super) fn begin(&mut self, axes: Subspace<6>, tolerance: f64) {
        (self.axes, self.mixed, self.rows) = (axes, Subspace::default(), Subspace::default());
        let omegas: Vec<_> = self.omega.basis().iter().map(cross_matrix).collect();
        let twists: Vec<_> = self.axes.basis().iter().map(twist_matrix).collect();
        let mixed = omegas
            .iter()
            .flat_map(|omega| twists.iter().map(|e| mixed(e, omega)));
        self.mixed.add(mixed.collect(), tolerance);
        if self.acceleration.is_full() && self.axes.is_full() {
            self.rows = Subspace::full();
            return;
        }
        let accelerations = self.acceleration.basis().iter().map(acceleration_matrix);
        let rows = accelerations.flat_map(|(d, one)| {
            let rows: Vec<_> = twists
                .iter()
                .map(|e| row(&(e.transpose() * d), &(e * one)))
                .collect();
            rows
        });
        self.rows.add(rows.collect(), tolerance);
    }

    /// The same spans in a frame at `x_pc` in the present one and fixed to it.
    pub(super) fn moved(&self, x_pc: &Pose) -> Self {
        let x = pose_matrix(x_pc);
        let (back, r) = (pose_matrix(&x_pc.inverse()), x_pc.rotation);
        Self {
            acceleration: self.acceleration.map(|vector| {
                let (d, one) = acceleration_matrix(vector);
                acceleration(&(back * d * x), one)
            }),
            omega: self
                .omega
                .map(|&omega| (r.tr_mul(&Vec3::from(omega))).into()),
            axes: self
                .axes
                .map(|axis| twist(&(back * twist_matrix(axis) * x))),
            mixed: self
                .mixed
                .map(|vector| mixed_vector(&(x.tr_mul(&mixed_matrix(vector)) * r))),
            rows: self.rows.map(|vector| {
                let (m, e) = row_matrices(vector);
                row(&(x.tr_mul(&m) * x), &(back * e * x))
            }),
        }
    }

    /// Crosses a joint, from the body before it to the body beyond it; both have the same frame at
    /// the reference position. `s` is the twist that it allows. `moves`: whether it moves, or is
    /// locked. `measured`: whether the force along it, of all bodies beyond it, is measured.
    ///
    /// Returns the functionals of the inertia and the offsets beyond that this joint makes
    /// observable. These rows vanish exactly on the transfers that no measurement distinguishes
    /// from the same transfer frozen at the reference position. With `X = exp(S q)`,
    ///
    /// ```text
    /// D_c = X^-1 (D_p + 2 S(omega_p) S dq + S^2 dq^2 + S ddq) X
    /// omega_c = X^-1 (omega_p + s dq)
    /// E_c = X^-1 E_p X
    /// ```
    ///
    /// a row `M = sym(E^T D)` has one part per monomial in `dq`, `ddq`, each of which must vanish,
    /// and changes with `q` as `M -> S^T M + M S`.
    pub(super) fn cross(
        &mut self,
        s: &Motion,
        moves: bool,
        measured: bool,
        tolerance: f64,
    ) -> Subspace<16> {
        let joint = JointTwist::new(s);
        if moves {
            self.close(&joint, tolerance);
        }
        let (rows, mixed) = self.gained(&joint, moves, measured);
        let mut visible = Subspace::default();
        visible.add(rows, tolerance);
        self.mixed.add(mixed, tolerance);
        if measured {
            self.axes.add(vec![twist(&joint.s)], tolerance);
        }
        let mut turned = Vec::new();
        if moves {
            let omegas: Vec<_> = self.omega.basis().iter().map(cross_matrix).collect();
            let gained = omegas
                .iter()
                .map(|omega| acceleration(&(embed(omega) * joint.s), 0.0));
            let of_joint = [
                acceleration(&joint.s, 0.0),
                acceleration(&joint.square, 0.0),
            ];
            self.acceleration
                .add(gained.chain(of_joint).collect(), tolerance);
            self.omega.add(vec![s.angular.into()], tolerance);
            turned.extend(self.rows.basis().iter().map(|row| joint.turned_row(row)));
        }
        self.rows.add(visible.basis().to_vec(), tolerance);
        visible.add(turned, tolerance);
        visible
    }

    /// Every position of a joint: the spans that are invariant under its motion.
    fn close(&mut self, joint: &JointTwist, tolerance: f64) {
        let JointTwist { s, turn, .. } = joint;
        self.acceleration.close(
            |vector| {
                let (d, _) = acceleration_matrix(vector);
                acceleration(&(d * s - s * d), 0.0)
            },
            tolerance,
        );
        let angular = joint.angular;
        self.omega
            .close(|omega| angular.cross(&Vec3::from(*omega)).into(), tolerance);
        self.axes.close(
            |axis| {
                let e = twist_matrix(axis);
                twist(&(e * s - s * e))
            },
            tolerance,
        );
        self.mixed.close(
            |vector| {
                let n = mixed_matrix(vector);
                mixed_vector(&(s.tr_mul(&n) + n * turn))
            },
            tolerance,
        );
        self.rows.close(|row| joint.turned_row(row), tolerance);
    }

    /// Rows, and vectors of `mixed`, that are added by the motion of a joint and by its
    /// measurement.
    fn gained(
        &self,
        joint: &JointTwist,
        moves: bool,
        measured: bool,
    ) -> (Vec<Row>, Vec<[f64; 12]>) {
        let JointTwist {
            s, turn, square, ..
        } = joint;
        let axes: Vec<_> = self.axes.basis().iter().map(twist_matrix).collect();
        let omegas: Vec<_> = self.omega.basis().iter().map(cross_matrix).collect();
        let none = Matrix4::zeros();
        let (mut rows, mut gained_mixed) = (Vec::new(), Vec::new());
        if moves {
            for e in &axes {
                rows.push(row(&e.tr_mul(s), &none));
                rows.push(row(&e.tr_mul(square), &none));
                gained_mixed.push(mixed(e, turn));
            }
            for vector in self.mixed.basis() {
                let m = mixed_matrix(vector) * s.fixed_view::<3, 4>(0, 0);
                rows.push(row(&m, &none));
            }
        }
        if measured {
            for vector in self.acceleration.basis() {
                let (d, one) = acceleration_matrix(vector);
                rows.push(row(&s.tr_mul(&d), &(s * one)));
            }
            gained_mixed.extend(omegas.iter().map(|omega| mixed(s, omega)));
        }
        if measured && moves {
            rows.push(row(&s.tr_mul(s), &none));
            rows.push(row(&s.tr_mul(square), &none));
            let turning = omegas.iter().map(|omega| s.tr_mul(&(embed(omega) * s)));
            rows.extend(turning.map(|m| row(&m, &none)));
            gained_mixed.push(mixed(s, turn));
        }
        (rows, gained_mixed)
    }

    /// All measured functionals of this body.
    pub(super) fn rows(&self) -> &Subspace<16> {
        &self.rows
    }
}

/// The ten coefficients of `tr(M J)` as a function of the ten inertial parameters, and those of the
/// offset `[n; f]`: ten, then six.
pub(super) fn coefficients(vector: &Row) -> Row {
    let (m, _) = row_matrices(vector);
    // tr(M J) = <M3, Sigma> + 2 m_h . h + M_44 m with Sigma = tr(I)/2 1 - I.
    let half = (m[(0, 0)] + m[(1, 1)] + m[(2, 2)]) / 2.0;
    let mut out = *vector;
    out[..10].copy_from_slice(&[
        m[(3, 3)],
        2.0 * m[(0, 3)],
        2.0 * m[(1, 3)],
        2.0 * m[(2, 3)],
        half - m[(0, 0)],
        -2.0 * m[(0, 1)],
        -2.0 * m[(0, 2)],
        half - m[(1, 1)],
        -2.0 * m[(1, 2)],
        half - m[(2, 2)],
    ]);
    out
}

/// Positions in a row of the upper triangle of a symmetric 4 x 4 matrix.
const UPPER: [(usize, usize); 10] = [
    (0, 0),
    (0, 1),
    (0, 2),
    (0, 3),
    (1, 1),
    (1, 2),
    (1, 3),
    (2, 2),
    (2, 3),
    (3, 3),
];

/// The row of the symmetric part of `m` and of the twist `e`.
fn row(m: &Matrix4<f64>, e: &Matrix4<f64>) -> Row {
    let mut out = [0.0; 16];
    for (entry, &(i, j)) in out.iter_mut().zip(&UPPER) {
        *entry = (m[(i, j)] + m[(j, i)]) / 2.0;
    }
    out[10..].copy_from_slice(&twist(e));
    out
}

fn row_matrices(row: &Row) -> (Matrix4<f64>, Matrix4<f64>) {
    let mut m = Matrix4::zeros();
    for (&entry, &(i, j)) in row.iter().zip(&UPPER) {
        m[(i, j)] = entry;
        m[(j, i)] = entry;
    }
    (m, twist_matrix(&std::array::from_fn(|i| row[10 + i])))
}

fn acceleration(d: &Matrix4<f64>, one: f64) -> [f64; 13] {
    std::array::from_fn(|i| if i < 12 { d[(i / 4, i % 4)] } else { one })
}

fn acceleration_matrix(vector: &[f64; 13]) -> (Matrix4<f64>, f64) {
    let d = Matrix4::from_fn(|i, j| if i < 3 { vector[4 * i + j] } else { 0.0 });
    (d, vector[12])
}

/// `S(omega)`.
fn cross_matrix(omega: &[f64; 3]) -> Mat3 {
    Vec3::from(*omega).cross_matrix()
}

/// `[S(omega), 0; 0, 0]`.
fn embed(turn: &Mat3) -> Matrix4<f64> {
    let mut m = Matrix4::zeros();
    m.fixed_view_mut::<3, 3>(0, 0).copy_from(turn);
    m
}

/// The first three columns of `E^T [S(omega), 0; 0, 0]`.
fn mixed(e: &Matrix4<f64>, omega: &Matrix3<f64>) -> [f64; 12] {
    mixed_vector(&e.fixed_view::<3, 4>(0, 0).tr_mul(omega))
}

fn mixed_vector(n: &Matrix4x3<f64>) -> [f64; 12] {
    std::array::from_fn(|i| n[(i / 3, i % 3)])
}

fn mixed_matrix(vector: &[f64; 12]) -> Matrix4x3<f64> {
    Matrix4x3::from_row_slice(vector)
}

/// A twist as a 4 x 4 matrix, `[S(omega), v; 0, 0]`.
fn twist_matrix(twist: &[f64; 6]) -> Matrix4<f64> {
    let [x, y, z, u, v, w] = *twist;
    #[rustfmt::skip]
    let matrix = Matrix4::new(
        0.0, -z,  y,   u,
        z,   0.0, -x,  v,
        -y,  x,   0.0, w,
        0.0, 0.0, 0.0, 0.0,
    );
    matrix
}

fn twist(m: &Matrix4<f64>) -> [f64; 6] {
    [
        m[(2, 1)],
        m[(0, 2)],
        m[(1, 0)],
        m[(0, 3)],
        m[(1, 3)],
        m[(2, 3)],
    ]
}

fn pose_matrix(x_ab: &Pose) -> Matrix4<f64> {
    let mut m = embed(&x_ab.rotation);
    m.fixed_view_mut::<3, 1>(0, 3).copy_from(&x_ab.translation);
    m[(3, 3)] = 1.0;
    m
}
