"""Decompositions under vmap: right, and never a batch in LAPACK's hands, where two would hang."""

import re
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.estimate.covariance import optimum_of
from jaxid.estimate.refit import Lanes, _refit_some
from jaxid.linear_algebra import column_basis, smallest_eigenvalue, solve

DEMO = Path(jaxid.__file__).parent / "demo" / "clean"
# A call with the shapes it is given: `custom_call @lapack_dgetrf_ffi(%0) … : (tensor<5x4x4xf64>)`.
CALL = re.compile(r"custom_call @lapack_(\w+).*?: \(([^)]*)\)")


def calls(text: str) -> list[tuple[str, int]]:
    """LAPACK's functions in a program, and how many matrices go with each call."""
    found = []
    for name, operands in CALL.findall(text):
        shape = [int(n) for n in re.findall(r"(\d+)x", operands.split("tensor<")[1])]
        found.append((name, int(np.prod(shape[:-2]))))
    return found


@pytest.fixture(scope="module")
def matrices() -> np.ndarray:
    rng = np.random.default_rng(3)
    wide = rng.normal(size=(5, 4, 4))
    return wide @ wide.transpose(0, 2, 1) + np.eye(4)


def test_results_are_those_of_numpy(matrices):
    right = np.arange(20.0).reshape(5, 4)
    found = jax.jit(jax.vmap(solve))(matrices, right)
    np.testing.assert_allclose(found, np.linalg.solve(matrices, right[..., None])[..., 0])
    smallest = jax.jit(jax.vmap(smallest_eigenvalue))(matrices)
    np.testing.assert_allclose(smallest, np.linalg.eigvalsh(matrices)[:, 0])
    basis, size = jax.jit(jax.vmap(column_basis))(matrices[:, :, :2])
    np.testing.assert_allclose(size, np.linalg.svd(matrices[:, :, :2])[1])
    spanned = np.einsum("bij,bkj->bik", basis, basis) @ matrices[:, :, :2]
    np.testing.assert_allclose(spanned, matrices[:, :, :2])


def test_the_batch_of_numpy_like_calls_is_seen(matrices):
    lowered = jax.jit(jnp.linalg.solve).lower(matrices, np.ones((5, 4, 1))).as_text()
    assert ("dgetrf_ffi", 5) in calls(lowered)


def test_many_fits_at_once_call_lapack_for_one_matrix_at_a_time():
    recording = jaxid.read(DEMO / "fit_1.csv")
    fit = jaxid.fit(jaxid.scara(), recording, jaxid.JointPEM(orders=(2, 3)))
    optimum = optimum_of(fit, "draws")
    lowered = eqx.filter_jit(_refit_some).lower(optimum, Lanes.around(optimum, 8), 2).as_text()
    found = calls(lowered)
    assert {name for name, _ in found} >= {"dgetrf_ffi"}
    assert all(count == 1 for _, count in found)
