//! The screen of `proprio top`: what is shown of a [`RobotState`], and what keys do.

use super::sections::{self, SILENCE, SectionRow, TableSection, doubtful, duration, presence};
use super::snapshot::RobotState;
use proprio_topics::Nanos;
use proprio_topics::ipc::Presence;
use ratatui::Frame;
use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyModifiers};
use ratatui::layout::{Constraint, Layout};
use ratatui::style::{Style, Stylize as _};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Paragraph, Wrap};

const KEYS: &str =
    "q quit  p pause  / filter  Tab section  arrows PgUp PgDn scroll  r robot  ? hide";

/// What a key asks for that the screen cannot do.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Wish {
    Nothing,
    Quit,
    Robot(String),
}

/// The screen.
#[derive(Default)]
pub(super) struct Screen {
    domain: String,
    snapshot: RobotState,
    is_paused: bool,
    filter: String,
    is_typing: bool,
    has_help: bool,
    /// The first line of the tables that is shown.
    scroll: usize,
    /// How many were shown last, and where sections begin.
    height: usize,
    starts: Vec<usize>,
}

impl Screen {
    /// Of what is in this domain; at first it knows nothing.
    pub(super) fn new(domain: &str, now: Nanos) -> Self {
        let mut view = Self::default();
        domain.clone_into(&mut view.domain);
        view.snapshot.now = now;
        view
    }

    /// Shows this, unless paused.
    pub(super) fn show(&mut self, snapshot: RobotState) {
        if !self.is_paused {
            self.snapshot = snapshot;
        }
    }

    /// A key is pressed.
    pub(super) fn press(&mut self, key: KeyEvent) -> Wish {
        let shortcut = (key.modifiers).intersection(KeyModifiers::CONTROL | KeyModifiers::ALT);
        match key.code {
            KeyCode::Char('c') if shortcut == KeyModifiers::CONTROL => return Wish::Quit,
            _ if !shortcut.is_empty() => {}
            KeyCode::Enter | KeyCode::Esc if self.is_typing => {
                self.is_typing = false;
                if key.code == KeyCode::Esc {
                    self.filter.clear();
                }
            }
            KeyCode::Backspace if self.is_typing => drop(self.filter.pop()),
            KeyCode::Char(typed) if self.is_typing => {
                self.filter.push(typed);
                self.scroll = 0;
            }
            KeyCode::Esc if !self.filter.is_empty() => self.filter.clear(),
            KeyCode::Char('q') | KeyCode::Esc => return Wish::Quit,
            KeyCode::Char('p' | ' ') => self.is_paused = !self.is_paused,
            KeyCode::Char('/') => {
                self.is_typing = true;
                self.filter.clear();
            }
            KeyCode::Char('?') => self.has_help = !self.has_help,
            KeyCode::Char('r') => return self.next_robot(),
            KeyCode::Tab | KeyCode::Right => {
                let next = self.starts.iter().find(|start| **start > self.scroll);
                self.scroll = next.copied().unwrap_or(0);
            }
            KeyCode::BackTab | KeyCode::Left => {
                let mut before = self.starts.iter().rev();
                let last = self.starts.last();
                let found = before.find(|start| **start < self.scroll).or(last);
                self.scroll = found.copied().unwrap_or(0);
            }
            KeyCode::Down => self.scroll += 1,
            KeyCode::Up => self.scroll = self.scroll.saturating_sub(1),
            KeyCode::PageDown => self.scroll += self.height,
            KeyCode::PageUp => self.scroll = self.scroll.saturating_sub(self.height),
            KeyCode::Home => self.scroll = 0,
            KeyCode::End => self.scroll = usize::MAX,
            _ => {}
        }
        Wish::Nothing
    }

    fn next_robot(&mut self) -> Wish {
        let robots = &self.snapshot.robots;
        let is_this = |name: &String| self.snapshot.robot.as_ref() == Some(name);
        let after = robots.iter().position(is_this).map_or(0, |at| at + 1);
        let Some(next) = robots.get(after).or_else(|| robots.first()).cloned() else {
            return Wish::Nothing;
        };
        (self.is_paused, self.scroll) = (false, 0);
        Wish::Robot(next)
    }

    /// Draws what is known. If that is long ago at `now`, it is no longer taken for the present.
    pub(super) fn draw(&mut self, frame: &mut Frame<'_>, now: Nanos) {
        let silence = now.saturating_sub(self.snapshot.now);
        let (now, trouble) = match silence > SILENCE && !self.is_paused {
            true => (
                now,
                format!("shared memory has not answered for {}", duration(silence)),
            ),
            false => (self.snapshot.now, self.snapshot.trouble.clone()),
        };
        let trouble = Span::styled(trouble, doubtful());
        let keys = self.keys();
        let area = frame.area();
        // Of texts with words that are not longer than this.
        let room = usize::from(area.width.saturating_sub(12).max(1));
        let lines = |text: &Line<'_>| {
            let count = match text.width() {
                few if few <= area.width.into() => few.min(1),
                many => many.div_ceil(room).min(usize::from(area.height) / 2),
            };
            Constraint::Length(u16::try_from(count).unwrap_or_default())
        };
        let trouble = Line::from(trouble);
        let parts = [
            Constraint::Length(3),
            lines(&trouble),
            Constraint::Min(0),
            lines(&keys),
        ];
        let [top, middle, tables, bottom] = Layout::vertical(parts).areas(area);
        frame.render_widget(Paragraph::new(self.head(now)), top);
        let wrap = Wrap { trim: true };
        frame.render_widget(Paragraph::new(trouble).wrap(wrap), middle);
        frame.render_widget(Paragraph::new(keys).wrap(wrap), bottom);
        if self.snapshot.robot.is_some() {
            let text = self.tables(tables.width.into(), tables.height.into(), now);
            frame.render_widget(Paragraph::new(text), tables);
        }
    }

    fn head(&self, now: Nanos) -> Vec<Line<'static>> {
        let snapshot = &self.snapshot;
        let mut first = vec![match self.is_paused {
            true => "PAUSED".reversed(),
            false => "proprio top".bold(),
        }];
        if let Some(robot) = &snapshot.robot {
            first.extend(["  robot ".into(), robot.clone().bold()]);
        }
        let place = (snapshot.robots.iter()).position(|it| snapshot.robot.as_ref() == Some(it));
        if let (several @ 2.., Some(place)) = (snapshot.robots.len(), place) {
            first.push(format!(" ({} of {several})", place + 1).into());
        }
        first.push(format!("  domain {}", self.domain).into());
        let (gateway, estimator) = (&snapshot.gateway, &snapshot.estimator);
        let started = gateway.1.as_ref().map(|it| it.started);
        let second = vec!["gateway   ".into(), presence(gateway.0, started, now)];
        let started = estimator.1.as_ref().map(|it| it.started);
        let mut third = vec!["estimator ".into(), presence(estimator.0, started, now)];
        if let (Presence::Running, Some(health)) = estimator {
            let (rate, lost, late) = (snapshot.estimates, health.lost, health.late);
            third.push(format!(", {rate:.1} estimates/s").into());
            let style = if lost + late > 0 {
                doubtful()
            } else {
                Style::new()
            };
            let text = format!(", samples: {lost} lost, {late} late");
            third.push(Span::styled(text, style));
        }
        [first, second, third].map(Line::from).into()
    }

    fn keys(&self) -> Line<'static> {
        let filter = format!("filter: {}", self.filter);
        match (self.is_typing, self.has_help) {
            (true, _) => Line::from(vec![
                filter.bold(),
                "_  (Enter: keep, Esc: no filter)".into(),
            ]),
            (_, true) => Line::from(KEYS),
            (_, false) if self.filter.is_empty() => Line::from("q quit  ? keys").dim(),
            _ => Line::from(vec![filter.bold(), "  q quit  ? keys".dim()]),
        }
    }

    /// The lines of all sections that are in view.
    fn tables(&mut self, width: usize, height: usize, now: Nanos) -> Vec<Line<'static>> {
        let (mut lines, mut starts) = (Vec::new(), Vec::new());
        let filter = self.filter.to_lowercase();
        for mut section in sections::of(&self.snapshot, now) {
            (section.rows).retain(|row| row.name.to_lowercase().contains(&filter));
            if section.rows.is_empty() && !filter.is_empty() {
                continue;
            }
            starts.push(lines.len());
            lines.extend(table(section, width));
        }
        if lines.is_empty() {
            lines.push(Line::styled("no name has this in it", doubtful()));
        }
        // Each section can be at the top.
        let last = lines.len().saturating_sub(height);
        self.scroll = self
            .scroll
            .min(last.max(starts.last().copied().unwrap_or(0)));
        (self.height, self.starts) = (height, starts);
        lines.into_iter().skip(self.scroll).take(height).collect()
    }
}

/// A section's lines: its title, the columns' names, its rows.
fn table(section: TableSection, width: usize) -> Vec<Line<'static>> {
    let title = vec![section.title.bold(), "  ".into(), section.summary];
    let mut lines = vec![Line::from(title)];
    if section.rows.is_empty() {
        return lines;
    }
    // Long names leave room for what is said of them.
    let longest = (width / 3).max(12);
    let shorten = |name: String| match name.chars().count() > longest {
        true => name.chars().take(longest - 1).chain(['…']).collect(),
        false => name,
    };
    let head: Vec<&str> = section.head.split('|').collect();
    let names = head.iter().map(|name| name.trim_start_matches('>').dim());
    let mut all: Vec<Vec<Span<'_>>> = vec![names.collect()];
    for SectionRow { name, cells } in section.rows {
        let name = Span::raw(shorten(name));
        all.push(std::iter::once(name).chain(cells).collect());
    }
    // The last cell of a short row is not in its column.
    let aligned = |cells: &[Span<'_>]| match cells.len() {
        few if few < head.len() => few.saturating_sub(1),
        all => all,
    };
    let mut widths = vec![0; head.len()];
    for cells in &all {
        for (width, cell) in widths.iter_mut().zip(cells.iter().take(aligned(cells))) {
            *width = cell.width().max(*width);
        }
    }
    for cells in all {
        let aligned = aligned(&cells);
        let mut spans = Vec::new();
        for (column, ((cell, width), name)) in
            (cells.into_iter().zip(&widths).zip(&head)).enumerate()
        {
            spans.push(Span::raw("  "));
            let gap = Span::raw(" ".repeat(width.saturating_sub(cell.width())));
            match column < aligned && name.starts_with('>') {
                true => spans.extend([gap, cell]),
                false => spans.extend([cell, gap]),
            }
        }
        lines.push(Line::from(spans));
    }
    lines
}
