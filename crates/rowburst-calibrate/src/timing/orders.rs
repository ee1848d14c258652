//! Readout orders by how well they explain the frames.

use super::{CLEAR_MARGIN, Candidate};
use rowburst_optics::Shutter;

pub(super) fn candidate(
    shutter: Shutter,
    row_time_us: f64,
    rss: f64,
    dof: f64,
    best: f64,
    variance_inflation: f64,
    variance: f64,
) -> Candidate {
    let variance = variance.max(f64::MIN_POSITIVE);
    let excess = (rss - best) / variance_inflation.max(f64::MIN_POSITIVE);
    Candidate {
        shutter,
        row_time_us,
        chi2: rss / variance / dof.max(1.0),
        excess,
        is_consistent: excess < CLEAR_MARGIN,
    }
}

pub(super) fn consistent_shutters(candidates: &[Candidate]) -> Vec<Shutter> {
    let mut remaining: Vec<&Candidate> = candidates.iter().filter(|c| c.is_consistent).collect();
    remaining.sort_by(|a, b| a.excess.total_cmp(&b.excess));
    remaining.iter().map(|c| c.shutter.clone()).collect()
}

pub(super) fn advice(candidates: &[Candidate], periodic: bool) -> Option<String> {
    let remaining = consistent_shutters(candidates);
    let dual = |s: &Shutter| matches!(s, Shutter::DualInsideOut | Shutter::DualOutsideIn);
    let both = remaining.iter().any(dual) && !remaining.iter().all(dual);
    match (remaining.len(), periodic) {
        (0 | 1, _) => None,
        (_, true) if both => Some("in this frame the stripes are symmetric about the middle row: a frame of another phase separates one sweep from two; a known waveform (signal file) such as a chirp or two unequal pulses also gives the direction".into()),
        (_, true) => Some("with only the frequency known, a direction and its reverse fit equally well: use a known waveform (signal file), such as a chirp or two unequal pulses".into()),
        (_, false) => Some("this waveform fits several readout orders: use one that is not symmetric in time, such as a chirp or two pulses of unequal length, within the readout of a frame".into()),
    }
}
