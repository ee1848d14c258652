//! A fuzzer for stable Rust: changes files at random and gives them to a reader, which may fail but not panic, hang or
//! take much memory.
//!
//! Each target runs for `ROWBURST_FUZZ_SECONDS` (1). A case depends on its number alone, which a failure names.

#![allow(dead_code, reason = "each test file uses only some of these helpers")]

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Longest time for one case; longer is a hang. Machines that are busy are slow.
const DEADLINE: Duration = Duration::from_secs(60);
/// Largest memory of the process in bytes, of all targets that run at once.
const MAX_MEMORY_BYTES: u64 = 2 << 30;

/// Numbers that are random enough (SplitMix64).
pub struct Chance(u64);

impl Chance {
    pub fn new(seed: u64) -> Self {
        Self(seed)
    }

    pub fn draw(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// A number below `end`.
    pub fn below(&mut self, end: usize) -> usize {
        (self.draw() % end.max(1) as u64) as usize
    }
}

/// Words of headers, and numbers at which sizes overflow.
const FRAGMENTS: [&[u8]; 12] = [
    b"-1",
    b"0",
    b"1e999",
    b"NaN",
    b"18446744073709551615",
    b"4294967296",
    b"99999999",
    b"[",
    b"\"",
    b"<",
    b"\xff\xff\xff\xff\xff\xff\xff\xff",
    b"\0\0\0\0\0\0\0\x80",
];

/// `seed` with one to four changes.
pub fn mutated(seed: &[u8], chance: &mut Chance) -> Vec<u8> {
    let mut bytes = seed.to_vec();
    for _ in 0..=chance.below(4) {
        // Headers are at the front of most files.
        let span = if chance.below(2) == 0 {
            bytes.len().min(256)
        } else {
            bytes.len()
        };
        let at = chance.below(span);
        match chance.below(9) {
            0 => bytes.truncate(at),
            1 => {
                let end = (at + 1 + chance.below(16)).min(bytes.len());
                bytes.drain(at.min(end)..end);
            }
            2 => {
                let end = (at + 1 + chance.below(64)).min(bytes.len());
                let copy = bytes[at.min(end)..end].to_vec();
                let to = chance.below(bytes.len() + 1);
                bytes.splice(to..to, copy);
            }
            3 => {
                let word = FRAGMENTS[chance.below(FRAGMENTS.len())];
                bytes.splice(at..at.min(bytes.len()), word.iter().copied());
            }
            4 => {
                let word = FRAGMENTS[chance.below(FRAGMENTS.len())];
                let end = (at + word.len()).min(bytes.len());
                bytes.splice(at.min(end)..end, word.iter().copied());
            }
            5 => {
                // A digit of a number in text.
                let digits: Vec<usize> = (0..span).filter(|&i| bytes[i].is_ascii_digit()).collect();
                if let Some(&at) = digits.get(chance.below(digits.len())) {
                    bytes[at] = b'0' + chance.below(10) as u8;
                }
            }
            _ => {
                if let Some(byte) = bytes.get_mut(at) {
                    *byte = match chance.below(4) {
                        0 => 0,
                        1 => 0xff,
                        2 => *byte ^ (1 << chance.below(8)),
                        _ => chance.draw() as u8,
                    };
                }
            }
        }
    }
    bytes
}

/// Peak memory of this process; `None` where the system does not tell.
fn peak_memory_bytes() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kibibytes: u64 = line.trim().trim_end_matches(" kB").parse().ok()?;
    Some(kibibytes << 10)
}

/// Writes changed copies of the file `name`, beside which others of `beside` lie, and gives the path to `read`.
pub fn fuzz(name: &str, seed: &[u8], beside: &[(&str, &[u8])], read: impl Fn(&Path) + Sync) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    for (other, bytes) in beside {
        let other = folder.path().join(other);
        std::fs::create_dir_all(other.parent().unwrap()).unwrap();
        std::fs::write(other, bytes).unwrap();
    }
    run_cases(name, 0, &|case| {
        std::fs::write(&path, mutated(seed, &mut Chance::new(case))).unwrap();
        read(&path);
    });
}

/// Runs `case` with the numbers from `first` on.
pub fn run_cases(name: &str, first: u64, case: &(dyn Fn(u64) + Sync)) {
    let seconds = std::env::var("ROWBURST_FUZZ_SECONDS").ok();
    let seconds = seconds.map_or(1.0, |text| text.parse().expect("seconds"));
    let budget = Duration::from_secs_f64(seconds);
    let number = AtomicU64::new(first);
    let began = Instant::now();
    std::thread::scope(|scope| {
        let watched = scope.spawn(|| {
            while began.elapsed() < budget {
                let now = number.load(Ordering::Relaxed);
                let result = catch_unwind(AssertUnwindSafe(|| case(now)));
                assert!(result.is_ok(), "{name}: case {now} panics");
                let memory = peak_memory_bytes().unwrap_or(0);
                assert!(
                    memory < MAX_MEMORY_BYTES,
                    "{name}: case {now}, {memory} bytes"
                );
                number.fetch_add(1, Ordering::Relaxed);
            }
        });
        let (mut last, mut since) = (u64::MAX, Instant::now());
        while !watched.is_finished() {
            std::thread::sleep(Duration::from_millis(20));
            let now = number.load(Ordering::Relaxed);
            if now != last {
                (last, since) = (now, Instant::now());
            }
            if since.elapsed() > DEADLINE {
                // The thread cannot be ended.
                eprintln!("{name}: case {now} hangs");
                std::process::abort();
            }
        }
    });
    println!("{name}: {} cases", number.load(Ordering::Relaxed) - first);
}
