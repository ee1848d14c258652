//! Dense scenes with the picture of a second camera.
//!
//! One frame holds too few numbers for a video with light everywhere (`design::count`). An ordinary picture of the
//! same scene, the guide `G`, brings what is missing: the frame has only to tell how the guide moves or changes its
//! brightness. The models are
//!
//! ```text
//! motion      v(x, t) = a G(p + d(p)) + c,   p + Σ_k τ_k(t) θ_k(p) = x
//! gain field  v(x, t) = G(x + d(x)) Σ_k c_k(t) φ_k(x)
//! still       v(x, t) = a G(x + d(x)) + c
//! places      v(x, t) = Σ_k s_k(t) G_k(x + d(x))
//! ```
//!
//! with modes of a free beam `τ_k` and cosines `c_k` in time, `θ_k`, `φ_k` on B-spline grids, and `G_k` the guide on the
//! k-th place. In a motion each point `p` carries its displacement. The affine map `d` is found by registration on a coarse
//! video without a guide, then from the frame. Pixels beside the guide that the field reaches are fitted to the frame. A tenth of the pixels of every row judges: [`fit`] drops a guide that predicts
//! them worse than no guide (docs/design/028).

mod affine;
mod basis;
mod decision;
mod flow;
mod frame_fit;
mod gain_field;
mod key_frames;
mod known_places;
mod least_squares;
mod margin;
mod mesh;
mod motion;
mod picture;
mod shapes;
mod smoothness;
mod without_guide;

pub use affine::Affine;
pub use known_places::{KnownPlaces, PlaceTrace};

use affine::{Field, register};
use decision::Evidence;
use frame_fit::FrameFit;
use gain_field::{GainField, GainModel};
use key_frames::KeyFrame;
use known_places::PlacesModel;
use motion::{Motion, MotionModel};
use rayon::prelude::*;
use rowburst_core::{Cancel, Error, ErrorKind, Parameter, Result};
use rowburst_optics::{Camera, Image, Measurement, RollingShutter, Video};
use tracing::info;
use without_guide::WithoutGuide;

/// A picture of the scene by an ordinary camera. Its frame is that of the field: what differs by up to 5 % of a side, 2°
/// and 2 % is found. It may have any number of pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct Guide {
    /// The picture `[y, x]`, in any unit of light.
    pub image: Image,
    /// When it was exposed; `None`: at an unknown time within the frame.
    pub exposure: Option<GuideExposure>,
}

/// The exposure of a guide.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GuideExposure {
    /// Middle of the exposure in microseconds from the start of the frame's first exposure.
    pub time_us: f64,
    /// Its length in microseconds.
    pub exposure_us: f64,
}

/// What a scene does with the light of the guide.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum GuideModel {
    /// The model is chosen by held-out pixels.
    #[default]
    Auto,
    /// Things move.
    Motion,
    /// Places change their brightness.
    Gain,
    /// Nothing changes.
    Still,
    /// Each place that the guide shows has a trace of its own. [`Self::Auto`] does not try it.
    Places,
}

impl GuideModel {
    /// All of them.
    pub const ALL: [Self; 5] = [
        Self::Auto,
        Self::Motion,
        Self::Gain,
        Self::Still,
        Self::Places,
    ];

    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Motion => "motion",
            Self::Gain => "gain",
            Self::Still => "still",
            Self::Places => "places",
        }
    }
}

/// A model that was tried.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GuideTrial {
    /// The model.
    pub model: GuideModel,
    /// Highest mode in time of a motion: 1 is a constant velocity.
    pub order: Option<usize>,
    /// Rms error of the fitted pixels over σ.
    pub fitted: f64,
    /// Rms error of the held-out pixels over σ.
    pub held_out: f64,
}

/// The video of a frame with a guide.
#[derive(Debug, Clone, PartialEq)]
pub struct GuideFit {
    /// The model of the video.
    pub model: GuideModel,
    /// The video in counts, `[t, y, x]`.
    pub video: Video,
    /// Counts of the video per unit of the guide.
    pub gain: f64,
    /// Counts of the video where the guide is zero; 0 for a gain field and for places.
    pub offset: f64,
    /// Blur of the guide that fits the frame best, in pixels of the field.
    pub blur_px: f64,
    /// The map from the field to the guide.
    pub affine: Affine,
    /// The guide seen from the field; of several the one nearest to the middle of the video.
    pub registered: Image,
    /// Correlation of the registered guide with the coarse picture of the scene that the frame gives without it.
    pub correlation: f64,
    /// Rms displacement of a motion over the field and the bins, in pixels.
    pub displacement_px: Option<f64>,
    /// Number of parameters of the model, without the pixels beside the guide that the frame fills.
    pub degrees_of_freedom: f64,
    /// The traces of the places of [`GuideModel::Places`].
    pub known_places: Option<KnownPlaces>,
    /// The models that were tried.
    pub trials: Vec<GuideTrial>,
    /// Index of the trial of the chosen model.
    chosen: usize,
    /// Rms error of the held-out pixels over σ of the coarse video without a guide.
    pub held_out_without: f64,
    /// Whether the guide belongs to the frame.
    pub used: bool,
    /// Why it was used or dropped.
    pub reason: String,
}

impl GuideFit {
    /// The trial of the chosen model.
    pub fn best(&self) -> &GuideTrial {
        &self.trials[self.chosen]
    }
}

/// Highest modes in time of the motions that are tried, each from the one before.
const ORDERS: [usize; 4] = [1, 2, 3, 5];
/// Times of a guide of unknown time that are tried first, as parts of the video.
const ASSUMED_TIMES: [f64; 3] = [1.0 / 6.0, 0.5, 5.0 / 6.0];
/// Blurs of a fit from coarse to fine, in pixels of a field of 108, and of one that goes on from a coarser model.
const BLURS_PX: [f64; 3] = [4.0, 2.0, 0.0];
const RESTART_BLURS_PX: [f64; 2] = [1.0, 0.0];
/// Gauss–Newton steps at each blur; more gain little.
const STEPS: usize = 6;
/// Blurs of the guide that are compared at the end, in pixels.
const GUIDE_BLURS_PX: [f64; 5] = [0.0, 0.5, 1.0, 1.5, 2.0];

/// Fits the models of `model` to the frame and says whether the guide belongs to it. `sigma` is the noise of a pixel of
/// weight 1 in counts. Several guides are key frames with times, and their model is motion.
///
/// # Errors
/// No guide, several guides without times or with one time, a guide without light or with values that are not finite, no
/// place or too many of [`GuideModel::Places`], or `cancel`.
pub fn fit(
    camera: &Camera,
    operator: &RollingShutter,
    measurement: &Measurement,
    sigma: f64,
    guides: &[Guide],
    model: GuideModel,
    cancel: &Cancel,
) -> Result<GuideFit> {
    check(guides, model)?;
    let shape = operator.video_shape();
    check_bins(shape.bins, guides.len(), model)?;
    let frame = FrameFit::new(operator, measurement, sigma, cancel);
    let mut key_frames: Vec<KeyFrame> = guides
        .iter()
        .map(|guide| KeyFrame {
            image: picture::on_grid(&guide.image, shape.rows, shape.columns),
            bins: guide.exposure.map(|e| bins_of(camera, e)),
        })
        .collect();
    let reference = key_frames::nearest_to_middle(&key_frames, shape.bins);
    check_on_field(&key_frames)?;
    let peak = key_frames::normalise(&mut key_frames, reference);
    let without = WithoutGuide::new(&frame);
    cancel.check()?;
    let coarse = coarse_pictures(&frame, &without, &key_frames[reference]);
    let found = coarse
        .par_iter()
        .map(|coarse| register(coarse, &key_frames[reference].image));
    let found: Vec<(Affine, f64)> = found.collect();
    let best = found.into_iter().max_by(|a, b| a.1.total_cmp(&b.1));
    let (start, correlation) = best.expect("at least one picture");
    info!(
        "guide: registered, shift {:.2} and {:.2} px, correlation {correlation:.3}; without a guide held-out {:.3} σ",
        start.parameters[0], start.parameters[3], without.held_out
    );
    cancel.check()?;
    let search = Search {
        frame: &frame,
        key_frames: &key_frames,
        reference: &key_frames[reference].image,
        start,
        correlation,
        held_out_without: without.held_out,
        saturated: decision::saturated(&guides[reference].image),
        scale: f64::from(peak),
    };
    search.run(model)
}

/// The inputs of the models.
struct Search<'a> {
    frame: &'a FrameFit<'a>,
    key_frames: &'a [KeyFrame],
    /// The guide nearest to the middle of the video.
    reference: &'a Image,
    start: Affine,
    correlation: f64,
    held_out_without: f64,
    /// Part of that guide's pixels at its greatest value.
    saturated: f64,
    /// Greatest value of that guide, by which it was divided.
    scale: f64,
}

/// A fitted model.
enum Fitted {
    Motion { order: usize, motion: Motion },
    Gain(GainField),
    Still,
    Places { affine: Affine, width: f64 },
}

/// A model with its video and errors.
struct Candidate {
    trial: GuideTrial,
    /// The map from the field to the guide.
    affine: Affine,
    fitted: Fitted,
}

impl Search<'_> {
    fn run(&self, model: GuideModel) -> Result<GuideFit> {
        let mut candidates = Vec::new();
        let wants = |one| model == GuideModel::Auto || model == one;
        if wants(GuideModel::Still) {
            candidates.push(self.still());
        }
        let wants_gain = wants(GuideModel::Gain) && self.key_frames.len() == 1;
        let gain = wants_gain.then(|| self.gain_field());
        self.frame.cancel().check()?;
        if wants(GuideModel::Motion) {
            candidates.extend(self.motions(gain.as_ref().map(|gain| gain.trial.held_out)));
        }
        candidates.extend(gain);
        if model == GuideModel::Places {
            candidates.push(self.known_places()?);
        }
        self.frame.cancel().check()?;
        let trials: Vec<GuideTrial> = candidates.iter().map(|c| c.trial).collect();
        let chosen = decision::choose(&trials);
        let shape = self.frame.shape();
        let field = Field::of(shape);
        let maps = [self.start, candidates[chosen].affine];
        let deviations = maps.map(|map| map.deviation(field.half_side()));
        let evidence = Evidence {
            trials: &trials,
            held_out_without: self.held_out_without,
            correlation: self.correlation,
            saturated: self.saturated,
            deviation: deviations[0].max(deviations[1]),
        };
        let (used, reason) = evidence.verdict(&trials[chosen]);
        info!("guide {reason}");
        let candidate = candidates.swap_remove(chosen);
        self.finish(candidate, trials, chosen, used, reason)
    }

    fn candidate(&self, fitted: Fitted, affine: Affine, video: &[f32]) -> Candidate {
        let (fitted_error, held_out) = self.frame.errors(video);
        let (model, order) = match &fitted {
            Fitted::Motion { order, .. } => (GuideModel::Motion, Some(*order)),
            Fitted::Gain(_) => (GuideModel::Gain, None),
            Fitted::Still => (GuideModel::Still, None),
            Fitted::Places { .. } => (GuideModel::Places, None),
        };
        info!(
            "guide: {} {order:?}: fitted {fitted_error:.3} σ, held-out {held_out:.3} σ",
            model.name()
        );
        Candidate {
            trial: GuideTrial {
                model,
                order,
                fitted: fitted_error,
                held_out,
            },
            affine,
            fitted,
        }
    }

    fn still(&self) -> Candidate {
        let (.., video) = gain_field::still(self.frame, self.reference, &self.start);
        self.candidate(Fitted::Still, self.start, &video)
    }

    fn gain_field(&self) -> Candidate {
        let model = GainModel::new(self.frame, self.reference, self.start);
        let found = model.fit();
        let (affine, video) = (found.affine, model.video(&found));
        self.candidate(Fitted::Gain(found), affine, &video)
    }

    /// Traces of the places of the guide, under the map of a gain field.
    fn known_places(&self) -> Result<Candidate> {
        let guide = self.reference;
        let affine = GainModel::new(self.frame, guide, self.start).fit().affine;
        self.frame.cancel().check()?;
        let model = PlacesModel::registered(self.frame, guide, &affine)?;
        let fitted = Fitted::Places {
            affine: model.affine,
            width: model.width(),
        };
        Ok(self.candidate(fitted, model.affine, &model.video()))
    }

    /// Motions with more and more modes, each from the one before, unless they are hopeless beside the held-out error of a gain
    /// field.
    fn motions(&self, gain: Option<f64>) -> Vec<Candidate> {
        let mut candidates = Vec::new();
        let mut last: Option<(MotionModel, Motion)> = None;
        let bins = self.frame.shape().bins;
        for order in ORDERS.into_iter().filter(|order| *order < bins) {
            if self.frame.cancel().is_cancelled() {
                break;
            }
            let model = self.motion_model(self.frame, order);
            let motion = match &last {
                Some((before, motion)) => {
                    let mut motion = model.extended(before, motion);
                    model.fit(&mut motion, &RESTART_BLURS_PX, STEPS);
                    motion
                }
                None => {
                    let (mut motion, blurs) = self.first_motion(&model);
                    model.fit(&mut motion, blurs, STEPS);
                    motion
                }
            };
            let video = model.video(&motion);
            let fitted = Fitted::Motion {
                order,
                motion: motion.clone(),
            };
            let candidate = self.candidate(fitted, model.affine(&motion), &video);
            let held_out = candidate.trial.held_out;
            candidates.push(candidate);
            if gain.is_some_and(|gain| held_out > decision::HOPELESS_MOTION * gain) {
                break;
            }
            last = Some((model, motion));
        }
        candidates
    }

    /// Where the fit of `model` begins, and its blurs: at rest, or where the time of the guide is unknown, at the best of the coarse
    /// motions that assume one of a few times.
    fn first_motion(&self, model: &MotionModel) -> (Motion, &'static [f64]) {
        let [guide @ KeyFrame { bins: None, .. }] = self.key_frames else {
            return (model.at_rest(), &BLURS_PX);
        };
        let assumed = |part: f64| {
            let bin = part * self.frame.shape().bins as f64 - 0.5;
            let guide = KeyFrame {
                bins: Some((bin, bin)),
                ..guide.clone()
            };
            let known = MotionModel::new(self.frame, &[guide], self.start, ORDERS[0]);
            let mut motion = known.at_rest();
            known.fit(&mut motion, &BLURS_PX[..1], STEPS);
            (known.objective(&motion), model.of_known_time(&motion, bin))
        };
        let motions = ASSUMED_TIMES.map(assumed).into_iter();
        let best = motions.min_by(|a, b| a.0.total_cmp(&b.0));
        (best.expect("at least one time").1, &BLURS_PX[1..])
    }

    fn motion_model<'f>(&self, frame: &'f FrameFit<'f>, order: usize) -> MotionModel<'f> {
        MotionModel::new(frame, self.key_frames, self.start, order)
    }

    /// The result, with all pixels fitted.
    fn finish(
        &self,
        candidate: Candidate,
        trials: Vec<GuideTrial>,
        chosen: usize,
        used: bool,
        reason: String,
    ) -> Result<GuideFit> {
        let shape = self.frame.shape();
        let whole = self.frame.with_all_pixels();
        let (mut displacement_px, mut known_places) = (None, None);
        let (video, affine, gain, offset, blur_px, parameters) = match candidate.fitted {
            Fitted::Motion { order, mut motion } => {
                let model = self.motion_model(&whole, order);
                model.fit(&mut motion, &[0.0], 2);
                let blur = model.best_blur(&motion, &GUIDE_BLURS_PX);
                displacement_px = Some(model.rms_displacement_px(&motion));
                let (video, gain, offset) = model.blurred_video(&motion, blur);
                let affine = model.affine(&motion);
                (video, affine, gain, offset, blur, model.parameters() as f64)
            }
            Fitted::Gain(mut found) => {
                let model = GainModel::new(&whole, self.reference, self.start);
                model.refit(&mut found);
                let video = model.video(&found);
                (
                    video,
                    found.affine,
                    found.gain,
                    0.0,
                    0.0,
                    model.parameters() as f64,
                )
            }
            Fitted::Still => {
                let guide = self.reference;
                let (gain, offset, video) = gain_field::still(&whole, guide, &self.start);
                (video, self.start, gain, offset, 0.0, 8.0)
            }
            Fitted::Places { affine, width } => {
                let guide = self.reference;
                let model = PlacesModel::new(&whole, guide, affine, width)?;
                let (found, parameters) = model.traces();
                known_places = Some(found);
                (
                    model.video(),
                    affine,
                    model.gain,
                    0.0,
                    0.0,
                    parameters + 6.0,
                )
            }
        };
        let field = Field::of(shape);
        Ok(GuideFit {
            model: candidate.trial.model,
            video: Video::new(shape, video)?,
            gain: gain / self.scale,
            offset,
            blur_px,
            affine,
            registered: field.warp(self.reference, &affine),
            correlation: self.correlation,
            displacement_px,
            degrees_of_freedom: parameters,
            known_places,
            trials,
            chosen,
            held_out_without: self.held_out_without,
            used,
            reason,
        })
    }
}

/// Parts of the video that a guide of unknown time is compared with, beside the whole of it.
const PARTS: usize = 4;

/// The coarse video without a guide at the time of the guide. Where that is unknown, its mean and the means of its parts.
fn coarse_pictures(frame: &FrameFit, without: &WithoutGuide, guide: &KeyFrame) -> Vec<Image> {
    let bins = frame.shape().bins;
    if let Some((from, to)) = guide.bins {
        let bin = |t: f64| t.round().clamp(0.0, (bins - 1) as f64) as usize;
        return vec![mean_picture(frame, without, bin(from)..=bin(to))];
    }
    let parts = PARTS.min(bins);
    let part = |p: usize| p * bins / parts..=((p + 1) * bins / parts - 1);
    std::iter::once(0..=bins - 1)
        .chain((0..parts).map(part))
        .map(|bins| mean_picture(frame, without, bins))
        .collect()
}

/// The mean of the coarse video over `bins`.
fn mean_picture(
    frame: &FrameFit,
    without: &WithoutGuide,
    bins: std::ops::RangeInclusive<usize>,
) -> Image {
    let shape = frame.shape();
    let count = bins.clone().count() as f32;
    let mut picture = Image::zeros(shape.rows, shape.columns);
    for t in bins {
        let bin = &without.video[t * shape.pixels()..(t + 1) * shape.pixels()];
        let pixels = picture.data_mut().iter_mut().zip(bin);
        pixels.for_each(|(p, v)| *p += v / count);
    }
    picture
}

/// First and last place of an exposure on the axis of bins, on which bin `t` has its middle at `t`.
fn bins_of(camera: &Camera, exposure: GuideExposure) -> (f64, f64) {
    let time = camera.time();
    let place = |us: f64| (us - time.start_us()) / time.bin_duration_us() - 0.5;
    let half = 0.5 * exposure.exposure_us;
    (
        place(exposure.time_us - half),
        place(exposure.time_us + half),
    )
}

fn check(guides: &[Guide], model: GuideModel) -> Result<()> {
    let fault = |found: String, rule: &'static str, remedy: &'static str| {
        Err(Error::input(Parameter::Guide, found, rule, remedy))
    };
    if guides.is_empty() {
        return fault(
            "no picture".into(),
            "there is at least one",
            "Give a picture of the scene.",
        );
    }
    for guide in guides {
        if let Some((y, x)) = guide.image.first_non_finite() {
            let value = guide.image.at(y, x);
            return fault(
                format!("{value} in row {y}, column {x}"),
                "every pixel is a finite number",
                "Check the picture.",
            );
        }
        let (least, most) = (guide.image.min(), guide.image.max());
        if most <= 0.0 || most == least {
            return fault(
                format!("values from {least} to {most}"),
                "a picture has light and shade",
                "Check the exposure of the second camera.",
            );
        }
        let is_bad = |e: &GuideExposure| {
            !(e.time_us.is_finite() && e.exposure_us.is_finite() && e.exposure_us >= 0.0)
        };
        if let Some(exposure) = guide.exposure.filter(|e| is_bad(e)) {
            return fault(
                format!("{} µs at {} µs", exposure.exposure_us, exposure.time_us),
                "time and exposure are finite, and an exposure is not below zero",
                "Leave both out where the time is unknown.",
            );
        }
    }
    if guides.len() > 1 {
        check_key_frames(guides, model)?;
    }
    Ok(())
}

/// A motion needs bins to move in.
fn check_bins(bins: usize, guides: usize, model: GuideModel) -> Result<()> {
    if bins > 1 || (model != GuideModel::Motion && guides == 1) {
        return Ok(());
    }
    let fault = Error::input(
        Parameter::Guide,
        format!("{guides} pictures for a motion in {bins} bin"),
        "a motion has two bins or more",
        "Give one picture and the model still or gain.",
    );
    Err(fault.with_kind(ErrorKind::Unsupported))
}

/// A guide has light at the pixels of the field.
fn check_on_field(guides: &[KeyFrame]) -> Result<()> {
    let greatest = guides.iter().map(|guide| guide.image.max());
    let Some(dark) = greatest.into_iter().find(|max| *max <= 0.0) else {
        return Ok(());
    };
    Err(Error::input(
        Parameter::Guide,
        format!("values up to {dark} at the resolution of the field"),
        "a picture has light and shade",
        "Check the exposure of the second camera, and the dark level that was subtracted.",
    ))
}

/// Several guides need different times, and move.
fn check_key_frames(guides: &[Guide], model: GuideModel) -> Result<()> {
    let mut times: Vec<f64> = guides
        .iter()
        .filter_map(|g| g.exposure.map(|e| e.time_us))
        .collect();
    times.sort_by(f64::total_cmp);
    times.dedup();
    if times.len() < guides.len() {
        return Err(Error::input(
            Parameter::Guide,
            format!("{} pictures with {} times", guides.len(), times.len()),
            "each of several pictures has a time of its own",
            "Give time_us and exposure_us of every picture, or one picture.",
        ));
    }
    if !matches!(model, GuideModel::Auto | GuideModel::Motion) {
        return Err(Error::input(
            Parameter::Guide,
            format!("{} pictures for the model {}", guides.len(), model.name()),
            "several pictures are key frames of a motion",
            "Give one picture, or the model motion.",
        )
        .with_kind(ErrorKind::Unsupported));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_motion_needs_two_bins() {
        assert!(check_bins(1, 1, GuideModel::Auto).is_ok());
        assert!(check_bins(2, 3, GuideModel::Motion).is_ok());
        for (guides, model) in [(1, GuideModel::Motion), (2, GuideModel::Auto)] {
            let error = check_bins(1, guides, model).unwrap_err().to_string();
            assert!(error.contains("two bins or more"), "{error}");
        }
    }

    #[test]
    fn a_guide_that_is_dark_on_the_grid_of_the_field_is_refused() {
        let guide = |value: f32| KeyFrame {
            image: Image::from_fn(4, 4, |_, _| value),
            bins: None,
        };
        assert!(check_on_field(&[guide(0.5)]).is_ok());
        let error = check_on_field(&[guide(0.5), guide(-0.1)]).unwrap_err();
        assert!(error.to_string().contains("-0.1"), "{error}");
    }
}
