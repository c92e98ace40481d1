"""Separation of noise and physics: p-values for recordings that differ."""

import dataclasses

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

from jaxid.discovery.data import Data
from jaxid.discovery.score import Gram, chance
from jaxid.discovery.separate import estimate_noise
from jaxid.discovery.table import SignatureTable

SAMPLES, DRAWS = 300, 80
TIME = np.linspace(0, 1, SAMPLES)


def drawn(rng: np.random.Generator, levels: tuple[float, ...]) -> Data:
    """Coloured noise of several levels; signatures that act in the last recording alone."""
    noise = [
        level * lfilter([1.0], [1.0, -0.8], rng.standard_normal(SAMPLES + 200))[200:]
        for level in levels
    ]
    base = np.stack([np.sin(7 * TIME), np.cos(11 * TIME), TIME], axis=1)
    table = np.zeros((len(levels), SAMPLES, 1, 4))
    table[-1, :, 0] = np.stack([np.sin(k * TIME) for k in (3, 23, 61, 97)], axis=1)
    return Data(
        np.stack(noise)[..., None],
        np.stack([base] * len(levels))[:, :, None],
        SignatureTable.of(table.astype(np.float32)),
        np.ones((len(levels), SAMPLES), bool),
    )


def p_value(data: Data, noise: tuple) -> float:
    explained, freedom = Gram.of(data, noise).explained([(0, 1, 2, 3)])
    return chance(float(explained[0]), int(freedom[0]))


@pytest.mark.parametrize("levels", [(1.0, 1.0), (1.0, 3.0)])
def test_p_values_are_true_where_recordings_have_levels_of_their_own(levels):
    rng = np.random.default_rng(11)
    own, pooled, apart = [], [], 0
    for _ in range(DRAWS):
        found = estimate_noise(drawn(rng, levels), [(0,), (1,), (2,), (3,)])
        own.append(p_value(found.data, found.noise))
        pooled.append(p_value(dataclasses.replace(found.data, level=None), found.noise))
        apart += found.data.level is not None
    low, high = binom.interval(0.999, DRAWS, 0.05)
    assert low <= np.sum(np.array(own) < 0.05) <= high
    if len(set(levels)) == 1:
        assert apart <= 0.05 * DRAWS
    else:
        assert apart == DRAWS
        # What the levels are for: without them the louder recording cries wolf.
        assert np.sum(np.array(pooled) < 0.05) > high


def test_levels_are_those_of_the_noise():
    found = estimate_noise(drawn(np.random.default_rng(12), (2.0, 1.0, 4.0)), [(0, 1)])
    assert np.allclose(found.data.level[:, 0], np.array([2.0, 1.0, 4.0]) / np.sqrt(7), rtol=0.1)
    assert np.isclose(found.noise[0].variance, 7.0, rtol=0.1)


def at_rest(data: Data, share: float) -> Data:
    """The same data with that share of the rows not compared, in the middle of each recording."""
    rows = np.abs(TIME - 0.5) < share / 2
    base, table = (
        np.where(rows[:, None, None], x.dtype.type(0), x)
        for x in (data.base, data.columns(range(4)))
    )
    residual = np.where(rows[:, None], 0.0, data.residual)
    return dataclasses.replace(data, residual=residual, base=base, table=SignatureTable.of(table))


def test_rows_at_rest_do_not_make_the_noise_weaker():
    rng = np.random.default_rng(15)
    blocks, values, variances = [(0,), (1,), (2,), (3,)], [], []
    for _ in range(DRAWS):
        found = estimate_noise(at_rest(drawn(rng, (1.0, 1.0)), 0.5), blocks)
        values.append(p_value(found.data, found.noise))
        variances.append(found.noise[0].variance)
    assert np.mean(variances) == pytest.approx(1.0, rel=0.03)
    low, high = binom.interval(0.999, DRAWS, 0.05)
    assert low <= np.sum(np.array(values) < 0.05) <= high


def test_recordings_of_equal_noise_have_one_level_however_long_they_rest():
    rng, apart = np.random.default_rng(16), 0
    for _ in range(20):
        whole, resting = (drawn(rng, (1.0,)) for _ in range(2))
        resting = at_rest(resting, 0.6)
        names = "residual", "base", "mask"
        both = {n: np.concatenate([getattr(x, n) for x in (whole, resting)]) for n in names}
        table = SignatureTable.of(np.concatenate([x.columns(range(4)) for x in (whole, resting)]))
        apart += estimate_noise(Data(table=table, **both), [(0,), (1,)]).data.level is not None
    assert apart <= 2


def test_a_recording_without_noise_is_no_division_by_zero():
    data = drawn(np.random.default_rng(13), (0.0, 1.0))
    found = estimate_noise(data, [(0,), (1,)])
    assert np.isfinite(Gram.of(found.data, found.noise).gram).all()


def test_the_middle_of_recordings_stays_within_their_samples():
    data = drawn(np.random.default_rng(13), (1.0, 1.0))
    mask = data.mask.copy()
    mask[1, 150:] = False
    data = dataclasses.replace(data, mask=mask)
    part = data.middle(200, least=1)
    assert part.residual.shape == (2, 100, 1)
    assert part.mask.all()
    np.testing.assert_array_equal(part.residual[0], data.residual[0, 100:200])
    np.testing.assert_array_equal(part.columns([3])[1], data.columns([3])[1, 25:125])
    assert data.middle(600, least=1) is data
    # Short pieces stay whole, however many they are.
    assert data.middle(200) is data


def test_the_middle_tells_the_same_noise_and_physics():
    blocks = [(0,), (1,), (2,), (3,)]
    data = drawn(np.random.default_rng(14), (1.0, 2.0))
    seen = dataclasses.replace(data, residual=data.residual + 3.0 * data.columns([2])[..., 0])
    whole, part = estimate_noise(seen, blocks), estimate_noise(seen.middle(400, least=1), blocks)
    assert whole.chosen == part.chosen == [2]
    assert abs(part.noise[0].variance / whole.noise[0].variance - 1) < 0.3
    np.testing.assert_allclose(part.data.level, whole.data.level, rtol=0.2)
