//! Recognising controllers by their status messages.

use super::frames::{ADDRESS_MOST, LENGTH, STEPS_PER_TURN, command};
use super::options::VescOptions;
use crate::bytes::{i16_be, u32_be};
use crate::recognise::{Evidence, Finding, Key, Traffic};
use crate::{Driver, Frame, Id, Recognise};
use alloc::vec::Vec;

/// The other status messages: charge, energy, inputs.
const OTHERS: [u8; 3] = [0x0E, 0x0F, 0x3A];
/// The fastest that a motor turns \[electrical rev/min\], the largest current \[0.1 A\].
const ERPM: u32 = 500_000;
const CURRENT: u16 = 10_000;
/// What thermometers tell, also those that are not there \[0.1 degrees Celsius\].
const TENTHS: core::ops::RangeInclusive<i16> = -1000..=2500;
/// The highest supply \[0.1 V\].
const SUPPLY: i16 = 1500;

fn id(address: u16, command: u8) -> Id {
    Id::extended(u32::from(command) << 8 | u32::from(address))
}

fn is_status(frame: &Frame) -> bool {
    let data = frame.data();
    let erpm = u32_be(data, 0).cast_signed().unsigned_abs();
    let [current, duty] = [4, 6].map(|at| i16_be(data, at).unsigned_abs());
    data.len() == LENGTH && erpm <= ERPM && current <= CURRENT && duty <= 1000
}

fn is_status_4(frame: &Frame) -> bool {
    let data = frame.data();
    let place = i64::from(i16_be(data, 6));
    let are_usual = [0, 2].iter().all(|at| TENTHS.contains(&i16_be(data, *at)));
    data.len() == LENGTH && are_usual && (0..=STEPS_PER_TURN).contains(&place)
}

fn is_status_5(frame: &Frame) -> bool {
    let data = frame.data();
    data.len() == LENGTH && (0..=SUPPLY).contains(&i16_be(data, 4)) && i16_be(data, 6) == 0
}

impl Recognise for VescOptions {
    fn recognise(seen: &Traffic) -> Vec<Finding> {
        let find = |address| controller(seen, address);
        (0..=ADDRESS_MOST).filter_map(find).collect()
    }
}

fn controller(seen: &Traffic, address: u16) -> Option<Finding> {
    let mut evidence = Evidence::new(seen, usize::from(ADDRESS_MOST) + 1);
    let status = evidence.sends(id(address, command::STATUS), is_status);
    let pid = evidence.sends(id(address, command::STATUS_4), is_status_4);
    let tachometer = evidence.sends(id(address, command::STATUS_5), is_status_5);
    if status.is_none() {
        evidence.lacks();
    }
    for command in OTHERS {
        evidence.sends_length(id(address, command), LENGTH);
    }
    let finding = evidence.finding(VescOptions::NAME, address.into(), "VESC motor controller")?;
    let pairs = Key::fill_in("pole_pairs", 7, "of the motor");
    let with_position = pid.or(tachometer);
    let position =
        (pid.is_none() && tachometer.is_some()).then(|| Key::new("position", "\"tachometer\""));
    let period = with_position.and_then(|stream| Key::period_ms(stream.period(), 1, 60_000));
    // Of its commands, those that move.
    let commands = (0..=0x0D_u8).filter(|command| *command != command::STATUS);
    let mut finding = finding
        .with_keys([pairs])
        .with_keys(position)
        .with_keys(period)
        .with_joints([0])
        .with_commands(commands.map(|command| id(address, command)..=id(address, command)));
    if with_position.is_none() {
        finding.unusable = "it sends no position: turn on status 4 or 5 in VESC Tool";
    }
    Some(finding)
}
