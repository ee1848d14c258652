"""Rolling-shutter compressive imaging: one frame behind a diffuser in, a 100,000 fps video out.

Arrays are C order; a video is ``[t, y, x]``, a frame ``[y, x]``, and ``y`` is the axis that the
shutter scans. Errors are :class:`InputError` (a ``ValueError``) where something given breaks a rule,
and :class:`WorkError` (a ``RuntimeError``) where the work itself failed.
"""

from ._operator import DataTerm, RollingShutterOperator, operator
from ._reconstruct import Report, Result, Trace, reconstruct
from ._rowburst import (
    Camera,
    Experiment,
    InputError,
    LiveView,
    Look,
    Progress,
    Psf,
    Simulation,
    WorkError,
    __version__,
    read_frames,
    set_threads,
    simulate,
    speckle_psf,
    threads,
)

__all__ = [
    "Camera",
    "DataTerm",
    "Experiment",
    "InputError",
    "LiveView",
    "Look",
    "Progress",
    "Psf",
    "Report",
    "Result",
    "RollingShutterOperator",
    "Simulation",
    "Trace",
    "WorkError",
    "__version__",
    "operator",
    "read_frames",
    "reconstruct",
    "set_threads",
    "simulate",
    "speckle_psf",
    "threads",
]
