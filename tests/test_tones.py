"""Frequencies of tones in a residual, for effects that are periodic in time."""

import numpy as np
import pytest

from jaxid.discovery.screening import tones_of

TONE, PERIOD, SAMPLES = 5.361, 0.004, 6000


def residual_of(missing: float, seed: int = 0):
    """White noise with a tone on the second joint; some of the samples are missing."""
    rng = np.random.default_rng(seed)
    residual, mask, times = np.zeros((2, SAMPLES, 2)), np.zeros((2, SAMPLES), bool), []
    for k in range(2):
        time = PERIOD * np.arange(SAMPLES)
        time = time[np.sort(rng.permutation(SAMPLES)[: round((1 - missing) * SAMPLES)])]
        there = slice(len(time))
        residual[k, there] = 0.3 * rng.standard_normal((len(time), 2))
        residual[k, there, 1] += np.sin(2 * np.pi * TONE * time + 1.7)
        mask[k, there] = True
        times.append(np.pad(time, (0, SAMPLES - len(time)), "edge"))
    return residual, mask, np.array(times)


@pytest.mark.parametrize("missing", [0.0, 0.02, 0.1])
def test_a_tone_has_its_frequency_although_samples_are_missing(missing):
    residual, mask, time = residual_of(missing)
    found, trials = tones_of(residual, mask, time)
    # A quarter of a line of the spectrum.
    assert found[1][0] == pytest.approx(TONE, abs=0.25 / (SAMPLES * PERIOD))
    assert all(abs(f - TONE) > 0.5 for f in found[0])
    # Independent frequencies of two joints below 0.4 times the sample rate.
    assert trials == pytest.approx(2 * 0.4 * SAMPLES, rel=0.02)
