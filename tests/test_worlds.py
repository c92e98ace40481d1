"""The worlds of the benchmark: what is simulated, logged and marked."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]


def test_worlds_tell_what_a_logger_aliases():
    """A line above half the logger's rate appears at their difference, and belongs to the noise."""
    if not (ROOT / "benchmarks").is_dir():
        pytest.skip("no benchmarks beside the tests: they are part of a checkout alone")
    from benchmarks._world_cases import _recorded, unexplained
    from benchmarks._world_simulation import Signals

    time = np.arange(20000) / 1000
    motion, chatter = np.sin(2 * np.pi * 3 * time), 0.1 * np.sin(2 * np.pi * 305 * time)
    still = np.zeros((len(time), 1))
    run = Signals(time, still, (motion + chatter)[:, None], still, still)
    ticks = np.arange(0, len(time), 4)
    seen = _recorded(np.random.default_rng(1), run, ticks, 250, np.array([0.01]), "white")
    middle = slice(500, -500)
    expected = (chatter[::4])[middle]
    np.testing.assert_allclose(seen["aliased"][middle, 0], expected, atol=1e-4)
    line = np.abs(np.fft.rfft(seen["aliased"][middle, 0]))
    assert np.fft.rfftfreq(len(expected), 1 / 250)[np.argmax(line)] == pytest.approx(55, abs=0.1)
    left = seen["tau"] - motion[::4, None] - unexplained(seen, along_motion=True)
    assert abs(left[middle]).max() < 1e-4
    np.testing.assert_array_equal(unexplained(seen, along_motion=False), seen["noise"])


def _moved(part, speed, seconds: float, tau: float = 0.0) -> list[float]:
    """Torque of a part of a world along a motion of joint 1 that is given by its speed."""
    part.reset()
    step, q, torques = 1e-4, 0.0, []
    for k in range(round(seconds / step)):
        q += step * speed(k * step)
        torques.append(part.torque(k * step, [q], [speed(k * step)], [tau], step))
    return torques


def test_parts_of_worlds_have_the_torque_of_their_closed_forms():
    if not (ROOT / "benchmarks").is_dir():
        pytest.skip("no benchmarks beside the tests: they are part of a checkout alone")
    from benchmarks import _world_departures as departures
    from benchmarks._world_physics import Friction, draw_robot

    # Sliding bristles have the force of Armstrong-Hélouvry's curve, and begin as a spring.
    bristles = departures.Bristles(0, 2.0, 0.001, 0.0, 0.5, 0.05)
    torques = _moved(bristles, lambda _: 0.04, 0.5)
    assert torques[-1] == pytest.approx(2.0 * (1 + 0.5 * np.exp(-((0.04 / 0.05) ** 2))), rel=1e-6)
    assert torques[0] == pytest.approx(2.0 * 0.04 * 1e-4 / 0.001, rel=0.01)
    friction = Friction(0.1, 2.0, "tanh", 1e-3)
    rng = np.random.default_rng(3)
    one, robot = np.ones(1), draw_robot(rng, "axis")
    (peak,) = departures.draw_world(rng, "peak", robot, (friction,), one, one, one, 9.0).beside
    fall = np.exp(-((0.04 / peak.drawn["velocity"]) ** peak.drawn["exponent"]))
    assert _moved(peak, lambda _: 0.04, 0.01)[-1] == pytest.approx(peak.size * fall)
    assert 0.2 <= peak.size / friction.coulomb <= 0.8
    # Load and temperature multiply: 20 % by twice the load, -10 % after ten time constants.
    both = departures.LoadAndHeat(0, friction, 3.0, 0.1, -0.1, 0.05)
    torques = _moved(both, lambda _: 0.04, 0.5, tau=-6.0)
    assert torques[0] == pytest.approx(2.0 * 0.2)
    assert torques[-1] == pytest.approx(2.0 * (1.2 * 0.9 - 1.0), rel=1e-3)
    # A slow motion carries the mass along; at its own frequency it moves further than the joint.
    small = departures.Resonance(0, 0.3, 20.0, 0.02)
    slow = np.array(_moved(small, lambda t: np.sin(2 * np.pi * t), 4.0))
    expected = 0.3 * 2 * np.pi * np.cos(2 * np.pi * 1e-4 * np.arange(len(slow)))
    assert np.std((slow - expected)[20000:]) < 0.02 * np.std(expected)
    fast = np.array(_moved(small, lambda t: np.sin(2 * np.pi * 20 * t), 4.0))
    resonant = 0.3 * 2 * np.pi * 20 / (2 * 0.02)
    assert np.max(np.abs(fast[-1000:])) == pytest.approx(resonant, rel=0.03)


def test_worlds_leave_the_plain_cases_as_they_are_and_log_what_they_say():
    pytest.importorskip("mujoco")
    if not (ROOT / "benchmarks").is_dir():
        pytest.skip("no benchmarks beside the tests: they are part of a checkout alone")
    from benchmarks._world_cases import draw_wanted
    from benchmarks._world_departures import WORLDS, logged_ticks

    plain = draw_wanted(3, 60, ("unknown",))
    drawn = draw_wanted(3, 60, ("unknown",), world="any")
    assert {w.world for w in drawn} == set(WORLDS)
    assert {w.world for w in plain} == {"plain"}
    assert [w for w in drawn if w.world == "plain"] == [
        p for p, w in zip(plain, drawn, strict=True) if w.world == "plain"
    ]
    assert any(w.robot == "elbow" for w in drawn)
    assert all(w.noise == "drifting" for w in drawn if w.world == "drift")
    rng = np.random.default_rng(2)
    np.testing.assert_array_equal(logged_ticks(rng, 20, 5, uneven=False), [0, 5, 10, 15])
    ticks = logged_ticks(rng, 20000, 5, uneven=True)
    assert np.all(np.diff(ticks) > 0)
    assert set((ticks % 5).tolist()) == {0, 1}
    # A stretch of 0.1 s, and one of a hundred.
    assert np.max(np.diff(ticks)) >= 100
    assert 3900 < len(ticks) < 3970


@pytest.mark.parametrize("world", ["lugre", "delay", "jitter", "resonance"])
def test_a_world_acts_in_the_recordings(world, tmp_path):
    """The recorded torque is that of the law a world says, on a body of one joint."""
    pytest.importorskip("mujoco")
    if not (ROOT / "benchmarks").is_dir():
        pytest.skip("no benchmarks beside the tests: they are part of a checkout alone")
    from benchmarks._world_cases import make, read_case
    from benchmarks.worlds import Wanted, judge

    wanted = Wanted(0, "clean", 5, (), "axis", "tanh", "white", "unknown", None, world)
    case = make(wanted)
    fitting, unseen = read_case(tmp_path, case)
    assert (len(fitting), len(unseen)) == (2, 1)
    missing = [np.max(np.diff(r.time)) > 5 * np.median(np.diff(r.time)) for r in fitting]
    assert all(missing) == (world == "jitter")
    assert case.law.delay == 0 if world != "delay" else case.law.delay in (1, 2, 3, 4)
    names = {"lugre": "hysteresis", "delay": "time_delay", "resonance": "joint_elasticity"}
    story = {
        "added": [
            {"effect": name, "joint": 1, "indistinguishable": [], "probability": 1.0}
            for name in (names.get(world), "spring")
            if name
        ],
        "verdict": "explained",
        "notes": [],
        "error_percent": {"after": {"validate": [1.0]}},
    }
    assert judge(case, wanted, story, np.ones(1))["alarm"]
    story["added"] = story["added"][:-1]
    assert not judge(case, wanted, story, np.ones(1))["alarm"]
    assert judge(case, wanted, story, np.ones(1))["right"]


def test_an_effect_that_describes_the_world_is_no_alarm_of_another_tool():
    for module in ("mujoco", "pinocchio", "pysindy", "gplearn", "sklearn"):
        pytest.importorskip(module)
    if not (ROOT / "benchmarks").is_dir():
        pytest.skip("no benchmarks beside the tests: they are part of a checkout alone")
    from benchmarks import baselines
    from benchmarks._baseline_tools import Found

    kind = "clean", 5, (), "axis", "tanh", "white", "unknown", None, "peak"
    wanted, case = baselines.Wanted(0, *kind), SimpleNamespace(hidden=())

    def alarm(missing: bool, *named: str) -> bool:
        found = Found(tuple((name, 1) for name in named), missing, lambda _: np.zeros(1))
        marks = baselines.judge(case, wanted, found)
        assert marks["right"] != marks["alarm"]
        return marks["alarm"]

    assert not alarm(False)
    assert not alarm(True, "stribeck")
    assert alarm(True, "stribeck", "spring")
    # A tool without names only says that something is missing.
    assert alarm(True)


def test_a_world_whose_effect_does_not_act_is_drawn_again():
    pytest.importorskip("mujoco")
    if not (ROOT / "benchmarks").is_dir():
        pytest.skip("no benchmarks beside the tests: they are part of a checkout alone")
    from benchmarks import _world_cases as cases
    from benchmarks._world_simulation import Signals, Undrawable

    rng = np.random.default_rng(1)
    robot = cases.draw_robot(rng, "axis")
    friction = cases.Friction(1.0, 1.0, "tanh", 0.01)
    still = np.zeros((1000, 1))
    run = Signals(np.arange(1000) / 1000, still, still, still, still)
    wanted = cases.Wanted(0, "single", 1, ("end_stop",), "axis", "tanh", "white", "unknown")
    one = np.ones(1)
    with pytest.raises(Undrawable, match="end_stop on joint 1 does not act"):
        cases._hidden(rng, wanted, robot, (friction,), one, 1.0, run, one)
