//! Reference solvers for `min_{v≥0} ½‖b − A v‖² + τ R(v)`, to which the solver of the library is compared.
//!
//! They are slow and take no short cuts. Each reaches any accuracy that is asked for, and proves it by a
//! [`Certifier`].

pub mod certifier;
pub mod fista;
pub mod gpsr_bb;
pub mod objective;
pub mod primal_dual;
mod run;

pub use certifier::Certifier;
pub use objective::Objective;
pub use run::{CertifiedSolution, Limits};
