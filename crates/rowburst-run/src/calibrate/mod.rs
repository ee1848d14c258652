//! Calibrations as the command line and Python meet them: numbers, report and folder of each.

pub mod psf;
pub mod sensor;
pub mod timing;

/// The verdict of a calibration and its reason: `good` where there is no warning.
pub(crate) fn verdict(warnings: &[String], good: &str) -> Option<(&'static str, String)> {
    let reason = match warnings.len() {
        0 => return Some(("good", good.to_string())),
        1 => "there is a warning, below".to_string(),
        n => format!("there are {n} warnings, below"),
    };
    Some(("doubtful", reason))
}

#[cfg(test)]
mod tests {
    use super::verdict;

    #[test]
    fn a_calibration_is_good_without_warnings_only() {
        let one = vec!["the flats are saturated".to_string()];
        assert_eq!(verdict(&[], "it holds"), Some(("good", "it holds".into())));
        assert_eq!(verdict(&one, "it holds").unwrap().0, "doubtful");
    }
}
