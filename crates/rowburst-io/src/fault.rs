//! What an [`io::Error`] means for the user.

use rowburst::Error;
use std::io::{self, ErrorKind};
use std::path::Path;

/// The error of a file that cannot be opened or read.
pub fn read_error(path: &Path, error: &io::Error) -> Error {
    let subject = path.display().to_string();
    match error.kind() {
        ErrorKind::NotFound | ErrorKind::NotADirectory => Error::input(
            subject,
            "no such file",
            "the file must exist",
            "Check the path; paths inside an experiment file are relative to that file.",
        ),
        ErrorKind::PermissionDenied => Error::input(
            subject,
            "a file that may not be read",
            "the file must be readable",
            "Change its permissions or copy it.",
        ),
        _ => Error::work(subject, format!("cannot read: {error}"), "Try again."),
    }
}

/// The error of a write: what failed and how to go on. The caller adds the file with
/// [`Error::within`].
pub fn write_error(error: &io::Error) -> Error {
    let remedy = match error.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded | ErrorKind::FileTooLarge => {
            "Free space on this disk or choose another folder with -o."
        }
        _ => "Check the disk or choose another folder with -o.",
    };
    Error::work("writing", error, remedy)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_disk_is_work_that_says_how_to_go_on() {
        let error = write_error(&io::Error::from(ErrorKind::StorageFull)).within("out/video.npy");
        assert!(matches!(error, Error::Work { .. }));
        let message = error.to_string();
        assert!(message.contains("out/video.npy"), "{message}");
        assert!(message.contains("Free space"), "{message}");
    }
}
