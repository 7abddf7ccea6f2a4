//! The common part of the Rust programs here: the states, and the protocol of `drive.py`. (The C++
//! programs have server.hpp.)
//!
//! A program has rows with names. Every request on standard input is one line, and so is its answer
//! on standard output:
//!
//! ```text
//! rows              the names of the program's rows
//! time ROW CALLS    nanoseconds per call, over CALLS calls that go round the states
//! show ROW STATE    the outputs at that state: name=value ...
//! ```
//!
//! The part of an output's name before the slash says which outputs are comparable in size.

use std::io::{BufRead, Write};
use std::str::FromStr;
use std::time::Instant;

/// The joints' state, the motion of the base and the sensors' readings at one instant. See
/// prepare.py.
pub struct State {
    pub position: Vec<f64>,
    pub velocity: Vec<f64>,
    pub acceleration: Vec<f64>,
    pub base: Motion,
    /// Force, torque.
    pub readings: Vec<[[f64; 3]; 2]>,
}

/// Motion of the base in its own axes, which are those of the world.
pub struct Motion {
    pub angular_velocity: [f64; 3],
    pub velocity: [f64; 3],
    pub angular_acceleration: [f64; 3],
    /// Classical acceleration of the origin, without subtraction of gravity.
    pub acceleration: [f64; 3],
}

/// The contents of states.txt.
pub struct States {
    pub joints: Vec<String>,
    pub sensors: Vec<String>,
    pub bodies: Vec<String>,
    pub contacts: Vec<String>,
    pub gravity: [f64; 3],
    /// Ten per body.
    pub parameters: Vec<[f64; 10]>,
    pub states: Vec<State>,
}

/// The words of a text, one after the other. A missing or wrong word ends the program.
struct Words<'a>(std::str::SplitAsciiWhitespace<'a>);

impl Words<'_> {
    fn next<T: FromStr>(&mut self) -> T {
        let word = self.0.next().unwrap_or_else(|| fail("states: ends early"));
        word.parse()
            .unwrap_or_else(|_| fail(&format!("states: '{word}' is wrong here")))
    }

    fn key(&mut self, key: &str) {
        let word: String = self.next();
        if word != key {
            fail(&format!("states: '{word}' instead of '{key}'"));
        }
    }

    fn names(&mut self, key: &str) -> Vec<String> {
        self.key(key);
        (0..self.next()).map(|_| self.next()).collect()
    }

    fn array<const N: usize>(&mut self) -> [f64; N] {
        std::array::from_fn(|_| self.next())
    }
}

impl States {
    pub fn read(path: &str) -> Self {
        let text =
            std::fs::read_to_string(path).unwrap_or_else(|error| fail(&format!("{path}: {error}")));
        let mut words = Words(text.split_ascii_whitespace());
        let joints = words.names("joints");
        let sensors = words.names("sensors");
        let bodies = words.names("bodies");
        let contacts = words.names("contacts");
        words.key("gravity");
        let gravity = words.array();
        words.key("parameters");
        let parameters = bodies.iter().map(|_| words.array()).collect();
        words.key("states");
        let states = (0..words.next::<usize>())
            .map(|_| State {
                position: joints.iter().map(|_| words.next()).collect(),
                velocity: joints.iter().map(|_| words.next()).collect(),
                acceleration: joints.iter().map(|_| words.next()).collect(),
                base: Motion {
                    angular_velocity: words.array(),
                    velocity: words.array(),
                    angular_acceleration: words.array(),
                    acceleration: words.array(),
                },
                readings: sensors
                    .iter()
                    .map(|_| [words.array(), words.array()])
                    .collect(),
            })
            .collect();
        Self {
            joints,
            sensors,
            bodies,
            contacts,
            gravity,
            parameters,
            states,
        }
    }

    /// The states with the joints in the order of `names`.
    pub fn in_order_of(mut self, names: &[&str]) -> Self {
        let places: Vec<usize> = names.iter().map(|name| place(&self.joints, name)).collect();
        if places.len() != self.joints.len() {
            fail(&format!(
                "{} joints instead of {}",
                places.len(),
                self.joints.len()
            ));
        }
        for state in &mut self.states {
            for values in [
                &mut state.position,
                &mut state.velocity,
                &mut state.acceleration,
            ] {
                *values = places.iter().map(|&at| values[at]).collect();
            }
        }
        self.joints = names.iter().map(|&name| name.to_owned()).collect();
        self
    }
}

/// The index of a name in a list.
pub fn place(names: &[String], name: &str) -> usize {
    names
        .iter()
        .position(|other| other == name)
        .unwrap_or_else(|| fail(&format!("{name} is not among {}", names.join(" "))))
}

/// The outputs at one state, by name.
#[derive(Default)]
pub struct Output(String);

impl Output {
    pub fn add(&mut self, kind: &str, name: &str, value: f64) {
        self.0 += &format!("{kind}/{name}={value:e} ");
    }

    pub fn add3(&mut self, kind: &str, name: &str, values: impl IntoIterator<Item = f64>) {
        for (axis, value) in ["x", "y", "z"].iter().zip(values) {
            self.add(kind, &format!("{name}.{axis}"), value);
        }
    }
}

/// A row: calls to time, and their outputs.
pub trait Bench {
    /// The timed calls, at the state with this number.
    fn run(&mut self, state: usize);
    /// The outputs of the last run.
    fn show(&self, output: &mut Output);
}

/// Answers requests until standard input ends.
pub fn serve(states: usize, rows: &mut [(&str, Box<dyn Bench>)]) {
    let out = std::io::stdout();
    for line in std::io::stdin().lock().lines() {
        let line = line.unwrap_or_else(|error| fail(&error.to_string()));
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        let answer = match words[..] {
            ["rows"] => rows
                .iter()
                .map(|(name, _)| *name)
                .collect::<Vec<_>>()
                .join(" "),
            [what @ ("time" | "show"), row, count] => {
                let bench = rows.iter_mut().find(|(name, _)| *name == row);
                let (Some((_, bench)), Ok(count)) = (bench, count.parse()) else {
                    fail(&format!("cannot do '{line}'"));
                };
                if what == "time" {
                    nanoseconds(bench.as_mut(), states, count).to_string()
                } else {
                    let mut output = Output::default();
                    bench.run(count);
                    bench.show(&mut output);
                    output.0
                }
            }
            _ => fail(&format!("cannot do '{line}'")),
        };
        if writeln!(out.lock(), "{answer}")
            .and_then(|()| out.lock().flush())
            .is_err()
        {
            return;
        }
    }
}

/// Nanoseconds per call. An untimed round of all states first fills the caches.
#[expect(clippy::disallowed_methods, reason = "this function measures time")]
fn nanoseconds(bench: &mut dyn Bench, states: usize, calls: usize) -> f64 {
    (0..states).for_each(|state| bench.run(state));
    let start = Instant::now();
    for call in 0..calls {
        bench.run(call % states);
    }
    start.elapsed().as_nanos() as f64 / calls as f64
}

/// Ends the program with a message.
pub fn fail(message: &str) -> ! {
    eprintln!("{}: {message}", std::env::args().next().unwrap_or_default());
    std::process::exit(1);
}
