//! Gives a fuzzer's bytes to the reader that PROPRIO_FUZZ_TARGET names, and writes its seeds into
//! the folder PROPRIO_FUZZ_SEEDS, if that is set.
#![no_main]

use libfuzzer_sys::{fuzz_target, Corpus};
use proprio_tests::fuzz::Target;
use std::sync::OnceLock;

fn target() -> &'static Target {
    static TARGET: OnceLock<&Target> = OnceLock::new();
    TARGET.get_or_init(|| {
        let name = std::env::var("PROPRIO_FUZZ_TARGET").expect("PROPRIO_FUZZ_TARGET");
        let target = Target::named(&name).expect("the name of a reader");
        if let Ok(folder) = std::env::var("PROPRIO_FUZZ_SEEDS") {
            for (number, seed) in (target.seeds)().iter().enumerate() {
                std::fs::write(format!("{folder}/seed-{number}"), seed).expect("a seed");
            }
        }
        target
    })
}

fuzz_target!(
    init: { target(); },
    |bytes: &[u8]| -> Corpus {
        (target().run)(bytes);
        Corpus::Keep
    }
);
