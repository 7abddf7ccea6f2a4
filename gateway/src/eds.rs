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

use configparser::ini::{Ini, IniDefault};
use proprio_drivers::objects::{Entry, Objects};
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
enum Place {
    /// `[1A00]`
    Object(u16),
    /// `[1A00sub1]`
    Sub(u16, u8),
    /// `[1A00Value]`
    Values(u16),
}

impl Place {
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

fn parse(text: &str) -> Result<Objects, String> {
    let mut form = IniDefault::default();
    form.delimiters = vec!['='];
    form.comment_symbols = vec![';'];
    let text = text.trim_start_matches('\u{feff}');
    let sections = Ini::new_from_defaults(form)
        .read(text.to_owned())
        .map_err(|e| format!("is no EDS or DCF file: {e}"))?;
    // In order, because explicit entries count before those of a short form.
    let sections: BTreeMap<String, Section> = sections.into_iter().collect();
    let places: Vec<(Place, &String, &Section)> = sections
        .iter()
        .filter_map(|(name, section)| Some((Place::of(name)?, name, section)))
        .collect();
    let mut entries = BTreeMap::new();
    for (place, name, section) in &places {
        let Place::Object(index) = *place else {
            continue;
        };
        let at = |problem| format!("[{name}]: {problem}");
        let compact = number(section, "compactsubobj")
            .map_err(at)?
            .map_or(0, |n| n.0);
        let template = entry(section).map_err(at)?;
        let is_list = matches!(number(section, "objecttype").map_err(at)?, Some((8 | 9, _)));
        match u8::try_from(compact) {
            Ok(count @ 1..) => {
                entries.insert((index, 0), plain(count.into()));
                entries.extend((1..=count).filter_map(|sub| Some(((index, sub), template?))));
            }
            _ if !is_list => entries.extend(template.map(|entry| ((index, 0), entry))),
            _ => {}
        }
    }
    for (place, name, section) in &places {
        let at = |problem| format!("[{name}]: {problem}");
        match *place {
            Place::Sub(index, sub) => {
                let entry = entry(section).map_err(at)?;
                entries.extend(entry.map(|entry| ((index, sub), entry)));
            }
            Place::Values(index) => {
                for (key, value) in *section {
                    let (Ok(sub), Some(value)) = (key.parse::<u8>(), value) else {
                        continue;
                    };
                    let (number, plus_node) = parse_number(value)
                        .ok_or_else(|| at(format!("{key} = {value:?} is no number")))?;
                    let own = true;
                    entries.insert(
                        (index, sub),
                        Entry {
                            number,
                            plus_node,
                            own,
                        },
                    );
                }
                let count = number(section, "nrofentries").map_err(at)?;
                if let Some((count, _)) = count {
                    entries.entry((index, 0)).or_insert(plain(count));
                }
            }
            Place::Object(_) => {}
        }
    }
    if entries.is_empty() {
        return Err("has no objects: it is no EDS or DCF file".into());
    }
    let of = |name: &str, key| sections.get(name).map_or(Ok(None), |s| number(s, key));
    let info = |key| of("deviceinfo", key).map_err(|e| format!("[DeviceInfo]: {e}"));
    if info("compactpdo")?.is_some_and(|(mask, _)| mask != 0) {
        let count = info("nroftxpdo")?.map_or(0, |(count, _)| count.min(4));
        for at in 0..count {
            #[allow(clippy::cast_possible_truncation)] // below 4
            let index = 0x1800 + at as u16;
            let id = Entry {
                plus_node: true,
                ..plain(0x180 + 0x100 * at)
            };
            entries.entry((index, 1)).or_insert(id);
        }
    }
    // With one m in the standard.
    let commissioning = |key| {
        let (one, two) = ("devicecomissioning", "devicecommissioning");
        let found =
            of(one, key).and_then(|found| found.map_or_else(|| of(two, key), |n| Ok(Some(n))));
        found.map_err(|e| format!("[DeviceComissioning]: {e}"))
    };
    let node = commissioning("nodeid")?.filter(|(node, _)| *node != 0);
    Ok(Objects {
        node: node.map(|(node, _)| u8::try_from(node).unwrap_or(u8::MAX)),
        bit_rate: commissioning("baudrate")?.map(|(kbit, _)| kbit.saturating_mul(1000)),
        entries,
    })
}

/// A default.
const fn plain(number: u32) -> Entry {
    Entry {
        number,
        plus_node: false,
        own: false,
    }
}

/// The value of an object's section; `None` if it has none, or is no integer of up to 32 bits.
fn entry(section: &Section) -> Result<Option<Entry>, String> {
    // Boolean, integers of 8, 16, 32, 24 bits, and their unsigned ones.
    const INTEGERS: [u32; 9] = [1, 2, 3, 4, 5, 6, 7, 0x10, 0x16];
    let is_integer = match number(section, "datatype")? {
        Some((kind, _)) if INTEGERS.contains(&kind) => true,
        // Real numbers, texts, times, domains, longer integers, structures.
        Some((8..0x80, _)) => return Ok(None),
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
                true => Err(format!("{key} = {value:?} is no number")),
                false => Ok(None),
            };
        };
        let access = section.get("accesstype").and_then(Option::as_ref);
        let is_constant = access.is_some_and(|access| access.trim().eq_ignore_ascii_case("const"));
        return Ok(Some(Entry {
            number,
            plus_node,
            own: key == "parametervalue" || is_constant,
        }));
    }
    Ok(None)
}

/// The number of a key; `None` without it, or if it is empty.
fn number(section: &Section, key: &str) -> Result<Option<(u32, bool)>, String> {
    match section.get(key).and_then(Option::as_ref) {
        Some(value) if !value.trim().is_empty() => match parse_number(value) {
            None => Err(format!("{key} = {value:?} is no number")),
            found => Ok(found),
        },
        _ => Ok(None),
    }
}

/// A number of up to 32 bits, and whether that of the node is added to it.
fn parse_number(text: &str) -> Option<(u32, bool)> {
    let text: String = text.split_whitespace().collect();
    let text = text.to_ascii_lowercase();
    let (literal, plus_node) = match text.split_once("$nodeid") {
        None => (text.as_str(), false),
        Some(("", "")) => ("0", true),
        Some(("", rest)) => (rest.strip_prefix('+')?, true),
        Some((rest, "")) => (rest.strip_suffix('+')?, true),
        Some(_) => return None,
    };
    let (digits, negative) = match literal.strip_prefix('-') {
        Some(digits) => (digits, true),
        None => (literal, false),
    };
    let magnitude = match (digits.strip_prefix("0x"), digits.strip_prefix('0')) {
        (Some(hexadecimal), _) => u32::from_str_radix(hexadecimal, 16),
        (_, Some(octal)) if !octal.is_empty() => u32::from_str_radix(octal, 8),
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
            ("08", None),
            ("0x", None),
            ("+1", Some((1, false))),
            ("", None),
            ("two", None),
        ] {
            assert_eq!(parse_number(text), expected, "{text}");
        }
    }

    #[test]
    fn mistakes_have_a_place() {
        for (text, expected) in [
            ("", "has no objects"),
            ("[DeviceInfo]\nVendorName=X\n", "has no objects"),
            ("[1800\nx=1\n", "is no EDS or DCF file"),
            (
                "[1800sub1]\nDataType=0x7\nDefaultValue=$NODE+0x180\n",
                "[1800sub1]: defaultvalue = \"$NODE+0x180\" is no number",
            ),
            (
                "[1A00Value]\n1=position\n",
                "[1a00value]: 1 = \"position\" is no number",
            ),
            (
                "[1000]\nObjectType=VAR\n",
                "[1000]: objecttype = \"VAR\" is no number",
            ),
        ] {
            let problem = parse(text).unwrap_err();
            assert!(problem.contains(expected), "{text}: {problem}");
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
            [2000]\r\nDataType=0xF\r\nDefaultValue=#1\r\n\
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
