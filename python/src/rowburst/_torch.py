"""The operator for torch, with gradients, and as a linear physics of deepinv. It is computed on the host."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ._errors import input_error

if TYPE_CHECKING:
    from ._operator import RollingShutterOperator


class TorchOperator:
    """``A`` on tensors: videos ``[..., t, y, x]`` to frames ``[..., y, x]``, with leading axes of any number.

    Gradients pass through it, of any order. Tensors of float64 are computed in float64, all others in float32; the result is
    of the type and on the device of the input, and is computed on the host.
    """

    def __init__(self, operator: RollingShutterOperator) -> None:
        self.operator = operator
        self.video_shape = operator.video_shape
        self.frame_shape = operator.frame_shape

    def __repr__(self) -> str:
        return f"<rowburst.TorchOperator: videos {self.video_shape} to frames {self.frame_shape}>"

    def __call__(self, video: Any) -> Any:
        """The frames ``[..., y, x]`` of videos ``[..., t, y, x]``."""
        return _Linear.apply(video, self, False)

    def adjoint(self, frame: Any) -> Any:
        """``Aᵀ`` of frames ``[..., y, x]``: videos ``[..., t, y, x]``.

        Parameters
        ----------
        frame : torch.Tensor
            Frames ``[..., y, x]``.

        Returns
        -------
        torch.Tensor
            ``[..., t, y, x]``, of the type and on the device of the frames.

        Raises
        ------
        InputError
            The last axes are not those of a frame.

        Examples
        --------
        ::

            A = rb.operator(camera, psf).to_torch()
            video = A.adjoint(torch.ones(A.frame_shape))
        """
        return _Linear.apply(frame, self, True)

    def deepinv(self) -> Any:
        """The same as a ``deepinv.physics.LinearPhysics``, on videos ``[batch, 1, t, y, x]`` and frames ``[batch, 1, y, x]``.

        Returns
        -------
        deepinv.physics.LinearPhysics
            With ``A``, ``A_adjoint`` and the solvers of deepinv.

        Raises
        ------
        InputError
            deepinv is not installed.

        Examples
        --------
        ::

            physics = rb.operator(camera, psf).to_torch().deepinv()
            video = physics.A_dagger(frame[None, None], solver="CG")
        """
        from ._extras import need

        need("deepinv", "TorchOperator.deepinv")
        from deepinv.physics import LinearPhysics

        def apply(x: Any, **kwargs: Any) -> Any:
            return self(x)

        def adjoint(y: Any, **kwargs: Any) -> Any:
            return self.adjoint(y)

        return LinearPhysics(A=apply, A_adjoint=adjoint, img_size=(1, *self.video_shape))

    def _on_host(self, values: Any, is_adjoint: bool) -> Any:
        """The operator or its adjoint of each array of a batch."""
        given, wanted = (self.frame_shape, self.video_shape) if is_adjoint else (self.video_shape, self.frame_shape)
        if tuple(values.shape[-len(given) :]) != given:
            tensor = f"a tensor of shape {tuple(values.shape)}"
            remedy = "Reshape it: videos are [..., t, y, x], frames [..., y, x]."
            subject = "frame" if is_adjoint else "video"
            raise input_error(subject, tensor, f"its last axes are {given}", remedy, kind="shape")
        native = self.operator._native
        double = values.dtype == torch.float64
        function = (
            (native.adjoint_double if double else native.adjoint) if is_adjoint else (native.apply_double if double else native.apply)
        )
        leading = tuple(values.shape[: -len(given)])
        kind = np.float64 if double else np.float32
        arrays = values.detach().to("cpu", torch.float64 if double else torch.float32).numpy().reshape(-1, int(np.prod(given)))
        found = np.stack([function(array) for array in arrays]) if len(arrays) else np.empty((0, int(np.prod(wanted))), kind)
        return torch.from_numpy(found.reshape(*leading, *wanted)).to(values)


class _Linear(torch.autograd.Function):
    """A linear map, whose derivative is its adjoint."""

    @staticmethod
    def forward(ctx: Any, values: Any, operator: TorchOperator, is_adjoint: bool) -> Any:
        ctx.operator, ctx.is_adjoint = operator, is_adjoint
        return operator._on_host(values, is_adjoint)

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> Any:
        return _Linear.apply(gradients[0], ctx.operator, not ctx.is_adjoint), None, None
