//! The name by which programs find the shared library: that of the interface's version.
#![allow(clippy::print_stdout)] // cargo reads it

fn main() {
    let major = env!("CARGO_PKG_VERSION_MAJOR");
    let minor = env!("CARGO_PKG_VERSION_MINOR");
    println!("cargo::rustc-cdylib-link-arg=-Wl,-soname,libproprio.so.{major}.{minor}");
    println!("cargo::rerun-if-changed=build.rs");
}
