//! Which messages of a .dbc file are meant, by name, identifier, address, or group of J1939.

use super::{DRIVE, WRENCH, at, half, messages, numbers, problem};
use crate::rig::{count, decode, encode, listener, options, spec};
use proprio_drivers::signal::Message;
use proprio_drivers::{Frame, Id, Mode};
use proprio_topics::{Counter, Quality, Reading, Temperature};

/// The address is added to the identifiers, so that one file serves every node.
#[test]
fn the_address_shifts_the_identifiers() {
    let options = options("dbc", WRENCH);
    let device = options.device(&spec(0x100, Mode::Listen, &[])).unwrap();
    let ids: Vec<Id> = device.claims().iter().map(|claim| claim.id).collect();
    assert_eq!(ids, [0x110, 0x111, 0x113].map(Id::standard));
    let problem = options.device(&spec(0x7F0, Mode::Listen, &[])).map(|_| ());
    let problem = problem.unwrap_err().to_string();
    assert!(
        problem.contains("the identifier 0x010 plus address is too large"),
        "{problem}"
    );
}

/// Mistakes are told in the words of the keys and of the file.
#[test]
fn mistakes_are_told() {
    let hold = |ms: &str| DRIVE.replace("torque = 100.0", &format!("torque = {ms}"));
    let units = |units: &str| format!("{WRENCH}units = {{ {units} }}\n");
    let path = |path: &str| WRENCH.replace("F.X", path);
    for (keys, told) in [
        (WRENCH.to_owned(), None),
        (hold("0.001"), None),
        (hold("3600000.0"), None),
        (hold("0.0"), Some("hold_ms.torque = 0 must be above 0")),
        (hold("-1.0"), Some("hold_ms.torque = -1 must be above 0")),
        (hold("3600000.1"), Some("at most an hour")),
        (hold("nan"), Some("hold_ms.torque = NaN must be above 0")),
        (
            DRIVE.replace("hold_ms = { torque", "hold_ms = { current"),
            Some("hold_ms.current: fields.current is missing"),
        ),
        (
            DRIVE.replace("hold_ms = {", "units = { current = \"A\" }\nhold_ms = {"),
            Some("units.current: fields.current is missing"),
        ),
        (
            path("G.X"),
            Some("no message \"G\"; it has F, T, Motion, State, Page"),
        ),
        (path("F.W"), Some("no signal \"W\"; it has X, Y, Z, Count")),
        (path("T.X"), Some("its unit \"Nm\" does not fit")),
        (
            path("F.Count"),
            Some("the file gives no unit: add units = { fx = "),
        ),
        (units("fx = \"\""), Some("its unit \"\" does not fit")),
        (units("fx = \"rad\""), Some("its unit \"rad\" does not fit")),
        (units("fx = \"*\""), Some("its unit \"*\" is not known")),
        (units("fx = \"--\""), Some("its unit \"--\" is not known")),
        (units("fx = \"kN\""), None),
        (
            units("fx = \"MN\""),
            Some("its unit \"MN\" is not known: m is a thousandth, and M a million: add units"),
        ),
        (
            units("fx = \"10 N\""),
            Some("its unit \"10 N\" has a number: if the file's factor 0.01 holds it already"),
        ),
    ] {
        let problem = problem(&keys, messages(), 0);
        assert_eq!(problem.is_some(), told.is_some(), "{keys}{problem:?}");
        let problem = problem.unwrap_or_default();
        assert!(problem.contains(told.unwrap_or_default()), "{problem}");
    }
    // Of a long file some are named.
    let mut many = messages();
    many.extend((0..9).map(|n| Message {
        name: format!("More{n}"),
        ..messages()[0].clone()
    }));
    let text = problem(&path("G.X"), many, 0).unwrap();
    assert!(text.contains("More5, More6 and 2 more"), "{text}");
}

/// The gateway reads the file that the keys name.
#[test]
fn the_file_is_that_of_the_keys() {
    let keys = WRENCH.replace("device.dbc", "arm/left.dbc");
    assert_eq!(options("dbc", &keys).description(), Some("arm/left.dbc"));
    assert_eq!(options("odrive", "").description(), None);
}

/// Identifiers of 29 bits are shifted too, up to the largest one.
#[test]
fn the_address_shifts_long_identifiers() {
    let most = |id: u32, address| {
        let mut messages = messages();
        messages[0].id = Ok(Id::extended(id));
        let mut options = options("dbc", WRENCH);
        options.describe(messages);
        let device = options.device(&spec(address, Mode::Listen, &[])).ok()?;
        let ids = device.claims().iter().map(|claim| claim.id);
        ids.max()
    };
    assert_eq!(most(0x18FF_0000, 0x21), Some(Id::extended(0x18FF_0021)));
    assert_eq!(most(0x1FFF_FFF0, 0xF), Some(Id::extended(0x1FFF_FFFF)));
    assert_eq!(most(0x1FFF_FFF0, 0x10), None);
}

/// A simulated device sends the number that is read back as the value: less its offset, in steps
/// of its factor, in its unit.
#[test]
fn factor_offset_and_unit_are_those_of_the_file() {
    for (unit, celsius, raw) in [("degC", 60.0, 100), ("degF", 20.0, 108), ("K", -263.15, 50)] {
        let keys = format!(
            "file = \"device.dbc\"\n[[reading]]\nkind = \"temperature\"\n\
             fields.temperature = \"State.Temperature\"\nunits.temperature = \"{unit}\"\n"
        );
        let mut messages = messages();
        messages[3].signals[1].offset = -40.0;
        let mut options = options("dbc", &keys);
        options.describe(messages);
        let mut board = options.board(&spec(0, Mode::Supervise, &[])).unwrap();
        let reading = Reading::Temperature(Temperature { celsius });
        let sent = encode(&mut *board, 0, &reading, Quality::GOOD);
        assert_eq!(sent[0].data(), [0, raw, 0, 0, 0, 0, 0, 0], "{unit}");
    }
    // A pound-force inch, and counts, which have no unit.
    for (kind, field, unit, value) in [
        ("joint", "torque", "lbf-in", 0.112_984_829_027_616_7),
        ("joint", "torque", "lbf in", 0.112_984_829_027_616_7),
        ("actuator", "duty", "", 1.0),
        ("actuator", "duty", "-", 1.0),
        ("actuator", "duty", "%", 0.01),
    ] {
        let keys = format!(
            "file = \"device.dbc\"\n[[reading]]\nkind = \"{kind}\"\n\
             fields.{field} = \"State.Torque\"\nunits.{field} = \"{unit}\"\n"
        );
        let joints: &[u8] = if kind == "joint" { &[0] } else { &[] };
        let frame = at(0x13, &[0, 0, 50, 0, 0, 0, 0, 0], 1.0);
        let (readings, _) = decode(&mut *listener("dbc", &keys, joints), &[frame]);
        let value_read = match readings[0].reading {
            Reading::Joint(state) => state.torque,
            Reading::Actuator(actuator) => actuator.duty,
            other => panic!("{other:?}"),
        };
        assert!(
            (value_read / 50.0 / value - 1.0).abs() < 1e-12,
            "{unit}: {value_read}"
        );
    }
}

/// What a file has that can not be used is told to who names it, and to nobody else.
#[test]
fn what_can_not_be_used_harms_nothing_else() {
    let mut messages = messages();
    messages[2].id = Err("its identifier 0x1e36001e has more than 11 bits".to_owned());
    messages[3].signals[1].bits = Err("65 bits".to_owned());
    // That a unit is missing, too, is not the reason.
    for (message, signal) in [(2, 0), (3, 1)] {
        messages[message].signals[signal].unit = String::new();
    }
    let (readings, _) = {
        let mut options = options("dbc", WRENCH);
        options.describe(messages.clone());
        let mut device = options.device(&spec(0, Mode::Listen, &[])).unwrap();
        decode(&mut *device, &[half(false, 7, 1.0), half(true, 7, 1.5)])
    };
    assert_eq!(numbers(&readings), [(7, 7)]);
    let named = |keys: &str| problem(keys, messages.clone(), 0).unwrap();
    let text = named(DRIVE);
    assert!(text.contains("0x1e36001e has more than 11 bits"), "{text}");
    let text = named(
        "file = \"device.dbc\"\n[[reading]]\nkind = \"temperature\"\n\
         fields.temperature = \"State.Temperature\"\n",
    );
    assert!(text.contains("State.Temperature\": 65 bits"), "{text}");
}

/// Long names and short ones; an identifier where one name is that of two messages.
#[test]
fn messages_have_two_names_and_an_identifier() {
    let keys = |path: &str| {
        format!(
            "file = \"device.dbc\"\n[[reading]]\nkind = \"temperature\"\n\
             fields.temperature = \"{path}\"\n"
        )
    };
    let mut messages = messages();
    messages[3].long_name = Some("StateOfTheMotor".to_owned());
    messages[3].signals[1].long_name = Some("TemperatureOfTheMotor".to_owned());
    let celsius = |path: &str, messages: &[Message], id| {
        let mut options = options("dbc", &keys(path));
        options.describe(messages.to_vec());
        let mut device = options.device(&spec(0, Mode::Listen, &[])).unwrap();
        let frame = Frame::new(id, &[0, 100, 0, 0, 0, 0, 0, 0]);
        decode(&mut *device, &[frame]).0.len()
    };
    let id = Id::standard(0x13);
    for path in [
        "State.Temperature",
        "StateOfTheMotor.TemperatureOfTheMotor",
        "StateOfTheMotor.Temperature",
        "0x013.Temperature",
    ] {
        assert_eq!(celsius(path, &messages, id), 1, "{path}");
    }
    // The same message twice is no other one.
    messages.push(messages[3].clone());
    assert_eq!(celsius("State.Temperature", &messages, id), 1);
    messages[5].id = Ok(Id::extended(0x13));
    let text = problem(&keys("State.Temperature"), messages.clone(), 0).unwrap();
    assert!(
        text.contains(
            "several messages \"State\": StateOfTheMotor 0x013, StateOfTheMotor 0x00000013"
        ),
        "{text}"
    );
    assert!(
        text.contains("write the identifier of one of them"),
        "{text}"
    );
    assert_eq!(celsius("0x013.Temperature", &messages, id), 1);
    assert_eq!(
        celsius("0x013.Temperature", &messages, Id::extended(0x13)),
        0
    );
    assert_eq!(
        celsius("0x00000013.Temperature", &messages, Id::extended(0x13)),
        1
    );
    let text = problem(&keys("0x77.Temperature"), messages.clone(), 0).unwrap();
    assert!(text.contains("no message with this identifier"), "{text}");
    // Neither its name nor its identifier tells it from another.
    let mut twice = messages.clone();
    twice[5].id = Ok(Id::standard(0x13));
    twice[5].size = 4;
    for path in ["State.Temperature", "0x013.Temperature"] {
        let text = problem(&keys(path), twice.clone(), 0).unwrap();
        assert!(text.contains("several messages"), "{text}");
        assert!(
            text.contains("give each another name in the file"),
            "{text}"
        );
    }
    twice[5].name = "Other".to_owned();
    twice[5].long_name = None;
    let text = problem(&keys("0x013.Temperature"), twice.clone(), 0).unwrap();
    assert!(text.contains("write the name of one of them"), "{text}");
    assert_eq!(celsius("State.Temperature", &twice, id), 1);
    let again = messages[3].signals[1].clone();
    messages[3].signals.push(again);
    let text = problem(&keys("0x013.Temperature"), messages, 0).unwrap();
    assert!(text.contains("several signals \"Temperature\""), "{text}");
}

/// A message of J1939 with one temperature, and its file.
fn group(ids: &[u32]) -> Vec<Message> {
    let message = |(number, id): (usize, &u32)| Message {
        name: format!("G{number}"),
        id: Ok(Id::extended(*id)),
        j1939: true,
        ..messages()[3].clone()
    };
    ids.iter().enumerate().map(message).collect()
}

/// The parameter group counts, and what the keys ask for.
#[test]
fn frames_of_j1939_are_told_by_their_group() {
    let ids = |more: &str, file: &[u32], heard: &[u32]| {
        let keys = format!(
            "file = \"device.dbc\"\n{more}\n[[reading]]\nkind = \"temperature\"\n\
             fields.temperature = \"G0.Temperature\"\n"
        );
        let mut options = options("dbc", &keys);
        options.describe(group(file));
        let spec = spec(0, Mode::Listen, &[]);
        let mut device = options.device(&spec).unwrap();
        let claims = device.claims().to_vec();
        let read = |id: &&u32| {
            let frame = Frame::new(Id::extended(**id), &[0, 100, 0, 0, 0, 0, 0, 0]);
            let is_read = !decode(&mut *device, &[frame]).0.is_empty();
            // The kernel's filters pass it.
            assert_eq!(claims.iter().any(|claim| claim.matches(frame.id)), is_read);
            is_read
        };
        let found: Vec<u32> = heard.iter().filter(read).copied().collect();
        // A simulated device is heard.
        let mut board = options.board(&spec).unwrap();
        let reading = Reading::Temperature(Temperature { celsius: 1.0 });
        let sent = encode(&mut *board, 0, &reading, Quality::GOOD);
        assert_eq!(
            decode(&mut *options.device(&spec).unwrap(), &sent).0.len(),
            1
        );
        found
    };
    let heard = [
        0x0CF0_0400,
        0x18F0_0417,
        0x0CF0_04FE,
        0x0CF0_0500,
        0x0DF0_0400,
    ];
    let engine = [0x0CF0_04FE];
    assert_eq!(ids("", &engine, &heard), heard[..3]);
    assert_eq!(ids("source_address = 0x17", &engine, &heard), heard[1..2]);
    assert_eq!(ids("priority = 6", &engine, &heard), heard[1..2]);
    assert_eq!(ids("j1939 = false", &engine, &heard), heard[2..3]);
    // A group without a destination.
    assert_eq!(ids("destination_address = 4", &engine, &heard), heard[..3]);
    // A group with one.
    let heard = [0x18EF_2305, 0x0CEF_FF07, 0x18EF_2405, 0x18EE_2305];
    let proprietary = [0x18EF_2305];
    assert_eq!(ids("", &proprietary, &heard), heard[..3]);
    assert_eq!(
        ids("destination_address = 0xFF", &proprietary, &heard),
        heard[1..2]
    );
    // Several messages of one group are told by their addresses.
    let both = [0x18EF_2305, 0x18EF_2306];
    assert_eq!(
        ids("", &both, &[0x18EF_2306, 0x0CEF_2305, 0x18EF_2405]),
        [0x0CEF_2305]
    );

    let keys = "file = \"device.dbc\"\n[[reading]]\nkind = \"temperature\"\n\
                fields.temperature = \"G0.Temperature\"\n";
    let text = problem(keys, group(&engine), 1).unwrap();
    assert!(
        text.contains("source_address tells the devices apart"),
        "{text}"
    );
    let asks = format!("source_address = 3\nj1939 = false\n{keys}");
    let text = problem(&asks, group(&engine), 0).unwrap();
    assert!(
        text.contains("source_address: none of its messages is one of J1939"),
        "{text}"
    );
}

/// Two devices send the same two messages: their halves are never combined.
#[test]
fn halves_of_two_senders_are_never_combined() {
    let mut messages = messages();
    for (message, group) in messages.iter_mut().zip([0xFF10, 0xFF11]) {
        message.id = Ok(Id::extended(0x1800_0000 | group << 8 | 0xFE));
        message.j1939 = true;
    }
    let keys = WRENCH.replace("counter = \"F.Count\"\nfault = \"State.Error\"\n", "");
    let mut options = options("dbc", &keys);
    options.describe(messages);
    let mut device = options.device(&spec(0, Mode::Listen, &[])).unwrap();
    let half = |second: u32, source: u32, n: u8, ms| {
        let id = Id::extended(0x18FF_1000 | second << 8 | source);
        let frame = half(false, n, ms);
        Frame::new(id, frame.data()).at(frame.t, frame.stamp)
    };
    let frames = [
        half(0, 5, 1, 0.0),
        half(0, 6, 2, 0.1),
        half(1, 6, 2, 0.2),
        half(1, 5, 1, 0.3),
        half(0, 6, 3, 10.0),
        half(1, 6, 3, 10.1),
    ];
    let (readings, faults) = decode(&mut *device, &frames);
    assert_eq!(numbers(&readings), [(1, 1), (3, 3)]);
    assert_eq!(count(&faults, Counter::Unexpected), 2);
}
