//! The plan as a readable table, which `proprio gateway --check` prints.

use super::{BusPlan, ChannelPlan, DevicePlan, OutputPlan, Plan, bit_rate, wiring};
use crate::config::{FrameSource, Pace};
use crate::joints::{CouplingPlan, JointMap, JointsPlan, ShaftInput, ShaftRole, Takes};
use crate::link::adapter::Adapter;
use crate::log::Stamps;
use proprio_drivers::Mode;
use std::fmt::{self, Formatter, Write as _};

impl fmt::Display for Plan {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "robot {}: {} buses, {} channels",
            self.robot,
            self.buses.len(),
            self.channels.len()
        )?;
        for bus in &self.buses {
            show_bus(f, bus)?;
            for device in &bus.devices {
                show_device(f, device)?;
                for output in &device.outputs {
                    if let Some(channel) = self.channels.get(output.channel as usize) {
                        show_output(f, &bus.joints, output, channel)?;
                    }
                }
            }
            for coupling in &bus.joints.couplings {
                show_coupling(f, &bus.joints, coupling)?;
            }
        }
        writeln!(f, "\n* shared with other devices of the same board")
    }
}

/// A bus without its devices.
fn show_bus(f: &mut Formatter<'_>, bus: &BusPlan) -> fmt::Result {
    write!(f, "\nbus {}: {}", bus.name, source(&bus.source))?;
    if let Some(realtime) = bus.realtime {
        realtime
            .cpu
            .map_or(Ok(()), |cpu| write!(f, ", cpu {cpu}"))?;
        realtime
            .priority
            .map_or(Ok(()), |p| write!(f, ", SCHED_FIFO {p}"))?;
    }
    if bus.listen_only {
        write!(f, ", listens only")?;
    }
    writeln!(
        f,
        "\n  load at most {:.0} % of {}{}, {:.0} frames/s{}",
        bus.load.share * 100.0,
        bit_rate(bus.rates.nominal),
        if bus.rates_assumed { " (assumed)" } else { "" },
        bus.load.frames,
        if bus.load.is_high() {
            "; above 70 % frames of low priority come late, and there is no room for others"
        } else {
            ""
        }
    )?;
    for device in &bus.devices {
        if !device.options.states_period() {
            writeln!(f, "  without {:?}: its period_ms is not given", device.name)?;
        }
    }
    Ok(())
}

/// A source of frames in words.
fn source(source: &FrameSource) -> String {
    match source {
        FrameSource::SocketCan(Adapter::Interface(name)) => format!("CAN interface {name}"),
        FrameSource::SocketCan(named) => format!("CAN adapter with {named}"),
        FrameSource::Virtual { name } => format!("virtual bus {name}"),
        FrameSource::Replay { log, pace, stamps } => {
            let pace = match pace {
                Pace::Fast => "fast",
                Pace::Recorded => "as recorded",
            };
            let stamps = match stamps {
                Stamps::Detect => "",
                Stamps::SinceStart => ", stamps since its start",
                Stamps::SincePrevious => ", stamps since the previous line",
            };
            format!("log {} ({pace}{stamps})", log.display())
        }
    }
}

/// A device without its outputs.
fn show_device(f: &mut Formatter<'_>, device: &DevicePlan) -> fmt::Result {
    let mut ids = String::new();
    if let Ok(built) = device.options.device(&device.spec) {
        for claim in built.claims() {
            let shared = if claim.exclusive { "" } else { "*" };
            write!(ids, " {}{shared}", claim.id)?;
        }
    }
    let listen = match device.spec.mode {
        Mode::Listen => ", listens only",
        Mode::Supervise => "",
    };
    writeln!(
        f,
        "  {} ({}, address {}{listen}): identifiers{ids}",
        device.name, device.driver, device.spec.address
    )
}

/// An output of a device, and its way to the channel.
fn show_output(
    f: &mut Formatter<'_>,
    joints: &JointsPlan,
    output: &OutputPlan,
    channel: &ChannelPlan,
) -> fmt::Result {
    write!(
        f,
        "    channel {:>3} {} {}",
        output.channel,
        channel.kind.word(),
        channel.name
    )?;
    if let Some(input) = &output.input {
        show_input(f, joints, output, input)?;
    }
    writeln!(f, ", stale after {} s", channel.max_silence)
}

/// The way of a device's output to a joint.
fn show_input(
    f: &mut Formatter<'_>,
    joints: &JointsPlan,
    output: &OutputPlan,
    input: &ShaftInput,
) -> fmt::Result {
    let shaft = joints.shafts.get(input.shaft);
    if let Some(motor) = shaft.filter(|s| matches!(s.role, ShaftRole::Motor(..))) {
        write!(f, ", by the coupling; motor {}", motor.name)?;
    }
    let JointMap { gain, offset } = output.map;
    write!(
        f,
        " = {gain} * output {} of the device {offset:+} rad",
        output.number
    )?;
    let takes = joints.input(input).map_or(Takes::ALL, |input| input.takes);
    show_takes(f, takes)?;
    if let Some(wrap) = input.wrap {
        let (centre, half) = (gain * wrap.centre + offset, 0.5 * (gain * wrap.range).abs());
        write!(
            f,
            ", turns counted, certain over {} s, else right from {:.4} to {:.4} rad",
            wrap.certain,
            centre - half,
            centre + half
        )?;
    }
    Ok(())
}

fn show_takes(f: &mut Formatter<'_>, takes: Takes) -> fmt::Result {
    if takes == Takes::ALL {
        return Ok(());
    }
    let words: Vec<_> = takes.quantities().map(wiring::word).collect();
    write!(f, " ({} alone)", words.join(", "))
}

/// The rows of a coupling.
fn show_coupling(
    f: &mut Formatter<'_>,
    joints: &JointsPlan,
    coupling: &CouplingPlan,
) -> fmt::Result {
    let name = |shaft: usize| joints.shafts.get(shaft).map_or("", |shaft| &shaft.name);
    let condition = coupling.matrix.condition();
    write!(f, "  coupling, condition number {condition:.1}")?;
    show_takes(f, coupling.takes(joints))?;
    writeln!(f)?;
    for (number, joint) in coupling.joints.iter().enumerate() {
        let weights = coupling.matrix.row(number).zip(&coupling.motors);
        let used = weights.filter(|(weight, _)| *weight != 0.0);
        let terms = used.map(|(weight, motor)| format!("{weight} * {}", name(*motor)));
        writeln!(
            f,
            "    {} = {}",
            name(joint.shaft),
            terms.collect::<Vec<_>>().join(" + ")
        )?;
    }
    Ok(())
}
