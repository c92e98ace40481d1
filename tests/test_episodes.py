"""Residuals that are large in a few episodes."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from loops import sines

import jaxid
from jaxid.arms import AbstractArm, Axis
from jaxid.control import Tracking
from jaxid.discovery.coloured_noise import floor_with_coloured_noise
from jaxid.discovery.episodes import episode_of, in_episodes, in_one_episode
from jaxid.effects import Coulomb, Stribeck, TorqueOffset, Viscous
from jaxid.parameters import Scalar, parameter


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


def pushed(seed: int, push: float = 0.0, noise: str = "white") -> jaxid.Recording:
    """An axis for 20 s at 100 Hz that is pushed from 7.2 to 8.8 s.

    **Arguments:**

    - `push`: largest force, N. `noise`: white, or with bursts.
    """
    rng, time = np.random.default_rng(seed), np.arange(0.0, 20.0, 0.01)
    q, v, a = sines(time, (0.2, 0.07, 0.02), (0.21, 0.53, 1.1), rng.uniform(0, 6, 3))
    tau = 5.0 * a + 4.0 * v + 3.0 * np.tanh(v / 0.02)
    inside = (time > 7.2) & (time < 8.8)
    tau -= push * inside * np.sin(np.pi * (time - 7.2) / 1.6) ** 2
    loud = np.repeat(rng.random(len(time) // 50) < 0.1, 50) if noise == "bursts" else False
    tau += 0.1 * np.where(loud, 4.0, 1.0) * rng.standard_normal(len(time))
    return jaxid.Recording.from_arrays(time, q, tau, name=f"run_{seed}")


def diagnosed(*runs: jaxid.Recording) -> jaxid.discovery.Diagnosis:
    effects = Viscous(1, 1.0), Coulomb(1, 1.0, smoothing=0.02), TorqueOffset(1)
    loop = jaxid.ClosedLoop(Axis(M=4.0), Tracking(cutoff=10.0), effects, name="axis")
    fit = jaxid.fit(loop, runs, jaxid.OEM(progress=False))
    return jaxid.diagnose(fit, catalogue=[Stribeck])


def test_a_push_in_one_recording_is_found_and_is_no_noise():
    diagnosis = diagnosed(pushed(1, push=6.0), pushed(2))
    found = episode_of(diagnosis, 0)
    assert found is not None
    assert found.recording == 0
    assert (found.start, found.end) == pytest.approx((7.2, 8.8), abs=0.3)
    said = in_one_episode(diagnosis, 0.05)
    assert said.startswith("on run_1 the error of joint 1 is ")
    assert f"from {found.start:.3g} to {found.end:.3g} s" in said
    # What the user does not find worth knowing is no reason.
    assert in_one_episode(diagnosis, 100.0) == ""
    floor = floor_with_coloured_noise(diagnosis.fit, diagnosis, diagnosis.noise, None, 0.05)
    assert floor is diagnosis.measured


class Gantry(AbstractArm):
    """Two sliding joints that do not act on each other."""

    M1: Scalar = parameter(4.0, symbol="M1", unit="kg", lower=0.0)
    M2: Scalar = parameter(4.0, symbol="M2", unit="kg", lower=0.0)

    @property
    def joints(self) -> int:
        return 2

    def prismatic(self) -> tuple[bool, ...]:
        return (True, True)

    def workspace(self) -> np.ndarray:
        return np.zeros((1, 2))

    def mass_matrix(self, q):
        return jnp.diag(jnp.stack([self.M1, self.M2]))

    def bias(self, q, v):
        return jnp.zeros_like(q)


@pytest.mark.parametrize(("wave", "named"), [(0.1, True), (20.0, False)])
def test_an_episode_beside_a_larger_error_of_another_joint_is_no_reason(wave, named):
    """The second joint lacks a force at all times, which no parameter explains."""
    runs = []
    for first, second in ((pushed(1, push=6.0), pushed(3)), (pushed(2), pushed(4))):
        q, tau = (
            np.column_stack([getattr(x, name)[:, 0] for x in (first, second)])
            for name in ("q", "tau")
        )
        tau[:, 1] += wave * np.sin(2 * np.pi * 0.9 * first.time)
        runs.append(jaxid.Recording.from_arrays(first.time, q, tau, name=first.name))
    effects = [x for j in (1, 2) for x in (Viscous(j, 1.0), Coulomb(j, 1.0, smoothing=0.02))]
    loop = jaxid.ClosedLoop(Gantry(), Tracking(cutoff=10.0), tuple(effects), name="gantry")
    diagnosis = jaxid.diagnose(jaxid.fit(loop, runs, jaxid.OEM(progress=False)), catalogue=[])
    assert episode_of(diagnosis, 0) is not None
    assert episode_of(diagnosis, 1) is None
    assert in_one_episode(diagnosis, 0.05).startswith("on run_1 the error of joint 1") == named


@pytest.mark.parametrize("noise", ["white", "bursts"])
def test_noise_is_no_single_episode(noise):
    for seed in range(3, 7):
        assert episode_of(diagnosed(pushed(seed, noise=noise), pushed(10 + seed)), 0) is None
