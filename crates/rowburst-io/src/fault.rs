//! What an [`io::Error`] means for the user.

use rowburst::ErrorKind as Kind;
use rowburst::error::{Subject, With};
use rowburst::{Error, Parameter, phrase};
use std::io::{self, ErrorKind};
use std::path::Path;

/// The error of a file that cannot be opened or read.
pub fn read_error(path: &Path, error: &io::Error) -> Error {
    let read = match error.kind() {
        ErrorKind::NotFound | ErrorKind::NotADirectory => Error::input(
            path,
            "no such file",
            "the file must exist",
            "Check the path; paths inside an experiment file are relative to that file.",
        )
        .with_kind(Kind::NotFound),
        ErrorKind::PermissionDenied => Error::input(
            path,
            "a file that may not be read",
            "the file must be readable",
            "Change its permissions or copy it.",
        )
        .with_kind(Kind::Unreadable),
        _ => Error::work(path, format!("cannot read: {error}"), "Try again.").with_kind(Kind::Io),
    };
    read.with_source(copy_of(error))
}

/// The same error for [`Error::with_source`], with the number that the operating system gave it.
fn copy_of(error: &io::Error) -> io::Error {
    match error.raw_os_error() {
        Some(number) => io::Error::from_raw_os_error(number),
        None => io::Error::new(error.kind(), error.to_string()),
    }
}

/// The error of a write: what failed and how to go on. The caller adds the file with
/// [`Error::within`].
pub fn write_error(error: &io::Error) -> Error {
    let remedy = match error.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded | ErrorKind::FileTooLarge => {
            phrase![
                "Free space on this disk or choose another folder",
                With(Parameter::Output),
                "."
            ]
        }
        _ => phrase![
            "Check the disk or choose another folder",
            With(Parameter::Output),
            "."
        ],
    };
    Error::work(Subject::named("writing"), error, remedy)
        .with_kind(Kind::Io)
        .with_source(copy_of(error))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_disk_is_work_that_says_how_to_go_on() {
        let error = write_error(&io::Error::from(ErrorKind::StorageFull)).within("out/video.npy");
        assert_eq!(error.kind(), Kind::Io);
        let message = error.to_string();
        assert!(message.contains("out/video.npy"), "{message}");
        assert!(message.contains("Free space"), "{message}");
    }

    #[test]
    fn the_number_of_the_operating_system_is_kept() {
        let number = |error: &Error| {
            let source = std::error::Error::source(error).unwrap();
            source.downcast_ref::<io::Error>().unwrap().raw_os_error()
        };
        let (full, denied) = (28, 13);
        let error = write_error(&io::Error::from_raw_os_error(full));
        assert_eq!(number(&error), Some(full));
        let error = read_error(
            Path::new("frame.npy"),
            &io::Error::from_raw_os_error(denied),
        );
        assert_eq!(number(&error), Some(denied));
    }
}
