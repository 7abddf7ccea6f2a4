//! Which devices receive which identifier.

use proprio_drivers::{Claim, Id};

/// The devices that receive each identifier: a table for the 2048 standard identifiers, a list for
/// the extended ones.
pub(crate) struct Dispatch {
    /// Per standard identifier, where its devices begin and end in `devices`.
    standard: Vec<(usize, usize)>,
    devices: Vec<u16>,
    extended: Vec<(Claim, u16)>,
}

impl Dispatch {
    /// From the claims of each device, in the order of their numbers.
    pub(crate) fn new<'a>(claims: impl Iterator<Item = &'a [Claim]>) -> Self {
        let claims: Vec<(u16, &[Claim])> = (0..).zip(claims).collect();
        let mut devices = Vec::new();
        let standard = (0..2048)
            .map(|id| {
                let begin = devices.len();
                let listens = |claims: &[Claim]| claims.iter().any(|c| c.matches(Id::Standard(id)));
                let listeners = claims.iter().filter(|(_, claims)| listens(claims));
                devices.extend(listeners.map(|(device, _)| *device));
                (begin, devices.len())
            })
            .collect();
        let extended = claims.iter().flat_map(|(device, claims)| {
            let extended = claims.iter().filter(|c| matches!(c.id, Id::Extended(_)));
            extended.map(|claim| (*claim, *device))
        });
        Self {
            standard,
            devices,
            extended: extended.collect(),
        }
    }

    /// The devices that receive `id`, each once.
    pub(crate) fn find(&self, id: Id) -> impl Iterator<Item = u16> + '_ {
        let (standard, extended): (&[u16], &[(Claim, u16)]) = match id {
            Id::Standard(id) => {
                let place = self.standard.get(usize::from(id)).copied();
                let (begin, end) = place.unwrap_or_default();
                (self.devices.get(begin..end).unwrap_or_default(), &[])
            }
            Id::Extended(_) => (&[], &self.extended),
        };
        let of_list = (extended.iter().enumerate()).filter(move |(at, (claim, device))| {
            let before = extended.get(..*at).unwrap_or_default();
            let earlier = |(c, d): &(Claim, u16)| d == device && c.matches(id);
            claim.matches(id) && !before.iter().any(earlier)
        });
        let of_list = of_list.map(|(_, (_, device))| *device);
        standard.iter().copied().chain(of_list)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_listener_gets_each_frame_once() {
        for id in [Id::standard(0x2A0), Id::extended(0x18FF_0001)] {
            // Two claims of one device are one listener.
            let twice = [Claim::shared(id), Claim::shared(id)];
            let other = [
                Claim::shared(Id::standard(0x2B0)),
                Claim::shared(Id::extended(7)),
            ];
            let range = [Claim {
                mask: !0xF,
                ..Claim::shared(id)
            }];
            let claims = [
                &twice[..],
                &other,
                &range,
                &[],
                &twice,
                &twice,
                &twice,
                &twice,
            ];
            let dispatch = Dispatch::new(claims.into_iter());
            let found = |id| dispatch.find(id).collect::<Vec<_>>();
            assert_eq!(found(id), [0, 2, 4, 5, 6, 7]);
            let next = match id {
                Id::Standard(raw) => Id::Standard(raw + 1),
                Id::Extended(raw) => Id::Extended(raw + 1),
            };
            assert_eq!(found(next), [2]);
            assert_eq!(found(Id::extended(7)), [1]);
            assert_eq!(found(Id::standard(0x2B0)), [1]);
            assert_eq!(found(Id::standard(7)), [0; 0]);
        }
    }
}
