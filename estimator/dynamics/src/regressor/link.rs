//! The regressor of one link, in its own axes or transformed to another frame: six rows of ten
//! numbers. Every other regressor is built from it.

use crate::kinematics::FrameMotion;
use crate::spatial::{Motion, Pose};

/// Columns of one link.
pub const LINK_PARAMETERS: usize = 10;

/// The first columns, mass and first moment; only these have a force.
pub const WITH_FORCE: usize = 4;

/// Six rows, [torque; force]. Each row is ten contiguous numbers, so that loops over them become
/// vector instructions.
pub type LinkRows = [[f64; LINK_PARAMETERS]; 6];

/// The regressor of a link: its net wrench, the sum of all wrenches on it except gravity, is
/// `A_l phi_l`.
///
/// ```text
/// A_l = [ 0   -S(a)                  alpha . + omega x (omega .) ]
///       [ a    S(alpha)+S(omega)^2   0                           ]
/// ```
///
/// Rows: torque \[Nm\] about the origin of the link's frame and force \[N\], in the link's axes.
/// Columns: `[m, h, (I_xx I_xy I_xz I_yy I_yz I_zz)]`.
///
/// `motion` is that of the link's frame in its own axes; `a` is its proper acceleration, so gravity
/// needs no term of its own. `v .` is the 3 x 6 matrix with `(v .) vech(I) = I v`, and
/// `omega x (omega .)` acts likewise.
///
/// Source: Traversaro et al. (ICRA 2015), eq. (8) to (10). Their `a + omega x v` of spatial
/// acceleration and velocity is the classical acceleration here; their `a_g`, to be added to it, is
/// minus the physical gravity. First given by Atkeson, An, Hollerbach (IJRR 1986).
#[inline(always)]
pub fn link_regressor(motion: &FrameMotion) -> LinkRows {
    let (w, l, a) = (
        &motion.angular_velocity,
        &motion.angular_acceleration,
        &motion.proper_acceleration,
    );
    let (xx, yy, zz) = (w.x * w.x, w.y * w.y, w.z * w.z);
    let (xy, xz, yz) = (w.x * w.y, w.x * w.z, w.y * w.z);
    #[rustfmt::skip]
    let rows = [
        [0.0,  0.0,  a.z, -a.y,  l.x, l.y - xz, l.z + xy, -yz, yy - zz,  yz],
        [0.0, -a.z,  0.0,  a.x,  xz,  l.x + yz, zz - xx,  l.y, l.z - xy, -xz],
        [0.0,  a.y, -a.x,  0.0, -xy,  xx - yy,  l.x - yz, xy,  l.y + xz, l.z],
        [a.x, -(yy + zz), xy - l.z, xz + l.y, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [a.y, xy + l.z, -(xx + zz), yz - l.x, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [a.z, xz - l.y, yz + l.x, -(xx + yy), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    ];
    rows
}

/// `X* A_l`: the link's rows in frame `a`, given `x_al` and the link's motion in its own axes.
/// Force rows are zero beyond [`WITH_FORCE`].
#[expect(
    clippy::needless_range_loop,
    reason = "a column of several rows at a time"
)]
#[inline(always)]
pub fn link_rows(x_al: &Pose, motion: &FrameMotion) -> LinkRows {
    let link = link_regressor(motion);
    let (r, t) = (&x_al.rotation, &x_al.translation);
    let mut rows = [[0.0; LINK_PARAMETERS]; 6];
    for axis in 0..3 {
        let (x, y, z) = (r[(axis, 0)], r[(axis, 1)], r[(axis, 2)]);
        for column in 0..LINK_PARAMETERS {
            rows[axis][column] = x * link[0][column] + y * link[1][column] + z * link[2][column];
        }
        for column in 0..WITH_FORCE {
            rows[axis + 3][column] =
                x * link[3][column] + y * link[4][column] + z * link[5][column];
        }
    }
    for column in 0..WITH_FORCE {
        let (x, y, z) = (rows[3][column], rows[4][column], rows[5][column]);
        rows[0][column] += t.y * z - t.z * y;
        rows[1][column] += t.z * x - t.x * z;
        rows[2][column] += t.x * y - t.y * x;
    }
    rows
}

/// The row `motion^T rows`: the power of the link's wrench along a motion given in the same frame,
/// per unit of each parameter.
#[inline(always)]
pub(super) fn row_along(motion: &Motion, rows: &LinkRows) -> [f64; LINK_PARAMETERS] {
    let (n, v) = (&motion.angular, &motion.linear);
    let mut out = [0.0; LINK_PARAMETERS];
    for column in 0..LINK_PARAMETERS {
        out[column] = n.x * rows[0][column] + n.y * rows[1][column] + n.z * rows[2][column];
    }
    for column in 0..WITH_FORCE {
        out[column] += v.x * rows[3][column] + v.y * rows[4][column] + v.z * rows[5][column];
    }
    out
}
