//! Order and numbers of file names.

use std::cmp::Ordering;

/// Order of names in which runs of digits count as numbers: `a2` before `a10`.
pub(super) fn natural(a: &str, b: &str) -> Ordering {
    let (mut left, mut right) = (a, b);
    while let (Some(l), Some(r)) = (left.chars().next(), right.chars().next()) {
        let order = if l.is_ascii_digit() && r.is_ascii_digit() {
            let (number, rest) = digits(left);
            let (other, other_rest) = digits(right);
            (left, right) = (rest, other_rest);
            let trimmed = |n: &str| n.trim_start_matches('0').to_string();
            let (number, other) = (trimmed(number), trimmed(other));
            number.len().cmp(&other.len()).then(number.cmp(&other))
        } else {
            (left, right) = (&left[l.len_utf8()..], &right[r.len_utf8()..]);
            l.cmp(&r)
        };
        if order != Ordering::Equal {
            return order;
        }
    }
    // Names that differ in leading zeros alone still have one order.
    left.len().cmp(&right.len()).then_with(|| a.cmp(b))
}

/// The run of digits that a text begins with, and the rest.
fn digits(text: &str) -> (&str, &str) {
    let end = text.find(|c: char| !c.is_ascii_digit());
    text.split_at(end.unwrap_or(text.len()))
}

/// The numbers in the names of a series: names that differ in one run of digits alone, whose
/// numbers rise. Counted in steps where all are multiples of one (`0010`, `0020`, …), so that
/// the smallest distance of neighbours is 1; `None` where the names are no such series.
pub(super) fn numbers(names: &[String]) -> Option<Vec<u64>> {
    let parts: Vec<Vec<&str>> = names.iter().map(|name| runs(name)).collect();
    let first = parts.first()?;
    if names.len() < 2 || parts.iter().any(|p| p.len() != first.len()) {
        return None;
    }
    let mut differing = (0..first.len()).filter(|&i| parts.iter().any(|p| p[i] != first[i]));
    let (at, None) = (differing.next()?, differing.next()) else {
        return None;
    };
    let numbers: Option<Vec<u64>> = parts.iter().map(|p| p[at].parse().ok()).collect();
    let numbers = numbers?;
    let steps: Option<Vec<u64>> = numbers
        .windows(2)
        .map(|pair| pair[1].checked_sub(pair[0]).filter(|&step| step > 0))
        .collect();
    let step = steps?.into_iter().fold(0, gcd);
    Some(numbers.iter().map(|n| (n - numbers[0]) / step).collect())
}

/// Runs of digits, and what is between them.
fn runs(mut text: &str) -> Vec<&str> {
    let mut runs = Vec::new();
    while let Some(first) = text.chars().next() {
        let is_digit = first.is_ascii_digit();
        let end = text.find(|c: char| c.is_ascii_digit() != is_digit);
        let (run, rest) = text.split_at(end.unwrap_or(text.len()));
        runs.push(run);
        text = rest;
    }
    runs
}

fn gcd(a: u64, b: u64) -> u64 {
    if b == 0 { a } else { gcd(b, a % b) }
}
