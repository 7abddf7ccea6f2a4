//! Plots as SVG inside HTML, for narrow and wide pages.
//!
//! Only the drawing is SVG, stretched to the width of the page. All text (ticks, legend, marks) is
//! HTML placed over it in percent. So text has the page's font size at any width, and colours come
//! from the page's style sheet, which supports light and dark mode. Lines keep their width when
//! stretched (`vector-effect`); dots are lines of zero length with round ends. Coordinates are
//! integers from 0 to [`WIDE`] and [`HIGH`], so that a curve needs about six bytes per point.

use super::escape::escape;
use std::fmt::Write as _;

/// Width of the drawing in units.
const WIDE: f64 = 4000.0;
/// Height of the drawing in units.
const HIGH: f64 = 1500.0;
/// Approximate number of ticks on an axis.
const TICKS: usize = 6;

/// The meaning of a curve; it determines the colour, the same in all plots of a page.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Ink {
    /// A measurement, or the truth.
    Measured,
    /// The parameters of the CAD.
    Cad,
    /// The same with fitted offsets and friction.
    Fitted,
    /// The identified parameters.
    Identified,
}

impl Ink {
    /// Its class in the style sheet.
    pub(crate) fn class(self) -> &'static str {
        match self {
            Self::Measured => "measured",
            Self::Cad => "cad",
            Self::Fitted => "fitted",
            Self::Identified => "identified",
        }
    }
}

/// The shape of a series.
#[derive(Debug, Clone)]
pub(crate) enum Shape {
    /// A line through points (x, y), ascending in x; a NaN breaks it.
    Line(Vec<(f64, f64)>),
    /// The area between two lines: (x, low, high).
    Band(Vec<(f64, f64, f64)>),
    /// Points with error bars: (x, y, low, high); without a bar where low or high is NaN.
    Dots(Vec<(f64, f64, f64, f64)>),
}

/// One series of a plot.
#[derive(Debug, Clone)]
pub(crate) struct Trace {
    /// Its name in the legend; series without a name are not listed.
    pub(crate) name: String,
    /// Its colour.
    pub(crate) ink: Ink,
    /// Its shape.
    pub(crate) shape: Shape,
}

impl Trace {
    pub(crate) fn line(name: &str, ink: Ink, points: Vec<(f64, f64)>) -> Self {
        Self {
            name: name.to_owned(),
            ink,
            shape: Shape::Line(points),
        }
    }

    pub(crate) fn band(name: &str, ink: Ink, points: Vec<(f64, f64, f64)>) -> Self {
        Self {
            name: name.to_owned(),
            ink,
            shape: Shape::Band(points),
        }
    }

    pub(crate) fn dots(name: &str, ink: Ink, points: Vec<(f64, f64, f64, f64)>) -> Self {
        Self {
            name: name.to_owned(),
            ink,
            shape: Shape::Dots(points),
        }
    }
}

/// The meaning of a shaded stretch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Shade {
    /// An estimate is withheld.
    Withheld,
    /// The robot is touched.
    Touched,
}

impl Shade {
    /// Its class in the style sheet and its name in the legend.
    fn words(self) -> (&'static str, &'static str) {
        match self {
            Self::Withheld => ("withheld", "withheld"),
            Self::Touched => ("touched", "pushed"),
        }
    }
}

/// The scale of an axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) enum AxisScale {
    #[default]
    Linear,
    /// Logarithmic; values that are not positive are not drawn.
    Log,
}

/// One axis.
#[derive(Debug, Clone, Default)]
pub(crate) struct PlotAxis {
    /// Its label with the unit: `t [s]`.
    pub(crate) label: String,
    /// Its scale.
    pub(crate) scale: AxisScale,
    /// Its range; `None`: from the data.
    pub(crate) range: Option<(f64, f64)>,
}

impl PlotAxis {
    pub(crate) fn new(label: &str) -> Self {
        Self {
            label: label.to_owned(),
            ..Self::default()
        }
    }

    pub(crate) fn within(label: &str, range: (f64, f64)) -> Self {
        Self {
            range: Some(range),
            ..Self::new(label)
        }
    }

    pub(crate) fn log(label: &str) -> Self {
        Self {
            scale: AxisScale::Log,
            ..Self::new(label)
        }
    }
}

/// A plot with its caption.
#[derive(Debug, Clone, Default)]
pub(crate) struct Plot {
    /// Its title.
    pub(crate) title: String,
    /// One sentence under the title; may be empty.
    pub(crate) note: String,
    /// The horizontal axis.
    pub(crate) x: PlotAxis,
    /// The vertical axis.
    pub(crate) y: PlotAxis,
    /// The series; the first is drawn at the bottom.
    pub(crate) series: Vec<Trace>,
    /// Vertical lines: position and label.
    pub(crate) marks: Vec<(f64, String)>,
    /// Stretches of x, shaded from top to bottom.
    pub(crate) shades: Vec<(Shade, Vec<(f64, f64)>)>,
    /// Maximum number of points per line; peaks are retained.
    pub(crate) most: usize,
}

impl Plot {
    /// The plot as a `<figure>`.
    pub(crate) fn html(&self) -> String {
        let mut html = String::from("<figure><figcaption>");
        let _ = write!(html, "<b>{}</b>", escape(&self.title));
        if !self.note.is_empty() {
            let _ = write!(html, " <span>{}</span>", escape(&self.note));
        }
        html.push_str("</figcaption>");
        let Some((x, y)) = self.ranges() else {
            html.push_str("<p class=\"none\">No data.</p></figure>");
            return html;
        };
        html.push_str(&self.legend());
        let _ = write!(
            html,
            "<div class=\"y-label\">{}</div><div class=\"plot\">{}{}</div><div \
             class=\"x-label\">{}</div></figure>",
            y.label(&self.y.label),
            self.svg(&x, &y),
            self.labels(&x, &y),
            x.label(&self.x.label)
        );
        html
    }

    /// The list of the series with a name, and of the shades; empty without a name.
    fn legend(&self) -> String {
        let mut html = String::new();
        for series in self.series.iter().filter(|s| !s.name.is_empty()) {
            let _ = write!(
                html,
                "<li class=\"{}{}\">{}</li>",
                series.ink.class(),
                series.shape.class(),
                escape(&series.name)
            );
        }
        if html.is_empty() {
            return html;
        }
        for (shade, stretches) in &self.shades {
            if !stretches.is_empty() {
                let (class, name) = shade.words();
                let _ = write!(html, "<li class=\"wide {class}\">{name}</li>");
            }
        }
        format!("<ul class=\"legend\">{html}</ul>")
    }

    /// The drawing: grid, shades, series, marks.
    fn svg(&self, x: &Range, y: &Range) -> String {
        let mut svg = format!(
            "<svg viewBox=\"0 0 {WIDE} {HIGH}\" preserveAspectRatio=\"none\" role=\"img\" \
             aria-label=\"{}\">",
            escape(&self.title)
        );
        let mut grid = String::new();
        for (value, _) in x.ticks(TICKS) {
            let _ = write!(grid, "M{:.0} 0V{HIGH}", x.at(value) * WIDE);
        }
        for (value, _) in y.ticks(TICKS) {
            let _ = write!(grid, "M0 {:.0}H{WIDE}", (1.0 - y.at(value)) * HIGH);
        }
        let _ = write!(svg, "<path class=\"grid\" d=\"{grid}\"/>");
        if y.from < 0.0 && y.to > 0.0 && y.scale == AxisScale::Linear {
            let _ = write!(
                svg,
                "<path class=\"axis\" d=\"M0 {:.0}H{WIDE}\"/>",
                (1.0 - y.at(0.0)) * HIGH
            );
        }
        for (shade, stretches) in &self.shades {
            let mut path = String::new();
            for (from, until) in stretches {
                let [from, until] = [from, until].map(|t| (x.at(*t) * WIDE).clamp(0.0, WIDE));
                let _ = write!(
                    path,
                    "M{from:.0} 0H{:.0}V{HIGH}H{from:.0}z",
                    until.max(from + 4.0)
                );
            }
            if !path.is_empty() {
                let class = shade.words().0;
                let _ = write!(svg, "<path class=\"shade {class}\" d=\"{path}\"/>");
            }
        }
        for series in &self.series {
            self.draw(series, x, y, &mut svg);
        }
        for (at, _) in &self.marks {
            if (x.from..=x.to).contains(at) {
                let _ = write!(
                    svg,
                    "<path class=\"mark\" d=\"M{:.0} 0V{HIGH}\"/>",
                    x.at(*at) * WIDE
                );
            }
        }
        svg.push_str("</svg>");
        svg
    }

    /// The texts over the drawing: of ticks and marks.
    fn labels(&self, x: &Range, y: &Range) -> String {
        let mut html = String::new();
        for (value, text) in y.ticks(TICKS) {
            let _ = write!(
                html,
                "<span class=\"y\" style=\"top:{:.1}%\">{text}</span>",
                (1.0 - y.at(value)) * 100.0
            );
        }
        for (value, text) in x.ticks(TICKS) {
            let _ = write!(
                html,
                "<span class=\"x\" style=\"left:{:.1}%\">{text}</span>",
                x.at(value) * 100.0
            );
        }
        for (at, text) in &self.marks {
            let fraction = x.at(*at);
            if !(0.0..=1.0).contains(&fraction) {
                continue;
            }
            // Above the plot, extending towards its middle, so that the text stays inside.
            let (side, percent) = if fraction > 0.5 {
                ("right", 1.0 - fraction)
            } else {
                ("left", fraction)
            };
            let _ = write!(
                html,
                "<span class=\"m\" style=\"{side}:{:.1}%\">{}</span>",
                percent * 100.0,
                escape(text)
            );
        }
        html
    }

    /// The ranges of both axes; `None` if there is nothing to draw.
    fn ranges(&self) -> Option<(Range, Range)> {
        let (mut x, mut y) = (Extent::default(), Extent::default());
        for series in &self.series {
            match &series.shape {
                Shape::Line(points) => {
                    for &(px, py) in points {
                        if px.is_finite() && py.is_finite() {
                            x.see(px, self.x.scale);
                            y.see(py, self.y.scale);
                        }
                    }
                }
                // A band without information may be so wide that everything else would be
                // invisible: it does not set the range and is clipped by the plot.
                Shape::Band(points) => {
                    for &(px, low, high) in points {
                        if px.is_finite() && low.is_finite() && high.is_finite() {
                            x.see(px, self.x.scale);
                        }
                    }
                }
                Shape::Dots(points) => {
                    for &(px, py, low, high) in points {
                        if px.is_finite() && py.is_finite() {
                            x.see(px, self.x.scale);
                            for value in [py, low, high] {
                                y.see(value, self.y.scale);
                            }
                        }
                    }
                }
            }
        }
        Some((x.range(&self.x, 0.0)?, y.range(&self.y, 0.06)?))
    }

    fn draw(&self, series: &Trace, x: &Range, y: &Range, html: &mut String) {
        let class = series.ink.class();
        let point = |px: f64, py: f64| (x.at(px) * WIDE, (1.0 - y.at(py)) * HIGH);
        match &series.shape {
            Shape::Line(points) => {
                let points = thin(points, if self.most == 0 { 1000 } else { self.most });
                let mut path = SvgPath::default();
                for (px, py) in points {
                    if py.is_finite() && px.is_finite() && !(y.scale == AxisScale::Log && py <= 0.0)
                    {
                        path.to(point(px, py));
                    } else {
                        path.lift();
                    }
                }
                let _ = write!(html, "<path class=\"line {class}\" d=\"{}\"/>", path.text);
            }
            Shape::Band(points) => {
                let step = points
                    .len()
                    .div_ceil(if self.most == 0 {
                        400
                    } else {
                        (self.most / 2).max(60)
                    })
                    .max(1);
                let points: Vec<_> = points.iter().step_by(step).collect();
                let mut path = SvgPath::default();
                for run in points.split(|(_, low, high)| !low.is_finite() || !high.is_finite()) {
                    path.lift();
                    run.iter()
                        .for_each(|(px, _, high)| path.to(point(*px, *high)));
                    run.iter()
                        .rev()
                        .for_each(|(px, low, _)| path.to(point(*px, *low)));
                    if !run.is_empty() {
                        path.text.push('z');
                    }
                }
                let _ = write!(html, "<path class=\"band {class}\" d=\"{}\"/>", path.text);
            }
            Shape::Dots(points) => {
                let (mut bars, mut dots) = (String::new(), String::new());
                for &(px, py, low, high) in points {
                    if !px.is_finite()
                        || !py.is_finite()
                        || (y.scale == AxisScale::Log && py <= 0.0)
                    {
                        continue;
                    }
                    let (cx, cy) = point(px, py);
                    let _ = write!(dots, "M{cx:.0} {cy:.0}h0");
                    if low.is_finite() && high.is_finite() && low < high {
                        let _ = write!(
                            bars,
                            "M{cx:.0} {:.0}V{:.0}",
                            point(px, low).1,
                            point(px, high).1
                        );
                    }
                }
                if !bars.is_empty() {
                    let _ = write!(html, "<path class=\"line {class}\" d=\"{bars}\"/>");
                }
                let _ = write!(html, "<path class=\"dots {class}\" d=\"{dots}\"/>");
            }
        }
    }
}

impl Shape {
    fn class(&self) -> &'static str {
        match self {
            Self::Line(_) => "",
            Self::Band(_) => " wide",
            Self::Dots(_) => " round",
        }
    }
}

/// At most about `most` of `points`: the lowest and the highest of each stretch of x, in order, so
/// that no peak is lost.
fn thin(points: &[(f64, f64)], most: usize) -> Vec<(f64, f64)> {
    if points.len() <= most {
        return points.to_vec();
    }
    let size = points.len().div_ceil((most / 2).max(1));
    let mut thinned = Vec::with_capacity(most + 2);
    for part in points.chunks(size) {
        let mut ends: Option<(usize, usize)> = None;
        for (i, (_, value)) in part.iter().enumerate() {
            if !value.is_finite() {
                continue;
            }
            let (low, high) = ends.unwrap_or((i, i));
            let below = part.get(low).is_some_and(|p| *value < p.1);
            let above = part.get(high).is_some_and(|p| *value > p.1);
            ends = Some((if below { i } else { low }, if above { i } else { high }));
        }
        match ends {
            Some((low, high)) => {
                let (first, last) = (low.min(high), low.max(high));
                thinned.extend(part.get(first));
                // Keep a gap between the two.
                if part
                    .get(first..last)
                    .is_some_and(|p| p.iter().any(|(_, y)| !y.is_finite()))
                {
                    thinned.push((f64::NAN, f64::NAN));
                }
                if last != first {
                    thinned.extend(part.get(last));
                }
                if part.last().is_some_and(|(_, y)| !y.is_finite()) {
                    thinned.push((f64::NAN, f64::NAN));
                }
            }
            None => thinned.push((f64::NAN, f64::NAN)),
        }
    }
    thinned
}

/// SVG path data in whole numbers: the first point of a run is absolute, the others relative.
#[derive(Default)]
struct SvgPath {
    text: String,
    last: Option<(i64, i64)>,
}

impl SvgPath {
    fn to(&mut self, (x, y): (f64, f64)) {
        // Clamp points far outside; the plot clips them.
        let next = (
            x.clamp(-WIDE, 2.0 * WIDE).round() as i64,
            y.clamp(-HIGH, 2.0 * HIGH).round() as i64,
        );
        let _ = match self.last {
            None => write!(self.text, "M{} {}", next.0, next.1),
            Some(last) if last == next => Ok(()),
            Some(last) => write!(self.text, "l{} {}", next.0 - last.0, next.1 - last.1),
        };
        self.last = Some(next);
    }

    fn lift(&mut self) {
        self.last = None;
    }
}

/// The minimum and maximum.
struct Extent(f64, f64);

impl Default for Extent {
    fn default() -> Self {
        Self(f64::INFINITY, f64::NEG_INFINITY)
    }
}

impl Extent {
    fn see(&mut self, value: f64, scale: AxisScale) {
        if value.is_finite() && (scale == AxisScale::Linear || value > 0.0) {
            *self = Self(self.0.min(value), self.1.max(value));
        }
    }

    /// The axis' range, extended by the fraction `margin` at both ends.
    fn range(&self, axis: &PlotAxis, margin: f64) -> Option<Range> {
        let (from, to) = match axis.range {
            Some(range) => range,
            None if self.0 > self.1 => return None,
            None if axis.scale == AxisScale::Log => (
                (self.0.log10() - 0.1).floor(),
                (self.1.log10() + 0.1).ceil(),
            ),
            None => {
                // A single value still needs a range.
                let room = (self.1 - self.0)
                    .max(self.1.abs().max(self.0.abs()) * 1e-9)
                    .max(1e-9)
                    * margin;
                (self.0 - room, self.1 + room)
            }
        };
        (from < to).then_some(Range {
            from,
            to,
            scale: axis.scale,
        })
    }
}

/// The range of an axis; in decades on a logarithmic one.
#[derive(Debug, Clone, Copy)]
struct Range {
    from: f64,
    to: f64,
    scale: AxisScale,
}

impl Range {
    /// The position of `value`: 0 at the start, 1 at the end.
    fn at(&self, value: f64) -> f64 {
        let value = if self.scale == AxisScale::Log {
            value.log10()
        } else {
            value
        };
        (value - self.from) / (self.to - self.from)
    }

    /// About `count` round tick values with their texts.
    fn ticks(&self, count: usize) -> Vec<(f64, String)> {
        if self.scale == AxisScale::Log {
            let step = ((self.to - self.from) / count as f64).ceil().max(1.0) as i64;
            let (first, last) = (self.from.ceil() as i64, self.to.floor() as i64);
            return (first..=last)
                .filter(|decade| decade.rem_euclid(step) == 0)
                .map(|decade| {
                    (
                        10f64.powi(decade as i32),
                        format!("10<sup>{decade}</sup>").replace('-', "−"),
                    )
                })
                .collect();
        }
        let step = self.step(count);
        let (first, last) = (
            (self.from / step).ceil() as i64,
            (self.to / step).floor() as i64,
        );
        let unit = 10f64.powi(self.power());
        let decimals = (-(step / unit).log10() - 1e-9).ceil().max(0.0) as usize;
        (first..=last)
            .map(|i| {
                let value = i as f64 * step;
                let text = if i == 0 {
                    "0".into()
                } else {
                    format!("{:.decimals$}", value / unit).replace('-', "−")
                };
                (value, text)
            })
            .collect()
    }

    /// The step between about `count` round values.
    fn step(&self, count: usize) -> f64 {
        let rough = (self.to - self.from) / count as f64;
        let decade = 10f64.powf(rough.log10().floor());
        let steps = [1.0, 2.0, 5.0, 10.0].map(|m| m * decade);
        steps
            .into_iter()
            .find(|s| *s >= rough * 0.999)
            .unwrap_or(decade)
    }

    /// The common power of ten of all tick texts: 0 unless the texts would be long.
    fn power(&self) -> i32 {
        let largest = self.from.abs().max(self.to.abs());
        if self.scale == AxisScale::Log || (self.step(TICKS) >= 1e-3 && largest < 1e5) {
            0
        } else {
            largest.log10().floor() as i32
        }
    }

    /// An axis' label in HTML, with the power of ten of its ticks.
    fn label(&self, label: &str) -> String {
        match self.power() {
            0 => escape(label),
            power => format!("{} · 10<sup>{power}</sup>", escape(label)).replace('-', "−"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(points: Vec<(f64, f64)>) -> Plot {
        Plot {
            title: "a < b".into(),
            x: PlotAxis::new("t [s]"),
            y: PlotAxis::new("Nm"),
            series: vec![Trace::line("s", Ink::Cad, points)],
            ..Plot::default()
        }
    }

    #[test]
    fn a_line_goes_from_corner_to_corner_and_breaks_at_a_nan() {
        let mut plot = line(vec![
            (0.0, 0.0),
            (1.0, 1.0),
            (2.0, f64::NAN),
            (3.0, 0.5),
            (4.0, 1.0),
        ]);
        plot.y.range = Some((0.0, 1.0));
        let html = plot.html();
        assert!(
            html.contains("<path class=\"line cad\" d=\"M0 1500l1000 -1500M3000 750l1000 -750\"/>"),
            "{html}"
        );
        assert!(
            html.contains("a &lt; b") && html.contains(">t [s]<"),
            "{html}"
        );
    }

    #[test]
    fn nothing_finite_is_said_in_words() {
        for points in [vec![], vec![(0.0, f64::NAN)], vec![(1.0, 1.0)]] {
            let html = line(points).html();
            assert!(
                html.contains("No data.") && !html.contains("<svg"),
                "{html}"
            );
        }
    }

    #[test]
    fn ticks_are_round_numbers_inside_the_range() {
        let range = Range {
            from: -0.013,
            to: 0.027,
            scale: AxisScale::Linear,
        };
        let texts: Vec<String> = range.ticks(5).into_iter().map(|t| t.1).collect();
        assert_eq!(texts, ["−0.01", "0", "0.01", "0.02"]);
        let range = Range {
            from: -7.0,
            to: 2.0,
            scale: AxisScale::Log,
        };
        let texts: Vec<String> = range.ticks(5).into_iter().map(|t| t.1).collect();
        assert_eq!(
            texts,
            [
                "10<sup>−6</sup>",
                "10<sup>−4</sup>",
                "10<sup>−2</sup>",
                "10<sup>0</sup>",
                "10<sup>2</sup>"
            ]
        );
        for decade in -9..9 {
            for lead in [1.0, 1.7, 2.3, 4.9, 7.7] {
                let to = lead * 10f64.powi(decade);
                let ticks = Range {
                    from: 0.0,
                    to,
                    scale: AxisScale::Linear,
                }
                .ticks(5);
                assert!((3..=7).contains(&ticks.len()), "{to}: {ticks:?}");
                assert!(
                    ticks
                        .iter()
                        .all(|t| (0.0..=to).contains(&t.0) && t.1.chars().count() < 7),
                    "{to}: {ticks:?}"
                );
            }
        }
    }

    #[test]
    fn thinning_keeps_peaks_and_gaps() {
        let mut points: Vec<(f64, f64)> = (0..10_000)
            .map(|i| (f64::from(i), f64::from(i).sin()))
            .collect();
        points[4321].1 = 20.0;
        points[7777].1 = -30.0;
        for point in &mut points[5000..5600] {
            point.1 = f64::NAN;
        }
        let thinned = thin(&points, 500);
        assert!(thinned.len() <= 520, "{}", thinned.len());
        assert!(thinned.contains(&(4321.0, 20.0)) && thinned.contains(&(7777.0, -30.0)));
        let gap = thinned
            .windows(2)
            .any(|w| w[0].0 < 5000.0 && w[1].0 > 5599.0);
        assert!(!gap, "a line across the gap");
        assert!(
            thinned
                .iter()
                .map(|p| p.0)
                .filter(|x| !x.is_nan())
                .is_sorted()
        );
    }
}
