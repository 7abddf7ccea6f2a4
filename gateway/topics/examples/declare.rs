//! Tells the estimator of a robot that something touches it, and later that it does not: what a
//! planner does that is about to grasp. Depends only on proprio-topics.
//!
//! `cargo run -p proprio-topics --features ipc --example declare -- icub_left_arm hand`
//!
//! The contact is one of estimator.toml, with `presence = "possible"`. PROPRIO_RUNTIME_DIR and
//! PROPRIO_DOMAIN select the domain.

use proprio_topics::ipc::{Domain, DomainConfig, Writer, monotonic};
use proprio_topics::{ContactDeclaration, ContactState, Name};
use std::error::Error;
use std::time::Duration;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [robot, contact] = arguments.as_slice() else {
        return Err("usage: declare ROBOT CONTACT".into());
    };
    let name = Name::new(contact).ok_or("a contact's name has 1 to 63 bytes")?;
    let domain = Domain::open(&DomainConfig::from_env())?;
    let mut declarations = Writer::<ContactDeclaration>::create(&domain, robot, domain.epoch())?;
    for is_touched in [true, false] {
        // The place and shape of the contact are those of estimator.toml.
        let now = monotonic();
        let state = ContactState::configured(is_touched);
        declarations.send(&ContactDeclaration::new(name, now, &state), now)?;
        println!("{contact}: {}", if is_touched { "touched" } else { "free" });
        std::thread::sleep(Duration::from_secs(2));
    }
    Ok(())
}
