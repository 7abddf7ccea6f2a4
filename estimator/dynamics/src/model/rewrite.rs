//! Rewrites a URDF text with other inertias: every `<inertial>` that changes is replaced;
//! everything else stays byte for byte, comments included.
//!
//! A body of the model may be several links of the URDF, joined by fixed joints. Its new inertia is
//! distributed among them by one rule: the affine map that takes the old body to the new one is
//! applied to the share of each link. With pseudo-inertias `J = U U^T` (`U` upper triangular)
//!
//! ```text
//! K = U_new U_old^-1        J_link := K J_link K^T        sum: K J_old K^T = J_new
//! ```
//!
//! So every share is physically consistent, all masses change by one factor, and massless links
//! stay massless. If the URDF's body, or a share of it, is not a physically consistent body with
//! extent in all directions, there is no such map. Then the top link of the body gets the whole
//! inertia (or the heaviest link, if the top link has no mass), and the others lose their
//! `<inertial>`.

use std::collections::HashMap;
use std::ops::Range;

use nalgebra::Matrix4;

use super::xml::{Document, ElementRef};
use super::{Model, ModelError, urdf};
use crate::spatial::{Mat3, Pose, RigidInertia};

/// Smallest ratio of diagonal elements of `U` that counts as extent in all directions.
const FLAT: f64 = 1e-6;

/// A URDF link that belongs to a body.
struct Portion<'a> {
    name: &'a str,
    pose: Pose,
    /// In the body's frame.
    old: RigidInertia,
}

/// The new inertia of each share, in the body's frame; `None` where the link loses its
/// `<inertial>`.
fn distribute(
    shares: &[Portion<'_>],
    top: &str,
    old: &RigidInertia,
    new: &RigidInertia,
) -> Vec<Option<RigidInertia>> {
    let nothing = |share: &Portion<'_>| share.old == RigidInertia::zero();
    let heaviest = || {
        let massive = (0..shares.len()).filter(|&i| shares[i].old.mass > 0.0);
        massive.max_by(|&a, &b| shares[a].old.mass.total_cmp(&shares[b].old.mass))
    };
    let on_top = shares.iter().position(|share| share.name == top);
    let main = on_top
        .filter(|&i| shares[i].old.mass > 0.0)
        .or_else(heaviest)
        .or(on_top)
        .unwrap_or(0);
    let mut result: Vec<Option<RigidInertia>> = shares
        .iter()
        .map(|share| nothing(share).then_some(share.old))
        .collect();
    let alone = shares
        .iter()
        .enumerate()
        .all(|(i, share)| i == main || nothing(share));
    let exists = |share: &Portion<'_>| nothing(share) || share.old.check(1e-9).is_ok();
    let map = carrying(old, new).filter(|_| !alone && shares.iter().all(exists));
    // The remainder after the other shares, so that the sum is correct to the last digit.
    let mut rest = *new;
    if let Some(map) = map {
        for (i, share) in shares.iter().enumerate() {
            if i != main && !nothing(share) {
                let body = from_pseudo(&(map * share.old.pseudo_inertia() * map.transpose()));
                rest = rest - body;
                result[i] = Some(body);
            }
        }
    }
    if let Some(place) = result.get_mut(main) {
        *place = Some(rest);
    }
    result
}

/// `K` with `K J_old K^T = J_new`; `None` if either has no extent in some direction.
fn carrying(old: &RigidInertia, new: &RigidInertia) -> Option<Matrix4<f64>> {
    let (old, new) = (upper(&old.pseudo_inertia())?, upper(&new.pseudo_inertia())?);
    Some(new * old.try_inverse()?)
}

/// The upper triangle `U` with `U U^T = J`.
fn upper(pseudo: &Matrix4<f64>) -> Option<Matrix4<f64>> {
    let reversed = Matrix4::from_fn(|i, j| pseudo[(3 - i, 3 - j)]);
    let lower = reversed.cholesky()?.l();
    let root = Matrix4::from_fn(|i, j| lower[(3 - i, 3 - j)]);
    let diagonal = root.diagonal();
    (diagonal.rows(0, 3).min() > FLAT * diagonal.rows(0, 3).max()).then_some(root)
}

fn from_pseudo(pseudo: &Matrix4<f64>) -> RigidInertia {
    let sigma: Mat3 = pseudo.fixed_view::<3, 3>(0, 0).into_owned();
    let sigma = (sigma + sigma.transpose()) / 2.0;
    RigidInertia {
        mass: pseudo[(3, 3)],
        first_moment: pseudo.fixed_view::<3, 1>(0, 3).into_owned(),
        inertia: Mat3::from_diagonal_element(sigma.trace()) - sigma,
    }
}

/// The replacement in a link's text. The first `<inertial>` counts, as everywhere.
fn patch(
    text: &str,
    node: ElementRef<'_>,
    inertia: Option<&RigidInertia>,
    patches: &mut Vec<(Range<usize>, String)>,
) {
    let inertials: Vec<_> = node
        .children()
        .filter(|child| child.name() == "inertial")
        .collect();
    let Some(inertia) = inertia else {
        patches.extend(
            inertials
                .iter()
                .map(|inertial| (inertial.range(), String::new())),
        );
        return;
    };
    if let Some(inertial) = inertials.first() {
        let range = inertial.range();
        let before = text.get(..range.start).unwrap_or_default();
        let line = before.rsplit('\n').next().unwrap_or_default();
        let indent = line.trim().is_empty().then_some(line);
        patches.push((range, element(inertia, indent)));
        return;
    }
    let range = node.range();
    let written = text.get(range.clone()).unwrap_or_default();
    let new = element(inertia, None);
    if written.ends_with("/>") && node.content() == range.end {
        patches.push((range.end - 2..range.end, format!(">{new}</link>")));
    } else {
        patches.push((node.content()..node.content(), new));
    }
}

/// An `<inertial>` element: axes of the link, origin at the centre of mass. On several lines, at
/// `indent`, if it is on its own line.
fn element(inertia: &RigidInertia, indent: Option<&str>) -> String {
    let mut buffer = zmij::Buffer::new();
    let mut number = |value: f64| {
        // Removes the sign of zero.
        buffer.format(value + 0.0).to_owned()
    };
    let c = inertia.centre().unwrap_or_default();
    let i = inertia.about_centre();
    let origin = format!(
        "<origin xyz=\"{} {} {}\" rpy=\"0 0 0\"/>",
        number(c.x),
        number(c.y),
        number(c.z)
    );
    let mass = format!("<mass value=\"{}\"/>", number(inertia.mass));
    let mut tensor = String::from("<inertia");
    for (name, row, column) in [
        ("ixx", 0, 0),
        ("ixy", 0, 1),
        ("ixz", 0, 2),
        ("iyy", 1, 1),
        ("iyz", 1, 2),
        ("izz", 2, 2),
    ] {
        tensor.push_str(&format!(" {name}=\"{}\"", number(i[(row, column)])));
    }
    tensor.push_str("/>");
    match indent {
        Some(indent) => {
            format!(
                "<inertial>\n{indent}  {origin}\n{indent}  {mass}\n{indent}  \
                 {tensor}\n{indent}</inertial>"
            )
        }
        None => format!("<inertial>{origin}{mass}{tensor}</inertial>"),
    }
}

impl Model {
    /// The URDF's text with the inertia of every body replaced by that of `inertias`, in the order
    /// of the bodies that [`Model::from_urdf`] makes of it with the same `keep`; everything else
    /// stays byte for byte. Read again, it gives these inertias but for rounding.
    ///
    /// A body of several links, joined by fixed joints, keeps them: the affine map that takes the
    /// old body to the new one is applied to the share of each link. If the old body, or one of its
    /// links, is not physically consistent, the top link gets the whole inertia, and the others
    /// lose their `<inertial>`. A body whose inertia equals that of the URDF, bit for bit, is left
    /// as written.
    ///
    /// # Errors
    /// As [`Model::from_urdf`]; the number of inertias differs from that of the bodies, or an
    /// inertia is not finite.
    pub fn rewrite_urdf(
        text: &str,
        keep: &[&str],
        inertias: &[RigidInertia],
    ) -> Result<String, ModelError> {
        let mut model = Self::from_urdf(text, keep)?;
        if inertias.len() != model.link_count() {
            return Err(ModelError::InertiaCount {
                given: inertias.len(),
                needed: model.link_count(),
            });
        }
        let before = model.inertias().to_vec();
        for (link, inertia) in inertias.iter().enumerate() {
            model.set_inertia(link, *inertia)?;
        }
        let document = Document::parse(text)?;
        let raw = urdf::link_inertias(&document)?;
        let mut bodies: Vec<Vec<Portion<'_>>> = before.iter().map(|_| Vec::new()).collect();
        for (name, inertia) in &raw {
            if let Some(frame) = model.frame(name) {
                bodies[frame.link].push(Portion {
                    name,
                    pose: frame.pose,
                    old: inertia.transformed(&frame.pose),
                });
            }
        }
        // The body between a moving joint and the F/T sensor in it is no link of the URDF; the link
        // beyond it gets its inertia.
        let mut inertias = inertias.to_vec();
        for joint in model.joints() {
            if bodies[joint.parent].is_empty() {
                inertias[joint.child] = inertias[joint.child] + inertias[joint.parent];
            }
        }
        let mut changed = HashMap::new();
        for (body, shares) in bodies.iter().enumerate() {
            if inertias[body] == before[body] {
                continue;
            }
            let top = model.link_name(body);
            for (share, inertia) in
                shares
                    .iter()
                    .zip(distribute(shares, top, &before[body], &inertias[body]))
            {
                if inertia != Some(share.old) {
                    changed.insert(
                        share.name,
                        inertia.map(|i| i.transformed(&share.pose.inverse())),
                    );
                }
            }
        }
        let mut patches = Vec::new();
        for node in urdf::robot(&document)?
            .children()
            .filter(|node| node.name() == "link")
        {
            if let Some(inertia) = node.attribute("name").and_then(|name| changed.get(name)) {
                patch(text, node, inertia.as_ref(), &mut patches);
            }
        }
        patches.sort_by_key(|(range, _)| range.start);
        let (mut out, mut end) = (String::with_capacity(text.len() + 4096), 0);
        for (range, new) in patches {
            out.push_str(text.get(end..range.start).unwrap_or_default());
            out.push_str(&new);
            end = range.end;
        }
        out.push_str(text.get(end..).unwrap_or_default());
        Ok(out)
    }
}
