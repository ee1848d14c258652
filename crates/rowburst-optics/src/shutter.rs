//! The order in which a sensor reads its rows.

use rowburst_core::{Error, Parameter, Result};

/// Readout order: row `r` is read out at the end of instant `k[r]`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Shutter {
    /// `k = r`.
    TopDown,
    /// `k = rows − 1 − r`.
    BottomUp,
    /// The two halves start at the middle and move outward (Andor Zyla, the paper).
    DualInsideOut,
    /// The two halves start at the top and bottom edges and meet in the middle.
    DualOutsideIn,
    /// `k` of each row, given.
    Custom(Vec<usize>),
    /// Every row sees one single bin.
    Global,
}

impl Shutter {
    /// Names of the shutters, as the experiment file spells them.
    pub const NAMES: [&'static str; 6] = [
        "top-down",
        "bottom-up",
        "dual-inside-out",
        "dual-outside-in",
        "custom",
        "global",
    ];

    /// The shutter of a name in the experiment file; `None` for `custom`, which has an order of
    /// rows besides, and for names that are none.
    pub fn from_name(name: &str) -> Option<Self> {
        Some(match name {
            "top-down" => Self::TopDown,
            "bottom-up" => Self::BottomUp,
            "dual-inside-out" => Self::DualInsideOut,
            "dual-outside-in" => Self::DualOutsideIn,
            "global" => Self::Global,
            _ => return None,
        })
    }

    /// The name in the experiment file.
    pub fn name(&self) -> &'static str {
        match self {
            Self::TopDown => "top-down",
            Self::BottomUp => "bottom-up",
            Self::DualInsideOut => "dual-inside-out",
            Self::DualOutsideIn => "dual-outside-in",
            Self::Custom(_) => "custom",
            Self::Global => "global",
        }
    }

    /// Whether two halves of the sensor are read at the same time.
    pub fn is_dual(&self) -> bool {
        matches!(self, Self::DualInsideOut | Self::DualOutsideIn)
    }

    /// The instant `k[r]` of every row.
    ///
    /// # Errors
    /// A custom order whose length is not `rows`, or that leaves an instant
    /// before its last one without a row.
    pub fn instants(&self, rows: usize) -> Result<Vec<usize>> {
        let half = rows / 2;
        Ok(match self {
            Self::TopDown => (0..rows).collect(),
            Self::BottomUp => (0..rows).rev().collect(),
            Self::DualInsideOut => (0..rows)
                .map(|r| if r < half { half - 1 - r } else { r - half })
                .collect(),
            Self::DualOutsideIn => (0..rows).map(|r| r.min(rows - 1 - r)).collect(),
            Self::Global => vec![0; rows],
            Self::Custom(order) => {
                check_order(order, rows)?;
                order.clone()
            }
        })
    }
}

fn check_order(order: &[usize], rows: usize) -> Result<()> {
    let remedy = "Give one integer per row: 0 for the rows read first, 1 for the next, and so on.";
    if order.len() != rows {
        return Err(Error::input(
            Parameter::RowOrder,
            format!("{} integers", order.len()),
            format!("a sensor of {rows} rows needs {rows}"),
            remedy,
        ));
    }
    let instants = order.iter().max().map_or(0, |last| last + 1);
    if instants > rows {
        return Err(Error::input(
            Parameter::RowOrder,
            format!("instant {}", instants - 1),
            format!("{rows} rows are read in at most {rows} instants, counted from 0"),
            remedy,
        ));
    }
    let mut read = vec![false; instants];
    for &k in order {
        read[k] = true;
    }
    match read.iter().position(|&r| !r) {
        None => Ok(()),
        Some(k) => Err(Error::input(
            Parameter::RowOrder,
            format!("no row read at instant {k}"),
            "every instant up to the last reads at least one row",
            remedy,
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn orders_for_even_and_odd_rows() {
        let order = |s: Shutter, rows| s.instants(rows).unwrap();
        assert_eq!(order(Shutter::TopDown, 4), [0, 1, 2, 3]);
        assert_eq!(order(Shutter::BottomUp, 4), [3, 2, 1, 0]);
        assert_eq!(order(Shutter::DualInsideOut, 4), [1, 0, 0, 1]);
        assert_eq!(order(Shutter::DualInsideOut, 5), [1, 0, 0, 1, 2]);
        assert_eq!(order(Shutter::DualOutsideIn, 4), [0, 1, 1, 0]);
        assert_eq!(order(Shutter::DualOutsideIn, 5), [0, 1, 2, 1, 0]);
        assert_eq!(order(Shutter::Global, 3), [0, 0, 0]);
    }

    #[test]
    fn custom_orders_are_checked() {
        let bad = |order: &[usize]| Shutter::Custom(order.to_vec()).instants(3).is_err();
        assert!(bad(&[0, 1]));
        assert!(bad(&[0, 2, 2]));
        assert!(bad(&[0, 1, 3]));
        assert!(!bad(&[1, 0, 1]));
    }
}
