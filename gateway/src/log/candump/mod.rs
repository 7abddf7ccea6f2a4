//! The text formats of can-utils' candump: reads all of them, writes the log format.
//!
//! The log format (`candump -l`, `-L`), which canplayer, python-can, SavvyCAN and others read too:
//!
//! ```text
//! (1436509052.249713) vcan0 123#DEADBEEF       classic, standard identifier: three digits
//! (1436509052.249713) vcan0 1F334455#1122 T    extended identifier: eight digits;
//!                                              -x adds R (received) or T (sent)
//! (1436509052.249713) vcan0 123#R4             remote request for 4 bytes
//! (1436509052.249713) vcan0 123##3112233       CAN FD: one digit of flags
//!                                              (1 bit rate switch, 2 error state)
//! (1436509052.249713) vcan0 20000004#0008000000006000
//!                                              error frame: 20000000 + error classes
//! (1436509052.249713) vcan0 123#1122334455667788_E
//!                                              classic, raw length code above 8 (dropped)
//! (1436509052.249713001) vcan0 123#            candump -N: nanoseconds
//! ```
//!
//! The screen format and the effect of its options:
//!
//! ```text
//!   vcan0  123   [4]  DE AD BE EF                               without stamps
//!  (1795225394.431732)  vcan0  123   [4]  DE AD BE EF           -t a
//!  (2026-11-21 01:43:14.431732)  vcan0  123   [4]  DE AD BE EF  -t A, local time: read as UTC
//!  (000.244690)  vcan0  1F334455   [2]  11 22                   -t d (since the previous line)
//!                                                               or -t z (since the first)
//!   vcan0  TX B -  12345678  [02]  AA BB                        -x; two-digit length: CAN FD
//!   vcan0       020   [5]  48 65 6C 6C 6F            'Hello'    -a
//!   vcan0  123   [4]  EF`BE`AD`DE                               -S
//!   vcan0       123   [8]  remote request
//!   vcan0  20000040   [1]  00                        ERRORFRAME     -e: more lines, after a tab
//! ```
//!
//! An absolute stamp has ten digits of seconds or a date. A shorter stamp is relative. In the log
//! format it counts from the origin of the log (other programs write such stamps). In the screen
//! format it is `-t z` or `-t d`, which one line cannot distinguish: the whole log tells
//! (`log/stamps.rs`), or [`LogReader::with_stamps`] states it. Stamps since the previous line are
//! added up.
//!
//! [`LogReader`]: super::LogReader
//! [`LogReader::with_stamps`]: super::LogReader::with_stamps
//!
//! Sources: can-utils `candump.c`, `lib.c` (`parse_canframe`, `sprint_canframe`,
//! `sprint_long_canframe`) and `lib.h`; the golden lines of tests/candump.rs were printed by
//! candump 2020.11.

mod line;
mod stamp;
mod writer;

pub(super) use line::parse_line;
pub use line::{Line, parse_frame};
pub use writer::{Writer, write_log_line};
