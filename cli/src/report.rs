//! The demo's report: one self-contained HTML file with plots, readable on a phone.

use plotters::prelude::*;
use std::fmt::Write as _;

/// One curve.
pub(crate) struct Curve<'a> {
    /// Its name in the legend.
    pub(crate) name: &'a str,
    /// Its colour.
    pub(crate) colour: RGBColor,
    /// Points (t, y); a NaN breaks the line.
    pub(crate) points: Vec<(f64, f64)>,
}

/// A plot of `curves` over time as SVG text.
pub(crate) fn plot(title: &str, unit: &str, curves: &[Curve<'_>]) -> anyhow::Result<String> {
    let finite = || {
        curves
            .iter()
            .flat_map(|c| &c.points)
            .filter(|(t, y)| t.is_finite() && y.is_finite())
    };
    let (mut x, mut y) = ((f64::MAX, f64::MIN), (f64::MAX, f64::MIN));
    for (px, py) in finite() {
        x = (x.0.min(*px), x.1.max(*px));
        y = (y.0.min(*py), y.1.max(*py));
    }
    if x.0 >= x.1 {
        return Ok(format!("<p>{}: no data</p>", escape(title)));
    }
    let margin = ((y.1 - y.0) * 0.06).max(1e-3);
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, (720, 220)).into_drawing_area();
        let mut chart = ChartBuilder::on(&area)
            .margin(6)
            .x_label_area_size(26)
            .y_label_area_size(58)
            .build_cartesian_2d(x.0..x.1, y.0 - margin..y.1 + margin)?;
        chart
            .configure_mesh()
            .light_line_style(WHITE)
            .x_desc("t [s]")
            .y_desc(format!("{title} [{unit}]"))
            .draw()?;
        for curve in curves {
            let style = curve.colour.stroke_width(1);
            // A line series draws through gaps, so each run of numbers is a series of its own.
            for (i, run) in curve
                .points
                .split(|(t, y)| !t.is_finite() || !y.is_finite())
                .filter(|r| !r.is_empty())
                .enumerate()
            {
                let series = chart.draw_series(LineSeries::new(run.iter().copied(), style))?;
                if i == 0 {
                    let colour = curve.colour;
                    series
                        .label(curve.name)
                        .legend(move |(x, y)| PathElement::new([(x, y), (x + 14, y)], colour));
                }
            }
        }
        chart
            .configure_series_labels()
            .background_style(WHITE.mix(0.8))
            .border_style(BLACK.mix(0.3))
            .draw()?;
        area.present()?;
    }
    // Scales with the page: a view box instead of a fixed size.
    Ok(svg.replacen("width=\"720\" height=\"220\"", "width=\"100%\"", 1))
}

/// At most `most` points of `points`, evenly picked: a plot has 720 pixels.
pub(crate) fn thin(points: Vec<(f64, f64)>, most: usize) -> Vec<(f64, f64)> {
    let step = points.len().div_ceil(most.max(1)).max(1);
    points.into_iter().step_by(step).collect()
}

/// The page: a title, rows of a table of facts, and blocks of HTML.
pub(crate) fn page(title: &str, facts: &[(&str, String)], blocks: &[String]) -> String {
    let mut html = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width, \
         initial-scale=1\"><title>{0}</title><style>body{{font:16px/1.5 system-ui,sans-serif;margin:1rem auto;padding:0 1rem;\
         max-width:52rem}}table{{border-collapse:collapse}}td,th{{padding:.15rem .8rem .15rem 0;text-align:left;vertical-align:top}}\
         td.n{{text-align:right;font-variant-numeric:tabular-nums}}svg{{height:auto}}</style></head><body><h1>{0}</h1><table>",
        escape(title)
    );
    for (name, value) in facts {
        let _ = write!(html, "<tr><th>{}</th><td>{}</td></tr>", escape(name), escape(value));
    }
    html.push_str("</table>");
    for block in blocks {
        html.push_str(block);
        html.push('\n');
    }
    html.push_str("</body></html>\n");
    html
}

/// Text that is safe in HTML.
pub(crate) fn escape(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}
