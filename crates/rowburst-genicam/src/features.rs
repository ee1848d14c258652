//! Features of a camera: its settings, and what of them can be set while frames come.

use rowburst_capture::Control;
use viva_genicam::genapi::{AccessMode, FeatureState, FeatureValue, RegisterIo};
use viva_genicam::{Camera, GenicamError, GigeRegisterIo, StandardFeature};

/// Where the standard puts the frequency of the camera's clock: 64 bits.
const TICK_FREQUENCY_ADDRESS: u64 = 0x093c;

/// What is set from the page.
const CONTROLS: [StandardFeature; 2] = [StandardFeature::ExposureTime, StandardFeature::Gain];

/// Ticks of the camera's clock in a second, where it says so.
pub fn ticks_per_second(camera: &Camera<GigeRegisterIo>) -> Option<u64> {
    let feature = camera.get_integer("GevTimestampTickFrequency").ok();
    let feature = feature.and_then(|ticks| u64::try_from(ticks).ok());
    let register = || {
        let bytes = camera.transport().read(TICK_FREQUENCY_ADDRESS, 8).ok()?;
        Some(u64::from_be_bytes(bytes.try_into().ok()?))
    };
    feature.or_else(register).filter(|&ticks| ticks > 0)
}

/// Has the camera give frames until it is stopped, where it knows other modes.
pub fn acquire_continuously(camera: &mut Camera<GigeRegisterIo>) -> Result<(), GenicamError> {
    match camera.acquisition_mode() {
        Ok(mode) if mode != "Continuous" => camera.set_acquisition_mode("Continuous"),
        // A camera without the feature has no other mode.
        _ => Ok(()),
    }
}

/// Every feature that has a value now, by its name.
pub fn values(camera: &Camera<GigeRegisterIo>) -> Vec<(String, String)> {
    let mut found: Vec<(String, String)> = Vec::new();
    for (_, names) in camera.nodemap().categories() {
        for name in names {
            let is_known = found.iter().any(|(known, _)| known == name);
            if !is_known
                && let Ok(state) = camera.feature_state(name)
                && let Some(value) = text(&state.value)
            {
                found.push((name.clone(), value));
            }
        }
    }
    found
}

fn text(value: &FeatureValue) -> Option<String> {
    match value {
        FeatureValue::Integer(value) => Some(value.to_string()),
        FeatureValue::Float(value) => Some(value.to_string()),
        FeatureValue::Boolean(value) => Some(value.to_string()),
        FeatureValue::Enum(value) | FeatureValue::String(value) => Some(value.clone()),
        _ => None,
    }
}

/// Exposure and gain, where the camera has them and lets them be set.
pub fn controls(camera: &Camera<GigeRegisterIo>) -> Vec<Control> {
    let resolved = CONTROLS
        .iter()
        .filter_map(|&feature| camera.resolve(feature).ok());
    let states = resolved.filter_map(|feature| {
        let state = camera.feature_state(feature.name).ok()?;
        control(feature.name, &state)
    });
    states.collect()
}

fn control(name: &str, state: &FeatureState) -> Option<Control> {
    let value = match state.value {
        FeatureValue::Integer(value) => value as f64,
        FeatureValue::Float(value) => value,
        _ => return None,
    };
    let range = state.range.as_ref()?;
    (state.access == Some(AccessMode::RW)).then(|| Control {
        name: name.into(),
        value,
        min: range.min,
        max: range.max,
        unit: state.unit.clone(),
    })
}

/// Sets exposure or gain.
pub fn set(
    camera: &mut Camera<GigeRegisterIo>,
    name: &str,
    value: f64,
) -> Result<(), GenicamError> {
    let exposure = camera.resolve(StandardFeature::ExposureTime);
    if exposure.is_ok_and(|feature| feature.name == name) {
        camera.set_exposure_time(value)?;
    } else {
        camera.set_gain(value)?;
    }
    Ok(())
}
