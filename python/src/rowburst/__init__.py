"""Rolling-shutter compressive imaging: one frame behind a diffuser in, a 100,000 fps video out.

Arrays are C order; a video is ``[t, y, x]``, a frame ``[y, x]``, and ``y`` is the axis that the
shutter scans. Errors are :class:`InputError` (a ``ValueError``) where something given breaks a rule,
and :class:`WorkError` (a ``RuntimeError``) where the work itself failed.
"""

from . import calibrate, capture, metrics
from ._batch import batch
from ._chunked import reconstruct_chunked
from ._colour import ColourResult, reconstruct_colour
from ._design import Design, design
from ._figure import Figure
from ._frames import read_frames, read_settings
from ._load import SavedColour, SavedResult, load
from ._operator import DataTerm, RollingShutterOperator, operator
from ._reconstruct import Report, Result, Trace, reconstruct
from ._reconstructor import Reconstructor
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
    set_threads,
    simulate,
    speckle_psf,
    threads,
)
from ._sweep import Sweep, sweep
from ._view import View

__all__ = [
    "Camera",
    "ColourResult",
    "DataTerm",
    "Design",
    "Experiment",
    "Figure",
    "InputError",
    "LiveView",
    "Look",
    "Progress",
    "Psf",
    "Reconstructor",
    "Report",
    "Result",
    "RollingShutterOperator",
    "SavedColour",
    "SavedResult",
    "Simulation",
    "Sweep",
    "Trace",
    "View",
    "WorkError",
    "__version__",
    "batch",
    "calibrate",
    "capture",
    "design",
    "load",
    "metrics",
    "operator",
    "read_frames",
    "read_settings",
    "reconstruct",
    "reconstruct_chunked",
    "reconstruct_colour",
    "set_threads",
    "simulate",
    "speckle_psf",
    "sweep",
    "threads",
]
