//! The memory that a run takes, and that this machine has left.

use rowburst::error::{Phrase, Subject};
use rowburst::reconstruct::Model;
use rowburst::{Camera, Error, ErrorKind, Parameter, Result, phrase};
use std::path::Path;

/// Checks that this machine has memory for a reconstruction with `camera`, before anything is allocated. Without the
/// check the operating system could end the program without a message. `subject` names the video in the error; `kept`
/// bytes stay between runs (0: none).
///
/// # Errors
/// The reconstruction takes more memory than this process can still use.
pub fn check_memory(subject: impl Into<Subject>, camera: &Camera, kept: u64) -> Result<()> {
    let what = format!("a video of {}", camera.video_shape());
    let remedy = phrase![
        "Make ",
        Parameter::Field,
        " smaller, bin the frame, or use a machine with more memory."
    ];
    let needed = Model::run_bytes(camera).and_then(|run| run.checked_add(kept));
    check_bytes(subject, &what, needed, remedy)
}

/// Checks that this machine has `needed` bytes for `what`; `None`: a number that is too large itself.
///
/// # Errors
/// More than this process can still use.
pub fn check_bytes(
    subject: impl Into<Subject>,
    what: &str,
    needed: Option<u64>,
    remedy: impl Into<Phrase>,
) -> Result<()> {
    let has_room = match (needed, available_memory_bytes()) {
        (None, _) => false,
        (Some(needed), Some(available)) => needed <= available,
        // The system does not say what is left: it must at least grant the memory.
        (Some(needed), None) => {
            let bytes = usize::try_from(needed);
            bytes.is_ok_and(|n| Vec::<u8>::new().try_reserve_exact(n).is_ok())
        }
    };
    if has_room {
        return Ok(());
    }
    let amount = |bytes: Option<u64>| match bytes {
        Some(bytes) => format!("{:.1} GiB", bytes as f64 / f64::from(1 << 30)),
        None => "more than any machine has".into(),
    };
    let available = match available_memory_bytes() {
        Some(bytes) => format!(", {} available", amount(Some(bytes))),
        None => String::new(),
    };
    let found = format!("no memory for {what}: {} needed{available}", amount(needed));
    Err(Error::work(subject, found, remedy).with_kind(ErrorKind::Memory))
}

/// Bytes that this process can still use: what the machine has left, or its control group (a container's or a
/// scheduler's limit) if that is less. `None` where the system does not say.
pub fn available_memory_bytes() -> Option<u64> {
    let machine = std::fs::read_to_string("/proc/meminfo").ok();
    let machine = machine.and_then(|text| {
        let free = field(&text, "MemAvailable:")? + field(&text, "SwapFree:").unwrap_or(0);
        Some(1024 * free)
    });
    let groups = std::fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
    machine
        .into_iter()
        .chain(group_available("/sys/fs/cgroup".as_ref(), &groups))
        .min()
}

/// Bytes that the control groups of this process and those above them have left (version 2 and version 1), below
/// `root`. `groups` is the text of `/proc/self/cgroup`.
fn group_available(root: &Path, groups: &str) -> Option<u64> {
    let mut folders = Vec::new();
    for line in groups.lines() {
        let mut parts = line.splitn(3, ':').skip(1);
        let (controllers, path) = (parts.next()?, parts.next()?);
        let root = match controllers {
            "" => root.to_path_buf(),
            list if list.split(',').any(|name| name == "memory") => root.join("memory"),
            _ => continue,
        };
        let group = root.join(path.trim_start_matches('/'));
        let above = group
            .ancestors()
            .take_while(|folder| folder.starts_with(&root));
        folders.extend(above.map(Path::to_path_buf));
    }
    folders.iter().filter_map(|folder| left(folder)).min()
}

/// Bytes that one control group has left; `None` where it has no limit.
fn left(folder: &Path) -> Option<u64> {
    let text = |name: &str| std::fs::read_to_string(folder.join(name)).ok();
    let number = |name: &str| -> Option<u64> { text(name)?.trim().parse().ok() };
    let files = [
        ("memory.max", "memory.current"),
        ("memory.limit_in_bytes", "memory.usage_in_bytes"),
    ];
    files.iter().find_map(|(limit, used)| {
        let (limit, used) = (number(limit)?, number(used)?);
        // The kernel drops cached files before it ends a process.
        let statistics = text("memory.stat").unwrap_or_default();
        let cached = field(&statistics, "inactive_file").unwrap_or(0);
        Some(limit.saturating_sub(used.saturating_sub(cached)))
    })
}

/// The number behind `name` in a text of one name and number a line.
fn field(text: &str, name: &str) -> Option<u64> {
    text.lines().find_map(|line| {
        let mut words = line.split_whitespace();
        (words.next() == Some(name)).then(|| words.next()?.parse().ok())?
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_smallest_limit_of_all_groups_counts() {
        let root = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| {
            let path = root.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        };
        let left = |groups: &str| group_available(root.path(), groups);
        assert_eq!(left("0::/job/step\n"), None);
        write("job/step/memory.max", "max\n");
        write("job/step/memory.current", "500\n");
        write("job/memory.max", "4000\n");
        write("job/memory.current", "1500\n");
        write("job/memory.stat", "anon 900\ninactive_file 100\n");
        // The group above has the limit; cached files do not count.
        assert_eq!(left("0::/job/step\n"), Some(2600));
        // Version 1.
        write("memory/old/memory.limit_in_bytes", "1000\n");
        write("memory/old/memory.usage_in_bytes", "400\n");
        assert_eq!(left("7:cpu,memory:/old\n3:pids:/old\n"), Some(600));
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn available_memory_is_known() {
        assert!(available_memory_bytes().unwrap() > 1 << 20);
    }
}
