"""A as SciPy, PyLops, PyProximal and SCICO use it, and the exact prox against dense matrices."""

import numpy as np
import pytest
from scipy.sparse.linalg import LinearOperator, lsqr

import rowburst as rb


@pytest.fixture(scope="module")
def operator(camera, psf):
    return rb.operator(camera, psf)


@pytest.fixture(scope="module")
def small():
    """Small enough for dense matrices; an exposure of 2.5 rows couples instants."""
    camera = rb.Camera(rows=6, columns=5, shutter="top-down", row_time_us=10, exposure_us=25)
    return camera, np.random.default_rng(1).exponential(size=(11, 9))


def dense(operator):
    return np.stack([operator.matvec(e) for e in np.eye(operator.shape[1])], axis=1)


def by_hand(camera, psf):
    """The interface's equation, term by term, in float64."""
    psf = psf / psf.sum()
    bins, height, width = camera.video_shape
    weights = camera.row_time_weights()
    matrix = np.zeros((camera.rows, camera.columns, bins, height, width))
    for r in range(camera.rows):
        for x in range(camera.columns):
            for y in range(height):
                for u in range(width):
                    dy, dx = psf.shape[0] // 2 + r - y, psf.shape[1] // 2 + x - u
                    if 0 <= dy < psf.shape[0] and 0 <= dx < psf.shape[1]:
                        matrix[r, x, :, y, u] = weights[r] * psf[dy, dx]
    return matrix.reshape(camera.rows * camera.columns, -1)


def test_it_is_the_equation(small):
    camera, psf = small
    matrix = by_hand(camera, psf)
    operator = rb.operator(camera, psf)
    assert isinstance(operator, LinearOperator)
    assert operator.shape == matrix.shape
    np.testing.assert_allclose(dense(operator), matrix, atol=1e-7 * matrix.max() * 30)


def test_types_and_layouts(operator, capture):
    video = capture.truth
    flat = video.ravel()
    expected = operator.matvec(flat)
    assert expected.dtype == np.float32
    frozen = flat.copy()
    frozen.setflags(write=False)
    swapped = flat.astype(flat.dtype.newbyteorder())
    strided = np.repeat(flat, 2)[::2]
    for same in (frozen, swapped, strided, flat.reshape(-1, 1)):
        np.testing.assert_array_equal(operator.matvec(same).ravel(), expected)
    doubled = operator.matvec(flat.astype(np.float64))
    assert doubled.dtype == np.float64
    np.testing.assert_allclose(doubled, expected, rtol=1e-5)
    np.testing.assert_array_equal(operator.matvec(flat.astype(np.float64).tolist()), doubled)
    np.testing.assert_array_equal(operator @ np.stack([flat, 2 * flat], 1), np.stack([expected, 2 * expected], 1))
    np.testing.assert_allclose(expected, (operator.H.H @ flat), rtol=1e-6)
    with pytest.raises(ValueError):
        operator.matvec(flat[:-1])
    with pytest.raises(rb.InputError, match="complex"):
        operator.matvec(flat.astype(complex))


def test_pylops_dottest(operator, small):
    pylops = pytest.importorskip("pylops")
    for own in (operator, rb.operator(*small)):
        for seed in range(20):
            np.random.seed(seed)
            assert pylops.utils.dottest(pylops.aslinearoperator(own), *own.shape)


@pytest.mark.parametrize("step", [1e-2, 1.0, 1e3])
@pytest.mark.parametrize("shutter", ["dual-inside-out", "top-down", "global"])
def test_the_prox_is_exact(step, shutter):
    # Blocks, blocks that are coupled, and whole planes by conjugate gradients.
    exposure = 25 if shutter == "top-down" else 10
    camera = rb.Camera(rows=8, columns=7, shutter=shutter, row_time_us=10, exposure_us=exposure)
    psf = np.random.default_rng(4).exponential(size=(15, 13))
    operator = rb.operator(camera, psf)
    a = by_hand(camera, psf)
    rng = np.random.default_rng(5)
    frame = rng.uniform(1, 2, camera.frame_shape)
    p = rng.normal(size=camera.video_shape)
    term = operator.data_term(frame)
    b = frame.ravel()
    expected = np.linalg.solve(a.T @ a + np.eye(p.size) / step, a.T @ b + p.ravel() / step)
    found = term.prox(p, step)
    assert found.shape == p.shape and found.dtype == np.float64
    np.testing.assert_allclose(found.ravel(), expected, atol=3e-5 * np.abs(expected).max())
    residual = a @ p.ravel() - b
    np.testing.assert_allclose(term(p), 0.5 * residual @ residual, rtol=1e-5)
    np.testing.assert_allclose(term.grad(p).ravel(), a.T @ residual, atol=1e-5 * np.abs(a.T @ residual).max())


def test_bad_steps_and_videos(operator, capture):
    term = operator.data_term(capture.frame)
    video = np.zeros(operator.shape[1], np.float32)
    for step in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(rb.InputError, match="step"):
            term.prox(video, step)
    video[7] = np.nan
    with pytest.raises(rb.InputError, match="finite"):
        term.prox(video, 1.0)


def test_scipy_solves_with_it(operator, capture):
    found = lsqr(operator, capture.frame.ravel(), iter_lim=30)[0]
    before = np.linalg.norm(capture.frame)
    assert np.linalg.norm(operator @ found - capture.frame.ravel()) < 0.3 * before


def objective(operator, b, tau, v):
    return 0.5 * np.sum((operator @ v.astype(np.float64) - b) ** 2) + tau * np.abs(v).sum()


def test_pyproximal_runs_with_it_as_it_stands(operator, capture):
    pylops = pytest.importorskip("pylops")
    pyproximal = pytest.importorskip("pyproximal")
    b = capture.frame.ravel().astype(np.float64)
    tau = 1e-3 * np.abs(operator.rmatvec(b)).max()
    zero = np.zeros(operator.shape[1])
    l1 = pyproximal.L1(tau)
    step = 20 / float(np.linalg.norm(operator.rmatvec(operator.matvec(operator.rmatvec(b)))) / np.linalg.norm(operator.rmatvec(b)))
    # Their own ℓ2 term with our operator, by accelerated proximal gradients.
    smooth = pyproximal.L2(Op=pylops.aslinearoperator(operator), b=b)
    fista = pyproximal.optimization.primal.ProximalGradient(
        smooth, l1, x0=zero, tau=step / 20, niter=60, acceleration="fista", show=False)
    # Our exact prox, by ADMM.
    admm = pyproximal.optimization.primal.ADMM(
        operator.data_term(capture.frame), l1, x0=zero, tau=step, niter=60, show=False)[1]
    start = objective(operator, b, tau, zero)
    by_fista, by_admm = (objective(operator, b, tau, np.asarray(v)) for v in (fista, admm))
    assert by_fista < 0.5 * start
    assert by_admm <= 1.02 * by_fista


def test_scico_runs_with_it_as_it_stands(operator, capture):
    snp = pytest.importorskip("scico.numpy")
    from scico import functional, linop, loss
    from scico.optimize import ADMM, AcceleratedPGM
    from scico.optimize.admm import LinearSubproblemSolver

    a = operator.to_scico()
    b = snp.array(capture.frame)
    x = snp.array(capture.truth)
    np.testing.assert_allclose(np.asarray(a(x)).ravel(), operator.matvec(capture.truth.ravel()), rtol=1e-6)
    y = np.asarray(a.adj(b)).ravel()
    np.testing.assert_allclose(y, operator.rmatvec(capture.frame.ravel()), rtol=1e-6)
    tau = 1e-3 * float(np.abs(y).max())
    flat = capture.frame.ravel().astype(np.float64)
    start = objective(operator, flat, tau, np.zeros(operator.shape[1]))
    norm = float(linop.operator_norm(a, maxiter=20)) ** 2
    pgm = AcceleratedPGM(
        f=loss.SquaredL2Loss(y=b, A=a), g=tau * functional.L1Norm(), L0=1.1 * norm, x0=snp.zeros(a.input_shape), maxiter=40)
    by_pgm = objective(operator, flat, tau, np.asarray(pgm.solve()).ravel())
    assert by_pgm < 0.5 * start
    # The exact prox as a term of ADMM's splitting, in the place of an inner solver.
    identity = linop.Identity(a.input_shape)
    admm = ADMM(
        f=None,
        g_list=[operator.data_term(capture.frame).to_scico(), tau * functional.L1Norm()],
        C_list=[identity, identity],
        rho_list=[norm / 20, norm / 20],
        x0=snp.zeros(a.input_shape),
        maxiter=40,
        subproblem_solver=LinearSubproblemSolver(),
    )
    by_admm = objective(operator, flat, tau, np.asarray(admm.solve()).ravel())
    assert by_admm < 1.1 * by_pgm


def test_scico_functional_has_a_gradient_and_maps(operator, capture):
    pytest.importorskip("scico.numpy")
    import jax
    import jax.numpy as jnp

    term = operator.data_term(capture.frame)
    functional, a = term.to_scico(), operator.to_scico()
    videos = np.random.default_rng(8).random((2, *operator.video_shape), np.float32)
    expected = [term.grad(video) for video in videos]
    np.testing.assert_allclose(functional.grad(jnp.asarray(videos[0])), expected[0], rtol=1e-5, atol=1e-5 * np.abs(expected[0]).max())
    # Of a composition, under jit.
    scaled = jax.jit(jax.grad(lambda v: 3.0 * functional(2.0 * v)))(videos[0] / 2)
    np.testing.assert_allclose(scaled, 6 * expected[0], rtol=1e-4, atol=1e-4 * np.abs(expected[0]).max())
    for mapped, of_one in (
        (jax.vmap(functional)(videos), [term(v) for v in videos]),
        (jax.vmap(jax.grad(functional))(videos), expected),
        (jax.vmap(lambda v: functional.prox(v, 0.5))(videos), [term.prox(v, 0.5) for v in videos]),
        (jax.vmap(a)(videos), [np.asarray(a(v)) for v in videos]),
    ):
        np.testing.assert_allclose(mapped, np.stack(of_one), rtol=1e-4, atol=1e-4 * np.abs(np.stack(of_one)).max())
