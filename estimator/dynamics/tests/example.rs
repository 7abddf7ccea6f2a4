//! The example program runs, and what it checks holds.

#[path = "../examples/dynamics.rs"]
#[allow(unreachable_pub, reason = "a program is a crate of its own")]
mod dynamics;

#[test]
fn the_example_runs() {
    dynamics::main().expect("torque = Y phi");
}
