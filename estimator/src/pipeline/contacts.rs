//! Which contacts are present at an instant, and where: from the configuration, declarations and
//! skins.
//!
//! A contact is present if it is declared present, or if a skin is touched that belongs to it; else
//! if it is configured as always present and is not declared absent. Its place is that of the
//! declaration if it has one, else that of the touch, else the configured one.
//!
//! Skins are read as of a little before the instant, so that estimates need not wait for them and a
//! replay has the same touches ([`Contacts::new`]).

use crate::setup::Setup;
use crate::skin::{TactilePatch, Taken, TouchSum};
use proprio_dynamics::spatial::Vec3;
use proprio_dynamics::{ContactKind, ContactSet, ContactSpec, PlaceStd, Structure};
use proprio_identification::Robot;
use proprio_topics::{ContactState, NO_CAUSE, Nanos, Quality, Skin};

/// How many declarations of a contact are kept: those of a second, from a program that follows a
/// moving contact a thousand times a second. Identification looks back by up to half a second.
const DECLARATIONS: usize = 1024;

/// Where a contact is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Place {
    /// In the contact's frame \[m\].
    pub(super) position: Vec3,
    /// In the contact's frame, of any length; used by a force along a direction.
    direction: Vec3,
    pub(super) std: PlaceStd,
    /// Whether it was measured, by a declaration or a skin.
    pub(super) is_located: bool,
}

impl Place {
    fn configured(spec: &ContactSpec) -> Self {
        let direction = match spec.kind {
            ContactKind::ForceAlong(direction) => direction,
            _ => Vec3::zeros(),
        };
        Self {
            position: spec.position,
            direction,
            std: PlaceStd::default(),
            is_located: false,
        }
    }

    /// This place, at another position.
    fn at(&self, position: Vec3, direction: Option<Vec3>, std: PlaceStd) -> Self {
        Self {
            position,
            direction: direction.unwrap_or(self.direction),
            std,
            is_located: true,
        }
    }
}

/// What a declaration says.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Declared {
    active: bool,
    /// Position, its standard deviation, and direction.
    place: Option<(Vec3, f64, Option<Vec3>)>,
}

/// The contacts of the pipeline.
pub(super) struct Contacts {
    declarations: Vec<Declarations>,
    patches: Vec<TactilePatch>,
    /// The number of the first patch's channel.
    first_channel: usize,
    configured: Vec<Place>,
    /// The places that the structure has now.
    places: Vec<Place>,
    /// Per contact, the channel of the skin whose touch is lost, or [`NO_CAUSE`].
    lost: Vec<u32>,
    /// How long before an instant the skins are read.
    delay: Nanos,
}

impl Contacts {
    /// Without declarations and samples.
    ///
    /// The delay of the skins is half of an estimate's wait: when an instant is released, all their
    /// earlier samples have arrived.
    pub(super) fn new(setup: &Setup) -> Self {
        let count = setup.robot.contacts.len();
        let specs = setup.robot.structure.contacts().iter().take(count);
        let configured: Vec<Place> = specs.map(Place::configured).collect();
        Self {
            declarations: vec![Declarations::default(); count],
            patches: setup.skins.iter().cloned().map(TactilePatch::new).collect(),
            first_channel: setup.robot.channels.len(),
            places: configured.clone(),
            configured,
            lost: vec![NO_CAUSE; count],
            delay: Nanos(setup.max_wait.0 / 2 + 1),
        }
    }

    /// Takes a declaration. False if a number in it makes no sense; its place is ignored then.
    pub(super) fn declare(&mut self, contact: usize, t: Nanos, state: &ContactState) -> bool {
        let Some(declarations) = self.declarations.get_mut(contact) else {
            return true;
        };
        let (position, direction) = (Vec3::from(state.position), Vec3::from(state.direction));
        let (std, norm) = (state.position_std, direction.norm());
        let is_given = |vector: &Vec3| !vector.iter().all(|x| x.is_nan());
        let all_finite = |vector: &Vec3| vector.iter().all(|x| x.is_finite());
        let is_good = (all_finite(&position) || !is_given(&position))
            && ((norm.is_finite() && norm >= 1e-9) || !is_given(&direction))
            && (std.is_nan() || (std >= 0.0 && std.is_finite()));
        let place = (is_good && is_given(&position)).then(|| {
            let std = if std.is_nan() { 0.0 } else { std };
            (position, std, is_given(&direction).then_some(direction))
        });
        let active = state.active;
        declarations.record(t, Declared { active, place });
        is_good
    }

    /// Takes a reading of skin number `number`.
    pub(super) fn push(&mut self, number: usize, t: Nanos, skin: &Skin, quality: Quality) -> Taken {
        let patch = self.patches.get_mut(number);
        patch.map_or(Taken::No, |patch| patch.push(t, skin, quality))
    }

    /// Whether an instant `t` was released that a reading stamped `stamp` would have been used for.
    pub(super) fn is_late(&self, stamp: Nanos, released: Nanos) -> bool {
        stamp <= released.saturating_sub(self.delay)
    }

    /// The stamp of the newest reading of skin number `number`.
    pub(super) fn newest(&self, number: usize) -> Option<Nanos> {
        self.patches.get(number)?.newest()
    }

    /// The contacts known to be present at `t`, by configuration, declaration or touch.
    pub(super) fn active(&self, robot: &Robot, t: Nanos) -> ContactSet {
        robot.active_contacts(|contact| match self.touch(contact, t).is_there() {
            true => Some(true),
            false => Some(self.declared(contact, t)?.active),
        })
    }

    /// Whether one of the `active` contacts was measured to be at another place than configured,
    /// and its torque depends on that: a force, not a full wrench.
    pub(super) fn is_elsewhere(&self, robot: &Robot, active: &ContactSet, t: Nanos) -> bool {
        let specs = robot.structure.contacts().iter().enumerate();
        let forces = specs.filter(|(_, spec)| spec.kind != ContactKind::Wrench);
        let mut placed = forces.map(|(contact, _)| contact);
        placed.any(|contact| {
            let declared = self.declared(contact, t).is_some_and(|d| d.place.is_some());
            active.contains(contact) && (declared || self.touch(contact, t).is_there())
        })
    }

    /// Moves the structure's contacts to their places at `t`.
    pub(super) fn place(&mut self, structure: &mut Structure, always: &ContactSet, t: Nanos) {
        for contact in 0..self.configured.len() {
            let (Some(configured), touch) = (
                self.configured.get(contact).copied(),
                self.touch(contact, t),
            ) else {
                continue;
            };
            let declared = self.declared(contact, t);
            let place = match declared
                .filter(|declared| declared.active)
                .and_then(|d| d.place)
            {
                Some((position, position_std, direction)) => {
                    let std = PlaceStd {
                        position: position_std,
                        direction: 0.0,
                    };
                    configured.at(position, direction, std)
                }
                None if touch.is_there() => {
                    let (position, direction, std) = touch.place();
                    configured.at(position, direction, std)
                }
                None => configured,
            };
            if let Some(lost) = self.lost.get_mut(contact) {
                // A contact that is present anyway, and a full wrench, do not depend on the touch.
                let kind = structure.contacts().get(contact).map(|spec| spec.kind);
                let is_certain = always.contains(contact) && kind == Some(ContactKind::Wrench);
                let patch = touch
                    .lost
                    .filter(|_| !touch.is_there() && declared.is_none() && !is_certain);
                *lost = patch
                    .and_then(|patch| u32::try_from(self.first_channel + patch).ok())
                    .unwrap_or(NO_CAUSE);
            }
            if let Some(now) = self.places.get_mut(contact)
                && *now != place
                && move_to(structure, contact, &place)
            {
                *now = place;
            }
        }
    }

    /// The places of the contacts.
    pub(super) fn places(&self) -> &[Place] {
        &self.places
    }

    /// Per contact, the channel of the skin whose touch is lost, or [`NO_CAUSE`].
    pub(super) fn lost(&self) -> &[u32] {
        &self.lost
    }

    /// The contacts that a program declares: their absence is known. A skin shows touches, never
    /// that there are none.
    pub(super) fn watched(&self, t: Nanos) -> ContactSet {
        let mut watched = ContactSet::EMPTY;
        (0..self.declarations.len())
            .filter(|contact| self.declared(*contact, t).is_some())
            .for_each(|contact| watched.insert(contact));
        watched
    }

    fn declared(&self, contact: usize, t: Nanos) -> Option<Declared> {
        self.declarations.get(contact)?.at(t)
    }

    fn touch(&self, contact: usize, t: Nanos) -> TouchSum {
        let mut touch = TouchSum::default();
        let patches = self.patches.iter().enumerate();
        for (number, patch) in patches.filter(|(_, patch)| patch.contact() == contact) {
            patch.add_touch(number, t.saturating_sub(self.delay), &mut touch);
        }
        touch
    }
}

/// False if the place is not a possible one.
fn move_to(structure: &mut Structure, contact: usize, place: &Place) -> bool {
    let direction = Some(&place.direction);
    structure
        .place_contact(contact, &place.position, direction)
        .is_ok()
}

/// What was declared of a contact, and when.
#[derive(Clone, Default)]
struct Declarations {
    /// The last changes, oldest first: from which stamp on, and what.
    changes: Box<arrayvec::ArrayVec<(Nanos, Declared), DECLARATIONS>>,
    /// The state before these changes.
    before: Option<Declared>,
}

impl Declarations {
    /// Records what holds from `t` on.
    fn record(&mut self, t: Nanos, declared: Declared) {
        let index = |changes: &[(Nanos, Declared)]| {
            changes
                .iter()
                .rposition(|(other, _)| *other <= t)
                .map_or(0, |i| i + 1)
        };
        let previous = index(&self.changes)
            .checked_sub(1)
            .and_then(|i| self.changes.get(i))
            .map_or(self.before, |(_, declared)| Some(*declared));
        // A declaration that repeats the state at `t` changes nothing.
        if previous == Some(declared) {
            return;
        }
        if self.changes.is_full() {
            self.before = Some(self.changes.remove(0).1);
        }
        let at = index(&self.changes);
        self.changes.insert(at, (t, declared));
    }

    /// What was declared last at `t`; none before the first declaration.
    fn at(&self, t: Nanos) -> Option<Declared> {
        self.changes
            .iter()
            .rev()
            .find(|(from, _)| *from <= t)
            .map_or(self.before, |(_, declared)| Some(*declared))
    }
}
