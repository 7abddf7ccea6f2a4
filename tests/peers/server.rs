//! What the Rust programs here share (the C++ ones have server.hpp): the states, and the
//! conversation with `drive.py`.
//!
//! A program offers rows by name. On standard input it is asked, one line each, and answers with
//! one line:
//!
//! ```text
//! rows              the names of the rows it has
//! time ROW CALLS    nanoseconds per call, over CALLS calls that go round the states
//! show ROW STATE    what comes out at that state: name=value ...; the part of a name before the slash says what is comparable in size
//! ```

use std::io::{BufRead, Write};
use std::str::FromStr;
use std::time::Instant;

/// The joints' state, the motion of the base and the sensors' readings at one instant; see
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
    /// Of the origin, classical, gravity not taken off.
    pub acceleration: [f64; 3],
}

/// states.txt.
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

/// Words of a text, one after the other; a missing or wrong one ends the program, which can do
/// nothing without it.
struct Words<'a>(std::str::SplitAsciiWhitespace<'a>);

impl Words<'_> {
    fn next<T: FromStr>(&mut self) -> T {
        let word = self.0.next().unwrap_or_else(|| fail("states: ends early"));
        word.parse()
            .unwrap_or_else(|_| fail(&format!("states: '{word}' is out of place")))
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

    /// The states with the joints in the order of `names`, that of the library at hand.
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

/// Where a name is in a list.
pub fn place(names: &[String], name: &str) -> usize {
    names
        .iter()
        .position(|other| other == name)
        .unwrap_or_else(|| fail(&format!("{name} is not among {}", names.join(" "))))
}

/// What comes out at one state, by name.
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

/// Something to time, and what it yields.
pub trait Bench {
    /// The calls that are timed, at the state of this number.
    fn run(&mut self, state: usize);
    /// What the last run came to.
    fn show(&self, output: &mut Output);
}

/// Answers until standard input ends.
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

/// Nanoseconds per call. Every state comes once before, untimed: another program has just had the
/// caches.
#[expect(
    clippy::disallowed_methods,
    reason = "to measure time is what this is for"
)]
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
