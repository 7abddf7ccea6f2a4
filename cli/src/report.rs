//! Parts of a report: one self-contained HTML file (no scripts, no network access) with plots and
//! tables. It is readable on narrow and wide screens, in light and dark mode. `demo` and `identify`
//! build their pages from these parts.

mod escape;
pub(crate) mod plot;

pub(crate) use escape::escape;

use proprio_estimator::check::significant;
use std::fmt::Write as _;

/// The style sheet. Colours after Okabe and Ito, which the colour-blind can distinguish.
const STYLE: &str = include_str!("report/style.css");

/// A page from blocks of HTML.
pub(crate) fn page(title: &str, blocks: &[String]) -> String {
    let mut html = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
         <meta name=\"color-scheme\" content=\"light dark\"><title>{0}</title>\
         <style>{STYLE}</style></head>\n<body><main><h1>{0}</h1>\n",
        escape(title)
    );
    for block in blocks {
        html.push_str(block);
        html.push('\n');
    }
    html.push_str("</main></body></html>\n");
    html
}

/// The verdict of a page: its class (`good`, `care`, `bad`), its heading and what it rests on.
pub(crate) fn verdict(class: &str, heading: &str, figures: &str) -> String {
    let (heading, figures) = (escape(heading), paragraph(&unbroken(figures)));
    format!("<div class=\"verdict {class}\"><h2>{heading}</h2>{figures}</div>")
}

/// The text with numbers and their per cent signs on one line.
fn unbroken(text: &str) -> String {
    text.replace(" %", "\u{a0}%")
}

/// A section: a heading and its contents.
pub(crate) fn section(title: &str, body: &[String]) -> String {
    format!(
        "<section><h2>{}</h2>\n{}</section>",
        escape(title),
        body.join("\n")
    )
}

/// A folded part, which the reader can unfold.
pub(crate) fn folded(title: &str, open: bool, body: &[String]) -> String {
    let open = if open { " open" } else { "" };
    format!(
        "<details{open}><summary>{}</summary>\n{}</details>",
        escape(title),
        body.join("\n")
    )
}

/// A paragraph of plain text; empty HTML without any.
pub(crate) fn paragraph(text: &str) -> String {
    match text {
        "" => String::new(),
        text => format!("<p>{}</p>", escape(text)),
    }
}

/// A list of plain texts; empty HTML if there is none.
pub(crate) fn list<S: AsRef<str>>(items: impl IntoIterator<Item = S>) -> String {
    let items: String = items
        .into_iter()
        .map(|item| format!("<li>{}</li>", escape(item.as_ref())))
        .collect();
    if items.is_empty() {
        items
    } else {
        format!("<ul>{items}</ul>")
    }
}

/// Figures side by side where the page is wide enough.
pub(crate) fn figures<'a>(plots: impl IntoIterator<Item = &'a plot::Plot>) -> String {
    let plots: String = plots.into_iter().map(plot::Plot::html).collect();
    format!("<div class=\"figures\">{plots}</div>")
}

/// One cell of a table.
#[derive(Debug, Clone)]
pub(crate) enum Cell {
    /// Text; in the first column it is the row's heading.
    Text(String),
    /// A number with three significant digits.
    Number(f64),
    /// An already formatted number, such as a percentage.
    Written(String),
    /// A formatted number with a bar behind it: the fraction of the cell that the bar covers, and
    /// its colour.
    Bar(String, f64, plot::Ink),
    /// A number and its standard deviation.
    Uncertain(f64, f64),
}

impl From<&str> for Cell {
    fn from(text: &str) -> Self {
        Self::Text(text.to_owned())
    }
}

impl From<String> for Cell {
    fn from(text: String) -> Self {
        Self::Text(text)
    }
}

impl From<f64> for Cell {
    fn from(number: f64) -> Self {
        Self::Number(number)
    }
}

/// A table, which scrolls horizontally if the page is too narrow for it.
#[derive(Debug, Clone)]
pub(crate) struct ReportTable {
    caption: String,
    head: Vec<String>,
    rows: Vec<Vec<Cell>>,
}

impl ReportTable {
    pub(crate) fn new(caption: &str, head: &[&str]) -> Self {
        Self {
            caption: caption.to_owned(),
            head: head.iter().map(|h| (*h).to_owned()).collect(),
            rows: vec![],
        }
    }

    pub(crate) fn row(&mut self, cells: Vec<Cell>) {
        self.rows.push(cells);
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Empty text for a table without rows.
    pub(crate) fn html(&self) -> String {
        let Some(first) = self.rows.first() else {
            return String::new();
        };
        let mut html = String::new();
        // Outside the scrolling part, so that it is as wide as the page, not as the table.
        if !self.caption.is_empty() {
            let _ = write!(html, "<p class=\"caption\">{}</p>", escape(&self.caption));
        }
        let _ = write!(
            html,
            "<div class=\"scroll\" tabindex=\"0\" role=\"region\" aria-label=\"{}\"><table>",
            escape(&self.caption)
        );
        html.push_str("<thead><tr>");
        for (i, head) in self.head.iter().enumerate() {
            let class = if matches!(first.get(i), Some(Cell::Text(_)) | None) {
                ""
            } else {
                " class=\"n\""
            };
            let _ = write!(html, "<th scope=\"col\"{class}>{}</th>", escape(head));
        }
        html.push_str("</tr></thead><tbody>");
        for row in &self.rows {
            html.push_str("<tr>");
            for (i, cell) in row.iter().enumerate() {
                let _ = match cell {
                    Cell::Text(text) if i == 0 => {
                        write!(html, "<th scope=\"row\">{}</th>", escape(text))
                    }
                    Cell::Text(text) => write!(html, "<td>{}</td>", escape(text)),
                    Cell::Number(value) => write!(html, "<td class=\"n\">{}</td>", number(*value)),
                    Cell::Written(text) => write!(html, "<td class=\"n\">{}</td>", escape(text)),
                    Cell::Bar(text, share, ink) => write!(
                        html,
                        "<td class=\"n bar\"><i class=\"{}\" \
                         style=\"width:{:.0}%\"></i><span>{}</span></td>",
                        ink.class(),
                        if share.is_finite() {
                            share.clamp(0.0, 1.0) * 100.0
                        } else {
                            0.0
                        },
                        escape(text)
                    ),
                    Cell::Uncertain(value, deviation) => {
                        write!(
                            html,
                            "<td class=\"n\">{} <small>± {}</small></td>",
                            number(*value),
                            short(*deviation)
                        )
                    }
                };
            }
            html.push_str("</tr>");
        }
        html.push_str("</tbody></table></div>");
        html
    }
}

/// Those tables that have rows.
pub(crate) fn tables<const N: usize>(all: [ReportTable; N]) -> Vec<String> {
    let filled = all.iter().filter(|table| !table.is_empty());
    filled.map(ReportTable::html).collect()
}

/// A list of facts: names and values.
pub(crate) fn facts(facts: &[(&str, String)]) -> String {
    let rows: String = facts
        .iter()
        .map(|(name, value)| (escape(name), unbroken(&escape(value))))
        .map(|(name, value)| format!("<div><dt>{name}</dt><dd>{value}</dd></div>"))
        .collect();
    format!("<dl class=\"facts\">{rows}</dl>")
}

/// A number with three significant digits; a dash for NaN.
pub(crate) fn number(value: f64) -> String {
    digits(value, 3)
}

/// A number with two significant digits, for standard deviations.
pub(crate) fn short(value: f64) -> String {
    digits(value, 2)
}

fn digits(value: f64, count: u8) -> String {
    if value == 0.0 {
        return "0".into();
    }
    if value.is_nan() {
        return "–".into();
    }
    if value.is_infinite() {
        return if value > 0.0 {
            "∞".into()
        } else {
            "−∞".into()
        };
    }
    // Rounding may add a digit: 9.996 becomes 10.0.
    let scientific = format!("{value:.*e}", usize::from(count) - 1);
    let rounded: f64 = scientific.parse().unwrap_or(value);
    let power = rounded.abs().log10().floor() as i32;
    let text = match power {
        -4..=5 => significant(rounded, count),
        _ => scientific,
    };
    text.replace('-', "−")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_three_digits() {
        for (value, text) in [
            (0.0, "0"),
            (9.996, "10.0"),
            (-1.2345, "−1.23"),
            (0.000_123_456, "0.000123"),
            (123_456.0, "123000"),
            (1.5e-7, "1.50e−7"),
            (f64::NAN, "–"),
            (f64::INFINITY, "∞"),
        ] {
            assert_eq!(number(value), text);
        }
    }

    #[test]
    fn names_from_files_can_not_break_the_page() {
        let mut table = ReportTable::new("a & b", &["<x>"]);
        table.row(vec!["<script>".into(), f64::NAN.into()]);
        let html = page(
            "<b>",
            &[section(
                "\"",
                &[table.html(), list(["<i>"]), facts(&[("<", ">".into())])],
            )],
        );
        assert!(
            !html.contains("<script>") && !html.contains("<x>") && !html.contains("<i>"),
            "{html}"
        );
        assert!(html.contains("&lt;script&gt;"));
    }
}
