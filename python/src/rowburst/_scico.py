"""The operator and the data term as SCICO objects. JAX calls them on the host."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from scico import functional as scico_functional
from scico import linop

if TYPE_CHECKING:
    from ._operator import DataTerm, RollingShutterOperator


def linear_operator(operator: RollingShutterOperator) -> Any:
    """``A`` from ``[t, y, x]`` to ``[y, x]``."""
    video, frame = operator.video_shape, operator.frame_shape

    def called(function: Any, shape: tuple[int, ...]) -> Any:
        result = jax.ShapeDtypeStruct(shape, np.float32)

        def on_host(x: Any) -> Any:
            return function(np.asarray(x, dtype=np.float32).reshape(-1)).reshape(shape)

        return lambda x: jax.pure_callback(on_host, result, x, vmap_method="sequential")

    def differentiable(forward: Any, adjoint: Any) -> Any:
        linear = jax.custom_vjp(forward)
        linear.defvjp(lambda x: (forward(x), None), lambda _, y: (adjoint(y),))
        return linear

    apply, adjoint = called(operator._native.apply, frame), called(operator._native.adjoint, video)
    return linop.LinearOperator(
        input_shape=video,
        output_shape=frame,
        eval_fn=differentiable(apply, adjoint),
        adj_fn=differentiable(adjoint, apply),
        input_dtype=np.float32,
        output_dtype=np.float32,
    )


def functional(term: DataTerm) -> Any:
    """``½‖W(b - A v)‖²`` with its gradient and its prox."""

    def value(v: Any) -> Any:
        scalar = jax.ShapeDtypeStruct((), np.float32)
        on_host = lambda v: np.float32(term(np.asarray(v)))
        return jax.pure_callback(on_host, scalar, v, vmap_method="sequential")

    def gradient(v: Any) -> Any:
        same = jax.ShapeDtypeStruct(v.shape, np.float32)
        on_host = lambda v: term.grad(np.asarray(v, dtype=np.float32))
        return jax.pure_callback(on_host, same, v, vmap_method="sequential")

    differentiable = jax.custom_vjp(value)
    differentiable.defvjp(lambda v: (value(v), v), lambda v, y: (y * gradient(v),))

    class RollingShutterData(scico_functional.Functional):  # type: ignore[misc]
        has_eval = True
        has_prox = True

        def __call__(self, x: Any) -> Any:
            return differentiable(x)

        def prox(self, v: Any, lam: float = 1.0, **kwargs: Any) -> Any:
            same = jax.ShapeDtypeStruct(v.shape, np.float32)
            step = lambda p, s: term.prox(np.asarray(p, dtype=np.float32), float(s))
            return jax.pure_callback(step, same, v, lam, vmap_method="sequential")

    return RollingShutterData()
