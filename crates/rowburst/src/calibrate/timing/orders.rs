//! Readout orders by how well they explain the frames.

use super::{CLEAR_MARGIN, Candidate};
use crate::Shutter;

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
        (_, true) if both => Some("these stripes mirror each other about the middle row by chance: a frame of another phase tells one sweep from two; a chirp or an unequal double pulse of known course (a signal file) decides the direction too".into()),
        (_, true) => Some("a light of which only the frequency is known cannot tell a direction from its reverse: a chirp or an unequal double pulse of known course (a signal file) decides".into()),
        (_, false) => Some("this course of light fits several orders: one that is not symmetric in time decides, such as a chirp or two pulses of unequal length, within the readout of a frame".into()),
    }
}
