"""Notes on values that a fit along the recorded motion estimated."""

import dataclasses
import re

import jax.numpy as jnp
import numpy as np
import pytest
from test_release import MASS, arctan, axis, recorded, tanh

import jaxid
from jaxid.discovery.remarks import remarks
from jaxid.discovery.step import Step
from jaxid.effects import Stribeck


@pytest.fixture(scope="module")
def fitted():
    """A fit with a free lead of friction, whose values tests replace."""
    return jaxid.fit(axis().free("lead1"), recorded(1, arctan), jaxid.OEM(progress=False))


def notes(fit, given=None, **values):
    """The notes on a fit with other values and deviations of a hundredth of a millisecond."""
    loop = fit.loop.with_values(**{"delay": 0.0, "lead1": 0.0, **values})
    covariance = 1e-10 * np.eye(len(fit.names))
    found = dataclasses.replace(fit, loop=loop, covariance=covariance)
    return " | ".join(remarks([Step("start", found, None, None)], given or axis(), {}))


@pytest.mark.parametrize(
    ("delay", "said", "unusual"),
    [
        (0.0005, "act 0.5 ± 0.01 ms later than recorded, which a sampled law, a bus or", False),
        # Half a sample of 4 ms, one and a half samples, three samples.
        (0.002, "act 2 ± 0.01 ms later than recorded, as if it is held", False),
        (0.006, "act 6 ± 0.01 ms later than recorded, which a sampled law, a bus or", False),
        (0.012, "act 12 ± 0.01 ms later than recorded, which a sampled law does not", True),
        (-0.001, "act 1 ± 0.01 ms earlier than recorded, which a sampled law does not", True),
    ],
)
def test_a_delay_is_told_with_its_cause(fitted, delay, said, unusual):
    told = notes(fitted, delay=delay)
    assert said in told
    assert ("check time stamps" in told) == unusual


def test_a_delay_as_given_is_not_told(fitted):
    assert "estimated to act" not in notes(fitted, delay=2e-5)
    given = axis().with_values(delay=0.0005)
    assert "estimated to act" not in notes(fitted, given, delay=0.0005)
    assert "2 ± 0.01 ms later than recorded, not 0.5 ms" in notes(fitted, given, delay=0.002)


def test_a_lead_below_the_time_constant_of_the_low_pass_is_its_work(fitted):
    # The cutoff of the axis is 20 Hz, so the time constant is 8 ms.
    told = notes(fitted, lead1=0.005)
    assert "by up to 8 ms at this cutoff" in told
    assert "soft constraints" not in told
    told = notes(fitted, lead1=0.0095)
    assert "soft constraints" in told
    assert "at this cutoff" not in told


def test_an_effect_with_uncertain_values_is_told_with_what_can_replace_it(fitted):
    loop = fitted.loop.add(Stribeck(joint=1, level=jnp.asarray(1.0), velocity=jnp.asarray(0.1)))

    def told(deviation):
        covariance = deviation**2 * np.eye(len(loop.names))
        fit = dataclasses.replace(fitted, loop=loop, covariance=covariance)
        steps = [
            Step("start", fit, None, None),
            Step("+", fit, None, None, added=loop.effects[-1]),
        ]
        return " | ".join(remarks(steps, axis(), {}))

    assert re.search(r"each value of stribeck on joint 1 is uncertain.*lead1.*the sum", told(2.0))
    assert "is uncertain" not in told(0.04)


def with_friction_by_load(ratio):
    """A recording of an axis with further friction, a multiple of the torque of its inertia."""
    plain = recorded(1, tanh)
    v = np.gradient(plain.q[:, 0], plain.time)
    a = np.gradient(v, plain.time)
    tau = plain.tau[:, 0] + ratio * np.abs(MASS * a) * tanh(v)
    return jaxid.Recording.from_arrays(plain.time, plain.q, tau, name="run")


@pytest.mark.parametrize(("ratio", "forbidden"), [(2.0, True), (0.8, False)])
def test_an_effect_that_needs_forbidden_values_is_told(ratio, forbidden):
    fit = jaxid.fit(axis(), with_friction_by_load(ratio), jaxid.OEM(progress=False))
    found = jaxid.diagnose(fit)
    assert found.ranking[0].key == ("load_dependent_friction", 1)
    assert found.ranking[0].possible is not forbidden
    said = " | ".join(remarks([Step("start", fit, None, found)], axis(), {}))
    told = re.search(
        r"load_dependent_friction on joint 1 would explain \d+ % of .* "
        r"alpha1 = ([\d.]+) ± ([\d.]+) \(bounds 0, 0\.95\)",
        said,
    )
    assert bool(told) == forbidden
    # The fit may absorb a part of it, but not so much that another value is said.
    assert not told or float(told[1]) == pytest.approx(ratio, rel=0.1)
