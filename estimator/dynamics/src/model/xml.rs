//! Reads the XML of a URDF as the readers of other robot programs do (tinyxml2, which urdfdom,
//! Pinocchio and MuJoCo use), so that a file which they load is not refused here for its syntax.
//!
//! These accept what a strict parser does not: prefixes that no `xmlns` declares, `--` in comments,
//! an empty line before `<?xml`, `&` that begins no entity, `<!x>`, anything after the root element
//! (a second `</robot>`, too) or after a NUL, and bytes of any encoding. quick-xml, a parser of
//! tokens, accepts most of it; the tree is built here with the place of every element, which the
//! messages and the rewriting of a URDF need.

use std::borrow::Cow;
use std::ops::{ControlFlow, Range};

use encoding_rs::{Encoding, UTF_8, UTF_16BE, UTF_16LE, WINDOWS_1252};
use quick_xml::errors::SyntaxError;
use quick_xml::escape::unescape;
use quick_xml::events::Event;
use quick_xml::events::attributes::Attributes;

use super::ModelError;

/// The text of a file: in the encoding of its byte order mark or of its declaration, else UTF-8,
/// else, because many editors wrote it undeclared, Windows-1252 (which includes Latin-1). A
/// declaration of another encoding is changed to UTF-8, so that the text can be written as such.
pub(super) fn decode(bytes: &[u8]) -> String {
    let head = bytes.get(..bytes.len().min(256)).unwrap_or_default();
    let encoding = match (Encoding::for_bom(bytes), head) {
        (Some((encoding, _)), _) => encoding,
        (None, [b'<', 0, ..]) => UTF_16LE,
        (None, [0, b'<', ..]) => UTF_16BE,
        // A declaration that can be read byte by byte is not in UTF-16, whatever it says.
        _ => declared(&String::from_utf8_lossy(head))
            .and_then(|(_, label)| Encoding::for_label(label.as_bytes()))
            .filter(|encoding| ![UTF_16LE, UTF_16BE].contains(encoding))
            .unwrap_or(UTF_8),
    };
    let (text, _, damaged) = encoding.decode(bytes);
    let mut text = if damaged && encoding == UTF_8 {
        let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
        WINDOWS_1252.decode_without_bom_handling(bytes).0
    } else {
        text
    }
    .into_owned();
    if let Some((range, label)) = declared(&text)
        && Encoding::for_label(label.as_bytes()) != Some(UTF_8)
    {
        text.replace_range(range, "UTF-8");
    }
    text
}

/// The encoding that the declaration at the start of `text` names, and its place there.
fn declared(text: &str) -> Option<(Range<usize>, String)> {
    let start = text.len() - text.trim_start().len();
    let declaration = text.get(start..)?.strip_prefix("<?xml")?;
    let declaration = declaration.get(..declaration.find("?>")?)?;
    let key = start + "<?xml".len() + declaration.find("encoding")? + "encoding".len();
    let after = text.get(key..)?;
    let quote = after.find(['"', '\''])?;
    let from = key + quote + 1;
    let length = text
        .get(from..)?
        .find(*after.as_bytes().get(quote)? as char)?;
    let label = text.get(from..from + length)?;
    Some((from..from + length, label.to_owned()))
}

#[derive(Debug)]
struct Element<'t> {
    name: &'t str,
    attributes: Vec<(&'t str, Cow<'t, str>)>,
    /// The text directly in it.
    text: String,
    children: Vec<usize>,
    /// From the start of its start tag to the end of its end tag.
    range: Range<usize>,
    /// The end of its start tag.
    content: usize,
}

/// The elements of a text, in its order.
#[derive(Debug)]
pub(super) struct Document<'t> {
    text: &'t str,
    elements: Vec<Element<'t>>,
    /// While it is read, the elements whose end tag has not come, outermost first.
    open: Vec<usize>,
}

impl<'t> Document<'t> {
    /// Reads a text.
    ///
    /// # Errors
    /// It has no element, or tags that do not fit together.
    pub(super) fn parse(text: &'t str) -> Result<Self, ModelError> {
        // To the other readers a NUL is the end.
        let text = text.split('\0').next().unwrap_or_default();
        let reader_from = |at: usize| {
            let mut reader = quick_xml::Reader::from_str(text.get(at..).unwrap_or_default());
            let config = reader.config_mut();
            config.allow_dangling_amp = true;
            // The check here can name both lines.
            config.check_end_names = false;
            config.allow_unmatched_ends = true;
            reader
        };
        // Where the reader began. It would not count a byte order mark.
        let mut base = text.len() - text.trim_start_matches('\u{feff}').len();
        let mut reader = reader_from(base);
        let mut document = Self {
            text,
            elements: Vec::new(),
            open: Vec::new(),
        };
        loop {
            let place = |at: u64| usize::try_from(at).map_or(text.len(), |at| base + at);
            let start = place(reader.buffer_position());
            match reader.read_event() {
                Ok(event) => {
                    let end = place(reader.buffer_position());
                    if document.take(event, start..end)?.is_break() {
                        break;
                    }
                }
                Err(error) => {
                    // `<!x>`, which no reader knows, is skipped.
                    let unknown = matches!(
                        error,
                        quick_xml::Error::Syntax(SyntaxError::InvalidBangMarkup)
                    );
                    let length = text.get(start..).and_then(|rest| rest.find('>'));
                    let Some(length) = length.filter(|_| unknown) else {
                        let at = place(reader.error_position());
                        return Err(document.wrong(at, error.to_string()));
                    };
                    base = start + length + 1;
                    reader = reader_from(base);
                }
            }
        }
        if let Some(&number) = document.open.last() {
            let Element { name, range, .. } = &document.elements[number];
            return Err(document.wrong(range.start, format!("<{name}> is not closed")));
        }
        if document.elements.is_empty() {
            return Err(document.wrong(0, "it has no element".to_owned()));
        }
        Ok(document)
    }

    fn wrong(&self, at: usize, reason: String) -> ModelError {
        ModelError::Syntax {
            line: line_at(self.text, at),
            reason,
        }
    }

    /// The first root element of this name, else the first one of any name.
    pub(super) fn root(&self, name: &str) -> ElementRef<'_> {
        let node = |number| ElementRef {
            document: self,
            number,
        };
        // The elements of a root lie in its range.
        let mut number = 0;
        while let Some(element) = self.elements.get(number) {
            if element.name == name {
                return node(number);
            }
            let end = element.range.end;
            number = self.elements.partition_point(|e| e.range.start < end);
        }
        node(0)
    }

    /// Takes what is next in the text, at `range`; breaks at its end.
    fn take(
        &mut self,
        event: Event<'_>,
        range: Range<usize>,
    ) -> Result<ControlFlow<()>, ModelError> {
        match event {
            Event::Start(_) => self.start(range, false)?,
            Event::Empty(_) => self.start(range, true)?,
            Event::End(tag) => {
                let name = tag.name();
                let name = str::from_utf8(name.into_inner()).unwrap_or_default();
                return self.end(name.trim(), range);
            }
            Event::Text(more) => self.add_text(str::from_utf8(&more).unwrap_or_default()),
            Event::CData(more) => self.add_text(str::from_utf8(&more).unwrap_or_default()),
            Event::GeneralRef(_) => {
                let raw = self.text.get(range).unwrap_or_default();
                self.add_text(&lenient(raw));
            }
            Event::Eof => return Ok(ControlFlow::Break(())),
            Event::Comment(_) | Event::Decl(_) | Event::PI(_) | Event::DocType(_) => {}
        }
        Ok(ControlFlow::Continue(()))
    }

    fn start(&mut self, range: Range<usize>, is_empty: bool) -> Result<(), ModelError> {
        let tag = self.text.get(range.start + 1..range.end - 1);
        let tag = tag.unwrap_or_default();
        let tag = tag.strip_suffix('/').filter(|_| is_empty).unwrap_or(tag);
        let tag = tag.trim_start();
        let name_end = tag.find(char::is_whitespace).unwrap_or(tag.len());
        let name = tag.get(..name_end).unwrap_or_default();
        let mut attributes = Vec::new();
        for attribute in Attributes::new(tag, name_end) {
            let syntax_error = |error| self.wrong(range.start, format!("<{name}>: {error}"));
            let attribute = attribute.map_err(syntax_error)?;
            let key = str::from_utf8(attribute.key.into_inner()).unwrap_or_default();
            let value = match attribute.value {
                Cow::Borrowed(raw) => str::from_utf8(raw).unwrap_or_default(),
                Cow::Owned(_) => "",
            };
            attributes.push((key, lenient(value)));
        }
        let elements = &mut self.elements;
        let number = elements.len();
        if let Some(parent) = self.open.last() {
            elements[*parent].children.push(number);
        }
        elements.push(Element {
            name,
            attributes,
            text: String::new(),
            children: Vec::new(),
            content: range.end,
            range,
        });
        if !is_empty {
            self.open.push(number);
        }
        Ok(())
    }

    fn end(&mut self, name: &str, range: Range<usize>) -> Result<ControlFlow<()>, ModelError> {
        let Some(number) = self.open.pop() else {
            // After the root it ends the text for the other readers, too.
            if !self.elements.is_empty() {
                return Ok(ControlFlow::Break(()));
            }
            let reason = format!("</{name}> closes nothing");
            return Err(self.wrong(range.start, reason));
        };
        let element = &mut self.elements[number];
        element.range.end = range.end;
        if element.name == name {
            return Ok(ControlFlow::Continue(()));
        }
        let line = line_at(self.text, element.range.start);
        let reason = format!("</{name}> where <{}> of line {line} is open", element.name);
        Err(self.wrong(range.start, reason))
    }

    /// Text belongs to the innermost open element.
    fn add_text(&mut self, more: &str) {
        let elements = &mut self.elements;
        if let Some(element) = self
            .open
            .last()
            .and_then(|&number| elements.get_mut(number))
        {
            element.text.push_str(more);
        }
    }
}

/// `raw` with its entities resolved; what is none stays as it is.
fn lenient(raw: &str) -> Cow<'_, str> {
    unescape(raw).unwrap_or_else(|_| {
        let piece = |piece| unescape(piece).unwrap_or(Cow::Borrowed(piece));
        let mut out = String::with_capacity(raw.len());
        let mut rest = raw;
        while let Some(at) = rest.find('&') {
            let length = rest[at..].find(';').map_or(1, |length| length + 1);
            out.push_str(&rest[..at]);
            let reference = &rest[at..at + length];
            // `a & b &lt; c`: the reference begins at the last `&` before the semicolon.
            let begin = reference.rfind('&').unwrap_or(0);
            out.push_str(&reference[..begin]);
            out.push_str(&piece(&reference[begin..]));
            rest = &rest[at + length..];
        }
        out.push_str(rest);
        Cow::Owned(out)
    })
}

/// The line, from 1, of a place in a text.
fn line_at(text: &str, at: usize) -> usize {
    let before = text.as_bytes().get(..at).unwrap_or(text.as_bytes());
    1 + before.iter().filter(|&&byte| byte == b'\n').count()
}

/// An element of a document.
#[derive(Clone, Copy)]
pub(super) struct ElementRef<'d> {
    document: &'d Document<'d>,
    number: usize,
}

impl<'d> ElementRef<'d> {
    fn element(self) -> &'d Element<'d> {
        &self.document.elements[self.number]
    }

    /// Its name, with its prefix if it has one.
    pub(super) fn name(self) -> &'d str {
        self.element().name
    }

    /// The value of an attribute; none if it is empty.
    pub(super) fn attribute(self, name: &str) -> Option<&'d str> {
        let mut attributes = self.element().attributes.iter();
        attributes
            .find(|(key, value)| *key == name && !value.trim().is_empty())
            .map(|(_, value)| &**value)
    }

    /// The names of its attributes.
    pub(super) fn attributes(self) -> impl Iterator<Item = &'d str> {
        self.element().attributes.iter().map(|(key, _)| *key)
    }

    /// The text directly in it.
    pub(super) fn text(self) -> &'d str {
        self.element().text.trim()
    }

    /// The elements directly in it.
    pub(super) fn children(self) -> impl Iterator<Item = Self> {
        let document = self.document;
        let children = self.element().children.iter();
        children.map(move |&number| Self { document, number })
    }

    /// The first element of this name directly in it.
    pub(super) fn child(self, name: &str) -> Option<Self> {
        self.children().find(|child| child.name() == name)
    }

    /// The elements anywhere in it.
    pub(super) fn descendants(self) -> impl Iterator<Item = Self> {
        let (document, end) = (self.document, self.element().range.end);
        let after = self.number + 1..document.elements.len();
        after
            .map(move |number| Self { document, number })
            .take_while(move |node| node.element().range.start < end)
    }

    /// The first element of this name anywhere in it.
    pub(super) fn descendant(self, name: &str) -> Option<Self> {
        self.descendants().find(|node| node.name() == name)
    }

    /// The line of its start tag, from 1. Counted only when asked for.
    pub(super) fn line(self) -> usize {
        line_at(self.document.text, self.element().range.start)
    }

    /// Its place in the text.
    pub(super) fn range(self) -> Range<usize> {
        self.element().range.clone()
    }

    /// Where its content begins.
    pub(super) fn content(self) -> usize {
        self.element().content
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_begins_no_entity_stays() {
        for (raw, expected) in [
            ("a&lt;b&#233;&amp;", "a<b\u{e9}&"),
            ("a & b", "a & b"),
            ("a & b &lt; c", "a & b < c"),
            ("&foo;&gt;&#xZZ;", "&foo;>&#xZZ;"),
            ("&", "&"),
            ("&;&&;", "&;&&;"),
        ] {
            assert_eq!(lenient(raw), expected, "{raw}");
        }
    }

    #[test]
    fn bytes_are_decoded_as_they_say_or_as_they_must_be() {
        let text =
            |encoding: &str| format!("\n<?xml version='1.0' encoding='{encoding}'?><r \u{e9}/>");
        let latin = |encoding: &str| text(encoding).chars().map(|c| c as u8).collect::<Vec<u8>>();
        let utf16 = |encoding: &str, bytes: fn(u16) -> [u8; 2], mark: &[u16]| -> Vec<u8> {
            let text = text(encoding);
            let units = text.trim_start().encode_utf16();
            let units = mark.iter().copied().chain(units);
            units.flat_map(bytes).collect()
        };
        for encoding in ["ISO-8859-1", "latin1", "windows-1252"] {
            assert_eq!(decode(&latin(encoding)), text("UTF-8"), "{encoding}");
        }
        assert_eq!(decode(text("utf-8").as_bytes()), text("utf-8"));
        // Wrong or unknown declarations.
        assert_eq!(decode(&latin("utf-8")), text("utf-8"));
        assert_eq!(decode(text("UTF-16").as_bytes()), text("UTF-8"));
        assert_eq!(decode(text("klingon").as_bytes()), text("UTF-8"));
        assert_eq!(decode(b"\xef\xbb\xbf<r/>"), "<r/>");
        assert_eq!(decode(b"\xef\xbb\xbf<r \xe9/>"), "<r \u{e9}/>");
        assert_eq!(decode(b"<r \xe9/>"), "<r \u{e9}/>");
        for (bytes, mark) in [
            (u16::to_le_bytes as fn(u16) -> [u8; 2], &[0xfeff_u16][..]),
            (u16::to_be_bytes, &[0xfeff]),
            (u16::to_le_bytes, &[]),
            (u16::to_be_bytes, &[]),
        ] {
            assert_eq!(
                decode(&utf16("UTF-16", bytes, mark)),
                text("UTF-8").trim_start()
            );
        }
        assert_eq!(decode(b""), "");
    }

    #[test]
    fn a_tree_is_read_with_its_places() {
        let text = "<?xml version=\"1.0\"?>\n<!DOCTYPE robot [<!ENTITY a \"b>\">]>\n<!-- a--b \
         --->\n\
            <note/>\n<robot name='r'a:b=\"1\"><x:y>\n1 &lt; <z/>2 & &foo;<![CDATA[<]]></x:y>\
            < e f = \"'>\" /></robot >\n<robot/> &\0";
        let document = Document::parse(text).unwrap();
        let robot = document.root("robot");
        assert_eq!((robot.name(), robot.line()), ("robot", 5));
        assert_eq!(robot.attribute("name"), Some("r"));
        assert_eq!(robot.attributes().collect::<Vec<_>>(), ["name", "a:b"]);
        let [y, e] = [robot.children().next(), robot.children().nth(1)].map(Option::unwrap);
        assert_eq!((y.name(), y.text(), y.line()), ("x:y", "1 < 2 & &foo;<", 5));
        assert_eq!((e.name(), e.attribute("f")), ("e", Some("'>")));
        assert_eq!(robot.descendant("z").unwrap().line(), 6);
        assert!(robot.child("z").is_none() && y.descendant("e").is_none());
        assert_eq!(
            &text[y.content()..y.range().end],
            "\n1 &lt; <z/>2 & &foo;<![CDATA[<]]></x:y>"
        );
        assert_eq!(document.root("sdf").name(), "note");
    }

    #[test]
    fn places_are_right_behind_what_is_skipped() {
        let text = "\u{feff}<a>\n<!x\n>&lt;<b c='d'/>\n</a>";
        let document = Document::parse(text).unwrap();
        let b = document.root("a").child("b").unwrap();
        assert_eq!((b.line(), b.attribute("c")), (3, Some("d")));
        assert_eq!(&text[b.range()], "<b c='d'/>");
        assert_eq!(document.root("a").range(), 3..text.len());
    }

    #[test]
    fn tags_that_do_not_fit_have_their_lines() {
        let error = |text: &str| {
            let error = Document::parse(text).unwrap_err().to_string();
            let after = error.strip_prefix("the URDF is not XML: line ");
            after.expect("a line").to_owned()
        };
        assert_eq!(
            error("<a>\n<b>\n</a>"),
            "3: </a> where <b> of line 2 is open"
        );
        assert_eq!(error("<a>\n<b>\n</b>\n"), "1: <a> is not closed");
        assert_eq!(error("\n</b><a/>"), "2: </b> closes nothing");
        assert_eq!(error(" \n"), "1: it has no element");
        assert!(error("<a/>\n<b c=d/>").starts_with("2: <b>: "));
        assert!(error("<a/>\n<b c='d' c='e'/>").starts_with("2: <b>: "));
        assert!(
            error("<a>\n<!-- ").starts_with("2: "),
            "{}",
            error("<a>\n<!-- ")
        );
    }
}
