//! Printing to standard output, which its reader may close, as `head` does.

/// `println!` that is no error if standard output is closed, as by `head`.
macro_rules! print_line {
    ($($text:tt)*) => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::stdout(), $($text)*);
    }};
}

/// The same without a line break.
macro_rules! print_part {
    ($($text:tt)*) => {{
        use std::io::Write as _;
        let _ = write!(std::io::stdout(), $($text)*);
    }};
}
