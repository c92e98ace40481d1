"""Mistakes in the data are named: made on purpose in recordings of the independent simulator."""

import dataclasses
import re
from pathlib import Path

import independent as sim
import jax.numpy as jnp
import numpy as np
import pytest
from loops import four_joints
from stories import recordings_of

import jaxid
from jaxid.effects import AbstractEffect, Motion
from jaxid.estimate.mistakes import at_limit, likely_mistake
from jaxid.parameters import Scalar, parameter

CLEAN = Path(jaxid.__file__).parent / "demo" / "clean"


@pytest.fixture(scope="module")
def clean():
    """Two recordings of a SCARA as they are."""
    return jaxid.read(CLEAN / "fit_1.csv", CLEAN / "fit_2.csv")


def spoilt(recordings, change):
    """Every recording with a mistake."""
    made = [dataclasses.replace(r, **change(r)) for r in recordings]
    return jaxid.Recordings.of(made)


MISTAKES = {
    "sign of joint 2": (
        lambda r: {"tau": r.tau * [1, -1]},
        "torque of joint 2 seems to have the wrong sign",
    ),
    "all signs": (lambda r: {"tau": -r.tau}, "torque of all joints seems to have the wrong sign"),
    "swapped": (lambda r: {"tau": r.tau[:, ::-1]}, r"torques \(or positions\) of joints 1 and 2"),
    "degrees": (
        lambda r: {"q": np.rad2deg(r.q)},
        "position of all joints seems to be in degrees, not",
    ),
    "noise alone": (
        lambda r: {"q": r.q * [1, 0] + 1e-4 * np.random.default_rng(1).normal(size=r.q.shape)},
        "joint 2 moves by",
    ),
    "still": (lambda r: {"q": r.q * [1, 0]}, "joint 2 moves by 0 only"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_named(clean, name):
    change, said = MISTAKES[name]
    assert re.search(said, likely_mistake(jaxid.scara(), spoilt(clean, change)))


# Sign of position, sign of torque and zero of the second joint of an arm under gravity.
OF_POSITION = {
    "position of joint 2 seems to have the wrong sign": (-1.0, 1.0, 0.0),
    "axis of joint 2 seems to point the other way": (-1.0, -1.0, 0.0),
    "position of joint 2 seems to be off by -90 degrees": (1.0, 1.0, -np.pi / 2),
}


@pytest.mark.parametrize("said", OF_POSITION)
def test_a_wrong_axis_or_zero_of_a_joint_is_named(elbow, said):
    loop, recordings = elbow
    sign, torque, zero = OF_POSITION[said]
    which = np.eye(loop.joints)[1]

    def change(r):
        q = r.q * np.where(which, sign, 1.0) + zero * which
        return {"q": q, "tau": r.tau * np.where(which, torque, 1.0)}

    assert likely_mistake(loop, recordings) == ""
    assert said in likely_mistake(loop, spoilt(recordings, change))


@pytest.fixture(scope="module")
def elbow():
    """An arm of four joints as in its URDF, and torque from Pinocchio along two motions."""
    pinocchio = pytest.importorskip("pinocchio")
    model = pinocchio.buildModelFromXML(four_joints())
    data = model.createData()
    rng, time = np.random.default_rng(4), 0.004 * np.arange(2500)
    made = []
    for name in ("one", "two"):
        rates = 2 * np.pi * rng.uniform(0.1, 0.5, (3, 4))
        q = 0.3 + np.sum([0.3 * np.sin(np.outer(time, w)) for w in rates], axis=0)
        v = np.gradient(q, time, axis=0)
        a = np.gradient(v, time, axis=0)
        tau = np.array([pinocchio.rnea(model, data, *x) for x in zip(q, v, a, strict=True)])
        tau = tau + 0.4 * v + 0.01 * np.abs(tau).max(axis=0) * rng.normal(size=tau.shape)
        made.append(jaxid.Recording.from_arrays(time, q, tau, name=name))
    return jaxid.serial(four_joints()), jaxid.Recordings.of(made)


class Fan(AbstractEffect):
    """A friction of the whole arm, with a smoothing and without a joint."""

    smoothing: Scalar = parameter(0.1, symbol="w", unit="rad/s", free=False, scale=0.1)
    level: Scalar = parameter(0.0, symbol="fan", unit="N·m", scale=0.1)

    def torque(self, motion: Motion):
        return self.level * jnp.tanh(motion.v / self.smoothing)


def test_an_effect_without_a_joint_may_have_a_smoothing(clean):
    change, said = MISTAKES["degrees"]
    assert re.search(said, likely_mistake(jaxid.scara().add(Fan()), spoilt(clean, change)))


def test_recordings_without_a_mistake_are_not_blamed(clean):
    assert likely_mistake(jaxid.scara(), clean) == ""


def test_what_is_no_mistake_is_not_named_as_one(clean):
    """Torque that has nothing to do with the motion."""
    rng = np.random.default_rng(0)
    noise = spoilt(clean, lambda r: {"tau": rng.normal(size=r.tau.shape)})
    assert likely_mistake(jaxid.scara(), noise) == ""


def test_a_fast_clock_is_named_if_the_bodies_are_known(clean):
    """The inertia that couples two joints is in no other term of the regression."""
    fitted = jaxid.fit(jaxid.scara(), clean, jaxid.OEM(progress=False)).loop
    known = fitted.hold("ZZ1r", "ZZ2", "MX2", "MY2")
    fast = spoilt(clean, lambda r: {"time": r.time / 2})
    assert "twice as fast" in likely_mistake(known, fast)
    assert likely_mistake(known, clean) == ""


def test_a_missing_spring_is_not_named_as_a_wrong_sign(clean):
    """At one frequency a spring is the same as an inertia of the wrong sign."""
    motion, sprung = clean[0], []
    q = np.stack([0.4 * np.sin(5 * motion.time), 0.5 * np.sin(5 * motion.time + 1)], axis=1)
    v, a = (np.gradient(x, motion.time, axis=0) for x in (q, np.gradient(q, motion.time, axis=0)))
    tau = 3.5 * a * [1, 0] + 0.06 * a * [0, 1] + 200 * q + 0.1 * v
    for name, part in (("one", slice(0, 500)), ("other", slice(500, 1000))):
        time = motion.time[part]
        sprung.append(jaxid.Recording.from_arrays(time, q[part], tau[part], name=name))
    assert likely_mistake(jaxid.scara(), jaxid.Recordings.of(sprung)) == ""


@pytest.mark.parametrize(
    ("case", "blamed"),
    [
        ({"controller": sim.PD(Kp=(3.0, 156.25))}, True),
        ({"effects": ["gravity"], "multiple": 20.0}, False),
        ({"effects": ["joint_elasticity"], "multiple": 20.0}, False),
    ],
)
def test_the_law_is_doubtful_only_if_the_arm_is_described_without_it(case, blamed):
    recordings, _ = recordings_of(sim.make_case(5, duration=8.0, **case))
    fit = jaxid.fit(jaxid.scara(), recordings)
    assert fit.error_percent.to_numpy().max() > 20
    assert any("without the law" in note for note in fit.notes) == blamed
    assert fit.mistake == ""


def test_a_torque_that_is_often_at_its_largest_value_is_named(clean):
    top = 0.5 * max(np.abs(r.tau[:, 1]).max() for r in clean)
    limited = spoilt(clean, lambda r: {"tau": np.clip(r.tau, [-np.inf, -top], [np.inf, top])})
    assert at_limit(clean) == ""
    assert re.fullmatch("the torque of joint 2 is at its .* may be at its limit", at_limit(limited))


def test_a_limited_torque_that_the_motion_does_not_explain_is_a_mistake(clean):
    """The motion is that of the torque before the limit."""
    unknown = dataclasses.replace(jaxid.scara(), controller=jaxid.control.Tracking())
    for share, is_named in ((0.05, True), (0.8, False)):
        top = [share * max(np.abs(r.tau[:, j]).max() for r in clean) for j in range(2)]
        limited = spoilt(clean, lambda r, top=top: {"tau": np.clip(r.tau, -np.array(top), top)})
        found = jaxid.fit(unknown, limited, jaxid.OEM(progress=False))
        assert ("is at its largest value in" in found.mistake) == is_named


def test_torque_that_has_nothing_to_do_with_the_motion_is_a_mistake(clean):
    unknown = dataclasses.replace(jaxid.scara(), controller=jaxid.control.Tracking())
    rng = np.random.default_rng(0)
    noise = spoilt(clean, lambda r: {"tau": rng.normal(size=r.tau.shape)})
    found = jaxid.fit(unknown, noise, jaxid.OEM(progress=False))
    assert "explains nothing of the torque" in found.mistake


def test_a_fit_names_the_mistake_first(clean):
    change, said = MISTAKES["swapped"]
    unknown = dataclasses.replace(jaxid.scara(), controller=jaxid.control.Tracking())
    found = jaxid.fit(unknown, spoilt(clean, change), jaxid.OEM(progress=False))
    assert re.search(said, found.mistake)
    assert found.notes[0] == found.mistake
    assert found.to_dict()["mistake"] == found.mistake
    diagnosed = repr(jaxid.diagnose(found, progress=False))
    assert re.search(f"{said}.*correct this first", diagnosed.splitlines()[0])


def test_no_effect_is_searched_before_a_mistake_is_corrected(clean):
    change, said = MISTAKES["sign of joint 2"]
    unknown = dataclasses.replace(jaxid.scara(), controller=jaxid.control.Tracking())
    story = jaxid.discover(unknown, spoilt(clean, change), progress=False)
    assert story.verdict == "undetermined"
    assert len(story.steps) == 1
    assert re.search(f"{said}.*no effect was searched", story.reason)


PENDULUM = """<robot name="pendulum"><link name="base"/><link name="rod"><inertial>
<origin xyz="0 0 -0.4"/><mass value="2.0"/>
<inertia ixx="0.05" iyy="0.05" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="pivot" type="continuous"><parent link="base"/><child link="rod"/>
<axis xyz="0 1 0"/></joint></robot>"""
INERTIA, WEIGHT = 0.05 + 2.0 * 0.4**2, 2.0 * 9.81 * 0.4


def swung(seed: int, faster: float = 1.0, times: float = 1.0, zero: float = 0.0) -> jaxid.Recording:
    """A pendulum moved by sines, with a clock that is `faster`, and inertia `times` the drawn one.

    It hangs at `zero`, and according to the file at 0.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 10.0, 0.005)
    sizes, rates, phases = np.array([0.5, 0.2]), np.array([2.0, 5.1]), rng.uniform(0, 6, 2)
    q, v, a = (
        (sizes * rates**k * np.sin(rates * time[:, None] + phases + k * np.pi / 2)).sum(axis=1)
        for k in range(3)
    )
    tau = times * INERTIA * a + WEIGHT * np.sin(q - zero) + 0.2 * v + 0.3 * np.tanh(v / 0.01)
    tau = tau + 0.03 * rng.normal(size=len(time))
    return jaxid.Recording.from_arrays(time / faster, q[:, None], tau[:, None], name=f"run{seed}")


@pytest.mark.parametrize(
    ("faster", "times", "share"),
    [(1.0, 1.0, None), (2.0, 1.0, 0.25), (1.0, 0.7, None), (1.0, 3.0, None), (1.0, 0.4, 0.4)],
)
def test_bodies_much_lighter_than_drawn_are_doubtful(faster, times, share):
    """A wrong clock does not raise the error if bodies are estimated."""
    runs = [swung(seed, faster, times) for seed in (1, 2)]
    found = jaxid.fit(jaxid.serial(PENDULUM, bodies="free"), runs, jaxid.OEM(progress=False))
    assert found.error_percent.to_numpy().max() < 3
    if share is None:
        assert found.mistake == ""
        return
    said = re.fullmatch(
        "the estimated inertia is (.*) of that of the bodies in the file: .*", found.mistake
    )
    assert float(said.group(1)) == pytest.approx(share, rel=0.05)
    assert "clock" in found.mistake


@pytest.mark.parametrize("zero", [0.0, 0.3, 1.5])
def test_another_zero_position_contradicts_the_drawn_bodies(zero):
    runs = [swung(seed, zero=zero) for seed in (1, 2)]
    found = jaxid.fit(jaxid.serial(PENDULUM, bodies="free"), runs, jaxid.OEM(progress=False))
    assert found.error_percent.to_numpy().max() < 3
    assert ("zero positions" in found.mistake) == (zero > 1)
    if not zero > 1:
        return
    story = jaxid.discover(jaxid.serial(PENDULUM, bodies="free"), runs, progress=False)
    assert story.verdict == "undetermined"
    assert "start from the estimated bodies" in story.reason


GANTRY = """<robot name="gantry"><link name="base"/><link name="bridge"><inertial>
<mass value="5.0"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="cart"><inertial>
<mass value="2.0"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="along" type="prismatic"><parent link="base"/><child link="bridge"/>
<axis xyz="1 0 0"/><limit lower="-2" upper="2" effort="900" velocity="9"/></joint>
<joint name="across" type="prismatic"><parent link="bridge"/><child link="cart"/>
<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="900" velocity="9"/></joint></robot>"""


def slid(seed: int, units: tuple[float, float]) -> jaxid.Recording:
    """A gantry moved by sines; its positions are multiplied by `units`."""
    rng = np.random.default_rng(seed)
    time, rates = np.arange(0.0, 10.0, 0.005), np.array([2.0, 5.1])
    phases = rng.uniform(0, 6, (2, 2))
    q, v, a = (
        np.sum(0.3 * rates**k * np.sin(rates * time[:, None, None] + phases + k * np.pi / 2), -1)
        for k in range(3)
    )
    tau = a * [7.0, 2.0] + 3.0 * v + np.tanh(v / 0.01) + 0.1 * rng.normal(size=q.shape)
    return jaxid.Recording.from_arrays(time, q * units, tau, name=f"run{seed}")


SCARA = """<robot name="scara"><link name="base"/><link name="upper"><inertial>
<mass value="2.0"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="lower"><inertial><origin xyz="{centre} 0 0"/>
<mass value="2.0"/><inertia ixx="1" iyy="1" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
<axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="900" velocity="9"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/>
<origin xyz="0.8 0 0"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="900" velocity="9"/></joint></robot>"""


@pytest.mark.parametrize(("centre", "is_named"), [(0.08, True), (0.0, False)])
def test_another_robot_contradicts_the_small_torque_that_only_the_drawn_one_has(centre, is_named):
    """A gantry is an arm of which no body is off its axis; then nothing shows that it is none."""
    runs = [slid(seed, (1.0, 1.0)) for seed in (1, 2)]
    drawn = jaxid.serial(SCARA.format(centre=centre), bodies="free")
    found = jaxid.fit(drawn, runs, jaxid.OEM(progress=False))
    assert found.error_percent.to_numpy().max() < 4
    assert ("that the file describes this robot" in found.mistake) == is_named


@pytest.mark.parametrize(("unit", "is_named"), [(1.0, False), (180 / np.pi, True)])
def test_one_joint_in_a_wrong_unit_contradicts_the_drawn_bodies(unit, is_named):
    """The mass of the cart alone moves the second joint, so it absorbs the unit."""
    runs = [slid(seed, (1.0, unit)) for seed in (1, 2)]
    found = jaxid.fit(jaxid.serial(GANTRY, bodies="free"), runs, jaxid.OEM(progress=False))
    assert found.error_percent.to_numpy().max() < 4
    assert ("check the unit of the position of joint 2 (" in found.mistake) == is_named
