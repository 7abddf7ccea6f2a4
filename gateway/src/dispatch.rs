//! Which devices receive which identifier.

use arrayvec::ArrayVec;
use proprio_drivers::{Claim, Id};

/// The devices that receive each identifier: a table for the 2048 standard identifiers, a list for
/// the extended ones.
pub(crate) struct Dispatch {
    /// Per standard identifier, at most [`SHARERS`] device numbers.
    standard: Vec<ArrayVec<u16, SHARERS>>,
    extended: Vec<(Claim, u16)>,
    /// The first identifier that more devices claim than it is passed to; a plan has none.
    crowded: Option<Id>,
}

/// Maximum number of devices that receive one identifier: those of one board.
pub(crate) const SHARERS: usize = 4;

/// An identifier that more than [`SHARERS`] devices with these claims would receive.
pub(crate) fn crowded<'a>(claims: impl Iterator<Item = &'a [Claim]>) -> Option<Id> {
    Dispatch::new(claims).crowded
}

impl Dispatch {
    pub(crate) fn new<'a>(claims: impl Iterator<Item = &'a [Claim]>) -> Self {
        let mut this = Self {
            standard: vec![ArrayVec::new(); 2048],
            extended: Vec::new(),
            crowded: None,
        };
        for (claims, device) in claims.zip(0_u16..) {
            for claim in claims {
                match claim.id {
                    Id::Extended(_) => {
                        this.extended.push((*claim, device));
                        let mut sharers: Vec<u16> = this
                            .extended
                            .iter()
                            .filter(|(other, _)| other.overlaps(claim))
                            .map(|(_, device)| *device)
                            .collect();
                        sharers.dedup();
                        if sharers.len() > SHARERS {
                            this.crowded.get_or_insert(claim.id);
                        }
                    }
                    Id::Standard(_) => {
                        for (devices, id) in this.standard.iter_mut().zip(0_u16..) {
                            if claim.matches(Id::Standard(id))
                                && !devices.contains(&device)
                                && devices.try_push(device).is_err()
                            {
                                this.crowded.get_or_insert(Id::Standard(id));
                            }
                        }
                    }
                }
            }
        }
        this
    }

    pub(crate) fn find(&self, id: Id) -> ArrayVec<u16, SHARERS> {
        match id {
            Id::Standard(id) => self
                .standard
                .get(usize::from(id))
                .cloned()
                .unwrap_or_default(),
            Id::Extended(_) => {
                let mut found = ArrayVec::new();
                for (claim, device) in &self.extended {
                    if claim.matches(id) && !found.contains(device) {
                        let _ = found.try_push(*device);
                    }
                }
                found
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_identifier_has_at_most_four_listeners() {
        for id in [Id::standard(0x2A0), Id::extended(0x18FF_0001)] {
            let shared = [Claim::shared(id)];
            let other = [Claim::shared(Id::standard(0x2B0))];
            let claims = |n: usize| {
                std::iter::repeat_n(&shared[..], n).chain(std::iter::repeat_n(&other[..], 4))
            };
            assert_eq!(crowded(claims(4)), None);
            assert_eq!(crowded(claims(5)), Some(id));
            assert_eq!(Dispatch::new(claims(4)).find(id).len(), 4);
        }
        // Two claims of one device are one listener, which gets each frame once.
        for id in [Id::standard(7), Id::extended(7)] {
            let twice = [Claim::shared(id), Claim::shared(id)];
            let claims = || std::iter::repeat_n(&twice[..], 4);
            assert_eq!(crowded(claims()), None);
            assert_eq!(Dispatch::new(claims()).find(id)[..], [0, 1, 2, 3]);
        }
    }
}
