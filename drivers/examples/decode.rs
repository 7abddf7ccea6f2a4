//! Decodes what a force/torque sensor sends: keys as in gateway.toml and two CAN frames in, a
//! wrench in SI units out.
//!
//! `cargo run -p proprio-drivers --example decode`

use proprio_drivers::{Decoded, Frame, Id, Mode, Options, Outputs, Spec};
use proprio_topics::{Nanos, Reading, StampKind, Wrench};
use std::error::Error;

/// Prints the wrench.
pub fn main() -> Result<(), Box<dyn Error>> {
    let Wrench { force, torque } = wrench()?;
    println!("force {force:?} N, torque {torque:?} Nm");
    Ok(())
}

/// The reading of a Robotous RFT60-HA01 at its maker's identifiers.
pub fn wrench() -> Result<Wrench, Box<dyn Error>> {
    let keys: toml::Table = "model = \"RFT60-HA01\"".parse()?;
    let options = Options::deserialize("robotous_rft", keys)?;
    let mut sensor = options.device(&Spec {
        address: 0x64,
        max_silence: Nanos::from_millis(50),
        mode: Mode::Listen,
        outputs: Outputs::default(),
    })?;
    // As a log or an interface would give them: identifier, bytes, and when they came.
    let frames = [
        (0x01, [0x0b, 0x00, 0x64, 0xff, 0x9c, 0x03, 0xe8, 0xff], 0),
        (0x02, [0x38, 0x07, 0xd0, 0xf8, 0x30, 0x00, 0x00, 0x00], 200),
    ];
    let mut decoded = Decoded::new();
    for (id, data, microseconds) in frames {
        let frame = Frame::new(Id::standard(id), &data);
        let at = Nanos(1000 * microseconds);
        sensor.on_frame(&frame.at(at, StampKind::Software), &mut decoded);
    }
    match decoded.readings.first().map(|stamped| stamped.reading) {
        Some(Reading::Wrench(wrench)) => Ok(wrench),
        _ => Err("no wrench came".into()),
    }
}
