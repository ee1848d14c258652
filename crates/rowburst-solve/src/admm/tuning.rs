//! The constants of the solver.

use crate::ProblemKind;
use std::num::NonZeroUsize;

/// Why [`Tuning::set`] refuses a value.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TuningError {
    /// No field has this name.
    #[error("no tuning constant has the name {0}")]
    UnknownName(String),
    /// The value is not finite, not above zero, or not whole where the field is a count. Some counts may be zero.
    #[error("{name} = {value}: a tuning constant is finite and above zero, and a count is whole")]
    NotAllowed {
        /// The name of the field.
        name: String,
        /// The value.
        value: f64,
    },
    /// The value contradicts another constant or the meaning of its own, so that a run would make no sense.
    #[error("{name} = {value}: {rule}")]
    Contradicts {
        /// The name of the field.
        name: String,
        /// The value.
        value: f64,
        /// What must hold.
        rule: &'static str,
    },
}

impl TuningError {
    /// The name of the constant at fault.
    pub fn name(&self) -> &str {
        match self {
            Self::UnknownName(name)
            | Self::NotAllowed { name, .. }
            | Self::Contradicts { name, .. } => name,
        }
    }
}

/// A field of [`Tuning`].
trait Field {
    fn get(&self) -> f64;

    /// Returns whether the field admits the value.
    fn set(&mut self, value: f64) -> bool;
}

impl Field for f64 {
    fn get(&self) -> f64 {
        *self
    }

    fn set(&mut self, value: f64) -> bool {
        let is_allowed = value.is_finite() && value > 0.0;
        if is_allowed {
            *self = value;
        }
        is_allowed
    }
}

impl Field for usize {
    fn get(&self) -> f64 {
        *self as f64
    }

    fn set(&mut self, value: f64) -> bool {
        let is_allowed = (1.0..=1e9).contains(&value) && value.fract() == 0.0;
        if is_allowed {
            *self = value as usize;
        }
        is_allowed
    }
}

/// A count that may be zero, as `None`.
impl Field for Option<NonZeroUsize> {
    fn get(&self) -> f64 {
        self.map_or(0.0, |count| count.get() as f64)
    }

    fn set(&mut self, value: f64) -> bool {
        let is_allowed = (0.0..=1e9).contains(&value) && value.fract() == 0.0;
        if is_allowed {
            *self = NonZeroUsize::new(value as usize);
        }
        is_allowed
    }
}

/// Defines a struct of constants, and the table of its fields by name.
macro_rules! constants {
    (
        $(#[$head:meta])*
        $struct:ident { $($(#[$line:meta])* $field:ident: $type:ty,)* }
        groups { $($(#[$group_line:meta])* $group:ident: $group_type:ty,)* }
    ) => {
        $(#[$head])*
        #[derive(Debug, Clone, Copy, PartialEq)]
        #[non_exhaustive]
        pub struct $struct {
            $($(#[$line])* pub $field: $type,)*
            $($(#[$group_line])* pub $group: $group_type,)*
        }

        impl $struct {
            /// The names of all constants, with their places.
            fn fields(&mut self) -> Vec<(String, &mut dyn Field)> {
                #[allow(unused_mut, reason = "a struct without groups adds none")]
                let mut fields: Vec<(String, &mut dyn Field)> =
                    vec![$((stringify!($field).to_string(), &mut self.$field)),*];
                $(for (name, field) in self.$group.fields() {
                    fields.push((format!("{}.{name}", stringify!($group)), field));
                })*
                fields
            }
        }
    };
}

constants! {
    /// The constants that depend on the kind of the problem, see [`ProblemKind`].
    KindTuning {
        /// Over-relaxation `α`, from 1 to below 2; larger is faster for some scenes and slower for LEDs
        /// (docs/design/006, 008).
        relaxation: f64,
        /// `ρ` at first, over a typical diagonal element of `A Aᵀ`; far from its end it costs more factors
        /// (docs/design/006, 008).
        initial_rho: f64,
        /// Smallest `ρ` on a support over `ρ` before the first restriction; smaller lets the dual grow without end,
        /// larger fits the noise less (docs/design/007).
        min_rho_ratio: f64,
        /// Corrections of `ρ` from here to `deadband_upper` are skipped; smaller saves factors, and `τ` is less exact
        /// (docs/design/006, 008).
        deadband_lower: f64,
        /// See `deadband_lower`; larger saves factors.
        deadband_upper: f64,
        /// `deadband_lower` up to the first restriction, and while `unrestricted_rho_interval` applies; smaller saves
        /// factors, and `ρ` settles later (docs/design/006, 008).
        early_deadband_lower: f64,
        /// See `early_deadband_lower`; larger saves factors.
        early_deadband_upper: f64,
        /// Iterations between corrections of `ρ` while a support is used and some bin is unrestricted; larger saves
        /// factors, and `ρ` settles later. `None`, by name 0: such a bin makes no difference (docs/design/008).
        unrestricted_rho_interval: Option<NonZeroUsize>,
        /// Step at which the warm-up ends; the first restriction is at the next multiple of `support_interval`. Smaller
        /// may lose shapes that the video does not show yet, larger takes longer (docs/design/006, 007).
        first_restriction: usize,
        /// Step from which `β` is constant and the run may stop; larger delays the first certificate (docs/design/006).
        settled_from: usize,
        /// Step to which a warm start goes back, plus less than a `support_interval` that keeps the rhythm of the updates;
        /// smaller repeats more of the warm-up (docs/design/014).
        warm_start_step: usize,
        /// Step at which `β` reaches its end; later is faster for large shapes but less robust
        /// (docs/design/006).
        continuation_end: usize,
        /// Factor on a bin's threshold at each widening; smaller makes bins unrestricted in fewer steps
        /// (docs/design/007).
        widening_factor: f64,
        /// Widenings after which a bin is unrestricted; larger keeps underfit bins restricted for longer. `None`, by name
        /// 0: no number of them (docs/design/007, 025).
        unrestricted_level: Option<NonZeroUsize>,
        /// Most widenings of a bin; larger widens bins in vain that no support explains, and the run does not settle.
        /// `None`, by name 0: no limit (docs/design/033).
        max_widenings: Option<NonZeroUsize>,
        /// Brightness over that of the video above which a voxel of a widened bin stays active; smaller gives added voxels
        /// more time to show light. From 1 on it makes no difference (docs/design/025).
        kept_threshold: f64,
        /// Part of a bin's light that the first restriction may cut off; the threshold of a bin that would lose more is
        /// lowered up to the next update. Larger loses light that is still spread, smaller keeps haze. From 1 on it makes
        /// no difference (docs/design/007).
        max_cut_light: f64,
        /// Step from which [`Tuning::max_brightness_ratio`] holds for `β`; the support begins later, and has it always.
        /// Smaller takes bins for dim that have not gathered their light (docs/design/007).
        brightness_capped_from: usize,
        /// Smallest factor on a bin's threshold of the support, which is lowered by the bin's brightness over that of the
        /// video. Smaller keeps haze in dark bins, larger drops faint light beside bright bins; from 1 on nothing is
        /// lowered (docs/design/007).
        min_bin_brightness: f64,
        /// Largest factor on `β` of an extended scene, see [`Tuning::extended`]; larger blurs faint parts. At 1 it makes no
        /// difference (docs/design/034).
        max_extended_factor: f64,
        /// Iteration at which an extended scene is restricted at the latest; smaller restricts haze, larger takes more
        /// iterations. Up to `first_restriction` it makes no difference (docs/design/034).
        latest_extended_restriction: usize,
    }
    groups {}
}

constants! {
    /// The constants of the solver. **Unstable**: names, meanings and values change between versions.
    ///
    /// [`Tuning::STANDARD`] has the values with which all documented results were made. Constants have no unit unless
    /// it is given. A step is an iteration that brings the run forward: all but those that a wait repeats.
    ///
    /// ```
    /// use rowburst_solve::admm::Tuning;
    /// let mut tuning = Tuning::STANDARD;
    /// tuning.support_threshold = 0.1;
    /// tuning.set("wide.initial_rho", 0.002).unwrap();
    /// assert!(tuning.set("support_treshold", 0.1).is_err());
    /// ```
    Tuning {
        /// `β` at its end over the brightness, for a prior whose terms act on single voxels; larger needs fewer
        /// iterations and is less exact at the end (docs/design/005).
        threshold: f64,
        /// [`Certificate::excess`](crate::Certificate::excess) at which a run stops; smaller takes more iterations for
        /// little gain (docs/design/009).
        tolerance: f64,
        /// Voxels per pixel of the frame above which the first restriction waits for a decline; smaller makes more
        /// runs wait (docs/design/008).
        undersampled: usize,
        /// Relative fall of a bin's brightness that ends the wait; smaller ends it too early (docs/design/008).
        decline: f64,
        /// Iterations over which that fall is measured, and after which any wait is reconsidered; larger waits longer
        /// (docs/design/008).
        decline_window: usize,
        /// Iteration at which the wait for a decline ends at the latest; smaller may cut off light that still rises
        /// (docs/design/008).
        latest_first_restriction: usize,
        /// Participation of the video over the number of measurements above which the scene is extended; smaller gives more
        /// scenes a larger `β`, which points do not bear (docs/design/034).
        extended: f64,
        /// Step from which on a scene may be extended; smaller takes the haze of the first steps for a scene
        /// (docs/design/034).
        extended_from: usize,
        /// `β` at first over its end; larger finds shapes faster and may lose faint points (docs/design/006).
        continuation_factor: f64,
        /// Steps between updates of `β`; larger follows the brightness less closely (docs/design/006).
        threshold_interval: usize,
        /// Brightness of the scene over that of the first x-step, which spreads sparse light; larger gives a larger
        /// first `β` (docs/design/006).
        initial_brightness_ratio: f64,
        /// Steps between counts of the degrees of freedom; larger lets the bound lag (docs/design/005).
        freedom_interval: usize,
        /// Largest part of the measurements that the degrees of freedom may take; larger lets a fit follow the noise
        /// (docs/design/005).
        max_freedom: f64,
        /// Differences below this part of the brightness count as zero in the degrees of freedom; larger counts fewer
        /// (docs/design/005).
        flat_difference: f64,
        /// Largest factor of one correction of `ρ`, up or down; larger overshoots (docs/design/005).
        max_rho_step: f64,
        /// Smallest `ρ` over a typical diagonal element of `A Aᵀ`; larger bounds `τ` from below (docs/design/005).
        min_relative_rho: f64,
        /// Largest `ρ` over a typical diagonal element of `A Aᵀ`; smaller bounds `τ` from above (docs/design/005).
        max_relative_rho: f64,
        /// Steps between updates of the support; smaller rebuilds more Gram blocks (docs/design/007).
        support_interval: usize,
        /// Threshold of the support over the brightness; larger drops faint light, smaller keeps haze
        /// (docs/design/007).
        support_threshold: f64,
        /// Part of `Σ v²` that the dim bins hold, whose brightness limits that of the video; larger takes more bins for dim,
        /// smaller takes haze for a bin (docs/design/007).
        dim_part: f64,
        /// Brightness of the video over that of the brightest dim bin, at most; larger loses dim bins beside a flash, smaller
        /// keeps haze (docs/design/007).
        max_brightness_ratio: f64,
        /// Residual of a bin over the expected one above which it may be underfit; smaller reacts to noise
        /// (docs/design/007).
        underfit_ratio: f64,
        /// Residual over that of the last update above which it has stalled; smaller widens bins sooner
        /// (docs/design/007).
        stall_ratio: f64,
        /// Active voxels over those of the last update above which the support is stable; larger delays the first
        /// certificate (docs/design/007).
        stable_ratio: f64,
        /// Steps between updates of the noise weights; smaller costs more rebuilt blocks (docs/design/010).
        weight_interval: usize,
        /// Step after which `late_weight_interval` holds; larger costs more rebuilt blocks
        /// (docs/design/010).
        frequent_weights_until: usize,
        /// Steps between late updates of the noise weights; smaller costs more rebuilt blocks (docs/design/010).
        late_weight_interval: usize,
        /// Steps after which the running product `A q` is computed afresh; larger lets rounding add up
        /// (docs/design/003).
        refresh_interval: usize,
        /// Iterations between certificates, and between objectives; smaller stops earlier, but each certificate costs a
        /// product with `Aᵀ` and a few passes (docs/design/009).
        check_interval: usize,
        /// Brightest voxel that the certificate admits over the brightest found; larger loosens the bound
        /// (docs/design/009).
        brightness_bound: f64,
    }
    groups {
        /// The constants of small problems, `small.…` by name.
        small: KindTuning,
        /// The constants of wide problems, `wide.…` by name.
        wide: KindTuning,
        /// The constants of problems whose rows share bins, `coupled.…` by name.
        coupled: KindTuning,
    }
}

/// The standard values of small problems, which the other kinds share but for some.
const SMALL: KindTuning = KindTuning {
    relaxation: 1.7,
    initial_rho: 0.01,
    min_rho_ratio: 0.3,
    deadband_lower: 0.98,
    deadband_upper: 1.02,
    early_deadband_lower: 0.8,
    early_deadband_upper: 1.25,
    unrestricted_rho_interval: None,
    first_restriction: 20,
    settled_from: 40,
    warm_start_step: 26,
    continuation_end: 20,
    widening_factor: 0.125,
    unrestricted_level: NonZeroUsize::new(5),
    max_widenings: None,
    kept_threshold: 1.0,
    max_cut_light: 0.2,
    brightness_capped_from: 20,
    min_bin_brightness: 1.0,
    max_extended_factor: 1.0,
    latest_extended_restriction: 1,
};

impl Default for Tuning {
    fn default() -> Self {
        Self::STANDARD
    }
}

impl Tuning {
    /// The standard values.
    pub const STANDARD: Self = Self {
        threshold: 0.015,
        tolerance: 1e-3,
        undersampled: 300,
        decline: 0.0001,
        decline_window: 5,
        latest_first_restriction: 150,
        extended: 0.35,
        extended_from: 20,
        continuation_factor: 4.0,
        threshold_interval: 5,
        initial_brightness_ratio: 10.0,
        freedom_interval: 10,
        max_freedom: 0.3,
        flat_difference: 0.01,
        max_rho_step: 2.0,
        min_relative_rho: 1e-7,
        max_relative_rho: 1e7,
        support_interval: 10,
        support_threshold: 0.12,
        dim_part: 0.1,
        max_brightness_ratio: 2.0,
        underfit_ratio: 1.3,
        stall_ratio: 0.85,
        stable_ratio: 0.9,
        weight_interval: 20,
        frequent_weights_until: 100,
        late_weight_interval: 100,
        refresh_interval: 50,
        check_interval: 5,
        brightness_bound: 2.0,
        small: SMALL,
        wide: KindTuning {
            relaxation: 1.9,
            initial_rho: 0.0015,
            min_rho_ratio: 0.1,
            deadband_lower: 0.95,
            deadband_upper: 1.05,
            early_deadband_lower: 0.6,
            early_deadband_upper: 1.6,
            unrestricted_rho_interval: NonZeroUsize::new(5),
            ..SMALL
        },
        coupled: KindTuning {
            first_restriction: 40,
            settled_from: 60,
            warm_start_step: 46,
            continuation_end: 40,
            widening_factor: 0.5,
            unrestricted_level: None,
            max_widenings: NonZeroUsize::new(4),
            kept_threshold: 0.005,
            max_cut_light: 1.0,
            brightness_capped_from: 1,
            min_bin_brightness: 0.1,
            max_extended_factor: 3.0,
            latest_extended_restriction: 60,
            ..SMALL
        },
    };

    /// The values for problems of `kind`.
    pub fn for_kind(&self, kind: ProblemKind) -> &KindTuning {
        match kind {
            ProblemKind::Small => &self.small,
            ProblemKind::Wide => &self.wide,
            ProblemKind::Coupled => &self.coupled,
        }
    }

    /// Sets the constant `name`: a field of [`Tuning`], or a field of [`KindTuning`] after `small.`, `wide.` or `coupled.`.
    ///
    /// # Errors
    /// An unknown name, a value that is not finite, not above zero, or not whole where the field is a count, or one that
    /// contradicts another constant. Nothing is changed then.
    pub fn set(&mut self, name: &str, value: f64) -> Result<(), TuningError> {
        self.set_all([(name, value)])
    }

    /// Sets several constants by name. The rules between constants are checked once all are set, so the order of
    /// `values` does not matter.
    ///
    /// # Errors
    /// As [`Self::set`]. Nothing is changed then.
    pub fn set_all<'a>(
        &mut self,
        values: impl IntoIterator<Item = (&'a str, f64)>,
    ) -> Result<(), TuningError> {
        let values: Vec<(&str, f64)> = values.into_iter().collect();
        let mut changed = *self;
        for (name, value) in &values {
            changed.set_unchecked(name, *value)?;
        }
        if let Some(rule) = changed.broken_rule() {
            let concerned = values.iter().find(|(name, _)| is_about(rule, name));
            if let Some((name, value)) = concerned.or(values.last()) {
                return Err(TuningError::Contradicts {
                    name: (*name).to_string(),
                    value: *value,
                    rule,
                });
            }
        }
        *self = changed;
        Ok(())
    }

    /// Checks the values of all fields and the rules between them, since fields can also be set without [`Self::set`].
    ///
    /// # Errors
    /// A value that [`Self::set`] refuses.
    pub fn check(mut self) -> Result<(), TuningError> {
        for (name, field) in self.fields() {
            let value = field.get();
            if !field.set(value) {
                return Err(TuningError::NotAllowed { name, value });
            }
        }
        let Some(rule) = self.broken_rule() else {
            return Ok(());
        };
        let mut changes = self.changes().into_iter();
        let concerned = changes.find(|(name, _)| is_about(rule, name));
        let (name, value) = concerned.expect("the standard values obey every rule");
        Err(TuningError::Contradicts { name, value, rule })
    }

    /// Sets the constant `name`, whatever the others are.
    fn set_unchecked(&mut self, name: &str, value: f64) -> Result<(), TuningError> {
        let mut fields = self.fields();
        let Some((_, field)) = fields.iter_mut().find(|(field, _)| field == name) else {
            return Err(TuningError::UnknownName(name.to_string()));
        };
        if !field.set(value) {
            return Err(TuningError::NotAllowed {
                name: name.to_string(),
                value,
            });
        }
        Ok(())
    }

    /// The first rule between the constants that does not hold.
    fn broken_rule(&self) -> Option<&'static str> {
        let kinds = [&self.small, &self.wide, &self.coupled];
        let has_valid_deadbands = |tuning: &KindTuning| {
            tuning.deadband_lower <= 1.0
                && tuning.deadband_upper >= 1.0
                && tuning.early_deadband_lower <= 1.0
                && tuning.early_deadband_upper >= 1.0
        };
        let rules = [
            (
                kinds
                    .iter()
                    .all(|tuning| (1.0..2.0).contains(&tuning.relaxation)),
                "relaxation is at least 1 and below 2",
            ),
            (self.max_rho_step >= 1.0, "max_rho_step is at least 1"),
            (
                self.min_relative_rho <= self.max_relative_rho,
                "min_relative_rho is at most max_relative_rho",
            ),
            (self.max_freedom < 1.0, "max_freedom is below 1"),
            (self.decline < 1.0, "decline is below 1"),
            (
                kinds.iter().all(|tuning| tuning.max_extended_factor >= 1.0),
                "max_extended_factor is at least 1",
            ),
            (
                kinds.iter().all(|tuning| tuning.widening_factor <= 1.0),
                "widening_factor is at most 1",
            ),
            (
                self.support_threshold <= 1.0,
                "support_threshold is at most 1",
            ),
            (self.dim_part < 1.0, "dim_part is below 1"),
            (
                self.max_brightness_ratio >= 1.0,
                "max_brightness_ratio is at least 1",
            ),
            (
                self.brightness_bound >= 1.0,
                "brightness_bound is at least 1",
            ),
            (
                kinds.iter().all(|tuning| tuning.min_rho_ratio <= 1.0),
                "min_rho_ratio is at most 1",
            ),
            (
                kinds.into_iter().all(has_valid_deadbands),
                "a deadband holds 1: deadband_lower and early_deadband_lower are at most 1, deadband_upper and \
                 early_deadband_upper at least 1",
            ),
        ];
        rules
            .into_iter()
            .find(|(holds, _)| !holds)
            .map(|(_, rule)| rule)
    }

    /// The names and values of all constants that differ from [`Self::STANDARD`].
    pub fn changes(self) -> Vec<(String, f64)> {
        let pairs = self.values().into_iter().zip(Self::STANDARD.values());
        let changed = pairs.filter(|(value, standard)| value != standard);
        changed.map(|(value, _)| value).collect()
    }

    /// The names and values of all constants.
    pub fn values(mut self) -> Vec<(String, f64)> {
        let fields = self.fields().into_iter();
        fields.map(|(name, field)| (name, field.get())).collect()
    }
}

/// Whether `rule` mentions the constant `name`, without its group.
fn is_about(rule: &str, name: &str) -> bool {
    let field = name.rsplit('.').next();
    rule.split([' ', ',']).any(|word| Some(word) == field)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_constant_has_a_name_and_can_be_set() {
        let names: Vec<String> = Tuning::STANDARD.values().into_iter().map(|v| v.0).collect();
        // All fields are numbers of 8 bytes, so the table is complete.
        assert_eq!(8 * names.len(), size_of::<Tuning>());
        for (i, name) in names.iter().enumerate() {
            let mut tuning = Tuning::STANDARD;
            // A value that every rule admits.
            let standard = Tuning::STANDARD.values()[i].1;
            let new = if standard.fract() == 0.0 {
                standard + 1.0
            } else {
                0.999 * standard
            };
            let new = if name.ends_with("deadband_upper") {
                standard + 1.0
            } else {
                new
            };
            tuning.set(name, new).unwrap();
            assert_eq!(tuning.changes(), [(name.clone(), new)]);
            for (j, (other, value)) in tuning.values().into_iter().enumerate() {
                let standard = Tuning::STANDARD.values()[j].1;
                assert_eq!(value, if i == j { new } else { standard }, "{name} {other}");
            }
        }
    }

    #[test]
    fn bad_values_and_names_are_refused() {
        let mut tuning = Tuning::STANDARD;
        for (name, value) in [
            ("support_threshold", 0.0),
            ("support_threshold", f64::NAN),
            ("decline", f64::INFINITY),
            ("check_interval", 0.0),
            ("check_interval", 2.5),
            ("check_interval", -1.0),
            ("small", 1.0),
            ("small.rho", 1.0),
            ("small.relaxation", 2.0),
            ("wide.unrestricted_level", 0.5),
            ("max_rho_step", 0.5),
            ("min_relative_rho", 1e8),
            ("max_relative_rho", 1e-8),
            ("max_freedom", 1.0),
            ("decline", 1.0),
            ("coupled.max_extended_factor", 0.5),
            ("small.widening_factor", 2.0),
            ("support_threshold", 1.5),
            ("dim_part", 1.0),
            ("max_brightness_ratio", 0.5),
            ("brightness_bound", 0.5),
            ("small.min_rho_ratio", 2.0),
            ("wide.deadband_lower", 1.1),
            ("small.early_deadband_upper", 0.9),
        ] {
            let error = tuning.set(name, value).unwrap_err();
            assert_eq!(error.name(), name, "{value}");
        }
        assert_eq!(tuning, Tuning::STANDARD);
    }

    #[test]
    fn rules_hold_once_all_values_are_set() {
        let mut tuning = Tuning::STANDARD;
        let values = [("max_relative_rho", 1e-8), ("min_relative_rho", 1e-9)];
        tuning.set_all(values).unwrap();
        assert_eq!(tuning.max_relative_rho, 1e-8);
        let values = [("decline", 0.1), ("min_relative_rho", 1e-7)];
        let error = tuning.set_all(values).unwrap_err();
        assert_eq!(error.name(), "min_relative_rho");
        // Nothing was changed.
        assert_eq!(tuning.decline, Tuning::STANDARD.decline);
    }

    #[test]
    fn fields_that_were_set_otherwise_are_checked() {
        assert_eq!(Tuning::STANDARD.check(), Ok(()));
        let mut tuning = Tuning::STANDARD;
        tuning.support_interval = 0;
        assert_eq!(tuning.check().unwrap_err().name(), "support_interval");
        let mut tuning = Tuning::STANDARD;
        tuning.wide.deadband_lower = 1.5;
        assert_eq!(tuning.check().unwrap_err().name(), "wide.deadband_lower");
    }
}
