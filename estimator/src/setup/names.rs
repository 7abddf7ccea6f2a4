//! Names of links, frames and joints as the configuration has them: where they are in the model, or
//! what is wrong with them, with a suggestion.

use proprio_dynamics::model::{Frame, Model};

/// The frame of a link or of a link that was folded into another; the error suggests a similar
/// name.
pub fn frame(model: &Model, name: &str) -> Result<Frame, String> {
    model.frame(name).ok_or_else(|| {
        if model.is_dropped(name) {
            return dropped(model, name);
        }
        format!(
            "{name:?} is not a link of the URDF{}",
            nearest(name, model.frame_names())
        )
    })
}

/// Why the name of a link or joint above the robot is none of the model's.
fn dropped(model: &Model, name: &str) -> String {
    format!(
        "{name:?} is above the robot, which floats in the URDF, and is dropped; the root is the \
         link {:?}",
        model.link_name(0)
    )
}

/// Why a name is not a moving joint, with a suggestion.
pub(super) fn no_joint(model: &Model, name: &str) -> String {
    if model.is_dropped(name) {
        return dropped(model, name);
    }
    if let Some(leader) = model.held_by(name) {
        return format!(
            "{name:?} follows {leader:?} (<mimic>), a fixed joint, which already holds it; remove \
             it here, or its <mimic> in the URDF"
        );
    }
    if let Some(joint) = model.joint(name)
        && model.joints().get(joint).is_some_and(|j| j.dof.is_none())
    {
        return format!("{name:?} is a fixed joint; there is nothing to lock");
    }
    if model.is_folded(name) {
        return format!("{name:?} is a fixed joint");
    }
    let names = (0..model.joint_count()).map(|j| model.joint_name(j));
    format!(
        "{name:?} is not a joint of the URDF{}",
        nearest(name, names)
    )
}

/// A suggestion for a misspelt name: the most similar one, or some of the names that exist.
pub fn nearest<'a>(name: &str, names: impl Iterator<Item = &'a str>) -> String {
    let names = by_distance(name, names);
    similar(name, &names).unwrap_or_else(|| {
        let some: Vec<_> = names.iter().take(8).map(|(_, n)| *n).collect();
        format!(
            "; the names are {}{}",
            some.join(", "),
            if names.len() > 8 { ", ..." } else { "" }
        )
    })
}

/// The most similar name as a suggestion; none if none is similar.
pub(crate) fn similar_name<'a>(name: &str, names: impl Iterator<Item = &'a str>) -> Option<String> {
    similar(name, &by_distance(name, names))
}

/// Names with their distance from `name`, the nearest first.
fn by_distance<'a>(name: &str, names: impl Iterator<Item = &'a str>) -> Vec<(usize, &'a str)> {
    let mut names: Vec<_> = names
        .map(|n| (strsim::damerau_levenshtein(name, n), n))
        .collect();
    names.sort_unstable();
    names
}

fn similar(name: &str, by_distance: &[(usize, &str)]) -> Option<String> {
    let (distance, near) = by_distance.first()?;
    (*distance <= name.len() / 2).then(|| format!("; did you mean {near:?}?"))
}
