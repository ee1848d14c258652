"""How close a video is to the truth: the numbers of ``result.json`` and of the report."""

from __future__ import annotations

from os import PathLike

from numpy.typing import ArrayLike

from . import _rowburst

__all__ = ["psnr", "ssim"]


def psnr(video: ArrayLike | PathLike[str], truth: ArrayLike | PathLike[str]) -> float:
    """Peak signal-to-noise ratio in decibels, with the maximum of the truth as the peak.

    Parameters
    ----------
    video, truth : array or path
        Videos ``[t, y, x]`` of one shape and one unit.

    Returns
    -------
    float
        Decibels; infinite for equal videos.

    Raises
    ------
    InputError
        The shapes differ.

    Examples
    --------
    >>> truth = np.ones((2, 4, 5))
    >>> round(rb.metrics.psnr(truth + 0.1, truth), 2)
    20.0
    """
    return _rowburst._psnr_db(video, truth)


def ssim(video: ArrayLike | PathLike[str], truth: ArrayLike | PathLike[str]) -> float:
    """Structural similarity (Wang et al. 2004), the mean over bins, with a Gaussian window of 1.5 pixels.

    Parameters
    ----------
    video, truth : array or path
        Videos ``[t, y, x]`` of one shape and one unit; the range is the maximum of the truth.

    Returns
    -------
    float
        At most 1, which equal videos have.

    Raises
    ------
    InputError
        The shapes differ.

    Examples
    --------
    >>> rb.metrics.ssim(np.ones((2, 4, 5)), np.ones((2, 4, 5)))
    1.0
    """
    return _rowburst._ssim(video, truth)
