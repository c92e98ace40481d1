"""Results that tests of several files look at: two discoveries with their search, a small fit."""

import dataclasses

import equinox as eqx
import independent as sim
import jax.numpy as jnp
import numpy as np
import pytest
from independent import effects as fx

import jaxid
from jaxid.discovery.asked import Asked
from jaxid.discovery.search import Search
from jaxid.discovery.step import Step
from jaxid.effects import AbstractEffect, Motion, Scene, on_joint
from jaxid.parameters import Scalar, parameter
from jaxid.storage.campaign import Campaign


def recordings_of(case: sim.Case) -> tuple[jaxid.Recordings, jaxid.Recordings]:
    made = {
        name: jaxid.Recording.from_arrays(r["time"], r["q"], r["tau"], q_ref=r["q_ref"], name=name)
        for name, r in case.recordings.items()
    }
    fit = jaxid.Recordings.of([made["fit_1"], made["fit_2"]])
    return fit, jaxid.Recordings.of(made["held_out"])


def floor_of(case: sim.Case, name: str = "held_out") -> np.ndarray:
    return np.asarray(case.recordings[name]["noise_floor_percent"])


class Bump(AbstractEffect):
    """A torque around one angle: height exp(-((q - place) / width)²)."""

    joint: int = eqx.field(static=True)
    height: Scalar = parameter(0.0, symbol="h", unit="N·m", scale=0.1)
    place: Scalar = parameter(0.0, symbol="place", unit="rad", scale=0.1, linear=False)
    width: Scalar = parameter(0.2, symbol="w", unit="rad", lower=0.01, scale=0.1, linear=False)

    def torque(self, motion: Motion):
        distance = (motion.q[self.joint - 1] - self.place) / self.width
        return on_joint(self.joint, self.height * jnp.exp(-(distance**2)), motion)


BUMP = fx.TorqueBump(joint=2, torque=0.06, angle=0.5, width=0.25)


@pytest.fixture(scope="session")
def bump_case() -> sim.Case:
    return sim.make_case(31, effects=[BUMP], noise="moderate", multiple=6.0, duration=12.0)


@pytest.fixture(scope="session")
def bump_story(bump_case) -> jaxid.Discovery:
    fit, held_out = recordings_of(bump_case)
    return jaxid.discover(jaxid.scara(), fit, held_out, progress=False)


@pytest.fixture(scope="session")
def offset_case() -> sim.Case:
    return sim.make_case(
        7, effects=[fx.TorqueOffset(joint=2, torque=0.03)], noise="strong", duration=12.0
    )


@pytest.fixture(scope="session")
def offset_story(offset_case, tmp_path_factory):
    fit, held_out = recordings_of(offset_case)
    journal = tmp_path_factory.mktemp("journal") / "steps"
    story = jaxid.discover(jaxid.scara(), fit, held_out, resume=journal, progress=False)
    return story, journal


def with_chain(case: sim.Case, start: Step, *effects: AbstractEffect) -> list[Step]:
    """The starting step, and one more for each effect, all in the last one's loop."""
    plain = jaxid.OEM(start="given", progress=False)
    method = jaxid.SeparablePEM(plain, filters=start.diagnosis.noise)
    steps = [start]
    for effect in effects:
        loop = steps[-1].fit.loop.add(effect)
        fitted = jaxid.fit(loop, recordings_of(case)[0], method)
        added = fitted.loop.effects[-1]
        steps.append(dataclasses.replace(start, label="+", fit=fitted, added=added))
    return steps


def two_link_of(case: sim.Case) -> jaxid.ClosedLoop:
    """The two-link arm with the law of a case."""
    return jaxid.two_link(jaxid.control.PD(**dataclasses.asdict(case.controller)))


def search_of(case: sim.Case) -> Search:
    """A search that keeps nothing, before its start."""
    fit, held_out = recordings_of(case)
    asked = Asked(
        recordings=fit,
        held_out=held_out,
        method=jaxid.OEM(),
        catalogue=jaxid.catalogue,
        significance=0.01,
        worth=0.05,
        most=6,
    )
    return Search(asked, Campaign(None, {}), silent)


def scene_of(speed: float) -> Scene:
    """Of a joint with this highest speed, rad/s."""
    one = np.ones(1)
    return Scene(
        -one,
        one,
        speed * one,
        one,
        one,
        one,
        one,
        0.005,
        10.0,
        ("a",),
        ((),),
        (),
        0.0,
        (False,),
        (None,),
    )


def silent(*_: object, **__: object) -> None:
    """Says nothing."""


@pytest.fixture(scope="session")
def small_fit() -> jaxid.Fit:
    """A regression on forty samples of one joint: a fit in some ten thousand bytes."""
    t = np.linspace(0, 1, 40)
    q = 0.1 * np.sin(6 * t) + 0.02 * np.sin(17 * t)
    v = 0.6 * np.cos(6 * t) + 0.34 * np.cos(17 * t)
    a = -3.6 * np.sin(6 * t) - 5.78 * np.sin(17 * t)
    force = 95.0 * a + 200.0 * v + 20.0 * np.sign(v) + np.random.default_rng(0).normal(size=40)
    record = jaxid.Recording.from_arrays(t, q, force, q_ref=q, name="päper")
    method = jaxid.IDIM(jaxid.Filtering(cutoff=10.0, rate=40.0, trim=0.05))
    return jaxid.fit(jaxid.emps(), record, method)
