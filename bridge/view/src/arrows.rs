//! Contact forces as arrows on the model.

use foxglove::messages::{
    ArrowPrimitive, Color, Duration, KeyValuePair, Pose, Quaternion, SceneEntity,
    SceneEntityDeletion, SceneUpdate, Timestamp, Vector3,
};
use proprio_topics::{ContactEstimate, ContactWrench, Description, Nanos, Role};

/// The length of an arrow per force \[m/N\]: 100 N are 0.2 m.
const LENGTH: f64 = 0.002;
/// Forces below this have no arrow \[N\].
const LEAST: f64 = 0.01;
/// The diameter of an arrow, and the length of its head unless half of it is shorter \[m\].
const DIAMETER: f64 = 0.01;
const HEAD: f64 = 0.03;

/// Each contact's arrow, or that it has none: what a client missed before does not matter. `wall`
/// is in \[ns since 1970, UTC\]; without further scenes, the arrows vanish after `lifetime`.
pub(crate) fn scene(
    wall: u64,
    lifetime: Nanos,
    names: &Description,
    estimate: &ContactEstimate,
) -> SceneUpdate {
    let timestamp = Timestamp::new_checked(
        u32::try_from(wall / 1_000_000_000).unwrap_or(u32::MAX),
        u32::try_from(wall % 1_000_000_000).unwrap_or_default(),
    );
    let mut scene = SceneUpdate::default();
    for (contact, number) in estimate.contacts().iter().zip(0..) {
        let Some(entry) = names.find(Role::Contact, number) else {
            continue;
        };
        let id = entry.name.as_str().to_owned();
        match arrow(contact) {
            Some((arrow, force)) => scene.entities.push(SceneEntity {
                timestamp,
                frame_id: entry.origin.as_str().to_owned(),
                id,
                lifetime: Some(Duration::saturating_from_secs_f64(lifetime.seconds())),
                frame_locked: true,
                metadata: vec![KeyValuePair {
                    key: "force [N]".to_owned(),
                    value: format!("{force:.2}"),
                }],
                arrows: vec![arrow],
                ..SceneEntity::default()
            }),
            None => scene.deletions.push(SceneEntityDeletion {
                timestamp,
                id,
                ..SceneEntityDeletion::default() // that of this id
            }),
        }
    }
    scene
}

/// The arrow of a contact, and its force \[N\]; none while it is withheld or there is no force.
fn arrow(contact: &ContactWrench) -> Option<(ArrowPrimitive, f64)> {
    let [x, y, z] = contact.force;
    let force = x.hypot(y).hypot(z);
    if contact.valid != 1 || !force.is_finite() || force < LEAST {
        return None;
    }
    // An arrow points along x: the shortest turn from there.
    let (along, side) = (x / force, y.hypot(z));
    let (sin, cos) = (0.5 * side.atan2(x)).sin_cos();
    let (turn_y, turn_z) = match side > 0.0 {
        true => (-z / side, y / side),
        false => (0.0, along.signum()),
    };
    let [x, y, z] = contact
        .position
        .map(|it| if it.is_nan() { 0.0 } else { it });
    let length = LENGTH * force;
    let head = HEAD.min(0.5 * length);
    let arrow = ArrowPrimitive {
        pose: Some(Pose {
            position: Some(Vector3 { x, y, z }),
            orientation: Some(Quaternion {
                x: 0.0,
                y: sin * turn_y,
                z: sin * turn_z,
                w: cos,
            }),
        }),
        shaft_length: length - head,
        shaft_diameter: DIAMETER,
        head_length: head,
        head_diameter: 2.0 * DIAMETER,
        color: Some(Color {
            r: 1.0,
            g: 0.45,
            b: 0.0,
            a: 0.9,
        }),
    };
    Some((arrow, force))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn contact(force: [f64; 3]) -> ContactWrench {
        ContactWrench {
            force,
            valid: 1,
            position: [0.1, 0.2, 0.3],
            ..ContactWrench::ABSENT
        }
    }

    #[test]
    fn arrows_point_along_their_forces() {
        for force in [
            [30.0, -40.0, 0.0],
            [-3.0, 4.0, 12.0],
            [0.0, 0.0, -7.0],
            [5.0, 0.0, 0.0],
            [-5.0, 0.0, 0.0],
            [-100.0, 1e-9, 0.0],
        ] {
            let (arrow, newtons) = arrow(&contact(force)).expect("an arrow");
            let pose = arrow.pose.expect("a pose");
            let q = pose.orientation.expect("an orientation");
            assert!(
                (q.w * q.w + q.y * q.y + q.z * q.z - 1.0).abs() < 1e-12,
                "{q:?}"
            );
            // The first column of the rotation.
            let x = [
                1.0 - 2.0 * (q.y * q.y + q.z * q.z),
                2.0 * (q.x * q.y + q.w * q.z),
                2.0 * (q.x * q.z - q.w * q.y),
            ];
            for (axis, force) in x.iter().zip(force) {
                assert!((axis * newtons - force).abs() < 1e-9, "{x:?} {force:?}");
            }
            let length = arrow.shaft_length + arrow.head_length;
            assert!((length - 0.002 * newtons).abs() < 1e-12);
            assert_eq!(pose.position.map(|it| it.z), Some(0.3));
        }
    }

    #[test]
    fn a_withheld_force_and_none_have_no_arrow() {
        assert_eq!(arrow(&contact([0.0; 3])), None);
        assert_eq!(arrow(&contact([f64::NAN; 3])), None);
        let withheld = ContactWrench {
            valid: 0,
            ..contact([9.0; 3])
        };
        assert_eq!(arrow(&withheld), None);
    }
}
