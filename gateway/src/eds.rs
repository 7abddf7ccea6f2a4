//! Reads EDS and DCF files (CiA 306) into the table that CANopen drivers use. `configparser` reads
//! the INI form; here the objects are found in it.
//!
//! - Numbers: decimal, hexadecimal (`0x`), octal (a leading 0), and `$NODEID+0x180`, in any order
//!   and case.
//! - A `ParameterValue` (DCF) counts before a `DefaultValue`.
//! - Arrays in short form: `CompactSubObj`, with the values in `[1A00Value]`; `CompactPDO`, with
//!   which a file leaves out the first four transmit PDOs because they have the identifiers of
//!   CiA 301.
//! - Sections and keys in any case. Objects that are no integers of up to 32 bits are left out.
//! - A value that is no number is kept with its place, and told only if a driver needs it. What is
//!   wrong elsewhere does no harm.

use configparser::ini::{Ini, IniDefault};
use proprio_drivers::objects::{ObjectEntry, Objects};
use std::collections::{BTreeMap, HashMap};
use std::path::Path;

/// One section; keys are in lower case.
type Section = HashMap<String, Option<String>>;

/// The objects of `file`.
///
/// # Errors
/// A message with the file, the place and the problem.
pub(crate) fn read(file: &Path) -> Result<Objects, String> {
    let at = |problem: String| format!("{}: {problem}", file.display());
    crate::dbc::text(file)
        .and_then(|text| parse(&text))
        .map_err(at)
}

/// What a section's name says.
enum SectionName {
    /// `[1A00]`
    Object(u16),
    /// `[1A00sub1]`
    Sub(u16, u8),
    /// `[1A00Value]`
    Values(u16),
}

impl SectionName {
    fn of(name: &str) -> Option<Self> {
        let end = name
            .find(|c: char| !c.is_ascii_hexdigit())
            .unwrap_or(name.len());
        let (index, rest) = name.split_at_checked(end)?;
        let index = u16::from_str_radix(index, 16).ok()?;
        match rest.strip_prefix("sub") {
            Some(sub) => Some(Self::Sub(index, u8::from_str_radix(sub, 16).ok()?)),
            None if rest.is_empty() => Some(Self::Object(index)),
            None => (rest == "value").then_some(Self::Values(index)),
        }
    }
}

/// The sections of `text`, in order, because explicit entries count before those of a short form.
fn sections(text: &str) -> Result<BTreeMap<String, Section>, String> {
    let mut form = IniDefault::default();
    form.delimiters = vec!['='];
    form.comment_symbols = vec![';'];
    // A section's name that does not end, or a value without a key, would refuse the whole file.
    // What follows such a name is of no section that is known.
    let lines = text.lines().map(|line| match line.trim_start() {
        name if name.starts_with('[') && !name.contains(']') => "[?]",
        value if value.starts_with('=') => "",
        _ => line,
    });
    let sections = Ini::new_from_defaults(form)
        .read(lines.collect::<Vec<_>>().join("\n"))
        .map_err(|e| format!("is no EDS or DCF file: {e}"))?;
    Ok(sections.into_iter().collect())
}

fn parse(text: &str) -> Result<Objects, String> {
    let sections = sections(text)?;
    let places: Vec<(SectionName, &String, &Section)> = sections
        .iter()
        .filter_map(|(name, section)| Some((SectionName::of(name)?, name, section)))
        .collect();
    let mut objects = Objects::default();
    for (place, name, section) in &places {
        let SectionName::Object(index) = *place else {
            continue;
        };
        let template = entry(name, section);
        let compact = number(section, "compactsubobj").map(u8::try_from);
        let is_list = matches!(number(section, "objecttype"), Some(8 | 9));
        match compact {
            Some(Ok(count @ 1..)) => {
                objects.entries.insert((index, 0), plain(count.into()));
                for sub in 1..=count {
                    put(&mut objects, (index, sub), template.clone());
                }
            }
            _ if !is_list => put(&mut objects, (index, 0), template),
            _ => {}
        }
    }
    for (place, name, section) in &places {
        match *place {
            SectionName::Sub(index, sub) => put(&mut objects, (index, sub), entry(name, section)),
            SectionName::Values(index) => {
                for (key, value) in *section {
                    let (Ok(sub), Some(value)) = (key.parse::<u8>(), value) else {
                        continue;
                    };
                    let found = parse_number(value).map(|(number, plus_node)| ObjectEntry {
                        number,
                        plus_node,
                        own: true,
                    });
                    let found =
                        found.ok_or_else(|| format!("[{name}]: {key} = {value:?} is no number"));
                    put(&mut objects, (index, sub), found.map(Some));
                }
                if let Some(count) = number(section, "nrofentries") {
                    objects.entries.entry((index, 0)).or_insert(plain(count));
                }
            }
            SectionName::Object(_) => {}
        }
    }
    if objects.entries.is_empty() && objects.unreadable.is_empty() {
        return Err("has no objects: it is no EDS or DCF file".into());
    }
    let value = |name: &str, key| sections.get(name).and_then(|section| number(section, key));
    if value("deviceinfo", "compactpdo").is_some_and(|mask| mask != 0) {
        let count = value("deviceinfo", "nroftxpdo").map_or(0, |count| count.min(4));
        for at in 0..count {
            #[allow(clippy::cast_possible_truncation)] // below 4
            let index = 0x1800 + at as u16;
            let id = ObjectEntry {
                plus_node: true,
                ..plain(0x180 + 0x100 * at)
            };
            objects.entries.entry((index, 1)).or_insert(id);
        }
    }
    // With one m in the standard.
    let commissioning =
        |key| value("devicecomissioning", key).or(value("devicecommissioning", key));
    let node = commissioning("nodeid").filter(|node| *node != 0);
    objects.node = node.map(|node| u8::try_from(node).unwrap_or(u8::MAX));
    objects.bit_rate = commissioning("baudrate").map(|kbit| kbit.saturating_mul(1000));
    objects.vendor = value("deviceinfo", "vendornumber").filter(|vendor| *vendor != 0);
    Ok(objects)
}

/// Puts what a file has of an object to the others.
fn put(objects: &mut Objects, at: (u16, u8), found: Result<Option<ObjectEntry>, String>) {
    match found {
        Ok(entry) => objects.entries.extend(entry.map(|entry| (at, entry))),
        Err(problem) => {
            objects.unreadable.insert(at, problem);
        }
    }
}

/// A default.
const fn plain(number: u32) -> ObjectEntry {
    ObjectEntry {
        number,
        plus_node: false,
        own: false,
    }
}

/// The value of an object's section `name`; `None` if it has none, or is no integer of up to 32
/// bits.
fn entry(name: &str, section: &Section) -> Result<Option<ObjectEntry>, String> {
    // Boolean, integers of 8, 16, 32, 24 bits, and their unsigned ones.
    const INTEGERS: [u32; 9] = [1, 2, 3, 4, 5, 6, 7, 0x10, 0x16];
    let is_integer = match number(section, "datatype") {
        Some(kind) if INTEGERS.contains(&kind) => true,
        // Real numbers, texts, times, domains, longer integers, structures.
        Some(8..0x80) => return Ok(None),
        // A type that the file itself defines, or a file without types.
        _ => false,
    };
    for key in ["parametervalue", "defaultvalue"] {
        let Some(value) = section.get(key).and_then(Option::as_ref) else {
            continue;
        };
        if value.trim().is_empty() {
            continue;
        }
        let Some((number, plus_node)) = parse_number(value) else {
            return match is_integer {
                true => Err(format!("[{name}]: {key} = {value:?} is no number")),
                false => Ok(None),
            };
        };
        let access = section.get("accesstype").and_then(Option::as_ref);
        let is_constant = access.is_some_and(|access| access.trim().eq_ignore_ascii_case("const"));
        return Ok(Some(ObjectEntry {
            number,
            plus_node,
            own: key == "parametervalue" || is_constant,
        }));
    }
    Ok(None)
}

/// The number of a key; `None` without it, or if it is none.
fn number(section: &Section, key: &str) -> Option<u32> {
    let value = section.get(key)?.as_ref()?;
    parse_number(value).map(|(number, _)| number)
}

/// A number of up to 32 bits, and whether that of the node is added to it.
fn parse_number(text: &str) -> Option<(u32, bool)> {
    let text: String = text
        .chars()
        .filter(|c| !c.is_whitespace() && *c != '"')
        .collect();
    let text = text.to_ascii_lowercase();
    let (literal, plus_node) = match text.split_once("nodeid") {
        None => (text.as_str(), false),
        Some((before, after)) => {
            let before = before.strip_suffix('$').unwrap_or(before);
            let literal = match (before, after) {
                ("", "") => "0",
                ("", rest) => rest.strip_prefix('+')?,
                (rest, "") => rest.strip_suffix('+')?,
                _ => return None,
            };
            (literal, true)
        }
    };
    let (digits, negative) = match literal.strip_prefix('-') {
        Some(digits) => (digits, true),
        None => (literal, false),
    };
    let magnitude = match (digits.strip_prefix("0x"), digits.strip_prefix('0')) {
        (Some(hexadecimal), _) => u32::from_str_radix(hexadecimal, 16),
        // Some write decimal numbers with zeros before them.
        (_, Some(octal)) if !octal.is_empty() && !octal.contains(['8', '9']) => {
            u32::from_str_radix(octal, 8)
        }
        _ => digits.parse(),
    };
    let magnitude = magnitude.ok()?;
    match negative {
        true => (magnitude <= 1 << 31).then_some((magnitude.wrapping_neg(), plus_node)),
        false => Some((magnitude, plus_node)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_read_as_the_standard_writes_them() {
        for (text, expected) in [
            ("0x1A0", Some((0x1A0, false))),
            ("0X1a0", Some((0x1A0, false))),
            ("255", Some((255, false))),
            ("017", Some((15, false))),
            ("0", Some((0, false))),
            ("-1", Some((u32::MAX, false))),
            ("-2147483648", Some((1 << 31, false))),
            ("-2147483649", None),
            ("0xFFFFFFFF", Some((u32::MAX, false))),
            ("0x100000000", None),
            ("$NODEID", Some((0, true))),
            ("$NodeId + 0x180", Some((0x180, true))),
            ("0x40000180+$NODEID", Some((0x4000_0180, true))),
            ("$NODEID0x180", None),
            ("1+$NODEID+1", None),
            ("08", Some((8, false))),
            ("\"0x20\"", Some((32, false))),
            ("NodeID+0x180", Some((0x180, true))),
            ("0x", None),
            ("+1", Some((1, false))),
            ("", None),
            ("two", None),
        ] {
            assert_eq!(parse_number(text), expected, "{text}");
        }
    }

    /// A value that is no number has its place, and harms nothing else.
    #[test]
    fn mistakes_have_a_place() {
        for (text, expected) in [
            ("", "has no objects"),
            ("[DeviceInfo]\nVendorName=X\n", "has no objects"),
        ] {
            let problem = parse(text).unwrap_err();
            assert!(problem.contains(expected), "{text}: {problem}");
        }
        for (text, at, expected) in [
            (
                "[1800sub1]\nDataType=0x7\nDefaultValue=$NODE+0x180\n",
                (0x1800, 1),
                "[1800sub1]: defaultvalue = \"$NODE+0x180\" is no number",
            ),
            (
                "[1A00Value]\n1=position\n",
                (0x1A00, 1),
                "[1a00value]: 1 = \"position\" is no number",
            ),
            (
                "[2000]\nDataType=6\nDefaultValue=0x\n[6098\nDefaultValue=1\n",
                (0x2000, 0),
                "[2000]: defaultvalue = \"0x\" is no number",
            ),
        ] {
            let right = "[1000]\n=5\nObjectType=VAR\nDataType=7\nDefaultValue=0x20192\n";
            let commissioning = "[DeviceComissioning]\nNodeID=x\nBaudrate=fast\n";
            let objects = parse(&format!("{text}{right}{commissioning}")).unwrap();
            assert_eq!(objects.unreadable.len(), 1, "{text}");
            assert_eq!(objects.unreadable[&at], expected);
            assert_eq!(objects.value(0x1000, 0, 1), Some(0x20192));
            assert_eq!((objects.node, objects.bit_rate), (None, None));
        }
    }

    /// Real files leave keys out, repeat names in another case, and hold texts, domains and types
    /// of their own.
    #[test]
    fn untidy_files_are_read() {
        let text = "\u{feff}; made by hand\r\n[fileinfo]\r\nFileName=a.eds\r\n\
            [1000]\r\nparametername=Device Type; or so\r\nDATATYPE = 0x0007\r\n\
            DefaultValue =0x00020192 ; a comment\r\n\
            [1008]\r\nObjectType=0x7\r\nDataType=0x0009\r\nDefaultValue=Drive = fast\r\n\
            [1A00]\r\nObjectType=0x9\r\nSubNumber=2\r\nDefaultValue=7\r\n\
            [1A00SUB0]\r\nDataType=5\r\nDefaultValue=1\r\n\
            [1a00Sub1]\r\nDataType=0x00A0\r\nDefaultValue=0x60640020\r\n\
            [6502]\r\nDataType=0x7\r\nDefaultValue=\r\n\
            [1A01]\r\nObjectType=8\r\nDataType=7\r\nDefaultValue=3\r\n\
            [2000]\r\nDataType=0xF\r\nDefaultValue=#1\r\n = 5\r\n=\r\n\
            [Tools]\r\nItems=0\r\n";
        let objects = parse(text).unwrap();
        let found: Vec<_> = objects
            .entries
            .iter()
            .map(|(at, e)| (*at, e.number))
            .collect();
        assert_eq!(
            found,
            [
                ((0x1000, 0), 0x20192),
                ((0x1A00, 0), 1),
                ((0x1A00, 1), 0x6064_0020)
            ]
        );
        assert_eq!((objects.node, objects.bit_rate), (None, None));
    }

    #[test]
    fn short_forms_are_written_out() {
        let text = "[DeviceInfo]\nCompactPDO=3\nNrOfTxPDO=2\n\
            [DeviceCommissioning]\nNodeID=0x12\nBaudrate=500\n\
            [1801sub1]\nDataType=7\nDefaultValue=0x80000280\n\
            [1A00Value]\nNrOfEntries=2\n1=0x60410010\n2=0x60640020\n\
            [2100]\nObjectType=8\nDataType=6\nDefaultValue=9\nAccessType=Const\nCompactSubObj=3\n\
            [2100Value]\nNrOfEntries=1\n2=$NODEID+1\n[2100sub3]\nDataType=6\nDefaultValue=4\n";
        let objects = parse(text).unwrap();
        let at = |index, sub| objects.value(index, sub, objects.node.unwrap());
        assert_eq!(
            (objects.node, objects.bit_rate),
            (Some(0x12), Some(500_000))
        );
        assert_eq!(
            (at(0x1800, 1), at(0x1801, 1)),
            (Some(0x192), Some(0x8000_0280))
        );
        assert_eq!(at(0x1802, 1), None);
        assert_eq!(
            [0, 1, 2, 3].map(|sub| at(0x1A00, sub)),
            [Some(2), Some(0x6041_0010), Some(0x6064_0020), None]
        );
        assert_eq!(
            [0, 1, 2, 3, 4].map(|sub| at(0x2100, sub)),
            [Some(3), Some(9), Some(0x13), Some(4), None]
        );
        assert_eq!(
            (objects.own(0x2100, 1), objects.own(0x2100, 3)),
            (Some(9), None)
        );
    }
}
