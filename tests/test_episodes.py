"""Residuals that are large in a few episodes."""

import dataclasses

import numpy as np
import pytest

from jaxid.control import Tracking
from jaxid.discovery.episodes import in_episodes


@pytest.mark.xdist_group("offset")
def test_an_error_in_a_short_episode_is_no_noise(offset_story):
    fit = offset_story[0].fit
    assert in_episodes(fit, 0.05) == ""
    first, second = (np.array(r) for r in fit.residuals[:2])
    when = fit.recordings[1].time
    second[(when > when[0] + 3.0) & (when < when[0] + 3.1), 1] += 30 * np.std(second[:, 1])
    hit = dataclasses.replace(fit, residuals=(first, second, *fit.residuals[2:]))
    said = in_episodes(hit, 0.05)
    assert f"the error of joint 2 on {fit.recordings[1].name} is" in said
    assert "it is largest at 3.0" in said
    # What the user does not find worth knowing refutes nothing.
    assert in_episodes(hit, 100.0) == ""
    # Along a recorded motion it may be friction at a reversal.
    follows = dataclasses.replace(hit.loop, controller=Tracking(cutoff=10.0))
    assert in_episodes(dataclasses.replace(hit, loop=follows), 0.05) == ""


@pytest.mark.xdist_group("offset")
@pytest.mark.parametrize("kind", ["heavy tails", "bursts"])
def test_noise_may_have_heavy_tails_and_bursts(kind, offset_story):
    fit, rng = offset_story[0].fit, np.random.default_rng(1)

    def noise(rest: np.ndarray) -> np.ndarray:
        if kind == "heavy tails":
            return rng.standard_t(3.0, rest.shape)
        loud = np.repeat(rng.random((len(rest) // 50 + 1, 1)) < 0.1, 50, axis=0)[: len(rest)]
        return np.where(loud, 4.0, 1.0) * rng.standard_normal(rest.shape)

    fit = dataclasses.replace(fit, residuals=tuple(noise(np.asarray(r)) for r in fit.residuals))
    assert in_episodes(fit, 0.05) == ""
