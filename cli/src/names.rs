//! Names that a user gives.

use proprio_estimator::setup::nearest;

/// What belongs to `name` among `named`. Without that name, the end of a message: which one is
/// similar, or which there are.
pub(crate) fn find<'a, T, I: Iterator<Item = (&'a str, T)>>(
    name: &str,
    named: impl Fn() -> I,
) -> Result<T, String> {
    let found = named().find(|(own, _)| *own == name);
    let found = found.map(|(_, what)| what);
    found.ok_or_else(|| nearest(name, named().map(|(own, _)| own)))
}
