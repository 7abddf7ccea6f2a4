//! The long set of [`proprio_tests::truth`]: a line for each trouble, and the runs that break the
//! promise.
//!
//! ```text
//! truth [FIRST LAST [TROUBLE..]]     seeds, and parts of troubles' names; default: 1 12, all
//! truth --keep FOLDER SEED TROUBLE   writes one run's log, configuration and URDF
//! ```

use proprio_tests::on_all_processors;
use proprio_tests::truth::{Outcome, Run, TROUBLES, Trouble};
use std::process::ExitCode;

fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    if let ["--keep", folder, seed, name] = words[..] {
        let seed = seed.parse().expect("a seed");
        let [(_, trouble)] = named(&[name])[..] else {
            panic!("{name:?} names no trouble, or several");
        };
        let run = Run::new(seed, trouble).expect("the robot has no such channel");
        let names = ["log.csv", "estimator.toml", "model.urdf"];
        for (name, text) in names.iter().zip(run.files()) {
            std::fs::write(format!("{folder}/{name}"), text).expect("a file");
        }
        println!("{:#?}", run.judged());
        return ExitCode::SUCCESS;
    }
    let (first, last, names) = match words[..] {
        [first, last, ref names @ ..] => (first, last, names),
        _ => ("1", "12", &[][..]),
    };
    let seeds: Vec<u64> =
        (first.parse().expect("a seed")..=last.parse().expect("a seed")).collect();
    let (mut runs, mut broken) = (0, 0);
    println!(
        "| trouble | broken | valid late | deviation / range | named | worst |\n\
         |---|---|---|---|---|---|"
    );
    for (name, trouble) in named(names) {
        let run = |seed: &u64| Some(Run::new(*seed, trouble)?.judged());
        let outcomes = on_all_processors(&seeds, run);
        let (line, few) = line(&outcomes);
        println!("| {name} | {few} of {} | {line} |", outcomes.len());
        for (seed, outcome) in outcomes.iter().filter(|(_, outcome)| outcome.is_broken()) {
            eprintln!("  {seed}: {outcome:?}");
        }
        runs += outcomes.len();
        broken += few;
    }
    println!("\nThe promise is broken in {broken} of {runs} runs.");
    ExitCode::from(u8::from(broken > 0))
}

fn named(names: &[&str]) -> Vec<(&'static str, Trouble)> {
    let all = TROUBLES.iter().copied();
    let exactly = |name: &&str| TROUBLES.iter().any(|(known, _)| known == name);
    let is_meant = |known: &str| {
        let meant = |name: &&str| known == *name || !exactly(name) && known.contains(*name);
        names.is_empty() || names.iter().any(meant)
    };
    all.filter(|(known, _)| is_meant(known)).collect()
}

/// The line of the table, and how many runs break the promise.
fn line(outcomes: &[(&u64, Outcome)]) -> (String, usize) {
    let all_outcomes = || outcomes.iter().map(|(_, outcome)| outcome);
    let broken = all_outcomes().filter(|outcome| outcome.is_broken()).count();
    let [all, valid] = [0, 1].map(|k| all_outcomes().map(|outcome| outcome.late[k]).sum::<usize>());
    let mut deviations: Vec<f64> = all_outcomes().map(|outcome| outcome.deviation).collect();
    deviations.retain(|deviation| deviation.is_finite());
    deviations.sort_by(f64::total_cmp);
    let deviation = deviations.get(deviations.len() / 2).copied();
    let worst = all_outcomes().filter_map(|outcome| outcome.worst.as_ref());
    let worst = worst.max_by(|a, b| a.share.total_cmp(&b.share));
    let worst = worst.map_or_else(String::new, |worst| {
        let (error, deviations) = (worst.error, worst.deviations);
        format!(
            "{error:.2} Nm, {deviations:.0} deviations, {:.0} %",
            100.0 * worst.share
        )
    });
    let share = valid as f64 / all.max(1) as f64;
    let deviation = deviation.map_or_else(String::new, |d| format!("{d:.3}"));
    let mut named: Vec<f64> = all_outcomes().map(Outcome::named).collect();
    named.retain(|named| named.is_finite());
    let count = named.len();
    let named = match count {
        0 => String::new(),
        _ => format!("{:.2}", named.iter().sum::<f64>() / count as f64),
    };
    (
        format!("{share:.2} | {deviation} | {named} | {worst}"),
        broken,
    )
}
