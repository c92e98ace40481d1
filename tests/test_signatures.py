"""Signatures: the linear response against a difference of two whole simulations."""

import independent as sim
import numpy as np
import pytest

import jaxid
from jaxid.discovery.linear import linearise
from jaxid.discovery.signatures import signatures
from jaxid.effects import (
    EncoderEccentricity,
    Gravity,
    JointElasticity,
    LoadDependentFriction,
    Spring,
    Stribeck,
    TorqueOffset,
)
from jaxid.simulate import prepare, set_substeps

LINES = sim.MultiSine(
    (((0.5, 2.0, 0.3), (0.2, 5.0, 1.0)), ((0.6, 3.0, 2.0), (0.2, 6.0, 0.5))), rise=1.0
)
SHAFT = JointElasticity(joint=1, compliance=2e-3, rotor=1.0)
WORN = LoadDependentFriction(joint=1, ratio=0.3)
SMALL = 1e-5
# Each at no amplitude, and with a small one.
PAIRS = {
    "offset": (TorqueOffset(1), TorqueOffset(1, SMALL)),
    "stribeck": (Stribeck(2, 0.0, 0.3), Stribeck(2, SMALL, 0.3)),
    "spring": (Spring(1), Spring(1, 0.0, SMALL)),
    "gravity": (Gravity(), Gravity((SMALL, 0.0))),
    "eccentricity": (EncoderEccentricity(2), EncoderEccentricity(2, SMALL)),
}


@pytest.fixture(scope="module")
def record():
    run = sim.simulate(sim.Scara(), LINES, sim.PD(), duration=1.5)
    return jaxid.Recording(run.time, run.q, run.tau, q_ref=run.q_ref)


@pytest.mark.parametrize("between", [(), (SHAFT,), (WORN,)], ids=["rigid", "elastic", "worn"])
def test_signature_is_the_derivative_of_a_simulation(record, between):
    """What acts on a link acts there also behind a transmission; what loads it, as a load."""
    loop = set_substeps(jaxid.scara().add(*between), 8)
    batch = prepare(loop, jaxid.Recordings.of(record))
    linear = linearise(loop, batch, "tau")
    proposed = [(none, 1.0) for none, _ in PAIRS.values()]
    hypotheses, table = signatures(loop, batch, linear, proposed, 0, lambda text: None)
    plain = jaxid.simulate(loop, record)[0].tau
    for hypothesis, (name, (_, some)) in zip(hypotheses, PAIRS.items(), strict=True):
        moved = jaxid.simulate(loop.add(some), record)[0].tau
        # A spring's second amplitude is its preload; of the others the first one was moved.
        column = hypothesis.columns[name == "spring"]
        expected = (np.asarray(moved) - np.asarray(plain)) / SMALL
        error = np.linalg.norm(table[0, ..., column] - expected) / np.linalg.norm(expected)
        # Torque goes as a line from sample to sample, which misses most where friction is steep.
        assert error < 2e-2, (name, error)
