//! What every simulated board of the protocol answers: its type, its firmware, the text in it.

use super::{BROADCAST, class, command, to_board, to_host};
use crate::{Format, Frame, Frames, board};

/// The bytes of a command of class `class` to board `address` in `frame`, starting with the command
/// byte.
fn command_for(frame: &Frame, class: u16, address: u8) -> Option<&[u8]> {
    let broadcast = to_board(class, BROADCAST);
    let ours = frame.id == to_board(class, address) || frame.id == broadcast;
    (ours && frame.format == Format::Classic && !frame.is_empty()).then(|| frame.data())
}

/// The text in a simulated board.
const INFO: &[u8; 32] = b"simulated board\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0";

/// Answers the management requests: board type and firmware version (a plausible one: 2.0.8,
/// protocol 2.0). Returns the bytes of the command that the frame is, if it is one to this board.
pub(crate) fn answer_management<'f>(
    frame: &'f Frame,
    class: u16,
    address: u8,
    board: u8,
    out: &mut Frames,
) -> Option<&'f [u8]> {
    const FIRMWARE: [u8; 3] = [2, 0, 8];
    let [major, minor, build] = FIRMWARE;
    if let Some([command::DISCOVER]) = command_for(frame, class::MANAGEMENT, address) {
        let id = to_host(class::MANAGEMENT, address);
        board::send(id, &[command::DISCOVER, board, major, minor, build], out);
    }
    if let Some([command::GET_ADDITIONAL_INFO]) = command_for(frame, class::MANAGEMENT, address) {
        for (number, text) in (0..).zip(INFO.as_chunks::<4>().0) {
            let [a, b, c, d] = *text;
            let data = [command::GET_ADDITIONAL_INFO, number, a, b, c, d];
            board::send(to_host(class::MANAGEMENT, address), &data, out);
        }
    }
    let version = if class == class::POLLING_MOTOR {
        command::MOTOR_GET_FIRMWARE_VERSION
    } else {
        command::GET_FIRMWARE_VERSION
    };
    let command = command_for(frame, class, address);
    if let Some(&[asked, want_major, want_minor]) = command
        && asked == version
    {
        let fits = u8::from(want_major == 2 && want_minor == 0);
        board::send(
            to_host(class, address),
            &[version, board, major, minor, build, 2, 0, fits],
            out,
        );
    }
    command
}
