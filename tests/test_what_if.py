"""An effect set by sliders: the linear system's answer, compared with simulations and refits."""

import dataclasses

import numpy as np
import pytest
from stories import recordings_of

import jaxid
from jaxid.discovery.what_if import WhatIf
from jaxid.errors import ModelError

pytestmark = pytest.mark.xdist_group("offset")
SOME = (jaxid.effects.TorqueOffset, jaxid.effects.Stribeck, jaxid.effects.Spring)


@pytest.fixture(scope="module")
def start(offset_story):
    """The starting model, which lacks an offset of 0.03 N·m on joint 2."""
    return offset_story[0].steps[0].fit


@pytest.fixture(scope="module")
def held_out(offset_case):
    return recordings_of(offset_case)[1]


@pytest.fixture(scope="module")
def what_if(start, held_out):
    return WhatIf.of(start, held_out, SOME)


def test_without_an_effect_it_is_the_fit(what_if, start, held_out):
    answer = what_if.answer(None)
    expected = np.sqrt((start.error_percent**2).mean().to_numpy())
    assert answer.fitted_percent == pytest.approx(expected, rel=1e-6)
    beyond = jaxid.compare(start, held_out)
    assert answer.held_out_percent == pytest.approx(beyond.error_percent.to_numpy()[0], rel=1e-3)
    seen = what_if.seen(held_out=True)
    assert seen.names == ("held_out",)
    (measured,) = (r.tau for r in held_out)
    assert seen.measured[seen.there] == pytest.approx(measured)
    assert seen.simulated[seen.there] == pytest.approx(np.asarray(beyond.runs[0].tau), abs=1e-3)


def test_an_effect_of_no_size_changes_nothing(what_if):
    nothing, none = what_if.answer(jaxid.effects.Spring(joint=2)), what_if.answer(None)
    assert nothing.fitted == pytest.approx(none.fitted, abs=1e-12)
    assert nothing.held_out == pytest.approx(none.held_out, abs=1e-12)


@pytest.mark.parametrize("beyond", [False, True], ids=["fitted", "held out"])
def test_the_answer_is_that_of_a_simulation_for_small_effects(what_if, start, held_out, beyond):
    recordings = held_out if beyond else start.recordings
    off = []
    for size in (0.04, 0.02):
        effect = jaxid.effects.Spring(joint=2, stiffness=size, preload=0.0)
        answer, nothing = what_if.answer(effect, again=False), what_if.answer(None)
        rest = [x.held_out if beyond else x.fitted for x in (answer, nothing)]
        predicted = (rest[1] - rest[0])[what_if.seen(beyond).there]
        runs = [
            jaxid.compare(dataclasses.replace(start, loop=loop), recordings).residuals
            for loop in (start.loop.add(effect), start.loop)
        ]
        simulated = np.concatenate(runs[1]) - np.concatenate(runs[0])
        off.append(np.linalg.norm(predicted - simulated) / np.linalg.norm(simulated))
    assert off[0] < 0.05
    # It is the first term of a series: half the effect, half the relative error.
    assert off[1] < 0.6 * off[0]


@pytest.mark.parametrize("size", [0.02, 0.008])
def test_with_its_parameters_estimated_again_it_is_a_refit(what_if, start, size):
    effect = jaxid.effects.TorqueOffset(joint=2, level=size)
    predicted = (what_if.answer(None).fitted - what_if.answer(effect).fitted)[what_if.seen().there]
    loop = start.loop.add(effect)
    held = loop.hold(*(name for name in loop.names if name not in start.loop.names))
    oem = dataclasses.replace(start.method.oem, start="given")
    fit = jaxid.fit(held, start.recordings, dataclasses.replace(start.method, oem=oem))
    found = np.concatenate(start.residuals) - np.concatenate(fit.residuals)
    off = np.linalg.norm((predicted - found)[..., 1]) / np.linalg.norm(found[..., 1])
    # A fit filters the first samples too, whose past is not known; the answer leaves them out.
    assert off < 0.1


def test_the_best_values_are_those_of_the_simulator(what_if):
    best = what_if.best(jaxid.effects.TorqueOffset(joint=2))
    assert float(best.level) == pytest.approx(0.03, abs=0.003)
    (low, high) = what_if.ranges(best)["offset2"]
    assert low < -0.03 < 0.03 < high


def test_an_explorer_follows_its_sliders(start, held_out):
    pytest.importorskip("ipywidgets", reason="the extra `notebook` is not installed")
    pytest.importorskip("anywidget", reason="the extra `notebook` is not installed")
    explorer = jaxid.explore(start, held_out, catalogue=SOME)
    explorer.choose("torque_offset", 2)
    explorer.move(offset2=0.03)
    assert float(explorer.effect.level) == pytest.approx(0.03)
    expected = WhatIf.of(start, held_out, SOME).answer(explorer.effect)
    assert explorer.answer.held_out_percent == pytest.approx(expected.held_out_percent)
    # The figure shows measured torque less what is left, of the joint that the effect is on.
    lines = {trace.name: np.asarray(trace.y) for trace in explorer.figure.data}
    (record,) = held_out
    assert lines["measured"] == pytest.approx(record.tau[:, 1], abs=1e-5)
    rest = lines["residual with the effect"]
    assert rest == pytest.approx(expected.held_out[0, : record.samples, 1], abs=1e-5)
    assert lines["with the effect"] == pytest.approx(record.tau[:, 1] - rest, abs=1e-5)
    with pytest.raises(ModelError, match="there is no slider Fs2: there are offset2"):
        explorer.move(Fs2=1.0)
    with pytest.raises(ModelError, match="drive_gain on joint 1 is not in the list"):
        explorer.choose("drive_gain", 1)
    explorer.refit()
    assert explorer.fit.names[-1] == "offset2"
    assert float(explorer.fit.theta[-1]) == pytest.approx(0.03, abs=0.003)
