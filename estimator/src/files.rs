//! Files that are replaced whole: whatever happens meanwhile, what is there is the old one or the new one.

use std::fs::{File, Permissions};
use std::io::{self, Write as _};
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use tempfile::NamedTempFile;

/// Puts `text` in the place of `file`: written beside it first, then, once that is on the disk, renamed. `mode`: who may do what with it.
///
/// # Errors
/// The system's; the old file is as it was then.
pub fn replace(file: &Path, text: &str, mode: u32) -> io::Result<()> {
    let mut new = begin(file)?;
    new.write_all(text.as_bytes())?;
    end(new, file, mode)
}

/// A file beside `file`, to be written and then put in its place by [`end`]; without that it is gone when dropped.
///
/// # Errors
/// The system's: there is no such folder, or nobody may write there.
pub fn begin(file: &Path) -> io::Result<NamedTempFile> {
    // tempfile names its own file in the error, which means nothing to whoever named another one.
    std::fs::metadata(folder(file))?;
    NamedTempFile::with_prefix_in(".proprio-", folder(file)).map_err(|error| io::Error::from(error.kind()))
}

/// Puts what [`begin`] began, written by now, in the place of `file`, once it is on the disk.
///
/// # Errors
/// The system's; the old file is as it was then.
pub fn end(new: NamedTempFile, file: &Path, mode: u32) -> io::Result<()> {
    new.as_file().set_permissions(Permissions::from_mode(mode))?;
    new.as_file().sync_all()?;
    new.persist(file).map_err(|error| error.error)?;
    // The rename itself is on the disk when the folder is. Not every file system can say so.
    let _ = File::open(folder(file)).and_then(|folder| folder.sync_all());
    Ok(())
}

fn folder(file: &Path) -> &Path {
    let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty());
    folder.unwrap_or(Path::new("."))
}
