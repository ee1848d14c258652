//! Light that passes a diffuser unscattered: a bright core above the speckle's envelope.
//!
//! The mean of `k` independent grains of fully developed speckle over their envelope
//! exceeds `t > 1` with a probability of at most `exp(−k(t − 1 − ln t))` (Chernoff's bound
//! for the gamma distribution). Means over windows of several sizes, from one grain on,
//! are compared with the `t` that no window of a pure speckle pattern exceeds but in one
//! pattern of ten thousand: a focus of one grain must be some twenty times, a
//! core of ten grains half as bright again as its surroundings. What is not that
//! bright is part of the envelope. The core's light is what lies above the envelope
//! around the brightest place, out to the ring that no longer stands out.

use super::envelope::Envelope;
use super::filter::smoothed;
use rowburst_optics::Image;

/// A ballistic core.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Core {
    /// Part of all light that lies in it above the envelope. Saturated pixels make it a
    /// lower bound.
    pub fraction: f64,
    /// Its middle in pixels `(y, x)`.
    pub at_px: (f64, f64),
    /// Radius at which it no longer stands out.
    pub radius_px: f64,
    /// Largest local mean over the envelope there.
    pub height: f64,
}

/// Chance of a false alarm in a pattern of pure speckle.
const FALSE_ALARM: f64 = 1e-4;

/// A core narrower in brightness than this may be the shape of an envelope that a
/// smooth model does not follow.
const MIN_HEIGHT: f64 = 1.5;

/// The ballistic core of `light` with speckle of `grain` pixels, if there is one.
pub fn ballistic_core(light: &Image, grain: f64) -> Option<Core> {
    let grain = grain.max(1.0);
    let mut envelope = Envelope::fit(light, grain);
    let first = search(light, &envelope.without(None), grain)?;
    // The first look had the core in its envelope.
    let (y, x) = first.at_px;
    let clean = envelope.without(Some((y, x, first.radius_px)));
    search(light, &clean, grain).or(Some(first))
}

fn search(light: &Image, envelope: &Image, grain: f64) -> Option<Core> {
    let (rows, columns) = (light.rows(), light.columns());
    let least = 0.05 * envelope.max();
    let ratio = Image::from_fn(rows, columns, |y, x| {
        if envelope.at(y, x) > least {
            light.at(y, x) / envelope.at(y, x)
        } else {
            1.0
        }
    });
    let short = rows.min(columns) as f64;
    let mut best: Option<(f64, usize, f64)> = None;
    for scale in [0.0, 1.0, 2.0, 4.0, 8.0].map(|s| s * grain) {
        if scale > short / 8.0 {
            break;
        }
        // Smoothing an autocovariance of FWHM g by s divides the variance by this.
        let grains = 1.0 + 11.09 * (scale / grain).powi(2);
        let windows = (rows * columns) as f64 / (1.133 * grain * grain * grains);
        let mean = smoothed(&ratio, scale);
        let at =
            (0..mean.data().len()).max_by(|&a, &b| mean.data()[a].total_cmp(&mean.data()[b]))?;
        let height = f64::from(mean.data()[at]);
        let evidence = grains * (height - 1.0 - height.max(1e-9).ln());
        let surprise = evidence - (windows.max(1.0) / FALSE_ALARM).ln();
        if height > MIN_HEIGHT && surprise > 0.0 && best.is_none_or(|b| surprise > b.0) {
            best = Some((surprise, at, height));
        }
    }
    let (_, at, height) = best?;
    let (y, x) = (at / columns, at % columns);
    let (radius, excess) = extent(light, envelope, (y, x), grain);
    let total: f64 = light.data().iter().map(|&p| f64::from(p)).sum();
    Some(Core {
        fraction: (excess / total).clamp(0.0, 1.0),
        at_px: (y as f64, x as f64),
        radius_px: radius,
        height,
    })
}

/// Radius out to which rings of one grain stand out, and the light above the envelope.
fn extent(light: &Image, envelope: &Image, (cy, cx): (usize, usize), grain: f64) -> (f64, f64) {
    let width = grain.max(2.0);
    let rings = (light.rows().min(light.columns()) as f64 / 3.0 / width) as usize + 1;
    let mut sums = vec![(0.0f64, 0.0f64, 0.0f64); rings];
    let reach = (rings as f64 * width) as usize;
    for y in cy.saturating_sub(reach)..(cy + reach + 1).min(light.rows()) {
        for x in cx.saturating_sub(reach)..(cx + reach + 1).min(light.columns()) {
            let r = (y as f64 - cy as f64).hypot(x as f64 - cx as f64);
            if let Some(ring) = sums.get_mut((r / width) as usize) {
                ring.0 += f64::from(light.at(y, x));
                ring.1 += f64::from(envelope.at(y, x));
                ring.2 += 1.0;
            }
        }
    }
    let mut excess = 0.0;
    for (i, &(light, envelope, pixels)) in sums.iter().enumerate() {
        let grains = (pixels / (1.133 * grain * grain)).max(1.0);
        if i > 0 && light < envelope * (1.0 + 1.0 / grains.sqrt()) {
            return (i as f64 * width, excess);
        }
        excess += light - envelope;
    }
    (rings as f64 * width, excess)
}
