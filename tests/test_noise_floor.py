"""The noise of recorded torque, told without a model of the robot."""

import dataclasses

import numpy as np
import pytest
import scipy

import jaxid
from jaxid.control import Tracking
from jaxid.discovery.floor import floor_of
from jaxid.noise import above_motion
from jaxid.simulation.batch import compared

RATE, DURATION = 250.0, 16.0


def axis(seed: int, noise: str = "white", level: float = 0.02, name: str = "axis"):
    """A slide with dry friction, its torque in closed form; the recording and its noise."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, DURATION, 1 / RATE)
    q, v, a = np.zeros((3, len(time)))
    for f, size in ((0.31, 0.3), (0.83, 0.1), (1.7, 0.03)):
        w = 2 * np.pi * f
        q += size * np.sin(w * time)
        v += size * w * np.cos(w * time)
        a -= size * w**2 * np.sin(w * time)
    clean = 2.0 * a + 0.8 * v + 1.5 * np.tanh(v / 0.005)
    white = rng.standard_normal(len(time))
    # Of the same power as white noise.
    pole = {"white": 0.0, "slight": 0.1, "coloured": 0.8}[noise]
    white = scipy.signal.lfilter([np.sqrt(1 - pole**2)], [1.0, -pole], white)
    errors = level * np.std(clean) * white
    tau = (clean + errors)[:, None]
    record = jaxid.Recording.from_arrays(time, q[:, None], tau, name=name)
    return record, errors[:, None]


def percent(noise, record, loop) -> np.ndarray:
    """The noise's share of the torque as it is compared, %."""
    left, whole = (compared(loop, [record], [x])[0] for x in (noise, record.tau))
    return 100 * np.linalg.norm(left, axis=0) / np.linalg.norm(whole, axis=0)


@pytest.fixture(scope="module")
def known():
    return jaxid.robots.emps()


def unknown(*records: jaxid.Recording) -> jaxid.ClosedLoop:
    law = Tracking().settled(records)
    return jaxid.robots.emps(law)


def test_white_noise_is_told_from_what_is_above_the_motion(known):
    ratios, inside = [], []
    for seed in range(12):
        record, noise = axis(seed)
        for loop in (known, unknown(record)):
            floor = floor_of(loop, jaxid.Recordings.of(record))
            assert floor is not None
            assert floor.sources == (("above the motion",),)
            truth = percent(noise, record, loop)
            ratios.append(floor.percent[0] / truth)
            inside.append((floor.low[0] < truth) & (truth < floor.high[0]))
    ratios = np.array(ratios)
    assert abs(np.median(ratios) - 1) < 0.05
    assert np.mean(abs(ratios - 1) < 0.15) > 0.9
    assert np.mean(inside) > 0.85


def test_coloured_noise_is_no_guide(known):
    told = [
        floor_of(known, jaxid.Recordings.of(axis(seed, "coloured")[0])).sources for seed in range(8)
    ]
    assert told == [(("",),)] * 8


def test_recordings_that_repeat_a_reference_tell_coloured_noise_as_well(known):
    ratios, inside = [], []
    for seed in range(12):
        pair = [axis(100 * k + seed, "coloured", name=f"run {k}") for k in (1, 2)]
        records = [record for record, _ in pair]
        for loop in (known, unknown(*records)):
            floor = floor_of(loop, jaxid.Recordings.of(records))
            assert floor.sources == (("repeats",), ("repeats",))
            truth = np.mean([percent(noise, record, loop) for record, noise in pair], axis=0)
            ratios.append(floor.percent[0] / truth)
            inside.append((floor.low[0] < truth) & (truth < floor.high[0]))
    assert abs(np.median(ratios) - 1) < 0.05
    assert np.mean(inside) > 0.85


def test_noise_that_is_coloured_in_other_recordings_is_no_guide(known):
    alone, together = [], []
    for seed in range(12):
        record, _ = axis(seed, "slight")
        rows = slice(0, 2000)
        signals = record.time[rows], record.q[rows], record.tau[rows]
        short = jaxid.Recordings.of(jaxid.Recording.from_arrays(*signals, name="short"))
        others = [axis(seed + 100 * k, "slight", name=f"run {k}")[0] for k in (1, 2)]
        alone.append(floor_of(known, short).sources)
        together.append(floor_of(known, short, others).sources)
    # A short recording alone does not always show it.
    assert alone.count((("above the motion",),)) > 2
    assert together == [(("",),)] * 12


def test_a_joint_that_never_moves_freely_tells_nothing():
    record, _ = axis(1)
    joint = np.ones((record.samples, 1), bool)
    for cutoff, moving in ((10.0, ~joint), (0.4 * RATE, joint)):
        # In the second case, samples hardly reach above the motion.
        told = above_motion(jaxid.Recordings.of(record), [cutoff], [moving], [1.0])
        assert told == [(None,)]


def test_bursts_of_other_recordings_widen_the_interval():
    """A recording may have no burst in the windows that are used, and many elsewhere."""
    inside = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        records, moving, errors = [], [], []
        for k in range(3):
            record, _ = axis(seed, level=0.0, name=str(k))
            speed = np.abs(np.gradient(record.q[:, 0], record.time))
            used = speed > 0.3 * speed.max()
            loud = np.repeat(rng.random(len(used) // 50 + 1) < 0.1, 50)[: len(used)]
            if k == 0:
                loud &= ~used
            noise = 0.1 * rng.standard_normal(len(used)) * np.where(loud, 2.5, 0.65)
            records.append(dataclasses.replace(record, tau=record.tau + noise[:, None]))
            moving.append(used[:, None])
            errors.append(float(np.sqrt(np.mean(noise**2))))
        ((first,), *_) = above_motion(jaxid.Recordings.of(records), [4.0] * 3, moving, [1.0] * 3)
        if first is not None:
            assert first.value < errors[0]
            inside.append(first.low <= errors[0] <= first.high)
    assert len(inside) >= 10
    assert np.mean(inside) > 0.9
