"""Searches along the recorded motion, for arms of many joints under a known law."""

import dataclasses
import re

import numpy as np
import pytest
from loops import four_joints, scara

import jaxid
from jaxid.control import PD, OpenLoop, Sampled, Tracking
from jaxid.discovery import alongside
from jaxid.discovery.alongside import along_recorded, in_the_loop
from jaxid.effects import JointElasticity

LAW = PD(Kp=[800.0, 600.0, 3000.0, 90.0], Kv=[80.0, 60.0, 300.0, 9.0])


def test_many_joints_are_searched_along_the_recorded_motion():
    loop = jaxid.serial(four_joints(), Sampled(LAW, every=1e-3, delay=2))
    along = along_recorded(loop)
    assert isinstance(along.controller, Tracking)
    # The torque of a tick is held for one period, after two more.
    assert float(along.controller.delay) == pytest.approx(2.5e-3)
    assert set(along.names) == {*loop.names, "delay"}
    continuous = along_recorded(dataclasses.replace(loop, controller=LAW)).controller
    assert isinstance(continuous, Tracking)
    assert float(continuous.delay) == 0.0


def test_loops_with_a_sampled_law_are_searched_along_the_recorded_motion():
    sampled = dataclasses.replace(scara(), controller=Sampled(scara().controller, every=1e-3))
    along = along_recorded(sampled)
    assert isinstance(along.controller, Tracking)
    assert float(along.controller.delay) == pytest.approx(0.5e-3)


@pytest.mark.parametrize(
    "loop",
    [
        scara(),
        jaxid.serial(four_joints()),
        jaxid.serial(four_joints(), OpenLoop()),
        jaxid.serial(four_joints(), LAW).add(JointElasticity(2, compliance=1e-3)),
    ],
)
def test_other_loops_are_unchanged(loop):
    assert along_recorded(loop) is loop


def test_an_interrupted_simulation_does_not_lose_the_result(monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(alongside, "compare", interrupted)
    monkeypatch.setattr(alongside, "needed_substeps", lambda *_: 1)
    loop = jaxid.serial(four_joints(), LAW)
    note = in_the_loop(loop, [along_recorded(loop)], moving())
    assert note.endswith("not known: the simulation was interrupted")


def moving() -> jaxid.Recordings:
    """A recording with a reference."""
    time = 0.004 * np.arange(300)
    q = 0.3 * np.sin(np.outer(time, [5.0, 7.0, 9.0, 11.0]) + np.array([0.1, 0.4, 0.9, 1.5]))
    return jaxid.Recordings.of(jaxid.Recording.from_arrays(time, q, q, q_ref=q, name="sines"))


def test_the_note_has_the_errors_of_the_simulated_loop():
    loop = jaxid.serial(four_joints(), LAW)
    asked = moving()[0]
    heavy = loop.with_values(Fc1=3.0)
    run = jaxid.simulate(heavy, asked)[0]
    record = jaxid.Recordings.of(dataclasses.replace(asked, q=run.q, tau=run.tau))
    note = in_the_loop(loop, [along_recorded(loop), along_recorded(heavy)], record)
    assert "on sines" in note
    last, first = (float(x) for x in re.findall(r"([-.\de]+) %", note))
    assert last < 0.01
    # The missing torque of joint 1, as a share of its torque; the others lack nothing.
    missing = np.sqrt(np.mean(np.tanh(run.v[:, 0] / 1e-3) ** 2)) * 3.0
    share = 100 * missing / np.sqrt(np.mean(run.tau[:, 0] ** 2)) / 4
    assert first == pytest.approx(share, rel=0.2)
    # Along the recorded motion a sign may be as sharp as the samples can tell.
    sharp = heavy.with_values(eps1=1e-30)
    alone = in_the_loop(loop, [along_recorded(sharp)], record)
    assert "starting model" not in alone
    (error,) = (float(x) for x in re.findall(r"([-.\de]+) %", alone))
    assert error < 0.5
