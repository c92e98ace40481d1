"""Score statistics of whitened signatures, stored by output, against dense matrices."""

import numpy as np
import pytest

from jaxid.discovery.data import Data
from jaxid.discovery.score import Gram, Whitened, corrected, effective_tests
from jaxid.discovery.table import SignatureTable
from jaxid.estimate.minimise import Prior
from jaxid.noise import ARFilter

RECORDINGS, SAMPLES, OUTPUTS, COLUMNS = 2, 80, 3, 9
NOISE = tuple(ARFilter(np.array([-0.5]), 0.25 * (j + 1)) for j in range(OUTPUTS))


def drawn(known: bool) -> Data:
    """Signatures of one output each, one of all outputs, and one that is zero."""
    rng = np.random.default_rng(3)
    shape = RECORDINGS, SAMPLES, OUTPUTS
    table = np.zeros((*shape, COLUMNS), np.float32)
    for c in range(COLUMNS - 2):
        table[:, :, c % OUTPUTS, c] = rng.standard_normal((RECORDINGS, SAMPLES))
    table[..., COLUMNS - 2] = rng.standard_normal(shape)
    prior = Prior(np.eye(4)[:2], np.array([0.3, -0.2, 0.0, 0.0])) if known else None
    level = np.array([[0.8, 1.0, 1.2], [1.2, 1.0, 0.8]])
    mask = np.ones((RECORDINGS, SAMPLES), bool)
    mask[1, 60:] = False
    residual, base = rng.standard_normal(shape), rng.standard_normal((*shape, 4))
    there = mask[..., None]
    base, table = base * there[..., None], table * there[..., None]
    return Data(residual * there, base, SignatureTable.of(table), mask, level, known=prior)


def dense(data: Data) -> tuple[np.ndarray, np.ndarray]:
    """Residual and scaled signatures as whole matrices, with the base projected out."""
    r = data.white_residual(data.residual, NOISE)
    z = data.white_columns(data.base, NOISE, slice(None))
    x = data.white_columns(data.columns(range(COLUMNS)).astype(float), NOISE)
    size = np.linalg.norm(x, axis=0)
    x = x / np.where(size > 0, size, 1.0)
    basis = np.linalg.qr(z)[0]
    return r - basis @ (basis.T @ r), x - basis @ (basis.T @ x)


@pytest.mark.parametrize("known", [False, True])
def test_parts_by_output_are_the_whole_matrix(known):
    data = drawn(known)
    white, (r, x) = Whitened.of(data, NOISE), dense(data)
    assert [len(part.columns) for part in white.parts] == [4, 3, 3, 0]
    close = {"rtol": 1e-5, "atol": 1e-6}
    np.testing.assert_allclose(white.residual, r, **close)
    np.testing.assert_allclose(white.columns([7, 0, 8, 4]), x[:, [7, 0, 8, 4]], **close)
    np.testing.assert_allclose(white.gram(), x.T @ x, **close)
    np.testing.assert_allclose(white.score(), r @ x, rtol=1e-5, atol=1e-5)
    blocks = np.array([[0, 1], [7, 3], [8, 8]])
    pairs = np.stack([x[:, b].T @ x[:, b] for b in blocks])
    np.testing.assert_allclose(white.within(blocks), pairs, **close)
    any_rows = np.random.default_rng(4).standard_normal((len(r), 2))
    np.testing.assert_allclose(white.products(any_rows), any_rows.T @ x, rtol=1e-5, atol=1e-5)


def test_columns_beside_the_others_are_scaled_and_multiplied_like_them():
    data = drawn(known=True)
    r, x = dense(data)
    more = x[:, [1, 7]] @ np.array([[2.0, 0.0], [5.0, 3.0]])
    white = Whitened.of(data, NOISE).beside(more)
    both = np.concatenate([x, more / np.linalg.norm(more, axis=0)], axis=1)
    close = {"rtol": 1e-4, "atol": 1e-5}
    np.testing.assert_allclose(white.gram(), both.T @ both, **close)
    np.testing.assert_allclose(white.columns([9, 10, 2]), both[:, [9, 10, 2]], **close)
    np.testing.assert_allclose(white.score(), r @ both, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(white.size[-2:], np.linalg.norm(more, axis=0))


def test_drawn_noise_has_the_covariance_of_the_products():
    white = Whitened.of(drawn(known=True), NOISE)
    noise, gram = white.noise(draws=40_000, seed=1), white.gram()
    # Four deviations of a covariance from so many draws.
    np.testing.assert_allclose(noise @ noise.T / 40_000, gram, atol=4 * np.sqrt(2 / 40_000))
    np.testing.assert_allclose(noise.mean(axis=1), 0.0, atol=4 / np.sqrt(40_000))
    assert not noise[COLUMNS - 1].any()


def test_signatures_that_are_not_finite_are_no_gram_matrix():
    data = drawn(known=False)
    data.table.values[1][0, 3, 1] = np.inf
    with np.errstate(invalid="ignore"), pytest.raises(np.linalg.LinAlgError):
        Gram.of(data, NOISE)


def test_effective_tests_are_honest():
    """Of tests that are one and the same there is one; of independent ones, their number."""
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((40, 10_000))
    same = Gram(np.ones((40, 40)), np.zeros(40), np.ones(40), 1.0, 1000.0)
    apart = Gram(np.eye(40), rng.normal(size=40), np.ones(40), 1.0, 1000.0)
    blocks = [[k] for k in range(40)]
    # 10 000 draws give the lowest decile to 3 %; five of those.
    assert effective_tests(same, np.tile(noise[0], (40, 1)), blocks) == pytest.approx(1.0, rel=0.15)
    assert effective_tests(apart, noise, blocks) == pytest.approx(40.0, rel=0.15)
    assert corrected(0.01, 10) == pytest.approx(1 - 0.99**10)
