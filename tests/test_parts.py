"""Optional parts of added effects, left out of the final fit if they explain too little."""

import dataclasses

import numpy as np
import pytest
from test_release import arctan, axis, recorded

import jaxid
from jaxid.discovery.fits import Fits
from jaxid.discovery.models import Model
from jaxid.discovery.parts import without_parts
from jaxid.discovery.verify import Refits
from jaxid.effects import PositionDependentFriction, Spring
from jaxid.noise import ARFilter
from jaxid.storage.campaign import Campaign

NOISE, TURN = 0.05, 0.5
# cos and sin of the first and of the second harmonic, N, in the directions of a torque.
ONCE, BOTH = (0.4, -0.2, 0.0, 0.0), (0.4, -0.2, 0.15, 0.1)


def varying(seed: int, sizes: tuple[float, ...]) -> jaxid.Recording:
    """An axis whose friction varies along its travel."""
    record = recorded(seed, arctan, noise=NOISE)
    angle = 2 * np.pi / TURN * record.q[:, 0]
    waves = np.cos(angle), np.sin(angle), np.cos(2 * angle), np.sin(2 * angle)
    wave = sum(size * x for size, x in zip(sizes, waves, strict=True))
    sign = arctan(np.gradient(record.q[:, 0], record.time))
    return dataclasses.replace(record, tau=record.tau + (wave * sign)[:, None])


def final(loop: jaxid.ClosedLoop, runs: list[jaxid.Recording]) -> jaxid.Fit:
    fit = jaxid.fit(loop, runs, jaxid.OEM(progress=False))
    noise = (ARFilter(np.zeros(0), NOISE),)
    fits = Fits(Refits(jaxid.Recordings.of(runs), jaxid.OEM()), Campaign(None, {}))
    model = Model(fit.loop.effects[-1:], 0.0, noise=noise, fit=fit)
    return without_parts(fits, model)


@pytest.mark.parametrize("sizes", [ONCE, BOTH])
def test_a_harmonic_that_is_not_there_is_left_out(sizes):
    loop = axis().without("torque_offset").add(PositionDependentFriction(joint=1, turn=TURN))
    found = final(loop, [varying(1, sizes), varying(2, sizes)])
    second = {"FA2_1", "FB2_1"}
    assert (second <= set(found.names)) == (sizes is BOTH)
    assert found.loop.held_names == (set() if sizes is BOTH else second)
    said = [n for n in found.notes if "held at zero" in n]
    assert len(said) == (sizes is ONCE)
    for name, size in zip(("FA1_1", "FB1_1", "FA2_1", "FB2_1"), sizes, strict=True):
        if name in found.names:
            at = found.names.index(name)
            assert abs(found.theta[at] - size) < 4 * found.std[at]
        else:
            assert float(getattr(found.loop.effects[-1], name[1:3])) == 0.0


def test_a_preload_that_an_offset_replaces_is_left_out():
    """The recordings do not determine both; the stiffness stays."""
    runs = [recorded(seed, arctan, spring=8.0, noise=NOISE) for seed in (1, 2)]
    found = final(axis().add(Spring(joint=1)), runs)
    assert found.loop.held_names == {"kq0_1"}
    at = found.names.index("k1")
    assert abs(found.theta[at] - 8.0) < 4 * found.std[at]
    assert found.undetermined == ()
