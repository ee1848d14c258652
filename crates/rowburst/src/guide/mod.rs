//! Dense scenes with the picture of a second camera.
//!
//! One frame holds too few numbers for a video with light everywhere (`design::count`). An ordinary picture of the
//! same scene, the guide `G`, brings what is missing: the frame has only to tell how the guide moves or changes its
//! brightness. The models are
//!
//! ```text
//! motion      v(x, t) = a G(x + d(x) + Σ_k τ_k(t) θ_k(x)) + c
//! gain field  v(x, t) = G(x + d(x)) Σ_k τ_k(t) φ_k(x)
//! still       v(x, t) = a G(x + d(x)) + c
//! ```
//!
//! with cosines `τ_k` in time, and `θ_k`, `φ_k` on B-spline grids. The affine map `d` is found by registration on a coarse
//! video without a guide, then from the frame. A tenth of the pixels of every row judges: [`fit`] drops a guide that
//! predicts them worse than no guide (docs/design/028).

mod affine;
mod basis;
mod change;
mod decision;
mod decoy;
mod edge;
mod frame_fit;
mod gain_field;
mod least_squares;
mod motion;
mod picture;
mod start;
mod without_guide;

pub use affine::Affine;
pub use change::{FrameChange, estimate_change};

use affine::Field;
use decision::Evidence;
use decoy::gain_over_decoys;
use edge::Edge;
use frame_fit::FrameFit;
use gain_field::{GainField, GainModel};
use motion::{KeyFrame, Motion, MotionModel};
use rowburst_core::{Cancel, Error, ErrorKind, Parameter, Result};
use rowburst_optics::{Camera, Image, Measurement, RollingShutter, Video};
use start::Start;
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
}

impl GuideModel {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Auto, Self::Motion, Self::Gain, Self::Still];

    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Motion => "motion",
            Self::Gain => "gain",
            Self::Still => "still",
        }
    }
}

/// A model that was tried.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GuideTrial {
    /// The model.
    pub model: GuideModel,
    /// Highest cosine in time of a motion.
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
    /// Counts of the video where the guide is zero; 0 for a gain field.
    pub offset: f64,
    /// Blur of the guide that fits the frame best, in pixels of the field.
    pub blur_px: f64,
    /// The map from the field to the guide.
    pub affine: Affine,
    /// The guide seen from the field; the first guide of several.
    pub registered: Image,
    /// Correlation of the registered guide with the coarse picture of the scene that the frame gives without it.
    pub correlation: f64,
    /// How far the guide predicts held-out pixels better than the best of its mirror images, fitted alike, in standard errors
    /// of the paired differences.
    pub decoy_gain: f64,
    /// Rms displacement of a motion over the field and the bins, in pixels.
    pub displacement_px: Option<f64>,
    /// Number of parameters of the model.
    pub degrees_of_freedom: f64,
    /// The models that were tried.
    pub trials: Vec<GuideTrial>,
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
        let of_model = self.trials.iter().filter(|t| t.model == self.model);
        let best = of_model.min_by(|a, b| a.held_out.total_cmp(&b.held_out));
        best.expect("the model was tried")
    }
}

/// Highest cosines in time of the motions that are tried.
const ORDERS: [usize; 3] = [2, 3, 5];
/// Blurs of a fit from coarse to fine, in pixels of a field of 108, and of one that goes on from a coarser model.
const BLURS_PX: [f64; 4] = [4.0, 2.0, 1.0, 0.0];
const RESTART_BLURS_PX: [f64; 2] = [1.0, 0.0];
/// Gauss–Newton steps at each blur; more gain little.
const STEPS: usize = 6;
/// Times that edge and motion are fitted in turn; more change little.
const EDGE_ROUNDS: usize = 1;
/// Blurs of the guide that are compared at the end, in pixels.
const GUIDE_BLURS_PX: [f64; 5] = [0.0, 0.5, 1.0, 1.5, 2.0];

/// Fits the models of `model` to the frame and says whether the guide belongs to it. `sigma` is the noise of a pixel of
/// weight 1 in counts. Several guides are key frames with times, and their model is motion.
///
/// # Errors
/// No guide, several guides without times or with one time, a guide without light or with values that are not finite, or
/// `cancel`.
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
    let frame = FrameFit::new(operator, measurement, sigma, cancel);
    let key_frames: Vec<KeyFrame> = guides
        .iter()
        .map(|guide| KeyFrame {
            image: normalised(&picture::on_grid(&guide.image, shape.rows, shape.columns)),
            bins: guide.exposure.map(|e| bins_of(camera, e)),
        })
        .collect();
    let without = WithoutGuide::new(&frame);
    cancel.check()?;
    let start = Start::new(&frame, &without, &key_frames[0]);
    info!(
        "guide: registered, shift {:.2} and {:.2} px, correlation {:.3}; without a guide held-out {:.3} σ",
        start.affine.parameters[0], start.affine.parameters[3], start.correlation, without.held_out
    );
    cancel.check()?;
    let search = Search {
        frame: &frame,
        key_frames: &key_frames,
        start,
        held_out_without: without.held_out,
        saturated: decision::saturated(&guides[0].image),
        scale: f64::from(guides[0].image.max()),
    };
    search.run(model)
}

/// The inputs of the models.
struct Search<'a> {
    frame: &'a FrameFit<'a>,
    key_frames: &'a [KeyFrame],
    start: Start,
    held_out_without: f64,
    /// Part of the guide's pixels at its greatest value.
    saturated: f64,
    /// Greatest value of the first guide, by which the guides were divided.
    scale: f64,
}

/// A fitted model.
enum Fitted {
    Motion { order: usize, motion: Motion },
    Gain(GainField),
    Still,
}

/// A model with its video and errors.
struct Candidate {
    trial: GuideTrial,
    fitted: Fitted,
    edge: Edge,
    video: Vec<f32>,
}

/// Whether a guide is used, and why.
struct Decision {
    used: bool,
    reason: String,
    decoy_gain: f64,
}

impl Search<'_> {
    fn run(&self, model: GuideModel) -> Result<GuideFit> {
        let mut candidates = Vec::new();
        let wants = |one| model == GuideModel::Auto || model == one;
        if wants(GuideModel::Still) {
            candidates.push(self.still());
        }
        if wants(GuideModel::Motion) {
            candidates.extend(self.motions());
        }
        self.frame.cancel().check()?;
        if wants(GuideModel::Gain) && self.key_frames.len() == 1 {
            candidates.push(self.gain_field());
        }
        self.frame.cancel().check()?;
        let trials: Vec<GuideTrial> = candidates.iter().map(|c| c.trial).collect();
        let chosen = decision::choose(&trials);
        let decided = self.judge(&trials, &trials[chosen]);
        self.frame.cancel().check()?;
        info!("guide {}", decided.reason);
        self.finish(candidates.swap_remove(chosen), trials, decided)
    }

    fn judge(&self, trials: &[GuideTrial], chosen: &GuideTrial) -> Decision {
        let shape = self.frame.shape();
        let (picture, guide) = (&self.start.picture, &self.key_frames[0]);
        let decoy_gain = gain_over_decoys(self.frame, picture, guide, chosen.model);
        let evidence = Evidence {
            trials,
            held_out_without: self.held_out_without,
            decoy_gain,
            saturated: self.saturated,
            deviation: self
                .start
                .affine
                .deviation(0.5 * shape.rows.max(shape.columns) as f64),
        };
        let (used, reason) = evidence.verdict(chosen);
        Decision {
            used,
            reason,
            decoy_gain,
        }
    }

    /// `video` is that of the model, without the edge.
    fn candidate(&self, fitted: Fitted, edge: &Edge, video: Vec<f32>) -> Candidate {
        let video = edge.added_to(video);
        let (fitted_error, held_out) = self.frame.errors(&video);
        let (model, order) = match &fitted {
            Fitted::Motion { order, .. } => (GuideModel::Motion, Some(*order)),
            Fitted::Gain(_) => (GuideModel::Gain, None),
            Fitted::Still => (GuideModel::Still, None),
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
            fitted,
            edge: edge.clone(),
            video,
        }
    }

    fn still(&self) -> Candidate {
        let (guide, affine) = (&self.key_frames[0].image, &self.start.affine);
        let (.., video) = gain_field::still(self.frame, guide, affine);
        let edge = Edge::new(self.frame, &video, affine);
        let (.., video) = gain_field::still(&edge.removed_from(self.frame), guide, affine);
        self.candidate(Fitted::Still, &edge, video)
    }

    fn gain_field(&self) -> Candidate {
        let guide = &self.key_frames[0].image;
        let model = GainModel::new(self.frame, guide, self.start.affine);
        let mut found = model.fit();
        let video = model.video(&found);
        let robust = self.frame.reweighted(&video);
        let edge = Edge::new(&robust, &video, &found.affine);
        let frame = edge.removed_from(&robust);
        let model = GainModel::new(&frame, guide, self.start.affine);
        model.refit(&mut found);
        model.correct(&mut found);
        let video = model.video(&found);
        self.candidate(Fitted::Gain(found), &edge, video)
    }

    /// Motions with more and more cosines, each from the one before.
    fn motions(&self) -> Vec<Candidate> {
        let bins = self.frame.shape().bins;
        let mut orders = ORDERS.into_iter().filter(|order| *order < bins).peekable();
        let Some(&first) = orders.peek() else {
            return Vec::new();
        };
        let model = self.motion_model(self.frame, first);
        let mut motion = model.at_rest();
        model.fit(&mut motion, &BLURS_PX, STEPS);
        let robust = self.frame.reweighted(&model.video(&motion));
        // Edge and motion explain each other's light at first.
        let mut edge = Edge::new(&robust, &model.video(&motion), &model.affine(&motion));
        for _ in 0..EDGE_ROUNDS {
            let frame = edge.removed_from(&robust);
            let model = self.motion_model(&frame, first);
            model.fit(&mut motion, &RESTART_BLURS_PX, STEPS);
            edge = Edge::new(&robust, &model.video(&motion), &model.affine(&motion));
        }
        let frame = edge.removed_from(&robust);
        let mut candidates = Vec::new();
        let mut before = self.motion_model(&frame, first);
        for order in orders {
            if self.frame.cancel().is_cancelled() {
                break;
            }
            let model = self.motion_model(&frame, order);
            motion = model.extended(&before, &motion);
            model.fit(&mut motion, &RESTART_BLURS_PX, STEPS);
            let fitted = Fitted::Motion {
                order,
                motion: motion.clone(),
            };
            candidates.push(self.candidate(fitted, &edge, model.video(&motion)));
            before = model;
        }
        candidates
    }

    fn motion_model<'f>(&self, frame: &'f FrameFit<'f>, order: usize) -> MotionModel<'f> {
        MotionModel::new(frame, self.key_frames, self.start.affine, order)
    }

    /// The result, with all pixels fitted.
    fn finish(
        &self,
        candidate: Candidate,
        trials: Vec<GuideTrial>,
        decided: Decision,
    ) -> Result<GuideFit> {
        let shape = self.frame.shape();
        let whole = self.frame.with_all_pixels().reweighted(&candidate.video);
        let frame = candidate.edge.removed_from(&whole);
        let guide = &self.key_frames[0].image;
        let mut displacement_px = None;
        let (video, affine, gain, offset, blur_px, parameters) = match candidate.fitted {
            Fitted::Motion { order, mut motion } => {
                let model = self.motion_model(&frame, order);
                model.fit(&mut motion, &[0.0], 2);
                let blur = model.best_blur(&motion, &GUIDE_BLURS_PX);
                displacement_px = Some(model.rms_displacement_px(&motion));
                let (video, gain, offset) = model.blurred_video(&motion, blur);
                let affine = model.affine(&motion);
                (video, affine, gain, offset, blur, model.parameters())
            }
            Fitted::Gain(mut found) => {
                let model = GainModel::new(&frame, guide, self.start.affine);
                model.refit(&mut found);
                let (video, parameters) = (model.video(&found), model.parameters());
                (video, found.affine, found.gain, 0.0, 0.0, parameters)
            }
            Fitted::Still => {
                let affine = self.start.affine;
                let (gain, offset, video) = gain_field::still(&frame, guide, &affine);
                (video, affine, gain, offset, 0.0, 8)
            }
        };
        let video = Edge::new(&whole, &video, &affine).added_to(video);
        let field = Field {
            rows: shape.rows,
            columns: shape.columns,
        };
        Ok(GuideFit {
            model: candidate.trial.model,
            video: Video::new(shape, video)?,
            gain: gain / self.scale,
            offset,
            blur_px,
            affine,
            registered: field.warp(guide, &affine),
            correlation: self.start.correlation,
            decoy_gain: decided.decoy_gain,
            displacement_px,
            degrees_of_freedom: parameters as f64,
            trials,
            held_out_without: self.held_out_without,
            used: decided.used,
            reason: decided.reason,
        })
    }
}

/// First and last place of an exposure on the axis of bins, on which bin `t` has its middle at `t`.
fn bins_of(camera: &Camera, exposure: GuideExposure) -> (f64, f64) {
    let params = camera.params();
    let rows = params.exposure_us / params.row_time_us;
    // The video begins a part of a row before the first exposure where that is no whole number of rows.
    let lead_us = (rows.ceil() - rows).max(0.0) * params.row_time_us;
    let bin_us = camera.time().bin_duration_us();
    let place = |us: f64| (us + lead_us) / bin_us - 0.5;
    let half = 0.5 * exposure.exposure_us;
    (
        place(exposure.time_us - half),
        place(exposure.time_us + half),
    )
}

/// The image with greatest value 1.
fn normalised(image: &Image) -> Image {
    let mut image = image.clone();
    let peak = image.max();
    image.data_mut().iter_mut().for_each(|p| *p /= peak);
    image
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
    if matches!(model, GuideModel::Gain | GuideModel::Still) {
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
