//! Whatever bytes a reader of foreign files is given, it reads them or says what is wrong, within a
//! moment: mutations of legal files, the same ones in every run. PROPRIO_FUZZ is their number for
//! each reader. `fuzz/README.md` tells how a fuzzer looks for more.
#![allow(missing_docs)]

use fastrand::Rng;
use proprio_tests::fuzz::{TARGETS, Target};
use proprio_tests::now;
use proprio_topics::Nanos;

/// One change of some bytes.
fn mutate(bytes: &mut Vec<u8>, other: &[u8], random: &mut Rng) {
    let at = random.usize(..=bytes.len());
    let end = (at + random.usize(..32)).min(bytes.len());
    match random.u8(..8) {
        0 if at < bytes.len() => bytes[at] ^= 1 << random.u8(..8),
        1 if at < bytes.len() => bytes[at] = random.u8(..),
        2 => bytes.insert(
            at,
            random
                .choice(*b"-0.9eE,:;=#<>\"[]{}\n \0\xff")
                .expect("bytes"),
        ),
        3 => drop(bytes.drain(at..end)),
        4 => bytes.extend_from_within(at..end),
        5 => {
            let part = random.usize(..=other.len());
            let part = &other[part..(part + 64).min(other.len())];
            bytes.splice(at..end, part.iter().copied());
        }
        6 => {
            let numbers = [
                "1e999",
                "-1",
                "NaN",
                "18446744073709551616",
                "0x80000000",
                "1e-320",
            ];
            let number = random.choice(numbers).expect("numbers");
            bytes.splice(at..end, number.bytes());
        }
        _ => bytes.truncate(at),
    }
}

fn try_mutations(name: &str) {
    let target: &Target = Target::named(name).expect("a target");
    let count = std::env::var("PROPRIO_FUZZ").ok();
    let count = count.map_or(500, |count| count.parse().expect("a number"));
    let mut random = Rng::with_seed(1);
    let seeds = (target.seeds)();
    for (number, seed) in seeds.iter().enumerate() {
        assert!((target.run)(seed), "{name}: seed {number} is not legal");
    }
    for _ in 0..count {
        // Of a long file, its beginning: more cases in the same time.
        let mut bytes = seeds[random.usize(..seeds.len())].clone();
        bytes.truncate(if random.u8(..8) == 0 {
            usize::MAX
        } else {
            8192
        });
        for _ in 0..=random.u8(..6) {
            mutate(&mut bytes, &seeds[random.usize(..seeds.len())], &mut random);
        }
        let start = now();
        let panicked = std::panic::catch_unwind(|| (target.run)(&bytes)).is_err();
        let took = now() - start;
        if panicked || took > Nanos::from_millis(5000) {
            let file = std::env::temp_dir().join(format!("proprio-fuzz-{name}"));
            std::fs::write(&file, &bytes).expect("a file");
            panic!("{name}: {took} s; the input is {}", file.display());
        }
    }
}

macro_rules! tests {
    ($($name:ident),*) => {
        $(
            #[test]
            fn $name() {
                try_mutations(stringify!($name));
            }
        )*

        #[test]
        fn no_reader_is_left_out() {
            let mut names: Vec<&str> = TARGETS.iter().map(|target| target.name).collect();
            let mut tested = vec![$(stringify!($name)),*];
            names.sort_unstable();
            tested.sort_unstable();
            assert_eq!(names, tested);
        }
    };
}

tests!(
    log, table, gateway, estimator, dbc, eds, urdf, taxels, parameters, state
);
