//! `--verbose`: the log on standard error.

use rowburst::vecmath::instruction_set;
use rowburst_run::{LogLevel, available_memory_bytes, set_log, set_log_level};
use std::time::Instant;
use tracing::info;

/// Logs every step from now on, with the seconds since `process_start`.
pub fn start(process_start: Instant) {
    set_log(move |message| {
        let seconds = process_start.elapsed().as_secs_f64();
        eprintln!("{seconds:9.3} s  {}", message.text);
    });
    set_log_level(LogLevel::Details);
}

/// Logs what the run works with.
pub fn describe_machine() {
    let memory = available_memory_bytes().map_or("unknown".to_string(), |bytes| {
        format!("{:.1} GiB", bytes as f64 / f64::from(1 << 30))
    });
    info!(
        "rowburst {}: instruction set {}, {} threads, {memory} of memory available",
        env!("CARGO_PKG_VERSION"),
        instruction_set(),
        rayon::current_num_threads()
    );
}
