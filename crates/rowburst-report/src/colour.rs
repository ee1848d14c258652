//! Colour maps.

use colorous::{GREYS, Gradient, INFERNO};

/// A colour, sRGB.
pub(crate) type Srgb = [u8; 3];

/// Grey that stands for a value that is not finite.
pub(crate) const NOT_FINITE: Srgb = [120, 130, 120];

/// Yellow that stands for a pixel that was left out; neither [`Map::Grey`] nor [`Map::Signed`] has it.
pub(crate) const LEFT_OUT: Srgb = [240, 196, 0];

/// Slate that stands for a voxel that the frame does not observe; [`Map::Light`] does not have it.
pub(crate) const UNOBSERVED: Srgb = [58, 74, 92];

/// Maps of one value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Map {
    /// Black to white: raw camera data.
    Grey,
    /// Black, purple, orange, yellow, even in lightness: light of the scene.
    Light,
    /// Blue, black, red: values on both sides of zero, on the ground of the pictures beside them in both themes.
    Signed,
}

/// Colours of [`Map::Signed`] at equal distances, as in the viewer.
const SIGNED: [Srgb; 5] = [
    [166, 212, 255],
    [52, 128, 206],
    [18, 18, 22],
    [205, 74, 52],
    [255, 196, 168],
];

fn signed(fraction: f64) -> Srgb {
    let at = fraction * (SIGNED.len() - 1) as f64;
    let i = (at as usize).min(SIGNED.len() - 2);
    let part = at - i as f64;
    std::array::from_fn(|c| {
        let (from, to) = (f64::from(SIGNED[i][c]), f64::from(SIGNED[i + 1][c]));
        (from + part * (to - from)).round() as u8
    })
}

impl Map {
    /// The colour at `fraction`, clamped to 0…1.
    pub(crate) fn at(self, fraction: f64) -> Srgb {
        let f = fraction.clamp(0.0, 1.0);
        let of = |gradient: Gradient, at: f64| gradient.eval_continuous(at).as_array();
        match self {
            Self::Grey => of(GREYS, 1.0 - f),
            Self::Light => of(INFERNO, f),
            Self::Signed => signed(f),
        }
    }

    /// 255 colours from low to high, then [`NOT_FINITE`].
    pub(crate) fn palette(self) -> Vec<u8> {
        let colours = (0..255).map(|i| self.at(f64::from(i) / 254.0));
        colours.chain([NOT_FINITE]).flatten().collect()
    }
}

/// Linear-light RGB of time, `fraction` 0…1 of the video, from blue over green to red.
///
/// In OKLCh (Ottosson 2020): equal times are equal steps of hue, and the two ends
/// differ. Lightness varies little, so that brightness is left to tell how bright.
pub(crate) fn time_hue(fraction: f64) -> [f32; 3] {
    const FIRST_DEGREES: f64 = 272.0;
    const LAST_DEGREES: f64 = 22.0;
    const MAX_CHROMA: f64 = 0.19;
    let f = fraction.clamp(0.0, 1.0);
    let hue = (FIRST_DEGREES + f * (LAST_DEGREES - FIRST_DEGREES)).to_radians();
    // Blue and red are vivid only when darker than green and yellow.
    let lightness = 0.66 + 0.14 * (std::f64::consts::PI * f).sin();
    // The most vivid colour that sRGB has at this hue: clipping channels would bend the hue.
    let is_in_gamut = |chroma| {
        let rgb = linear_rgb(lightness, chroma, hue);
        rgb.iter().all(|c| (0.0..=1.0).contains(c))
    };
    let (mut inside, mut outside) = (0.0, MAX_CHROMA);
    for _ in 0..12 {
        let middle = 0.5 * (inside + outside);
        if is_in_gamut(middle) {
            inside = middle;
        } else {
            outside = middle;
        }
    }
    linear_rgb(lightness, inside, hue).map(|c| c as f32)
}

/// Linear-light sRGB of an OKLCh colour, hue in radians; outside 0…1 where sRGB has none.
fn linear_rgb(lightness: f64, chroma: f64, hue: f64) -> [f64; 3] {
    let (a, b) = (chroma * hue.cos(), chroma * hue.sin());
    let l = (lightness + 0.396_337_777_4 * a + 0.215_803_757_3 * b).powi(3);
    let m = (lightness - 0.105_561_345_8 * a - 0.063_854_172_8 * b).powi(3);
    let s = (lightness - 0.089_484_177_5 * a - 1.291_485_548_0 * b).powi(3);
    [
        4.076_741_662_1 * l - 3.307_711_591_3 * m + 0.230_969_929_2 * s,
        -1.268_438_004_6 * l + 2.609_757_401_1 * m - 0.341_319_396_5 * s,
        -0.004_196_086_3 * l - 0.703_418_614_7 * m + 1.707_614_701_0 * s,
    ]
}

/// sRGB of linear-light RGB.
pub(crate) fn srgb(linear: [f32; 3]) -> Srgb {
    linear.map(|c| {
        let c = c.clamp(0.0, 1.0);
        let encoded = if c <= 0.003_130_8 {
            12.92 * c
        } else {
            1.055 * c.powf(1.0 / 2.4) - 0.055
        };
        (encoded * 255.0).round() as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ends_and_middle_are_known() {
        assert_eq!(Map::Grey.at(0.0), [0, 0, 0]);
        assert_eq!(Map::Grey.at(2.0), [255, 255, 255]);
        assert_eq!(Map::Light.at(0.0), [0, 0, 4]);
        // Zero is dark: no white slab in the dark theme.
        let [r, g, b] = Map::Signed.at(0.5);
        assert!(r < 30 && g < 30 && b < 30);
        let ([r, _, b], [blue_r, _, blue_b]) = (Map::Signed.at(1.0), Map::Signed.at(0.0));
        assert!(r > b && blue_b > blue_r);
        assert_eq!(Map::Light.palette().len(), 768);
    }

    #[test]
    fn time_runs_from_blue_to_red_in_distinct_even_steps() {
        let [r, _, b] = srgb(time_hue(0.0));
        assert!(b > 200 && r < 120);
        let [r, _, b] = srgb(time_hue(1.0));
        assert!(r > 200 && b < 120);
        for i in 0..20 {
            let [(hue, chroma), (next, _)] = [i, i + 1].map(|i| oklab_hue(f64::from(i) / 20.0));
            let step = (hue - next).rem_euclid(360.0);
            assert!((step - 12.5).abs() < 0.1, "{i}: {step}");
            assert!(chroma > 0.12, "{i}: {chroma}");
        }
    }

    /// Hue in degrees and chroma of the colour of time.
    fn oklab_hue(fraction: f64) -> (f64, f64) {
        let [r, g, b] = time_hue(fraction).map(f64::from);
        let l = (0.412_221_470_8 * r + 0.536_332_536_3 * g + 0.051_445_992_9 * b).cbrt();
        let m = (0.211_903_498_2 * r + 0.680_699_545_1 * g + 0.107_396_956_6 * b).cbrt();
        let s = (0.088_302_461_9 * r + 0.281_718_837_6 * g + 0.629_978_700_5 * b).cbrt();
        let a = 1.977_998_495_1 * l - 2.428_592_205_0 * m + 0.450_593_709_9 * s;
        let b = 0.025_904_037_1 * l + 0.782_771_766_2 * m - 0.808_675_766_0 * s;
        (b.atan2(a).to_degrees(), a.hypot(b))
    }
}
