//! Reads .dbc files into the tables that drivers decode by.
//!
//! Only what these tables need is read: messages (`BO_`), signals (`SG_`), floating-point numbers
//! (`SIG_VALTYPE_`), the pages of extended multiplexing (`SG_MUL_VAL_`), and of the attributes
//! (`BA_`) long names and the format of identifiers. Whatever else is in a file, or is wrong with
//! it, does no harm. A message or signal that can not be used is kept with the reason, for whoever
//! asks for it.
//!
//! A statement begins with its keyword at the beginning of a line, behind a semicolon, or behind a
//! message or signal, outside of quotes.

use proprio_drivers::Id;
use proprio_drivers::signal::{Bits, Message, Raw, Signal, Switch};
use std::collections::HashMap;
use std::path::Path;

/// The message under which editors keep signals that belong to none.
const NO_MESSAGE: &str = "VECTOR__INDEPENDENT_SIG_MSG";
/// Bit 31 of an identifier: it is an extended one.
const EXTENDED: u64 = 1 << 31;

/// The messages of `file`.
///
/// # Errors
/// A message with the file and the problem.
pub(crate) fn read(file: &Path) -> Result<Vec<Message>, String> {
    let at = |problem: String| format!("{}: {problem}", file.display());
    text(file).and_then(|text| parse(&text)).map_err(at)
}

/// The text of a file that describes a device, without a byte order mark.
pub(crate) fn text(file: &Path) -> Result<String, String> {
    let bytes = std::fs::read(file).map_err(|e| format!("cannot be read: {e}"))?;
    let wide = |order: fn([u8; 2]) -> u16| {
        let units = bytes.chunks_exact(2).skip(1);
        let units = units.map(|pair| order([pair[0], pair[1]]));
        char::decode_utf16(units)
            .map(|c| c.unwrap_or(char::REPLACEMENT_CHARACTER))
            .collect()
    };
    Ok(match *bytes {
        [0xFF, 0xFE, ..] => wide(u16::from_le_bytes),
        [0xFE, 0xFF, ..] => wide(u16::from_be_bytes),
        _ => {
            let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(&bytes);
            // Most editors write Windows-1252, whose letters and degree signs are those of Latin-1.
            let latin = || bytes.iter().copied().map(char::from).collect();
            std::str::from_utf8(bytes).map_or_else(|_| latin(), str::to_owned)
        }
    })
}

/// The statements of a file. Each begins on a line of its own or behind the semicolon of another.
fn statements(text: &str) -> impl Iterator<Item = &str> {
    let mut begins: Vec<usize> = Vec::new();
    let (mut is_quoted, mut is_fresh, mut is_remark) = (false, true, false);
    for (at, c) in text.char_indices() {
        let rest = &text[at..];
        if matches!(c, '\n' | '\r') {
            (is_fresh, is_remark) = (!is_quoted, false);
        } else if is_fresh && !c.is_whitespace() {
            is_fresh = false;
            let end = rest.find(|c: char| !c.is_ascii_uppercase() && c != '_');
            if rest[..end.unwrap_or(rest.len())].ends_with('_') {
                begins.push(at);
            }
        }
        is_remark |= !is_quoted && rest.starts_with("//");
        is_fresh |= c == ';' && !is_quoted && !is_remark;
        if c == '"' && !is_remark {
            // Comments hold quotes that nothing marks. The last one is before the semicolon.
            let begin = begins.last().copied().unwrap_or_default();
            let is_comment = text[begin..].starts_with("CM_");
            let ends = rest[1..].trim_start().starts_with(';');
            let is_marked = text[..at].ends_with('\\');
            is_quoted ^= !(is_quoted && !ends && (is_comment || is_marked));
        }
    }
    let ends = begins.clone().into_iter().skip(1).chain([text.len()]);
    begins
        .into_iter()
        .zip(ends)
        .map(|(begin, end)| &text[begin..end])
}

/// The words of a statement: names and numbers, one-letter signs, and texts behind a quote.
fn words(statement: &str) -> Vec<&str> {
    const SIGNS: &[char] = &[':', ';', ',', '|', '@', '(', ')', '[', ']'];
    let mut words = Vec::new();
    let mut rest = statement.trim_start();
    while let Some(first) = rest.chars().next() {
        let end = match first {
            '"' => rest[1..].find('"').map_or(rest.len(), |end| end + 1),
            sign if SIGNS.contains(&sign) => 1,
            _ => {
                let ends = |c: char| c.is_whitespace() || c == '"' || SIGNS.contains(&c);
                rest.find(ends).unwrap_or(rest.len())
            }
        };
        words.push(&rest[..end]);
        rest = rest[end..]
            .strip_prefix('"')
            .filter(|_| first == '"')
            .unwrap_or(&rest[end..]);
        rest = rest.trim_start();
    }
    words
}

/// The words of a statement, and of those that follow a message or signal on its line: no semicolon
/// ends these two.
fn parts(statement: &str) -> Vec<Vec<&str>> {
    const OPEN: [&str; 2] = ["BO_", "SG_"];
    let words = words(statement);
    let mut is_open = words.first().is_some_and(|first| OPEN.contains(first));
    let is_keyword = |word: &str| {
        let is_letter = |c: char| c.is_ascii_uppercase() || c == '_';
        word.ends_with('_') && word.chars().all(is_letter)
    };
    let goes_on = |_: &&str, next: &&str| {
        let begins = is_open && is_keyword(next);
        is_open &= !begins || OPEN.contains(next);
        !begins
    };
    words.chunk_by(goes_on).map(<[&str]>::to_vec).collect()
}

/// A message as the file has it.
struct MessageStatement<'t> {
    number: &'t str,
    name: &'t str,
    size: &'t str,
    signals: Vec<Vec<&'t str>>,
}

/// What other statements say of messages and signals, by the numbers of messages as they are
/// written, and by short names.
#[derive(Default)]
struct Statements<'t> {
    sections: Vec<MessageStatement<'t>>,
    floats: HashMap<(&'t str, &'t str), &'t str>,
    switches: HashMap<(&'t str, &'t str), Switch>,
    long_messages: HashMap<&'t str, &'t str>,
    long_signals: HashMap<(&'t str, &'t str), &'t str>,
    formats: HashMap<&'t str, &'t str>,
    /// The words that `formats` are numbers of.
    format_words: Vec<&'t str>,
    usual_format: &'t str,
    protocol: &'t str,
}

impl<'t> Statements<'t> {
    fn new(text: &'t str) -> Self {
        let mut this = Self::default();
        for statement in statements(text).flat_map(parts) {
            match *statement {
                ["BO_", number, name, ":", size, ..] => this.sections.push(MessageStatement {
                    number,
                    name,
                    size,
                    signals: Vec::new(),
                }),
                ["SG_", ref signal @ ..] => {
                    if let Some(section) = this.sections.last_mut() {
                        section.signals.push(signal.to_vec());
                    }
                }
                ["SIG_VALTYPE_", number, name, ":", kind, ..]
                | ["SIG_VALTYPE_", number, name, kind, ..] => {
                    this.floats.insert((number, name), kind);
                }
                ["SG_MUL_VAL_", number, name, multiplexor, ref ranges @ ..] => {
                    if let Some(switch) = switch_of(multiplexor, ranges) {
                        this.switches.insert((number, name), switch);
                    }
                }
                ["BA_", "\"SystemMessageLongSymbol", "BO_", number, name, ..] => {
                    this.long_messages.insert(number, name);
                }
                [
                    "BA_",
                    "\"SystemSignalLongSymbol",
                    "SG_",
                    number,
                    signal,
                    name,
                    ..,
                ] => {
                    this.long_signals.insert((number, signal), name);
                }
                ["BA_", "\"VFrameFormat", "BO_", number, format, ..] => {
                    this.formats.insert(number, format);
                }
                ["BA_", "\"ProtocolType", protocol, ..] => this.protocol = protocol,
                ["BA_DEF_", "BO_", "\"VFrameFormat", "ENUM", ref words @ ..] => {
                    let texts = words.iter().filter(|word| word.starts_with('"'));
                    this.format_words = texts.copied().collect();
                }
                ["BA_DEF_DEF_", "\"VFrameFormat", format, ..] => this.usual_format = format,
                _ => {}
            }
        }
        this
    }

    /// Whether the extended identifiers of message `number` are those of SAE J1939.
    fn is_j1939(&self, number: &str) -> bool {
        let word = |format: &'t str| {
            let word = format
                .parse()
                .ok()
                .and_then(|at: usize| self.format_words.get(at));
            word.copied().unwrap_or(format)
        };
        let formats = [self.formats.get(number).copied(), Some(self.usual_format)];
        let is_given = |format: &&str| !matches!(*format, "" | "\"");
        match formats.into_iter().flatten().find(is_given) {
            Some(format) => word(format) == "\"J1939PG",
            None => self.protocol.eq_ignore_ascii_case("\"J1939"),
        }
    }

    fn message(&self, section: &MessageStatement<'_>) -> Message {
        let j1939 = self.is_j1939(section.number);
        let id = id_of(section.number);
        let j1939 = j1939 && matches!(id, Ok(Id::Extended(_)));
        let most = if j1939 { 8 } else { 64 };
        let size = section.size.parse::<usize>().ok();
        let id = id.and_then(|id| match size {
            Some(size) if size <= most => Ok(id),
            Some(size) if j1939 => Err(format!(
                "its length {size} is above 8 bytes: J1939 sends it in several packets, which \
                 this driver does not put together"
            )),
            _ => Err(format!("its length {} is not 0 to 64 bytes", section.size)),
        });
        let long_name = self.long_messages.get(section.number);
        let signals = section.signals.iter();
        Message {
            name: section.name.to_owned(),
            long_name: long_name.and_then(|name| long(name)),
            id,
            j1939,
            size: size.unwrap_or(0),
            signals: signals
                .filter_map(|words| self.signal(section, words))
                .collect(),
        }
    }

    /// A signal from the words behind its keyword; `None` if it has no name.
    fn signal(&self, section: &MessageStatement<'_>, words: &[&str]) -> Option<Signal> {
        let colon = words.iter().position(|word| *word == ":");
        let (head, body) = words.split_at(colon.unwrap_or(words.len()));
        let (name, mark) = (*head.first()?, head.get(1).copied().unwrap_or(""));
        let at = (section.number, name);
        let float = self.floats.get(&at).copied();
        // Spaces may be anywhere, also between the order and the sign.
        let bracket = body.iter().position(|word| *word == "(");
        let (place, scale) = body.split_at(bracket.unwrap_or(body.len()));
        let parts = match (place, scale) {
            (
                &[":", start, "|", length, "@", ref kind @ ..],
                &["(", factor, ",", offset, ")", ref rest @ ..],
            ) => {
                let numbers =
                    SignalCoding::new(float, start, length, &kind.concat(), factor, offset);
                numbers.map(|numbers| (numbers, rest))
            }
            _ => Err("it is not written name : start|length@order (factor,offset)".to_owned()),
        };
        let (numbers, rest) = match parts {
            Ok((numbers, rest)) => (Ok(numbers), rest),
            Err(problem) => (Err(problem), [].as_slice()),
        };
        let unit = rest.iter().find_map(|word| word.strip_prefix('"'));
        let switch = match self.switches.get(&at) {
            Some(switch) => Ok(Some(switch.clone())),
            None => simple_switch(section, name, mark),
        };
        let (switch, bits) = match switch {
            Ok(switch) => (
                switch,
                numbers.as_ref().map(|n| n.bits).map_err(String::clone),
            ),
            Err(problem) => (None, Err(problem)),
        };
        let numbers = numbers.ok();
        Some(Signal {
            name: name.to_owned(),
            long_name: self.long_signals.get(&at).and_then(|name| long(name)),
            bits,
            raw: numbers.as_ref().map_or(Raw::Unsigned, |n| n.raw),
            factor: numbers.as_ref().map_or(1.0, |n| n.factor),
            offset: numbers.as_ref().map_or(0.0, |n| n.offset),
            unit: unit.unwrap_or_default().to_owned(),
            switch,
        })
    }
}

fn parse(text: &str) -> Result<Vec<Message>, String> {
    let file = Statements::new(text);
    if file.sections.is_empty() {
        return Err("has no message (BO_): it is no .dbc file".into());
    }
    let sections = file.sections.iter().filter(|s| s.name != NO_MESSAGE);
    Ok(sections.map(|section| file.message(section)).collect())
}

/// A long name; editors write an empty one where there is none.
fn long(word: &str) -> Option<String> {
    let name = word.strip_prefix('"').filter(|name| !name.is_empty())?;
    Some(name.to_owned())
}

fn id_of(number: &str) -> Result<Id, String> {
    let Ok(raw) = number.parse::<u64>() else {
        return Err(format!("its identifier {number:?} is no number"));
    };
    if raw < EXTENDED {
        let standard = u16::try_from(raw).ok().filter(|raw| *raw <= 0x7FF);
        return standard.map(Id::standard).ok_or_else(|| {
            format!(
                "its identifier {raw:#x} has more than 11 bits; that of an extended frame is \
                 written plus 2147483648, here {}",
                raw + EXTENDED
            )
        });
    }
    let extended = u32::try_from(raw - EXTENDED).ok();
    let extended = extended.filter(|raw| *raw <= 0x1FFF_FFFF).map(Id::extended);
    extended.ok_or_else(|| format!("its identifier {:#x} has more than 29 bits", raw - EXTENDED))
}

/// The numbers of a signal.
struct SignalCoding {
    bits: Bits,
    raw: Raw,
    factor: f64,
    offset: f64,
}

impl SignalCoding {
    fn new(
        float: Option<&str>,
        start: &str,
        length: &str,
        kind: &str,
        factor: &str,
        offset: &str,
    ) -> Result<Self, String> {
        let bits = match (start.parse(), length.parse()) {
            (Ok(start), Ok(length)) => Bits::new(start, length, kind.starts_with('0')),
            _ => None,
        };
        let bits = bits.ok_or_else(|| {
            format!("{length} bits from bit {start} on are none, more than 64, or beyond 64 bytes")
        })?;
        let (raw, right) = match float {
            Some("1") => (Raw::Float32, bits.length() == 32),
            Some("2") => (Raw::Float64, bits.length() == 64),
            _ if kind.ends_with('-') => (Raw::Signed, true),
            _ => (Raw::Unsigned, true),
        };
        if !right {
            return Err(format!("a floating-point number of {length} bits"));
        }
        let number = |text: &str| text.parse().ok().filter(|number: &f64| number.is_finite());
        match (
            number(factor).filter(|factor| *factor != 0.0),
            number(offset),
        ) {
            (Some(factor), Some(offset)) => Ok(Self {
                bits,
                raw,
                factor,
                offset,
            }),
            _ => Err(format!(
                "factor {factor} and offset {offset} must be numbers, and the factor other than 0"
            )),
        }
    }
}

/// The frames that a statement of extended multiplexing names.
fn switch_of(multiplexor: &str, ranges: &[&str]) -> Option<Switch> {
    let ranges = ranges.split(|word| *word == "," || *word == ";");
    let ranges = ranges.map(<[&str]>::concat);
    let ranges = ranges.filter(|range| !range.is_empty()).map(|range| {
        let (first, last) = range.split_once('-')?;
        Some((first.parse().ok()?, last.parse().ok()?))
    });
    Some(Switch {
        signal: multiplexor.to_owned(),
        ranges: ranges.collect::<Option<_>>()?,
    })
}

/// The frames that have a signal with `mark`, of which no statement of extended multiplexing
/// speaks: the message then has one multiplexor.
fn simple_switch(
    section: &MessageStatement<'_>,
    name: &str,
    mark: &str,
) -> Result<Option<Switch>, String> {
    let Some(page) = mark.strip_prefix('m') else {
        return Ok(None);
    };
    let Ok(page) = page.trim_end_matches('M').parse() else {
        return Err(format!(
            "its mark {mark:?} must be M, m and a number, or both"
        ));
    };
    let marked = section
        .signals
        .iter()
        .filter(|s| matches!(s[..], [_, "M", ..]));
    let multiplexors: Vec<&str> = marked.map(|signal| signal[0]).collect();
    match *multiplexors {
        [multiplexor] if multiplexor != name => Ok(Some(Switch {
            signal: multiplexor.to_owned(),
            ranges: vec![(page, page)],
        })),
        [] => Err("it is multiplexed, but the message has no multiplexor".into()),
        _ => Err(format!(
            "it is multiplexed, and the message has several multiplexors ({}): SG_MUL_VAL_ must \
             tell which one counts",
            multiplexors.join(", ")
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEAD: &str = "VERSION \"\"\n\nNS_ :\n\tCM_\n\tBA_\n\nBS_:\n\nBU_: Node\n\n";

    fn messages(text: &str) -> Vec<Message> {
        parse(&format!("{HEAD}{text}")).unwrap()
    }

    /// What can not be used has the reason, and the rest of the file is read.
    #[test]
    fn mistakes_have_a_place_and_harm_nothing_else() {
        const RIGHT: &str = "BO_ 291 Right: 8 Node\n SG_ S : 0|16@1- (1,0) [0|0] \"\" Node\n";
        let signal = |rest: &str| format!("BO_ 1 M: 8 Node\n SG_ S {rest} [0|0] \"\" Node\n");
        for (text, expected) in [
            (
                "BO_ 4096 Far: 8 Node\n".to_owned(),
                "its identifier 0x1000 has more than 11 bits",
            ),
            // As many bits more as a standard identifier has room for.
            (
                "BO_ 506855454 Far: 8 Node\n".to_owned(),
                "its identifier 0x1e36001e has more",
            ),
            (
                "BO_ 103596083 Far: 8 Node\n".to_owned(),
                "0x62cc033 has more than 11 bits",
            ),
            (
                "BO_ 2684354560 Far: 8 Node\n".to_owned(),
                "0x20000000 has more than 29 bits",
            ),
            (
                "BO_ 99999999999999999999 Far: 8 Node\n".to_owned(),
                "is no number",
            ),
            (
                "BO_ 1 Long: 203 Node\n".to_owned(),
                "its length 203 is not 0 to 64 bytes",
            ),
            (signal(": 0|65@1+ (1,0)"), "65 bits from bit 0"),
            (signal(": 510|8@1+ (1,0)"), "8 bits from bit 510"),
            (signal(": 0|16@1+ (0,0)"), "factor 0 and offset 0"),
            (signal(": 0|16@1+ (1,x)"), "factor 1 and offset x"),
            (
                signal(": 0|16@1+ (1)"),
                "it is not written name : start|length",
            ),
            (signal("m3 : 0|16@1- (1,0)"), "has no multiplexor"),
            (signal("mx : 0|16@1- (1,0)"), "its mark \"mx\" must be"),
            (
                signal(": 0|16@1- (1,0)") + "SIG_VALTYPE_ 1 S : 1;\n",
                "a floating-point number of 16 bits",
            ),
        ] {
            let messages = messages(&format!("{text}\n{RIGHT}"));
            let message = &messages[0];
            let problem = message.id.as_ref().err().or(message
                .signals
                .first()
                .and_then(|signal| signal.bits.as_ref().err()));
            let problem = problem.unwrap_or_else(|| panic!("{text}"));
            assert!(problem.contains(expected), "{text}: {problem}");
            let right = messages.last().unwrap();
            assert_eq!(
                (right.id.clone(), right.signals.len()),
                (Ok(Id::standard(291)), 1)
            );
            assert_eq!(
                right.signals[0].bits.as_ref().ok(),
                Bits::new(0, 16, false).as_ref()
            );
        }
        let none = parse("BO_ what\n").unwrap_err();
        assert!(none.contains("it is no .dbc file"), "{none}");
    }

    /// Statements look like others inside of comments and texts, and comments hold bare quotes.
    #[test]
    fn texts_hold_anything() {
        let messages = messages(
            "BO_ 1 A: 8 Node\n SG_ S : 0|8@1+ (1E-003,-.5) [0|0] \"a:b\" Node\n\
             CM_ BO_ 1 \"he said \"no\"\nBO_ 7 Fake: 8 Node\n SG_ T : 0|8@1+ (1,0) [0|0] \
             \"\"\n\";\n\
             BA_ \"Path\" \"C:\\dir\\\";\n\
             BO_ 2 B : 8 Vector__XXX\n",
        );
        let names: Vec<_> = messages
            .iter()
            .map(|message| message.name.as_str())
            .collect();
        assert_eq!(names, ["A", "B"]);
        let signal = &messages[0].signals[0];
        assert_eq!((signal.factor, signal.offset), (1e-3, -0.5));
        assert_eq!(
            (messages[0].signals.len(), signal.unit.as_str()),
            (1, "a:b")
        );
    }

    #[test]
    fn statements_begin_and_end_anywhere() {
        let float = |text: &str| {
            let message = "BO_ 1 A: 8 N\n SG_ S : 0|32@1+ (1,0) [0|0] \"\" N\n";
            let messages = messages(&text.replace("BO_", message));
            format!("{:?}", messages[0].signals[0])
        };
        let expected = float("BO_\nSIG_VALTYPE_ 1 S : 1;\n");
        assert_ne!(expected, float("BO_\n"));
        for text in [
            "BO_\nCM_ BO_ 1 \"text\"\n;\nSIG_VALTYPE_ 1 S : 1;\n",
            "CM_ \"text\" \r\n ;\r\nBO_\nSIG_VALTYPE_ 1 S : 1;\n",
            "BO_\nBA_DEF_ BO_ \"x\" INT 0 1; SIG_VALTYPE_ 1 S : 1;\n",
            "// made \"by hand; SIG_VALTYPE_ 2\nBO_ // \"\nSIG_VALTYPE_ 1 S : 1; // \"\n",
        ] {
            assert_eq!(float(text), expected, "{text}");
        }
        let old = float(&"BO_\nSIG_VALTYPE_ 1 S : 1;\n".replace('\n', "\r"));
        assert_eq!(old, expected);
    }

    /// As cantools reads them.
    #[test]
    fn lines_and_spaces_may_be_anywhere() {
        const BO: &str = "BO_ 1 A: 8 N\n";
        const S: &str = " SG_ S : 7|16@0- (0.5,1) [0|0] \"rad\" N\n";
        const T: &str = " SG_ T m0 : 23|8@1+ (1,0) [0|0] \"\" N\n";
        let text = format!("{BO}{S}{T}BO_ 2 B: 8 N\n{S}CM_ SG_ 1 S \"BO_ 3 C: 8 N\";\n");
        let right = messages(&text);
        assert_eq!((right.len(), right[0].signals.len()), (2, 2));
        for spaced in [
            text.replace("\n SG_", " SG_"),
            text.replace("N\n", "N "),
            text.replace("@0- (", " @ 0 - ( "),
            text.replace("7|16", "7 | 16").replace(')', " )"),
        ] {
            assert_eq!(messages(&spaced), right, "{spaced}");
        }
    }

    #[test]
    fn files_of_windows_editors_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a.dbc");
        let text = format!(
            "{HEAD}BO_ 2147483650 M: 8 Node\n SG_ S : 7|8@0- (1,0) [0|0] \"\u{b0}/s\" Node\n"
        )
        .replace('\n', "\r\n");
        let latin = text.chars().map(|c| c as u8).collect();
        let marked = [b"\xEF\xBB\xBF", text.as_bytes()].concat();
        let wide = |order: fn(u16) -> [u8; 2]| {
            let units = std::iter::once(0xFEFF).chain(text.encode_utf16());
            units.flat_map(order).collect::<Vec<u8>>()
        };
        for bytes in [
            latin,
            marked,
            wide(u16::to_le_bytes),
            wide(u16::to_be_bytes),
        ] {
            std::fs::write(&file, bytes).unwrap();
            let messages = read(&file).unwrap();
            assert_eq!(messages[0].id, Ok(Id::extended(2)));
            assert_eq!(messages[0].signals[0].unit, "\u{b0}/s");
        }
        let missing = read(&folder.path().join("b.dbc")).unwrap_err();
        assert!(missing.contains("b.dbc: cannot be read"), "{missing}");
    }

    #[test]
    fn names_of_more_than_32_letters_are_found() {
        let messages = messages(
            "BO_ 291 Short: 8 Node\n SG_ S : 0|8@1+ (1,0) [0|0] \"\" Node\n\
             BO_ 292 Other: 8 Node\n SG_ S : 0|8@1+ (1,0) [0|0] \"\" Node\n\
             BA_ \"SystemMessageLongSymbol\" BO_ 291 \"Longer\";\n\
             BA_ \"SystemSignalLongSymbol\" SG_ 291 S \"Longest\";\n\
             BA_ \"SystemSignalLongSymbol\" SG_ 292 S \"\";\n",
        );
        assert_eq!(messages[0].long_name.as_deref(), Some("Longer"));
        assert_eq!(messages[0].signals[0].long_name.as_deref(), Some("Longest"));
        assert_eq!(
            (&messages[1].long_name, &messages[1].signals[0].long_name),
            (&None, &None)
        );
    }

    /// By the attribute of the message, as a number or a word, else the default, else the protocol.
    #[test]
    fn messages_of_j1939_are_found() {
        const WORDS: &str = "BA_DEF_ BO_ \"VFrameFormat\" ENUM \"StandardCAN\",\"ExtendedCAN\",\
                             \"reserved\",\"J1939PG\";\n";
        for (text, expected) in [
            ("", [false, false]),
            ("BA_ \"VFrameFormat\" BO_ 2147483649 3;\n", [true, false]),
            (
                "BA_ \"VFrameFormat\" BO_ 2147483650 \"J1939PG\";\n",
                [false, true],
            ),
            ("BA_DEF_DEF_ \"VFrameFormat\" \"J1939PG\";\n", [true, true]),
            (
                "BA_DEF_DEF_ \"VFrameFormat\" \"J1939PG\";\nBA_ \"VFrameFormat\" BO_ 2147483649 \
                 1;\n",
                [false, true],
            ),
            (
                "BA_DEF_DEF_ \"VFrameFormat\" \"ExtendedCAN\";\n",
                [false, false],
            ),
            ("BA_ \"ProtocolType\" \"J1939\";\n", [true, true]),
            (
                "BA_ \"ProtocolType\" \"J1939\";\nBA_DEF_DEF_ \"VFrameFormat\" \"ExtendedCAN\";\n\
                 BA_ \"VFrameFormat\" BO_ 2147483649 3;\n",
                [true, false],
            ),
            (
                "BA_ \"ProtocolType\" \"J1939\";\nBA_DEF_DEF_ \"VFrameFormat\" \"\";\n",
                [true, true],
            ),
        ] {
            let messages = messages(&format!(
                "BO_ 2147483649 A: 8 Node\nBO_ 2147483650 B: 8 Node\nBO_ 1 C: 8 Node\n{WORDS}{text}"
            ));
            let found = [0, 1].map(|at: usize| messages[at].j1939);
            assert_eq!((found, messages[2].j1939), (expected, false), "{text}");
        }
        let long = messages("BO_ 2147483649 A: 39 Node\nBA_ \"ProtocolType\" \"J1939\";\n");
        assert!(long[0].id.as_ref().unwrap_err().contains("several packets"));
    }

    /// Pages are those that `SG_MUL_VAL_` names, for signals marked `M` too.
    #[test]
    fn extended_multiplexing_counts() {
        let text = "BO_ 256 M: 8 N\n SG_ Page M : 0|8@1+ (1,0) [0|0] \"\" N\n\
             SG_ Sub M : 8|8@1+ (1,0) [0|0] \"\" N\n SG_ S m0 : 16|16@1- (1,0) [0|0] \"\" N\n";
        let switches = |text: &str| {
            let signals = messages(text).remove(0).signals;
            signals.into_iter().map(|s| s.switch).collect::<Vec<_>>()
        };
        let switch = |signal: &str, ranges: &[(u64, u64)]| {
            let (signal, ranges) = (signal.to_owned(), ranges.to_vec());
            Some(Switch { signal, ranges })
        };
        let with =
            format!("{text}SG_MUL_VAL_ 256 Sub Page 2-2,  4 - 5;\nSG_MUL_VAL_ 256 S Sub 0-0;\n");
        assert_eq!(
            switches(&with),
            [
                None,
                switch("Page", &[(2, 2), (4, 5)]),
                switch("Sub", &[(0, 0)])
            ]
        );
        let without = messages(text).remove(0).signals.remove(2);
        assert!(
            without
                .bits
                .unwrap_err()
                .contains("several multiplexors (Page, Sub)")
        );
        let one = text.replace("Sub M", "Sub m1M");
        assert_eq!(
            switches(&one),
            [None, switch("Page", &[(1, 1)]), switch("Page", &[(0, 0)])]
        );
    }
}
