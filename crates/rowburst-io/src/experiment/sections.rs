//! The keys of the experiment file.

use crate::keys::{Key, Kind, Section, schema};
use rowburst::Shutter;
use rowburst::bayer::Bayer;
use rowburst::camera::MAX_SIDE;

pub(super) static CAMERA: Section = Section {
    name: "camera",
    meaning: "The camera. What is missing here is taken from the metadata of the frame's file.",
    keys: &[
        Key::optional("rows", SIDE, "Rows of the frame, after binning."),
        Key::optional("columns", SIDE, "Columns of the frame, after binning."),
        Key::optional(
            "shutter",
            Kind::Choice(&Shutter::NAMES),
            "Order in which rows are read.",
        ),
        Key::optional(
            "row_time_us",
            Kind::Positive,
            "Time from one read-out to the next, in µs; may be left out for the shutter global.",
        ),
        Key::optional(
            "exposure_us",
            Kind::Positive,
            "Exposure of each row, in µs; it ends when the row is read, and may be shorter or longer than a row time.",
        ),
        Key::optional(
            "row_order",
            Kind::FileOrCounts,
            "For the shutter custom: the instant at which each row is read, as a list or as a .npy file.",
        ),
        Key::optional(
            "binning",
            Kind::Count(1, 64),
            "Raw pixels along a side of a pixel of the working grid; a larger raw frame is binned by the mean; 1 where it is left out.",
        ),
        Key::optional(
            "bins_per_row",
            Kind::Count(1, 64),
            "Bins of the video in each row time; 1 where it is left out.",
        ),
        Key::optional(
            "pixel_pitch_um",
            Kind::Positive,
            "Pitch of a pixel after binning, in µm, for scale bars, TIFF files and simulated optics.",
        ),
        Key::optional(
            "magnification",
            Kind::Positive,
            "Size of an image on the sensor over that of the object (M of Eq. 1). Scale bars, distances and speeds of report and viewer are then those at the object; files keep the pitch of the sensor.",
        ),
        Key::optional(
            "trigger_delay_us",
            Kind::NonNegative,
            "Time from the trigger to the start of exposure of the row that is read first, in µs. Times keep this start as their zero; report and viewer say how long it is after the trigger.",
        ),
        Key::optional(
            "bit_depth",
            Kind::Count(1, 32),
            "Bits of the converter; pixels at its end are saturated and left out.",
        ),
        Key::optional(
            "bias_counts",
            Kind::NonNegative,
            "Counts without light; subtracted unless there is a dark frame.",
        ),
        Key::optional(
            "gain_electrons_per_count",
            Kind::Positive,
            "Electrons per count. With gain and read noise, σ is that of each pixel's shot and read noise, and pixels are weighted by it. With the gain alone, light is shown in electrons, too.",
        ),
        Key::optional(
            "read_noise_electrons",
            Kind::NonNegative,
            "Read noise, in electrons rms; see the gain.",
        ),
        Key::optional(
            "full_well_counts",
            Kind::Positive,
            "Counts at which a pixel is full; it is then left out.",
        ),
        Key::optional(
            "bayer",
            Kind::Choice(&Bayer::NAMES),
            "Mosaic of a colour sensor whose frames are raw; they are reconstructed plane by plane.",
        ),
    ],
};

pub(super) static CALIBRATION: Section = Section {
    name: "calibration",
    meaning: "Files of the calibration. Options of the command line take precedence.",
    keys: &[
        Key::optional(
            "psf",
            Kind::File,
            "Image of the point-spread function, or a patch set (.toml) by calibrate psf --positions-mm.",
        ),
        Key::optional("dark", Kind::File, "A frame without light."),
        Key::optional(
            "flat",
            Kind::File,
            "A frame of even light as recorded, dark level included: the dark frame or bias_counts is subtracted from it, and only its shape matters.",
        ),
        Key::optional(
            "bad_pixels",
            Kind::File,
            "A mask; pixels that are not zero are left out.",
        ),
    ],
};

pub(super) static FIELD: Section = Section {
    name: "field",
    meaning: "Size of the video where it is larger than the sensor; centred on it.",
    keys: &[
        Key::required("rows", SIDE, "Rows of the video."),
        Key::required("columns", SIDE, "Columns of the video."),
    ],
};

pub(super) static RECONSTRUCTION: Section = Section {
    name: "reconstruction",
    meaning: "Options of the reconstruction.",
    keys: &[
        Key::optional("prior", Kind::Text, "The prior; auto where it is left out."),
        Key::optional(
            "tau",
            Kind::ChoiceOrPositive(&["auto", "held-out"]),
            "Weight of the prior; auto where it is left out.",
        ),
    ],
};

pub(super) static RECORDING: Section = Section {
    name: "recording",
    meaning: "A recording of many frames, for batch.",
    keys: &[Key::optional(
        "frame_period_us",
        Kind::Positive,
        "Time from the start of a frame to that of the next, in µs.",
    )],
};

pub(super) static GUIDE: Section = Section {
    name: "guide",
    meaning: "Pictures of the same scene by an ordinary second camera, each in a table [[guide]].",
    keys: &[
        Key::required(
            "image",
            Kind::File,
            "The picture, of any size; it shows what the field shows.",
        ),
        Key::optional(
            "time_us",
            Kind::NonNegative,
            "Middle of its exposure, in µs from the start of the frame's first exposure; several pictures need it; left out: at an unknown time within the frame.",
        ),
        Key::optional(
            "exposure_us",
            Kind::NonNegative,
            "Its exposure, in µs; 0 where it is left out.",
        ),
    ],
};

pub(super) static SECTIONS: [&Section; 6] = [
    &CAMERA,
    &CALIBRATION,
    &FIELD,
    &RECONSTRUCTION,
    &RECORDING,
    &GUIDE,
];

/// The sections of which a file may have several.
pub(super) static REPEATED: [&str; 1] = [GUIDE.name];

const SIDE: Kind = Kind::Count(1, MAX_SIDE);

/// The JSON Schema of the experiment file, as text.
pub fn experiment_schema() -> String {
    schema(
        "Rowburst experiment file",
        "A camera, its calibration, the field and how to reconstruct, in TOML. Paths are relative to the file.",
        &SECTIONS,
        &REPEATED,
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `UPDATE_SCHEMA=1` renews the file.
    #[test]
    fn the_committed_schema_is_that_of_the_keys() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/schema/experiment.schema.json");
        let schema = experiment_schema();
        if std::env::var_os("UPDATE_SCHEMA").is_some() {
            std::fs::write(path, &schema).unwrap();
        }
        // The order of keys differs between features of serde_json.
        let value = |text: &str| serde_json::from_str::<serde_json::Value>(text).unwrap();
        let committed = std::fs::read_to_string(path).unwrap();
        assert_eq!(value(&committed), value(&schema));
    }
}
