//! proprio-tests
