//! The memory that this machine has left.

use std::path::Path;

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
