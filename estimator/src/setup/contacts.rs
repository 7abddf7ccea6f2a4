//! The contacts of the configuration, and what refers to them: patches of skin, and the feet of a
//! walking robot.

use super::names::{frame, nearest};
use crate::config::{Config, ContactModel, Foot, Occurrence, TactileSkin};
use crate::skin::{PatchSetup, TRIANGLE, TRIANGLES, Taxel, TaxelMap, threshold};
use proprio_dynamics::model::{Frame, Model};
use proprio_dynamics::spatial::Vec3;
use proprio_dynamics::{ContactKind, ContactSpec, FrameMotion};
use proprio_identification::robot::{NamedContact, Stance};
use proprio_topics::{MAX_CONTACTS, Name, Nanos};

/// The contacts: their names, and what the solver needs of them.
pub(super) fn contacts(
    config: &Config,
    model: &Model,
) -> Result<(Vec<NamedContact>, Vec<ContactSpec>), String> {
    let (mut names, mut specs) = (Vec::<NamedContact>::new(), Vec::new());
    if config.contact.len() >= MAX_CONTACTS {
        return Err(format!(
            "the configuration has {} contacts; at most {} are possible: remove some",
            config.contact.len(),
            MAX_CONTACTS - 1
        ));
    }
    for contact in &config.contact {
        let at = format!("contact {:?}", contact.name());
        if Name::new(contact.name()).is_none() || contact.name().contains(['/', ',', '"', '\n']) {
            return Err(format!(
                "{at}: a name has at most {} bytes, without / , \" and line ends",
                Name::CAPACITY
            ));
        }
        if names.iter().any(|n| n.name == contact.name()) {
            return Err(format!(
                "{at}: two contacts have this name; give each its own name"
            ));
        }
        let frame = frame(model, &contact.link).map_err(|e| format!("{at}: link: {e}"))?;
        let kind = match (contact.kind, contact.direction) {
            (ContactModel::Wrench, _) => ContactKind::Wrench,
            (ContactModel::Force, _) => ContactKind::Force,
            (ContactModel::ForceAlong, direction) => {
                ContactKind::ForceAlong(Vec3::from(direction.unwrap_or_default()))
            }
        };
        specs.push(ContactSpec {
            frame,
            kind,
            position: Vec3::from(contact.position_m),
        });
        let always = contact.presence == Occurrence::Always;
        names.push(NamedContact {
            name: contact.name().to_owned(),
            frame: contact.link.clone(),
            always,
        });
    }
    Ok((names, specs))
}

/// The patches of skin, with their taxels in the frames of their contacts.
pub(super) fn skins(
    config: &Config,
    model: &Model,
    contacts: &[NamedContact],
    specs: &[ContactSpec],
    warnings: &mut Vec<String>,
) -> Result<Vec<PatchSetup>, String> {
    let mut skins = Vec::<PatchSetup>::new();
    for skin in &config.skin {
        let at = format!("skin {:?}", skin.channel);
        if skins.iter().any(|other| other.channel == skin.channel) {
            return Err(format!(
                "{at}: two skins have this channel; give each its own"
            ));
        }
        let frame = frame(model, &skin.link).map_err(|e| format!("{at}: link: {e}"))?;
        let contact = contact_number(&skin.contact, contacts).map_err(|e| format!("{at}: {e}"))?;
        let Some(own) = specs.get(contact).map(|spec| spec.frame) else {
            continue;
        };
        if own.link != frame.link {
            return Err(format!(
                "{at}: contact {:?} is on the link {:?}, the skin on {:?}; name a contact on the \
                 skin's link",
                skin.contact,
                model.link_name(own.link),
                model.link_name(frame.link)
            ));
        }
        let map = TaxelMap::load(&skin.taxels).map_err(|e| format!("{at}: taxels: {e}"))?;
        let taxels = taxels(skin, &map).map_err(|e| format!("{at}: {e}"))?;
        if let Some(warning) = far_taxel(skin, taxels) {
            warnings.push(format!("{at}: {warning}"));
        }
        let x_cs = own.pose.inverse() * frame.pose;
        let placed = |taxel: &Taxel| Taxel {
            position: x_cs.point(&taxel.position),
            normal: x_cs.rotation * taxel.normal,
        };
        let count = taxels.iter().flatten().count();
        let of_pitch = || map.pitch().unwrap_or(0.0) / f64::sqrt(12.0);
        skins.push(PatchSetup {
            channel: skin.channel.clone(),
            contact,
            taxels: taxels
                .iter()
                .map(|taxel| taxel.as_ref().map(placed))
                .collect(),
            threshold: threshold(skin.noise, count, skin.false_alarms_per_hour),
            position_std: skin.position_std_m.unwrap_or_else(of_pitch),
            max_silence: Nanos::from_seconds(skin.max_silence_ms * 1e-3),
        });
    }
    Ok(skins)
}

/// The taxels of the file that the patch has.
fn taxels<'m>(skin: &TactileSkin, map: &'m TaxelMap) -> Result<&'m [Option<Taxel>], String> {
    let taxels = map.0.get(skin.first_taxel..).unwrap_or_default();
    let taxels = taxels.get(..TRIANGLE * TRIANGLES).unwrap_or(taxels);
    if taxels.iter().flatten().next().is_some() {
        return Ok(taxels);
    }
    Err(format!(
        "first_taxel = {}: {} has no taxel from there on; it has {} rows, counted from 0",
        skin.first_taxel,
        skin.taxels.display(),
        map.0.len()
    ))
}

/// A warning if a taxel is further from its link's origin than any taxel of a robot's limb.
fn far_taxel(skin: &TactileSkin, taxels: &[Option<Taxel>]) -> Option<String> {
    /// \[m\]
    const FAR: f64 = 2.0;
    let mut taxels = taxels.iter().flatten();
    let is_far = taxels.any(|taxel| taxel.position.norm() > FAR);
    is_far.then(|| {
        format!(
            "{} places a taxel more than {FAR} m from the origin of {:?}: positions are in metres",
            skin.taxels.display(),
            skin.link
        )
    })
}

/// The number of the contact of this name.
fn contact_number(name: &str, contacts: &[NamedContact]) -> Result<usize, String> {
    let number = contacts.iter().position(|contact| contact.name == name);
    number.ok_or_else(|| {
        let names = nearest(name, contacts.iter().map(|contact| contact.name.as_str()));
        format!("contact = {name:?} is not a contact{names}")
    })
}

/// The motion of a link while `frame`, which is fixed to it, is at rest.
pub(super) fn standing(frame: &Frame, gravity: [f64; 3]) -> FrameMotion {
    FrameMotion::of_link_from_imu(&FrameMotion::standing(&Vec3::from(gravity)), &frame.pose)
}

/// The links of a walking robot that may be at rest.
pub(super) fn stances(
    feet: &[Foot],
    model: &Model,
    contacts: &[NamedContact],
    specs: &[ContactSpec],
) -> Result<Vec<Stance>, String> {
    let mut stances = Vec::<Stance>::new();
    for (number, foot) in feet.iter().enumerate() {
        let at = format!("base.foot {:?}", foot.link);
        let frame = frame(model, &foot.link).map_err(|e| format!("{at}: link: {e}"))?;
        let contact = contact_number(&foot.contact, contacts).map_err(|e| format!("{at}: {e}"))?;
        let carries =
            |spec: &ContactSpec| spec.frame.link == frame.link && spec.kind == ContactKind::Wrench;
        if !specs.get(contact).is_some_and(carries) {
            return Err(format!(
                "{at}: contact {:?} must be on the same link and of kind \"wrench\" to carry the \
                 robot",
                foot.contact
            ));
        }
        if stances.iter().any(|other| other.contact == contact) {
            return Err(format!(
                "{at}: contact {:?} already belongs to another foot",
                foot.contact
            ));
        }
        if number + 1 < feet.len() && contacts.get(contact).is_some_and(|c| c.always) {
            return Err(format!(
                "{at}: contact {:?} is always present, so no later foot could become the base; \
                 give it presence = \"possible\"",
                foot.contact
            ));
        }
        stances.push(Stance {
            link: frame.link,
            motion: standing(&frame, foot.gravity_mps2),
            contact,
        });
    }
    Ok(stances)
}
