//! The example program decodes what its sensor's manual says of these bytes.

use proprio_topics::Wrench;

#[path = "../../examples/decode.rs"]
#[allow(unreachable_pub, reason = "a program is a crate of its own")]
mod decode;

/// 50 counts per N and 2000 per Nm, big-endian.
#[test]
fn the_example_decodes_a_wrench() {
    decode::main().expect("a wrench");
    let (force, torque) = ([2.0, -2.0, 20.0], [-0.1, 1.0, -1.0]);
    assert_eq!(
        decode::wrench().expect("a wrench"),
        Wrench { force, torque }
    );
}
