//! Which parts of a changed configuration a running gateway can take over.
//!
//! Of a device: its driver's keys, `listen_only`, `max_silence_ms`, and of its joints ratio, sign,
//! offset and the keys of their turns. Everything that buses, filters, channels or other processes
//! rest on needs a restart of the gateway: also which device gives what of a joint (`takes`), and
//! couplings.

use crate::joints::{JointsPlan, Matrix, ShaftRole, Takes};
use crate::plan::{BusPlan, DevicePlan, OutputPlan, Plan};
use proprio_drivers::Claim;
use std::collections::BTreeSet;

/// What changes of a device.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct DeviceChange {
    /// The number of the bus, and of the device on it.
    pub(crate) device: (usize, u16),
    /// Its keys, in words.
    pub(crate) what: Vec<&'static str>,
    /// Whether another device takes over and starts from bring-up.
    pub(crate) restarts: bool,
}

/// The changes from `old` to `new`; none of a device that is equal.
///
/// # Errors
/// The places in the file whose change needs a restart of the gateway.
pub(crate) fn changes(old: &Plan, new: &Plan) -> Result<Vec<DeviceChange>, Vec<String>> {
    let mut blocked = Vec::new();
    if old.robot != new.robot {
        blocked.push("robot".to_owned());
    }
    compare_lists("", "bus", &old.buses, &new.buses, |b| &b.name, &mut blocked);
    for new_bus in &new.buses {
        if let Some(old_bus) = old.buses.iter().find(|b| b.name == new_bus.name) {
            compare_buses((old, old_bus), (new, new_bus), &mut blocked);
        }
    }
    if !blocked.is_empty() {
        return Err(blocked);
    }
    let buses = old.buses.iter().zip(&new.buses).zip(0..);
    let devices = buses.flat_map(|((old, new), bus)| {
        let pairs = old.devices.iter().zip(&new.devices).zip(0..);
        pairs.filter_map(move |((old, new), device)| change((bus, device), old, new))
    });
    Ok(devices.collect())
}

/// Names what was added to, removed from or moved in a list.
fn compare_lists<'a, T>(
    place: &str,
    kind: &str,
    old: &'a [T],
    new: &'a [T],
    name: impl Fn(&'a T) -> &'a str,
    blocked: &mut Vec<String>,
) {
    let names = |list: &'a [T]| -> Vec<&'a str> { list.iter().map(&name).collect() };
    let (old, new) = (names(old), names(new));
    let sets = [&old, &new].map(|list| list.iter().copied().collect::<BTreeSet<_>>());
    let [before, after] = &sets;
    for added in after.difference(before) {
        blocked.push(format!("{place}{kind} {added:?}: added"));
    }
    for removed in before.difference(after) {
        blocked.push(format!("{place}{kind} {removed:?}: removed"));
    }
    if before == after && old != new {
        blocked.push(format!("{place}the order of [[{kind}]]"));
    }
}

fn compare_buses(old: (&Plan, &BusPlan), new: (&Plan, &BusPlan), blocked: &mut Vec<String>) {
    let ((old_plan, old_bus), (new_plan, new_bus)) = (old, new);
    let (old, new) = (old_bus, new_bus);
    let place = format!("bus {:?}", new.name);
    let keys = [
        ("source", old.source == new.source),
        ("realtime", old.realtime == new.realtime),
        ("listen_only", old.listen_only == new.listen_only),
    ];
    for (key, _) in keys.iter().filter(|(_, equal)| !equal) {
        blocked.push(format!("{place}: {key}"));
    }
    if couplings(&old.joints) != couplings(&new.joints) {
        blocked.push(format!("{place}: couplings"));
    }
    let inside = format!("{place}, ");
    compare_lists(
        &inside,
        "device",
        &old.devices,
        &new.devices,
        |d| &d.name,
        blocked,
    );
    for new in &new.devices {
        let Some(old) = old.devices.iter().find(|old| old.name == new.name) else {
            continue;
        };
        let place = format!("{inside}device {:?}", new.name);
        let claims = |device: &DevicePlan| -> Option<Vec<Claim>> {
            let built = device.options.device(&device.spec).ok()?;
            Some(built.claims().to_vec())
        };
        let channels = |plan: &Plan, bus: &BusPlan, device: &DevicePlan| -> Vec<_> {
            let outputs = device.outputs.iter();
            outputs
                .map(|output| {
                    let channel = plan.channels.get(output.channel as usize);
                    let input = output.input.as_ref();
                    let shaft = input.and_then(|input| bus.joints.shafts.get(input.shaft));
                    let takes = input
                        .and_then(|input| bus.joints.input(input))
                        .map(|s| s.takes);
                    let names = (
                        channel.map(|c| c.name.clone()),
                        shaft.map(|s| s.name.clone()),
                    );
                    (
                        output.number,
                        output.kind,
                        names,
                        shaft
                            .filter(|s| matches!(s.role, ShaftRole::Motor(..)))
                            .map(|s| s.role),
                        takes,
                    )
                })
                .collect()
        };
        if old.driver != new.driver {
            blocked.push(format!("{place}: driver"));
        } else if old.spec.address != new.spec.address {
            blocked.push(format!("{place}: address"));
        } else if claims(old) != claims(new) {
            blocked.push(format!("{place}: keys that change its identifiers"));
        }
        if channels(old_plan, old_bus, old) != channels(new_plan, new_bus, new) {
            blocked.push(format!("{place}: joints or outputs"));
        }
    }
}

/// A coupling, by the names of its joints and motors.
#[derive(PartialEq)]
struct Coupled<'p> {
    joints: Vec<&'p str>,
    motors: Vec<&'p str>,
    matrix: &'p Matrix,
    takes: Takes,
}

/// The couplings of a bus.
fn couplings(plan: &JointsPlan) -> Vec<Coupled<'_>> {
    let name = |shaft: usize| {
        let shaft = plan.shafts.get(shaft);
        shaft.map_or("", |shaft| shaft.name.as_str())
    };
    let each = plan.couplings.iter().map(|coupling| Coupled {
        joints: coupling.joints.iter().map(|at| name(at.shaft)).collect(),
        motors: coupling.motors.iter().map(|motor| name(*motor)).collect(),
        matrix: &coupling.matrix,
        takes: coupling.takes(plan),
    });
    each.collect()
}

/// What changes of one device of the same name, driver, address and channels.
fn change(device: (usize, u16), old: &DevicePlan, new: &DevicePlan) -> Option<DeviceChange> {
    let maps = |plan: &DevicePlan| -> Vec<_> {
        let wrap = |output: &OutputPlan| output.input.and_then(|input| input.wrap);
        plan.outputs.iter().map(|r| (r.map, wrap(r))).collect()
    };
    let keys = [
        ("keys of the driver", old.options != new.options),
        ("listen_only", old.spec.mode != new.spec.mode),
        (
            "max_silence_ms",
            old.spec.max_silence != new.spec.max_silence,
        ),
        ("joints", maps(old) != maps(new)),
    ];
    let what: Vec<_> = keys
        .iter()
        .filter(|(_, differs)| *differs)
        .map(|(key, _)| *key)
        .collect();
    let restarts = keys.iter().take(2).any(|(_, differs)| *differs);
    (!what.is_empty()).then_some(DeviceChange {
        device,
        what,
        restarts,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    const FILE: &str = r#"
schema = 1
robot = "r"
[[bus]]
name = "a"
source = { kind = "virtual", name = "a" }
[[bus.device]]
driver = "icub_strain"
name = "ft"
address = 1
[[bus.device]]
driver = "icub_imu"
name = "imu"
address = 2
[[bus]]
name = "b"
source = { kind = "virtual", name = "b" }
[[bus.device]]
driver = "icub_motor"
name = "elbow_motor"
address = 3
[[bus.device.joint]]
name = "elbow"
ratio = 100.0
"#;

    fn compared(changed: &str) -> Result<Vec<DeviceChange>, Vec<String>> {
        let plan = |text| Plan::parse(text, Path::new(".")).unwrap();
        assert_ne!(changed, FILE, "the text is not in the file");
        changes(&plan(FILE), &plan(changed))
    }

    #[test]
    fn a_device_can_change_what_nobody_else_rests_on() {
        let change = |device, what: &[&'static str], restarts| DeviceChange {
            device,
            what: what.to_vec(),
            restarts,
        };
        for (from, to, wanted) in [
            ("schema", "# Nothing.\nschema", None),
            (
                "ratio = 100.0",
                "ratio = 50",
                Some(change((1, 0), &["joints"], false)),
            ),
            (
                "ratio",
                "sign = -1\nratio",
                Some(change((1, 0), &["joints"], false)),
            ),
            (
                "ratio",
                "offset_rad = 0.1\nratio",
                Some(change((1, 0), &["joints"], false)),
            ),
            (
                "ratio",
                "wraps_rad = [0.0, 6.283185307179586]\ncentre_rad = 0.1\n\
                 max_speed_radps = 100.0\nratio",
                Some(change((1, 0), &["joints"], false)),
            ),
            (
                "address = 3",
                "address = 3\nmax_silence_ms = 7",
                Some(change((1, 0), &["max_silence_ms"], false)),
            ),
            (
                "address = 1",
                "address = 1\nperiod_ms = 2",
                Some(change((0, 0), &["keys of the driver"], true)),
            ),
            (
                "address = 2",
                "address = 2\nlisten_only = true\nmax_silence_ms = 7",
                Some(change((0, 1), &["listen_only", "max_silence_ms"], true)),
            ),
        ] {
            let wanted: Vec<_> = wanted.into_iter().collect();
            assert_eq!(compared(&FILE.replacen(from, to, 1)), Ok(wanted), "{to}");
        }
    }

    #[test]
    fn what_others_rest_on_needs_a_restart() {
        let bus = "[[bus]]\nname = \"c\"\nsource = { kind = \"virtual\", name = \"c\" }\n";
        let other = "[[bus.device]]\ndriver = \"icub_imu\"\nname = \"imu\"\naddress = 2\n";
        let removed = FILE.replace(other, "");
        for (text, wanted) in [
            (FILE.replace("\"r\"", "\"s\""), &["robot"][..]),
            (format!("{FILE}{bus}"), &["bus \"c\": added"]),
            (
                FILE.replace("name = \"b\"\n", "name = \"c\"\n"),
                &["bus \"c\": added", "bus \"b\": removed"],
            ),
            (
                FILE.replace("name = \"b\" }", "name = \"z\" }\nlisten_only = true"),
                &["bus \"b\": source", "bus \"b\": listen_only"],
            ),
            (
                FILE.replace("name = \"a\" }", "name = \"a\" }\nrealtime = { cpu = 1 }"),
                &["bus \"a\": realtime"],
            ),
            (removed.clone(), &["bus \"a\", device \"imu\": removed"]),
            (
                format!("{removed}{other}"),
                &[
                    "bus \"a\", device \"imu\": removed",
                    "bus \"b\", device \"imu\": added",
                ],
            ),
            (
                removed.replace(
                    "[[bus.device]]\ndriver = \"icub_strain\"",
                    &format!("{other}[[bus.device]]\ndriver = \"icub_strain\""),
                ),
                &["bus \"a\", the order of [[device]]"],
            ),
            (
                FILE.replace("address = 2", "address = 5"),
                &["bus \"a\", device \"imu\": address"],
            ),
            (
                FILE.replace("address = 2", "address = 2\nlegacy = \"mtb\""),
                &["bus \"a\", device \"imu\": keys that change its identifiers"],
            ),
            (
                FILE.replace("ratio", "takes = [\"position\"]\nratio"),
                &["bus \"b\", device \"elbow_motor\": joints or outputs"],
            ),
            (
                format!(
                    "{FILE}[[bus.coupling]]\njoints = [\"knee\"]\nmotors = [\"elbow\"]\n\
                     matrix = [[1.0]]\n"
                ),
                &[
                    "bus \"b\": couplings",
                    "bus \"b\", device \"elbow_motor\": joints or outputs",
                ],
            ),
            (
                FILE.replace("\"elbow\"", "\"knee\""),
                &["bus \"b\", device \"elbow_motor\": joints or outputs"],
            ),
        ] {
            assert_eq!(
                compared(&text),
                Err(wanted.iter().map(|w| (*w).to_owned()).collect())
            );
        }
    }

    /// What a coupling consists of needs a restart; the gears of its motors do not.
    #[test]
    fn a_coupling_is_not_changed_while_it_runs() {
        let second = "[[bus.device]]\ndriver = \"icub_motor\"\nname = \"other_motor\"\n\
                      address = 4\n[[bus.device.joint]]\nname = \"other\"\n";
        let coupled = format!(
            "{FILE}{second}[[bus.coupling]]\njoints = [\"a\", \"b\"]\n\
             motors = [\"elbow\", \"other\"]\nmatrix = [[1.0, 0.0], [1.0, 2.0]]\n"
        );
        let compared = |from: &str, to: &str| {
            let plan = |text: &str| Plan::parse(text, Path::new(".")).unwrap();
            assert!(coupled.contains(from), "{from}");
            changes(&plan(&coupled), &plan(&coupled.replacen(from, to, 1)))
        };
        let whole = vec!["bus \"b\": couplings".to_owned()];
        assert_eq!(compared("[1.0, 2.0]", "[1.0, 3.0]"), Err(whole.clone()));
        let takes = "takes = [\"position\", \"torque\"]\njoints = [\"a\"";
        assert_eq!(compared("joints = [\"a\"", takes), Err(whole.clone()));
        let swapped = compared("[\"elbow\", \"other\"]", "[\"other\", \"elbow\"]");
        assert_eq!(swapped.unwrap_err()[0], whole[0]);
        let gear = compared("ratio = 100.0", "ratio = 50.0").unwrap();
        assert_eq!((gear.len(), gear[0].what.as_slice()), (1, &["joints"][..]));
        assert_eq!(compared("schema", "# Nothing.\nschema"), Ok(vec![]));
        // The turns of a motor alone.
        let turns = |centre: f64| {
            let keys = format!(
                "wraps_rad = [0.0, 3.0]\ncentre_rad = {centre}\nmax_speed_radps = 9.0\nratio"
            );
            Plan::parse(&coupled.replacen("ratio", &keys, 1), Path::new(".")).unwrap()
        };
        assert_eq!(changes(&turns(0.1), &turns(0.1)), Ok(vec![]));
        let gear = changes(&turns(0.1), &turns(0.2)).unwrap();
        assert_eq!(gear[0].what.as_slice(), &["joints"][..]);
    }
}
