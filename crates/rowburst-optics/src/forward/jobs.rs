//! Products of one instant, which an engine computes in batches.

/// Forward product of one instant: `values[i, x]` becomes sensor row `rows[i]` of the convolved `light` `[y, x]`.
pub(super) struct ForwardJob<'a, T> {
    pub light: &'a [T],
    pub rows: &'a [usize],
    pub values: &'a mut [T],
}

/// Adjoint product of one instant: from `values[i, x]` in sensor row `rows[i]` to the light of the field.
///
/// Field rows that are zero in `mask` need not be computed.
pub(super) struct AdjointJob<'a, T> {
    pub values: &'a [T],
    pub rows: &'a [usize],
    pub mask: Option<&'a [u8]>,
}
