//! Frames taken under one condition, and how each pixel behaves in them.

use rowburst_core::error::Subject;
use rowburst_core::{Error, ErrorKind, Parameter, Result};
use rowburst_optics::Image;

use super::stats::mean;

/// Frames of one size, all finite, at least two, no two neighbours the same.
#[derive(Debug, Clone, PartialEq)]
pub struct Stack {
    parameter: Parameter,
    frames: Vec<(String, Image)>,
}

impl Stack {
    /// Checks `frames`, each with a name for messages; `parameter` is [`Parameter::Darks`] or
    /// [`Parameter::Flats`].
    ///
    /// # Errors
    /// Fewer than two frames, frames of several sizes, a pixel that is not finite, or
    /// the same frame twice in a row.
    pub fn new(parameter: Parameter, frames: Vec<(String, Image)>) -> Result<Self> {
        if frames.len() < 2 {
            return Err(Error::input(
                parameter,
                format!(
                    "{} frame{}",
                    frames.len(),
                    if frames.len() == 1 { "" } else { "s" }
                ),
                "noise is measured between frames: at least two are needed",
                "Record 20 or more with nothing changed between them.",
            ));
        }
        let (first, size) = (&frames[0].0, size(&frames[0].1));
        for (name, image) in &frames {
            check_size(Subject::item(parameter, name), image, size, first)?;
            if let Some((y, x)) = image.first_non_finite() {
                return Err(Error::input(
                    Subject::item(parameter, name),
                    format!("{} at row {y}, column {x}", image.at(y, x)),
                    "every pixel of a calibration frame is a finite number",
                    "Leave this frame out, or save the camera's raw counts.",
                )
                .with_kind(ErrorKind::NotFinite));
            }
        }
        for pair in frames.windows(2) {
            let (name, image) = &pair[1];
            if *image == pair[0].1 && !is_clipped(image) {
                return Err(Error::input(
                    Subject::item(parameter, name),
                    format!("the same frame as {}", pair[0].0),
                    "no two recorded frames have the same noise",
                    "Leave copies out; check that the software does not save one frame twice.",
                ));
            }
        }
        Ok(Self { parameter, frames })
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Whether there is none; a stack has at least two.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// Frame `i`.
    pub fn image(&self, i: usize) -> &Image {
        &self.frames[i].1
    }

    /// All frames in their order.
    pub fn images(&self) -> impl Iterator<Item = &Image> {
        self.frames.iter().map(|(_, image)| image)
    }

    /// Name of frame `i`.
    pub fn name(&self, i: usize) -> &str {
        &self.frames[i].0
    }

    /// Rows and columns.
    pub fn size(&self) -> (usize, usize) {
        size(self.image(0))
    }

    /// Refuses a stack of another size than `other`'s.
    pub(super) fn check_same_size(&self, other: &Self) -> Result<()> {
        let first = Subject::item(self.parameter, self.name(0));
        check_size(first, self.image(0), other.size(), other.name(0))
    }

    /// Whether all values are whole numbers, as an analogue-to-digital converter gives.
    pub(super) fn has_integer_counts(&self) -> bool {
        self.images()
            .all(|image| image.data().iter().all(|v| v.fract() == 0.0))
    }
}

/// Whether most pixels are at one end of the counts of the frame, where they show no noise. Later checks say so.
fn is_clipped(image: &Image) -> bool {
    let (low, high) = (image.min(), image.max());
    let count = |end: f32| image.data().iter().filter(|v| **v == end).count();
    2 * count(low).max(count(high)) > image.data().len()
}

fn size(image: &Image) -> (usize, usize) {
    (image.rows(), image.columns())
}

fn check_size(
    subject: Subject,
    image: &Image,
    expected: (usize, usize),
    first: &str,
) -> Result<()> {
    if size(image) == expected {
        return Ok(());
    }
    Err(Error::input(
        subject,
        format!("{}×{} pixels", image.rows(), image.columns()),
        format!(
            "all frames have the size of the first, {first}: {}×{}",
            expected.0, expected.1
        ),
        "Record darks and flats with the same region of interest and binning.",
    )
    .with_kind(ErrorKind::Shape))
}

/// Mean and variance of each pixel over the frames of a stack.
#[derive(Debug, Clone, PartialEq)]
pub struct Moments {
    /// Mean over the frames.
    pub mean: Vec<f64>,
    /// Variance over the frames, without the drift of whole frames.
    pub variance: Vec<f64>,
    /// Degrees of freedom of each variance.
    pub dof: f64,
    /// By how much each frame lies above the mean of all.
    pub drift: Vec<f64>,
}

impl Moments {
    /// Those of `stack`.
    pub fn of(stack: &Stack) -> Self {
        let count = stack.len() as f64;
        let pixels = stack.image(0).data().len();
        let mut means = vec![0.0; pixels];
        for image in stack.images() {
            let sums = means.iter_mut().zip(image.data());
            sums.for_each(|(sum, &p)| *sum += f64::from(p));
        }
        means.iter_mut().for_each(|m| *m /= count);
        let level = mean(means.iter().copied());
        let drift: Vec<f64> = stack
            .images()
            .map(|image| mean(image.data().iter().map(|&p| f64::from(p))) - level)
            .collect();
        let mut variance = vec![0.0; pixels];
        for (image, drift) in stack.images().zip(&drift) {
            let differences = image.data().iter().zip(&means);
            variance
                .iter_mut()
                .zip(differences)
                .for_each(|(v, (&p, m))| {
                    *v += (f64::from(p) - m - drift).powi(2);
                });
        }
        variance.iter_mut().for_each(|v| *v /= count - 1.0);
        Self {
            mean: means,
            variance,
            dof: count - 1.0,
            drift,
        }
    }
}
