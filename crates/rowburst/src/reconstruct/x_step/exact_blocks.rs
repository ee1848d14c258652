//! The exact x-step by the blocks of instants, where no bin is seen by two of them (docs/design/003).

use super::{Equation, System, XStep};
use rowburst_core::Support;
use rowburst_core::linop::Background;
use rowburst_solve::blocks::Blocks;
use rowburst_solve::{DataHints, ProblemKind};

/// Measurements of an instant above which a factor costs more than ten iterations (docs/design/008).
const LARGE_BLOCK: usize = 1024;

/// Smallest `ρ` for f32 blocks; smaller is faster, and rounding of the blocks enters the result (docs/design/003).
const MIN_RHO_SINGLE: f64 = 1e-5;

/// The precision of Gram blocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Precision {
    /// f32 as long as `ρ` is above the rounding of the blocks, then f64.
    Adaptive,
    /// f64 from the start.
    Double,
}

/// Cholesky factors of the blocks, which are all of `B Bᵀ` where no bin is seen by two instants.
pub struct ExactBlocks {
    blocks: AnyBlocks,
    precision: Precision,
}

enum AnyBlocks {
    Single(Blocks<f32>),
    Double(Blocks<f64>),
}

impl ExactBlocks {
    pub fn new(system: &System, precision: Precision) -> Self {
        let blocks = match precision {
            Precision::Adaptive => AnyBlocks::Single(system.blocks()),
            Precision::Double => AnyBlocks::Double(system.blocks()),
        };
        Self { blocks, precision }
    }

    /// A solver without blocks, to free the memory of another one before new blocks are built.
    pub fn empty() -> Self {
        Self {
            blocks: AnyBlocks::Double(Blocks::empty()),
            precision: Precision::Double,
        }
    }

    /// Whether the blocks have the precision of new ones.
    fn has_first_precision(&self) -> bool {
        match self.blocks {
            AnyBlocks::Single(_) => true,
            AnyBlocks::Double(_) => self.precision == Precision::Double,
        }
    }

    /// Replaces f32 blocks by f64 ones for the same system.
    fn make_double(&mut self, system: &System) -> &mut Blocks<f64> {
        if matches!(self.blocks, AnyBlocks::Single(_)) {
            // Frees the old blocks before it builds the new ones.
            self.blocks = AnyBlocks::Double(Blocks::empty());
            self.blocks = AnyBlocks::Double(system.blocks());
        }
        match &mut self.blocks {
            AnyBlocks::Double(blocks) => blocks,
            AnyBlocks::Single(_) => unreachable!("the blocks are f64 now"),
        }
    }
}

impl XStep for ExactBlocks {
    fn solve(&mut self, system: &System, equation: Equation) -> bool {
        let Equation { r, rho, y, gram_y } = equation;
        let min_rho_single = MIN_RHO_SINGLE * system.max_squared_weight() * system.scale();
        if let AnyBlocks::Single(blocks) = &mut self.blocks
            && rho >= min_rho_single
        {
            blocks.solve_incremental(r, rho, y, gram_y);
            if !blocks.is_ill_conditioned() {
                return true;
            }
        }
        let blocks = self.make_double(system);
        blocks.solve_with_product(r, rho, y, gram_y);
        !blocks.is_ill_conditioned()
    }

    fn solve_alone(&mut self, system: &System, equation: Equation) {
        let Equation { r, rho, y, gram_y } = equation;
        self.make_double(system)
            .solve_with_product(r, rho, y, gram_y);
    }

    fn restrict(&mut self, system: &System, before: Option<&Support>) {
        let has_changed = |instant| system.has_changed_at(instant, before);
        match &mut self.blocks {
            AnyBlocks::Single(blocks) => {
                blocks.reset();
                blocks.rebuild_changed(has_changed, system);
            }
            AnyBlocks::Double(blocks) => blocks.rebuild_changed(has_changed, system),
        }
    }

    fn rebuild(&mut self, system: &System) {
        match &mut self.blocks {
            AnyBlocks::Single(blocks) => {
                blocks.reset();
                blocks.rebuild_all(system);
            }
            AnyBlocks::Double(blocks) => blocks.rebuild_all(system),
        }
    }

    fn reset(&mut self) -> bool {
        if let AnyBlocks::Single(blocks) = &mut self.blocks {
            blocks.reset();
        }
        self.has_first_precision()
    }

    fn is_renewed_by_rebuild(&self, background: Background) -> bool {
        background != Background::Static && self.has_first_precision()
    }

    fn hints(&self, system: &System) -> DataHints {
        block_hints(system)
    }

    #[cfg(test)]
    fn method(&self) -> super::Method {
        match self.blocks {
            AnyBlocks::Single(_) => super::Method::SingleBlocks,
            AnyBlocks::Double(_) => super::Method::DoubleBlocks,
        }
    }
}

/// What solvers with blocks cost.
pub fn block_hints(system: &System) -> DataHints {
    let (_, columns) = system.shutter().frame_shape();
    let mut rows = system.shutter().rows_of_instants().iter();
    if !rows.any(|rows| rows.len() * columns > LARGE_BLOCK) {
        return DataHints::default();
    }
    DataHints {
        kind: ProblemKind::Wide,
        // Above this number the block of all voxels is cheaper than that of the active ones. A block on a support
        // costs `m²` products for each active voxel; the block of all voxels uses the shifts of the field and costs
        // `4 m²` for each row of the field.
        max_restricted_voxels: 4 * system.shape().rows,
    }
}
