//! Flats sorted by their light, and where the counts end.

use super::stack::Stack;
use super::stats::{mean, median};
use rowburst_core::error::Phrase;
use rowburst_core::{Error, Parameter, Result, phrase};

/// Flats of nearly the same light.
#[derive(Debug, Clone, PartialEq)]
pub struct Level {
    /// Indices of its frames in the stack, by rising light.
    pub frames: Vec<usize>,
    /// Mean counts above dark.
    pub light: f64,
    /// Part of the readings that lie at the end of the counts.
    pub clipped: f64,
}

/// Frames whose light differs by less than this belong together: a lamp's flicker lies
/// below it, the steps of a deliberate series above.
const STEP: f64 = 0.05;

/// Largest light over smallest in a level, where a series has no gaps.
const SPAN: f64 = 1.25;

/// Part of the readings at the end of the counts below which it says nothing: single
/// hot pixels reach it under any light.
const MAX_CLIPPED_FRACTION: f64 = 1e-3;

/// Part of the readings at the end of the counts above which a frame is saturated.
const SATURATED: f64 = 0.5;

/// Light of each flat: mean counts above `dark` over the `usable` pixels.
pub fn lights(flats: &Stack, dark: &[f64], usable: &[bool]) -> Vec<f64> {
    let light = |pixels: &[f32]| {
        let above = pixels.iter().zip(dark).map(|(&p, d)| f64::from(p) - d);
        mean(above.zip(usable).filter(|(_, u)| **u).map(|(v, _)| v))
    };
    flats.images().map(|image| light(image.data())).collect()
}

/// Levels by rising light.
pub fn levels(flats: &Stack, lights: &[f64], end: Option<f64>, usable: &[bool]) -> Vec<Level> {
    let mut order: Vec<usize> = (0..lights.len()).collect();
    order.sort_by(|&a, &b| lights[a].total_cmp(&lights[b]));
    let mut groups: Vec<Vec<usize>> = Vec::new();
    for i in order {
        match groups.last_mut() {
            Some(group)
                if lights[i] < lights[group[group.len() - 1]] * (1.0 + STEP)
                    && lights[i] < lights[group[0]] * SPAN =>
            {
                group.push(i);
            }
            _ => groups.push(vec![i]),
        }
    }
    groups
        .into_iter()
        .map(|frames| Level {
            light: mean(frames.iter().map(|&i| lights[i])),
            clipped: end.map_or(0.0, |end| {
                mean(frames.iter().map(|&i| part_at(flats, i, end, usable)))
            }),
            frames,
        })
        .collect()
}

/// The count at which readings pile up, if they do: the brightest of all, where many
/// more readings lie than just below it.
pub fn end_of_counts(flats: &Stack, usable: &[bool]) -> Option<f64> {
    let readings = || {
        let frames = flats.images();
        frames.flat_map(|image| {
            let pixels = image.data().iter().zip(usable);
            pixels.filter(|(_, u)| **u).map(|(&p, _)| p)
        })
    };
    let end = readings().fold(f32::NEG_INFINITY, f32::max);
    let (mut at, mut below) = (0usize, f32::NEG_INFINITY);
    for p in readings() {
        if p == end {
            at += 1;
        } else {
            below = below.max(p);
        }
    }
    let next = readings().filter(|&p| p == below).count();
    let frame = usable.iter().filter(|u| **u).count();
    // Where counts just run out, each count has a little fewer readings than the one
    // below it, never several times as many.
    (at as f64 > MAX_CLIPPED_FRACTION * frame as f64 && at > 20 && at > 3 * next)
        .then_some(f64::from(end))
}

/// Part of the usable pixels of frame `i` at `end` or above.
fn part_at(flats: &Stack, i: usize, end: f64, usable: &[bool]) -> f64 {
    let pixels = flats.image(i).data().iter().zip(usable);
    let at = pixels.filter(|(_, u)| **u);
    mean(at.map(|(&p, _)| f64::from(u8::from(f64::from(p) >= end))))
}

impl Level {
    /// Whether so few readings are cut off that mean and variance can be trusted.
    pub fn is_unclipped(&self) -> bool {
        self.clipped <= MAX_CLIPPED_FRACTION
    }
}

/// Refuses flats that are darker than the darks, not lit, or all saturated. `noise` is
/// the standard deviation of a dark pixel in counts.
pub fn check_light(lights: &[f64], levels: &[Level], dark_level: f64, noise: f64) -> Result<()> {
    let middle = median(&mut lights.to_vec());
    let brightest = lights.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let found = format!(
        "flats {middle:+.2} counts above the darks' {dark_level:.2} (median; the brightest {brightest:+.2})"
    );
    let refused = |rule: &'static str, remedy: Phrase| {
        Err(Error::input(Parameter::Flats, &found, rule, remedy))
    };
    if levels.iter().all(|level| level.clipped > SATURATED) {
        return refused(
            "more than half of the pixels of every flat are saturated",
            "Dim the light or shorten the exposure until the flats lie at about half of the range."
                .into(),
        );
    }
    // A mean over a frame is good to far less than the noise of one pixel; what is left
    // is drift of the bias.
    if middle < -0.5 * noise {
        return refused(
            "the darks are brighter than the flats",
            phrase![
                "Check that ",
                Parameter::Darks,
                " and ",
                Parameter::Flats,
                " are not swapped, and that the cap was on for the darks."
            ],
        );
    }
    if brightest <= noise {
        return refused(
            "the light in a flat exceeds the noise of a dark pixel",
            "Check the lamp and the shutter; aim at half of the range.".into(),
        );
    }
    Ok(())
}
