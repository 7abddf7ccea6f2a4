//! Reads .dbc files into the tables that drivers decode by. `can-dbc` parses; here its result is
//! checked and brought into the drivers' form.

use can_dbc::{ByteOrder, Dbc, MessageId, MultiplexIndicator, SignalExtendedValueType, ValueType};
use proprio_drivers::Id;
use proprio_drivers::signal::{Bits, Message, Raw, Signal, Switch};
use std::path::Path;

/// The message under which editors keep signals that belong to none.
const NO_MESSAGE: &str = "VECTOR__INDEPENDENT_SIG_MSG";

/// The messages of `file`.
///
/// # Errors
/// A message with the file, the place and the problem.
pub(crate) fn read(file: &Path) -> Result<Vec<Message>, String> {
    let at = |problem: String| format!("{}: {problem}", file.display());
    text(file).and_then(|text| parse(&text)).map_err(at)
}

/// The text of a file that describes a device.
pub(crate) fn text(file: &Path) -> Result<String, String> {
    let bytes = std::fs::read(file).map_err(|e| format!("cannot be read: {e}"))?;
    // Most editors write Windows-1252, whose letters and degree signs are those of Latin-1.
    let text = String::from_utf8(bytes);
    Ok(text.unwrap_or_else(|e| e.as_bytes().iter().copied().map(char::from).collect()))
}

fn parse(text: &str) -> Result<Vec<Message>, String> {
    let file = Dbc::try_from(text).map_err(|e| format!("is no .dbc file: {e}"))?;
    let messages = file.messages.iter().filter(|m| m.name != NO_MESSAGE);
    let message = |message: &can_dbc::Message| {
        message_of(&file, message).map_err(|e| format!("message {:?}: {e}", message.name))
    };
    messages.map(message).collect()
}

fn message_of(file: &Dbc, message: &can_dbc::Message) -> Result<Message, String> {
    let id = match message.id {
        MessageId::Standard(raw) if raw > 0x7FF => {
            return Err(format!(
                "its identifier {raw:#x} has more than 11 bits; that of an extended frame is \
                 written plus 2147483648"
            ));
        }
        MessageId::Standard(raw) => Id::standard(raw),
        MessageId::Extended(raw) => Id::extended(raw),
    };
    if message.size > 64 {
        return Err(format!("its length {} is above 64 bytes", message.size));
    }
    let signal = |signal: &can_dbc::Signal| {
        signal_of(file, message, signal).map_err(|e| format!("signal {:?}: {e}", signal.name))
    };
    Ok(Message {
        name: message.name.clone(),
        id,
        size: usize::try_from(message.size).unwrap_or(0),
        signals: message
            .signals
            .iter()
            .map(signal)
            .collect::<Result<_, _>>()?,
    })
}

fn signal_of(
    file: &Dbc,
    message: &can_dbc::Message,
    signal: &can_dbc::Signal,
) -> Result<Signal, String> {
    let big_endian = signal.byte_order == ByteOrder::BigEndian;
    let bits = Bits::new(signal.start_bit, signal.size, big_endian).ok_or_else(|| {
        format!(
            "{} bits from bit {} on are none, more than 64, or beyond 64 bytes",
            signal.size, signal.start_bit
        )
    })?;
    let mut types = file.signal_extended_value_type_list.iter();
    let float = types
        .find(|t| t.message_id == message.id && t.signal_name == signal.name)
        .map(|t| t.signal_extended_value_type);
    let raw = match (float, signal.value_type) {
        (Some(SignalExtendedValueType::IEEEfloat32Bit), _) => Raw::Float32,
        (Some(SignalExtendedValueType::IEEEdouble64bit), _) => Raw::Float64,
        (_, ValueType::Signed) => Raw::Signed,
        (_, ValueType::Unsigned) => Raw::Unsigned,
    };
    let right = match raw {
        Raw::Float32 => signal.size == 32,
        Raw::Float64 => signal.size == 64,
        Raw::Signed | Raw::Unsigned => true,
    };
    if !right {
        return Err(format!("a floating-point number of {} bits", signal.size));
    }
    if signal.factor == 0.0 || !signal.factor.is_finite() || !signal.offset.is_finite() {
        return Err(format!(
            "factor {} and offset {} must be numbers, and the factor other than 0",
            signal.factor, signal.offset
        ));
    }
    Ok(Signal {
        name: signal.name.clone(),
        bits,
        raw,
        factor: signal.factor,
        offset: signal.offset,
        unit: signal.unit.clone(),
        switch: switch_of(file, message, signal)?,
    })
}

/// The frames that have `signal`.
fn switch_of(
    file: &Dbc,
    message: &can_dbc::Message,
    signal: &can_dbc::Signal,
) -> Result<Option<Switch>, String> {
    use MultiplexIndicator::{
        MultiplexedSignal, Multiplexor, MultiplexorAndMultiplexedSignal, Plain,
    };
    let value = match signal.multiplexer_indicator {
        Plain | Multiplexor => return Ok(None),
        MultiplexedSignal(value) | MultiplexorAndMultiplexedSignal(value) => value,
    };
    let mut extended = file.extended_multiplex.iter();
    if let Some(found) =
        extended.find(|e| e.message_id == message.id && e.signal_name == signal.name)
    {
        let ranges = found.mappings.iter().map(|m| (m.min_value, m.max_value));
        return Ok(Some(Switch {
            signal: found.multiplexor_signal_name.clone(),
            ranges: ranges.collect(),
        }));
    }
    // Without such an entry there is one multiplexor.
    let multiplexor = message
        .signals
        .iter()
        .find(|s| s.multiplexer_indicator == Multiplexor);
    match multiplexor {
        Some(multiplexor) => Ok(Some(Switch {
            signal: multiplexor.name.clone(),
            ranges: vec![(value, value)],
        })),
        None => Err("it is multiplexed, but the message has no multiplexor".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEAD: &str = "VERSION \"\"\n\nNS_ :\n\nBS_:\n\nBU_: Node\n\n";

    fn problem(text: &str) -> String {
        parse(&format!("{HEAD}{text}")).unwrap_err()
    }

    #[test]
    fn mistakes_have_a_place() {
        for (text, expected) in [
            (
                "BO_ 4096 Far: 8 Node\n",
                "message \"Far\": its identifier 0x1000 has more than",
            ),
            (
                "BO_ 1 M: 8 Node\n SG_ S : 0|65@1+ (1,0) [0|0] \"\" Node\n",
                "message \"M\": signal \"S\": 65 bits from bit 0",
            ),
            (
                "BO_ 1 M: 8 Node\n SG_ S : 0|16@1+ (0,0) [0|0] \"\" Node\n",
                "factor 0 and offset 0",
            ),
            (
                "BO_ 1 M: 8 Node\n SG_ S : 0|16@1- (1,0) [0|0] \"\" Node\nSIG_VALTYPE_ 1 S : 1;\n",
                "a floating-point number of 16 bits",
            ),
            (
                "BO_ 1 M: 8 Node\n SG_ S m3 : 0|16@1- (1,0) [0|0] \"\" Node\n",
                "has no multiplexor",
            ),
            ("BO_ what\n", "is no .dbc file"),
        ] {
            let problem = problem(text);
            assert!(problem.contains(expected), "{text}: {problem}");
        }
    }

    #[test]
    fn files_of_windows_editors_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a.dbc");
        let text = format!("{HEAD}BO_ 2147483650 M: 8 Node\n SG_ S : 7|8@0- (1,0) [0|0] \"");
        let bytes = [text.as_bytes(), b"\xb0/s\" Node\n"].concat();
        std::fs::write(&file, bytes).unwrap();
        let messages = read(&file).unwrap();
        assert_eq!(messages[0].id, Id::extended(2));
        assert_eq!(messages[0].signals[0].unit, "\u{b0}/s");
        let missing = read(&folder.path().join("b.dbc")).unwrap_err();
        assert!(missing.contains("b.dbc: cannot be read"), "{missing}");
    }
}
