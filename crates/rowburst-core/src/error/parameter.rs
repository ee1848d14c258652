//! The parameters that an error can be about.

macro_rules! parameters {
    ($($(#[doc = $doc:literal])+ $variant:ident = $name:literal,)+) => {
        /// What a user gives: a file, a quantity or an option. Each interface has names of its own for them
        /// ([`super::Names`]).
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        #[non_exhaustive]
        pub enum Parameter {
            $($(#[doc = $doc])+ $variant,)+
        }

        impl Parameter {
            /// All parameters.
            pub const ALL: &'static [Self] = &[$(Self::$variant),+];

            /// The name in the library, which is that of the experiment file and of Python where these have it.
            pub fn name(self) -> &'static str {
                match self {
                    $(Self::$variant => $name,)+
                }
            }
        }
    };
}

parameters! {
    /// The recorded frame.
    Frame = "frame",
    /// The frames of a recording, or of a calibration.
    Frames = "frames",
    /// The point-spread function.
    Psf = "psf",
    /// PSFs at several positions of the field.
    PatchSet = "patch_set",
    /// The dark frame.
    Dark = "dark",
    /// The flat field.
    Flat = "flat",
    /// The mask of bad pixels.
    BadPixels = "bad_pixels",
    /// Frames without light, for the calibration of a sensor.
    Darks = "darks",
    /// Evenly lit frames, for the calibration of a sensor.
    Flats = "flats",
    /// Both kinds of frames of the calibration of a sensor.
    DarksAndFlats = "darks_and_flats",
    /// Captures of a point source.
    Captures = "captures",
    /// Expected size of the grains of the speckle, in pixels.
    ExpectedGrainPx = "expected_grain_px",
    /// Diameter of the pinhole, in µm.
    PinholeUm = "pinhole_um",
    /// Counts of a saturated pixel of a capture.
    SaturationCounts = "saturation_counts",
    /// Positions of the point source at each capture, in mm.
    PositionsMm = "positions_mm",
    /// Exposure of each capture, in ms.
    ExposuresMs = "exposures_ms",
    /// The true video.
    Truth = "truth",
    /// A frame of the scene without the diffuser.
    Direct = "direct",
    /// Pictures of the scene by a second camera.
    Guide = "guide",
    /// What a scene does with the light of a guide.
    GuideModel = "guide_model",
    /// Time and exposure of each guide, in µs.
    GuideExposuresUs = "guide_exposures_us",
    /// Times at which a simulation takes guides, in µs.
    GuideTimesUs = "guide_times_us",
    /// The scene of a simulation.
    Scene = "scene",
    /// A video.
    Video = "video",
    /// An image.
    Image = "image",
    /// The weights of the pixels.
    Weights = "weights",
    /// The simulated frame before noise is added.
    NoiselessFrame = "noiseless_frame",
    /// The course of a light over time.
    Signal = "signal",
    /// The signal of a photodiode.
    Photodiode = "photodiode",
    /// A region of the video.
    Region = "region",
    /// The experiment file.
    Experiment = "experiment",
    /// The folder or file of results.
    Output = "output",
    /// Whether a folder with foreign files is written to.
    Force = "force",
    /// Whether a recording of the same name is moved away.
    Replace = "replace",
    /// The folder in which inputs are looked for.
    Inputs = "inputs",
    /// The files that are written.
    Write = "write",
    /// The camera.
    Camera = "camera",
    /// Rows of the sensor.
    Rows = "rows",
    /// Columns of the sensor.
    Columns = "columns",
    /// The order in which rows are read.
    Shutter = "shutter",
    /// Time from one row to the next, in µs.
    RowTimeUs = "row_time_us",
    /// Exposure of a row, in µs.
    ExposureUs = "exposure_us",
    /// The instant at which each row is read.
    RowOrder = "row_order",
    /// Side of the square of pixels that are added up.
    Binning = "binning",
    /// Bins of the video in one row time.
    BinsPerRow = "bins_per_row",
    /// Distance of two pixels, in µm.
    PixelPitchUm = "pixel_pitch_um",
    /// From the trigger to the first exposure, in µs.
    TriggerDelayUs = "trigger_delay_us",
    /// Bits of the converter.
    BitDepth = "bit_depth",
    /// Counts without light.
    BiasCounts = "bias_counts",
    /// Electrons for each count.
    GainElectronsPerCount = "gain_electrons_per_count",
    /// Read noise, in electrons.
    ReadNoiseElectrons = "read_noise_electrons",
    /// Counts of a saturated pixel.
    FullWellCounts = "full_well_counts",
    /// The mosaic of colour filters.
    Bayer = "bayer",
    /// Size of the reconstructed field.
    Field = "field",
    /// Rows of the field.
    FieldRows = "field_rows",
    /// Columns of the field.
    FieldColumns = "field_columns",
    /// Time from one frame to the next, in µs.
    FramePeriodUs = "frame_period_us",
    /// The prior.
    Prior = "prior",
    /// The weight τ of the prior, or the rule for it.
    Tau = "tau",
    /// Standard deviation of the noise, in counts.
    NoiseSigma = "noise_sigma",
    /// Limit of the number of iterations.
    MaxIterations = "max_iterations",
    /// The constants of the solver.
    Tuning = "tuning",
    /// When a frame corrects its PSF and camera.
    SelfCalibrate = "self_calibrate",
    /// Limit of the time, in s.
    TimeBudgetS = "time_budget_s",
    /// Standard errors of traces.
    StandardErrors = "standard_errors",
    /// The bins that are reconstructed.
    Bins = "bins",
    /// Bins of a chunk.
    PartBins = "part_bins",
    /// Step length of a data step.
    Step = "step",
    /// The seed of random numbers.
    Seed = "seed",
    /// Number of threads.
    Threads = "threads",
    /// The memory of a reconstruction.
    Memory = "memory",
    /// Height of digits, in pixels.
    HeightPx = "height_px",
    /// Number of digits.
    Digits = "digits",
    /// Brightness of a background.
    Background = "background",
    /// Wavelength, in nm.
    WavelengthNm = "wavelength_nm",
    /// The pupil of the lens.
    Aperture = "aperture",
    /// Diameter of the pupil, in mm.
    DiameterMm = "diameter_mm",
    /// Image-side numerical aperture.
    Na = "na",
    /// Focal length, in mm.
    FocalLengthMm = "focal_length_mm",
    /// Distance from pupil to sensor, in mm.
    ImageDistanceMm = "image_distance_mm",
    /// Size of the image over that of the object.
    Magnification = "magnification",
    /// Full angle of the diffuser at half of its maximum, in degrees.
    DiffuserFwhmDeg = "diffuser_fwhm_deg",
    /// Rms phase of the diffuser, in rad.
    RmsPhase = "rms_phase",
    /// Lens and diffuser of a simulated PSF.
    SpeckleOptics = "speckle_optics",
    /// Rows of a simulated PSF.
    PsfRows = "psf_rows",
    /// Columns of a simulated PSF.
    PsfColumns = "psf_columns",
    /// Signal-to-noise ratio.
    Snr = "snr",
    /// Electrons in the brightest pixel of the frame.
    PeakElectrons = "peak_electrons",
    /// Electrons from the brightest scene pixel in a bin.
    SceneElectrons = "scene_electrons",
    /// Range of row times that are tried, in µs.
    RowTimesUs = "row_times_us",
    /// Expected row time, in µs.
    ExpectedRowTimeUs = "expected_row_time_us",
    /// Frequency of a light, in Hz.
    FrequencyHz = "frequency_hz",
    /// Part of its period for which a light is on.
    Duty = "duty",
    /// Photons of a bright scene pixel in a bin.
    Photons = "photons",
    /// Number of bright scene pixels.
    BrightPixels = "bright_pixels",
    /// Electrons for each photon.
    QuantumEfficiency = "quantum_efficiency",
    /// Electrons for each count.
    ElectronsPerCount = "electrons_per_count",
    /// Electrons of a saturated pixel.
    FullWellElectrons = "full_well_electrons",
    /// Rms optical path through the diffuser, in nm.
    DiffuserPathRmsNm = "diffuser_path_rms_nm",
    /// Bandwidth of the source, in nm.
    SourceBandwidthNm = "source_bandwidth_nm",
    /// Number of pixels that are not zero in a bin.
    NonZeroPixels = "non_zero_pixels",
    /// The map of the trials that succeed.
    SuccessMap = "success_map",
    /// Signal-to-noise ratio of trials.
    TrialSnr = "trial_snr",
    /// The frames that are processed.
    FramesRange = "frames_range",
    /// Joins the videos of a recording.
    Stitch = "stitch",
    /// Layout of a figure.
    Layout = "layout",
    /// A figure of a result.
    Figure = "figure",
    /// Port of the viewer's server.
    Port = "port",
    /// Instruction set of the vector loops.
    Simd = "simd",
}

impl Parameter {
    /// The parameter of this name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.iter().copied().find(|p| p.name() == name)
    }
}

impl std::fmt::Display for Parameter {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_unique() {
        for parameter in Parameter::ALL {
            assert_eq!(Parameter::from_name(parameter.name()), Some(*parameter));
        }
    }
}
