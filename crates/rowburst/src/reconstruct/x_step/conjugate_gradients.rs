//! The x-step without blocks, for exposures longer than a row and for wide sensors (docs/design/004, 025).

use super::active_system::ActiveSystem;
use super::preconditioner::{MeanFieldPreconditioner, PlanePreconditioner};
use super::{Equation, Precision, System, XStep};
use rowburst_core::Support;
use rowburst_core::linop::Background;
use rowburst_solve::conjugate_gradient::{ConjugateGradient, Preconditioner, TOLERANCE};
use rowburst_solve::{DataHints, ProblemKind};
use std::sync::Arc;

/// Residual over `ρ‖y‖` of conjugate gradients where the solution itself is asked for.
const EXACT_TOLERANCE: f64 = 0.01;

/// Most calls of conjugate gradients for that.
const MAX_EXACT_CALLS: usize = 10;

/// The same of whole planes, to a residual of [`TOLERANCE`]; more cost time and gain nothing (docs/design/026).
const MAX_PLANE_CALLS: usize = 3;

/// Early x-steps of exposures longer than a row, see [`ConjugateGradient::early_calls`]; more cost quality, fewer time
/// (docs/design/025).
const EARLY_CALLS: usize = 40;

/// Preconditioned conjugate gradients, unless an exact step on the support takes less time.
pub struct ConjugateGradients {
    solver: ConjugateGradient,
    active: Option<ActiveSystem>,
}

impl ConjugateGradients {
    /// For a system on all voxels.
    pub fn new(system: &System, precision: Precision) -> Self {
        let mut solver = ConjugateGradient::new(preconditioner(system), system.measurement_len());
        if precision == Precision::Adaptive && !system.shutter().time().is_disjoint() {
            solver.early_calls = EARLY_CALLS;
        }
        Self {
            solver,
            active: None,
        }
    }
}

impl XStep for ConjugateGradients {
    fn solve(&mut self, system: &System, equation: Equation) -> bool {
        let Equation { r, rho, y, gram_y } = equation;
        if let Some(active) = &mut self.active {
            if active.solve(r, rho, y, gram_y) {
                return true;
            }
            self.active = None;
        }
        let operator = system.stacked_operator();
        self.solver.solve(operator, r, rho, TOLERANCE, y, gram_y)
    }

    fn solve_alone(&mut self, system: &System, equation: Equation) {
        let Equation { r, rho, y, gram_y } = equation;
        if let Some(active) = &mut self.active {
            active.reset();
            if active.solve(r, rho, y, gram_y) {
                return;
            }
        }
        self.solver.forget();
        self.solver.early_calls = 0;
        let operator = system.stacked_operator();
        let (tolerance, max_calls) = if system.shutter().convolves_planes() {
            (TOLERANCE, MAX_PLANE_CALLS)
        } else {
            (EXACT_TOLERANCE, MAX_EXACT_CALLS)
        };
        for _ in 0..max_calls {
            if self.solver.solve(operator, r, rho, tolerance, y, gram_y) {
                break;
            }
        }
    }

    fn restrict(&mut self, system: &System, _before: Option<&Support>) {
        if let Some(support) = system.support() {
            self.solver.restrict(support, preconditioner(system));
        }
        self.active = active_system(system);
    }

    fn rebuild(&mut self, system: &System) {
        self.solver
            .restart(system.support(), preconditioner(system));
        self.active = active_system(system);
    }

    fn reset(&mut self) -> bool {
        false
    }

    fn is_renewed_by_rebuild(&self, _background: Background) -> bool {
        true
    }

    fn hints(&self, system: &System) -> DataHints {
        let kind = if system.shutter().time().is_disjoint() {
            ProblemKind::Small
        } else {
            ProblemKind::Coupled
        };
        DataHints {
            kind,
            ..DataHints::default()
        }
    }

    #[cfg(test)]
    fn method(&self) -> super::Method {
        match self.active {
            Some(_) => super::Method::ActiveSystem,
            None => super::Method::ConjugateGradients,
        }
    }
}

/// The exact step on the support, where it takes less time than conjugate gradients.
fn active_system(system: &System) -> Option<ActiveSystem> {
    let is_stacked = !matches!(system.background(), Background::None | Background::Alone);
    if is_stacked {
        return None;
    }
    ActiveSystem::new(system.operator(), system.support()?)
}

/// The mean field along the rows, or of whole planes where the operator convolves these.
pub fn preconditioner(system: &System) -> Box<dyn Preconditioner> {
    let shutter = system.shutter();
    if shutter.convolves_planes() {
        return Box::new(PlanePreconditioner {
            shutter: Arc::clone(shutter),
            scale: system.scale(),
        });
    }
    Box::new(MeanFieldPreconditioner::new(
        system.model().mean_field(shutter),
        shutter,
        system.background(),
        system.support(),
        system.operator().weights(),
    ))
}
