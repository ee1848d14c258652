"""The forward operator and the data term, for SciPy, PyLops, PyProximal and SCICO."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray
from scipy.sparse.linalg import LinearOperator

from . import _rowburst
from ._checks import check_camera, check_positive, checked_array, checked_psf
from ._extras import need
from ._lazy import Lazy
from ._rowburst import Camera, Psf

if TYPE_CHECKING:
    from ._torch import TorchOperator


def _like(array: NDArray[Any]) -> np.dtype[Any]:
    """float32 for float32 of any byte order, and float64 for the rest."""
    return np.dtype(np.float32 if array.dtype.newbyteorder("=") == np.float32 else np.float64)


class RollingShutterOperator(LinearOperator):
    """``A``: from the flattened video ``[t, y, x]`` to the flattened frame ``[y, x]``.

    Vectors of float32 are computed in float32 and give float32; all others, in float64.
    """

    def __init__(
        self, camera: Camera, psf: Psf | ArrayLike | PathLike[str] | None, dtype: DTypeLike = np.float64
    ) -> None:
        check_camera(camera, takes_experiment=False)
        self.camera = camera
        self._psf: Psf | ArrayLike | PathLike[str] | None = checked_psf(psf)
        self._lazy: Lazy[_rowburst._Operator] = Lazy()
        native = self._native
        self._psf = native.psf
        super().__init__(np.dtype(dtype), native.shape)  # type: ignore[call-arg]

    @property
    def _native(self) -> _rowburst._Operator:
        # A copy computes at its first call: an error while it is unpickled would end a worker of a multiprocessing.Pool,
        # and the pool would wait for ever.
        return self._lazy.get(lambda: _rowburst._Operator(self.camera, self._psf))

    def __getstate__(self) -> dict[str, Any]:
        # What SciPy keeps besides, from 1.18 on a module, cannot all be pickled.
        return {"camera": self.camera, "_psf": self._psf, "dtype": self.dtype, "shape": self.shape}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.camera, self._psf, self._lazy = state["camera"], state["_psf"], Lazy()
        super().__init__(state["dtype"], state["shape"])  # type: ignore[call-arg]

    @property
    def video_shape(self) -> tuple[int, int, int]:
        """Shape of its input, before flattening."""
        return self.camera.video_shape

    @property
    def frame_shape(self) -> tuple[int, int]:
        """Shape of its output, before flattening."""
        return self.camera.frame_shape

    def _matvec(self, x: Any) -> NDArray[Any]:
        x = np.asarray(x)
        apply = self._native.apply if _like(x) == np.float32 else self._native.apply_double
        return apply(x.reshape(-1))

    def _rmatvec(self, x: Any) -> NDArray[Any]:
        x = np.asarray(x)
        adjoint = self._native.adjoint if _like(x) == np.float32 else self._native.adjoint_double
        return adjoint(x.reshape(-1))

    def __call__(self, x: Any) -> Any:
        """``A x``: of a video ``[t, y, x]`` the frame ``[y, x]``; of a flattened one, the flattened frame.

        Examples
        --------
        >>> A = rb.operator(camera, psf)
        >>> A(np.ones(camera.video_shape, np.float32)).shape
        (24, 30)
        """
        x = np.asarray(x) if hasattr(x, "__array__") or isinstance(x, (list, tuple)) else x
        if isinstance(x, np.ndarray) and x.shape == self.video_shape:
            return self.matvec(x.reshape(-1)).reshape(self.frame_shape)
        return super().__call__(x)

    def data_term(self, frame: ArrayLike | PathLike[str]) -> DataTerm:
        """``½‖W(b - A v)‖²`` of a raw frame ``b``, with its exact prox.

        Parameters
        ----------
        frame : array or path
            The raw frame ``[y, x]``.

        Returns
        -------
        DataTerm
            A function of flattened videos, with ``grad`` and ``prox``.

        Raises
        ------
        InputError
            The frame breaks a rule.

        Examples
        --------
        >>> term = rb.operator(camera, psf).data_term(frame)
        >>> term(np.zeros(12 * 24 * 30)) > 0
        True
        """
        return DataTerm(self, frame)

    def to_scico(self) -> Any:
        """The same as a ``scico.linop.LinearOperator`` on videos, which may be traced and compiled.

        Returns
        -------
        scico.linop.LinearOperator
            From videos ``[t, y, x]`` to frames ``[y, x]``, of float32.

        Raises
        ------
        InputError
            scico is not installed.

        Examples
        --------
        ::

            S = rb.operator(camera, psf).to_scico()
            frame = S(snp.zeros(S.input_shape))
        """
        need("scico", "to_scico")
        from ._scico import linear_operator

        return linear_operator(self)

    def to_torch(self) -> TorchOperator:
        """The same on torch tensors, videos ``[..., t, y, x]`` to frames ``[..., y, x]``, with gradients.

        Returns
        -------
        TorchOperator
            A function of tensors with ``adjoint``, and ``deepinv()``: a ``deepinv.physics.LinearPhysics``. Tensors of
            float64 are computed in float64, all others in float32, on the host.

        Raises
        ------
        InputError
            torch is not installed.

        Examples
        --------
        ::

            A = rb.operator(camera, psf).to_torch()
            video = torch.zeros(A.video_shape, requires_grad=True)
            torch.sum((A(video) - frame) ** 2).backward()
        """
        need("torch", "to_torch")
        from ._torch import TorchOperator

        return TorchOperator(self)


class DataTerm:
    """``f(v) = ½‖W(b - A v)‖²`` with its gradient and its exact proximal step.

    PyProximal takes it as it is wherever it takes a ``ProxOperator``, on flattened videos;
    :meth:`to_scico` is the same as a SCICO functional.
    """

    hasgrad = True

    def __init__(self, operator: RollingShutterOperator, frame: ArrayLike | PathLike[str]) -> None:
        self.operator = operator
        self._frame: ArrayLike | PathLike[str] = checked_array("frame", frame)
        self._lazy: Lazy[_rowburst._DataTerm] = Lazy()
        # The mistakes of a frame are found here.
        _ = self._native

    @property
    def _native(self) -> _rowburst._DataTerm:
        return self._lazy.get(lambda: _rowburst._DataTerm(self.operator._native, self._frame))

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_lazy"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lazy = Lazy()

    def __repr__(self) -> str:
        rows, columns = self.operator.frame_shape
        return f"<rowburst.DataTerm of a frame of {rows}×{columns}>"

    def __call__(self, x: ArrayLike) -> float:
        return self._native.value(np.asarray(x).reshape(-1))

    def grad(self, x: ArrayLike) -> NDArray[Any]:
        """``AᵀW²(A x - b)``.

        Parameters
        ----------
        x : array
            A video, flattened or ``[t, y, x]``.

        Returns
        -------
        numpy.ndarray
            The gradient, in the shape of ``x``.

        Raises
        ------
        InputError
            The video has another number of values, or one that is not finite.

        Examples
        --------
        >>> term = rb.operator(camera, psf).data_term(frame)
        >>> term.grad(np.zeros((12, 24, 30))).shape
        (12, 24, 30)
        """
        x = np.asarray(x)
        return self._native.gradient(x.reshape(-1)).astype(_like(x), copy=False).reshape(x.shape)

    def prox(self, x: ArrayLike, step: float) -> NDArray[Any]:
        """``argmin_v f(v) + ‖v - x‖²/(2 step)``.

        Exact to rounding where every bin is seen by one instant, else to 1e-6 of the residual. A step
        that differs from the last one costs a factorisation.

        Parameters
        ----------
        x : array
            A video, flattened or ``[t, y, x]``.
        step : float
            The step, above zero.

        Returns
        -------
        numpy.ndarray
            The video, in the shape of ``x``.

        Raises
        ------
        InputError
            The step is not above zero, or the video has another number of values, or one that is not finite.

        Examples
        --------
        >>> term = rb.operator(camera, psf).data_term(frame)
        >>> found = term.prox(np.zeros((12, 24, 30)), 1.0)
        >>> term(found) < term(np.zeros((12, 24, 30)))
        True
        """
        x = np.asarray(x)
        found = self._native.prox(x.reshape(-1), float(step))
        return found.astype(_like(x), copy=False).reshape(x.shape)

    def proxdual(self, x: ArrayLike, step: float) -> NDArray[Any]:
        """The step of the convex conjugate, by Moreau's identity.

        Parameters
        ----------
        x : array
            A video, flattened or ``[t, y, x]``.
        step : float
            The step, above zero.

        Returns
        -------
        numpy.ndarray
            In the shape of ``x``.

        Raises
        ------
        InputError
            The step is not above zero, or the video has another number of values, or one that is not finite.

        Examples
        --------
        >>> term = rb.operator(camera, psf).data_term(frame)
        >>> term.proxdual(np.ones((12, 24, 30)), 1.0).shape
        (12, 24, 30)
        """
        check_positive("step", step, "Give a step above zero, such as 1.0.")
        x = np.asarray(x)
        return x - float(step) * self.prox(x / float(step), 1.0 / float(step))

    def to_scico(self) -> Any:
        """The same as a ``scico.functional.Functional`` on videos ``[t, y, x]``.

        Returns
        -------
        scico.functional.Functional
            With ``grad`` and the exact ``prox``, of float32; ``jax.vmap`` and ``jit`` take it.

        Raises
        ------
        InputError
            scico is not installed.

        Examples
        --------
        ::

            f = rb.operator(camera, psf).data_term(frame).to_scico()
            video = f.prox(snp.zeros(camera.video_shape), 1.0)
        """
        need("scico", "to_scico")
        from ._scico import functional

        return functional(self)


def operator(
    camera: Camera, psf: Psf | ArrayLike | PathLike[str] | None, dtype: DTypeLike = np.float64
) -> RollingShutterOperator:
    """The forward operator ``A`` of a camera behind a diffuser.

    Parameters
    ----------
    camera : Camera
        The camera.
    psf : Psf, array or path
        The point-spread function ``[y, x]``. None, which an experiment without a PSF has, is refused.
    dtype : dtype
        The type that solvers see, and in which most of them work: with ``numpy.float32`` they are about twice as fast.

    Returns
    -------
    RollingShutterOperator
        A ``scipy.sparse.linalg.LinearOperator`` from the flattened video ``[t, y, x]`` to the flattened frame ``[y, x]``.

    Raises
    ------
    InputError
        An argument breaks a rule.

    Examples
    --------
    >>> A = rb.operator(camera, psf)
    >>> A.shape == (24 * 30, 12 * 24 * 30)
    True
    """
    return RollingShutterOperator(camera, psf, dtype)
