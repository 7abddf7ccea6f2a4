//! Printing to standard output, which its reader may close, as `head` does.

use std::sync::atomic::AtomicBool;

/// Whoever read standard output has closed it.
pub(crate) static CLOSED: AtomicBool = AtomicBool::new(false);

/// `println!` that is no error if standard output is closed, as by `head`: see [`CLOSED`].
macro_rules! print_line {
    ($($text:tt)*) => {{
        use std::io::Write as _;
        if writeln!(std::io::stdout(), $($text)*).is_err() {
            crate::print::CLOSED.store(true, std::sync::atomic::Ordering::Relaxed);
        }
    }};
}

/// The same without a line break.
macro_rules! print_part {
    ($($text:tt)*) => {{
        use std::io::Write as _;
        let _ = write!(std::io::stdout(), $($text)*);
    }};
}
