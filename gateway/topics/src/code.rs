//! Enumerations in shared memory: numbers, of which a reader checks that they mean something.
//!
//! A Rust enumeration may only hold one of its variants, and shared memory may hold anything: what
//! a process of another version wrote, or one that went wrong. So payloads hold [`Code`]s, for
//! which every number is legal, and [`Reader`](crate::ipc::Reader) skips and counts a payload with
//! a number that has no meaning.

use core::fmt;
use core::marker::PhantomData;
use iceoryx2_bb_derive_macros::ZeroCopySend;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;
use zerocopy::FromBytes;

/// An enumeration whose variants have numbers in shared memory.
pub trait Coded: ZeroCopySend + Copy + fmt::Debug {
    /// Its number.
    fn code(self) -> u32;
    /// The variant with number `code`; `None` if there is none.
    fn from_code(code: u32) -> Option<Self>;
}

/// The number of a variant of `E`, as it stands in shared memory: not necessarily one that exists.
#[repr(C)]
#[derive(Clone, Copy, PartialEq, Eq, Hash, ZeroCopySend, FromBytes)]
pub struct Code<E: Coded> {
    number: u32,
    meaning: PhantomData<E>,
}

impl<E: Coded> Code<E> {
    /// The number `number`, whether or not it has a meaning.
    #[must_use]
    pub const fn of_number(number: u32) -> Self {
        let meaning = PhantomData;
        Self { number, meaning }
    }

    /// The number.
    #[must_use]
    pub const fn number(self) -> u32 {
        self.number
    }

    /// What it means; `None` if it has no meaning. Payloads that come out of a
    /// [`Reader`](crate::ipc::Reader) have only numbers with a meaning.
    #[must_use]
    pub fn get(self) -> Option<E> {
        E::from_code(self.number)
    }
}

impl<E: Coded> From<E> for Code<E> {
    fn from(meaning: E) -> Self {
        Self::of_number(meaning.code())
    }
}

impl<E: Coded> PartialEq<E> for Code<E> {
    fn eq(&self, other: &E) -> bool {
        self.number == other.code()
    }
}

impl<E: Coded + Default> Default for Code<E> {
    fn default() -> Self {
        E::default().into()
    }
}

impl<E: Coded> fmt::Debug for Code<E> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.get() {
            Some(meaning) => meaning.fmt(f),
            None => write!(f, "unknown code {}", self.number),
        }
    }
}

/// Defines an enumeration without fields that is [`Coded`]: the number of a variant is its
/// discriminant, and the name after it the one in tables and logs. Also `ALL`, and `Code`s of
/// constants.
macro_rules! coded {
    (
        $(#[$of_all:meta])*
        pub enum $name:ident {
            $($(#[$of_one:meta])* $variant:ident = $number:literal => $word:literal,)+
        }
    ) => {
        $(#[$of_all])*
        #[repr(C)]
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, ZeroCopySend)]
        pub enum $name {
            $($(#[$of_one])* $variant = $number,)+
        }

        impl $name {
            /// All variants, in the order of their numbers.
            pub const ALL: [Self; [$($number),+].len()] = [$(Self::$variant),+];

            /// Its name in tables and logs.
            #[must_use]
            pub const fn word(self) -> &'static str {
                match self {
                    $(Self::$variant => $word,)+
                }
            }

            /// Its number in shared memory.
            #[must_use]
            pub const fn in_memory(self) -> $crate::Code<Self> {
                $crate::Code::of_number(self as u32)
            }
        }

        impl $crate::Coded for $name {
            fn code(self) -> u32 {
                self as u32
            }

            fn from_code(code: u32) -> Option<Self> {
                Self::ALL.into_iter().find(|variant| *variant as u32 == code)
            }
        }

        impl core::fmt::Display for $name {
            fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
                f.pad(self.word())
            }
        }
    };
}
pub(crate) use coded;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Reason;
    use std::format;

    #[test]
    fn only_numbers_with_a_meaning_have_one() {
        for (number, reason) in (0..).zip(Reason::ALL) {
            let code = Code::<Reason>::of_number(number);
            assert_eq!(code.get(), Some(reason));
            assert!(code == reason && code == Code::from(reason) && code == reason.in_memory());
        }
        let past = Code::<Reason>::of_number(Reason::ALL.len() as u32);
        assert_eq!(past.get(), None);
        assert_eq!(
            format!("{past:?}"),
            format!("unknown code {}", Reason::ALL.len())
        );
    }
}
