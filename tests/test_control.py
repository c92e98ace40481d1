"""Controllers against the independent simulator, and against the laws they state."""

import dataclasses
import math
from functools import cache

import equinox as eqx
import independent as sim
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy

import jaxid
from jaxid.control import PD, PID, AbstractController, Cascade, OpenLoop, Sampled, Tracking
from jaxid.effects import Motion
from jaxid.errors import ModelError, RecordingError
from jaxid.simulation.loads import inverse

GAINS = {"Kp": (6.25, 156.25), "Kv": (2.0, 25.0), "Kg": (3.5, 0.06)}
# Lines of at most 6 rad/s, faded in within 1 s.
LINES = sim.MultiSine(
    (((0.5, 2.0, 0.3), (0.2, 5.0, 1.0)), ((0.6, 3.0, 2.0), (0.2, 6.0, 0.5))), rise=1.0
)
MOVES = sim.Trapezoid(((0.05, 0.05, 0.2, 3.0), (0.5, -0.03, 0.25, 4.0)))


def recorded(run, **options):
    """A run of the independent simulator as a recording."""
    return jaxid.Recording(run.time, run.q, run.tau, q_ref=run.q_ref, **options)


def with_plant(loop, plant, **settings):
    """The loop with the independent plant's values."""
    joints = range(1, loop.joints + 1)
    values = {}
    values |= {f"eps{j}": 1 / plant.gamma for j in joints}
    for j, (fv, fc) in zip(joints, plant.friction_parameters(), strict=True):
        values |= {f"Fv{j}": fv, f"Fc{j}": fc}
    values |= {name: getattr(plant, name) for name in loop.names if hasattr(plant, name)}
    if "offset1" in loop.names:
        values["offset1"] = plant.offset
    return dataclasses.replace(loop.with_values(**values), **settings)


def scara_under(controller, substeps=8, **settings):
    """The SCARA of the independent plant, in steps that are short next to any tolerance."""
    stepping = jaxid.Stepping(substeps=substeps)
    return with_plant(jaxid.scara(controller), sim.Scara(), stepping=stepping, **settings)


def gap(ours, theirs):
    """Difference in norm, relative, joint by joint."""
    return np.linalg.norm(ours - theirs, axis=0) / np.linalg.norm(theirs, axis=0)


@cache
def pd_run():
    """The independent SCARA under its PD law, 2 s."""
    return sim.simulate(sim.Scara(), LINES, sim.PD(), duration=2.0)


@cache
def pd_simulated():
    """jaxid's counterpart."""
    return jaxid.simulate(scara_under(PD(**GAINS)), recorded(pd_run()))[0]


# --- PD ---------------------------------------------------------------------------------------


def test_pd_agrees_with_the_independent_one():
    run, ours = pd_run(), pd_simulated()
    # The reference between samples is a spline: (10 ms)^4/384 times 6^4 · 0.2 rad/s^4 is 7e-9 rad
    # in the middle of the lines, and more where the fading's third derivative jumps, 60 rad/s³:
    # (10 ms)³/24 · 60 is 2e-6 rad for some samples. Gains of 22 and 9 N·m/rad make 5e-5 N·m of it.
    assert np.all(gap(ours.tau, run.tau) < 1e-5)
    np.testing.assert_allclose(ours.tau, run.tau, atol=5e-5)
    np.testing.assert_allclose(ours.q, run.q, atol=1e-6)
    np.testing.assert_allclose(ours.v, run.v, atol=2e-5)
    np.testing.assert_allclose(ours.a, run.a, atol=1e-3)


def test_pd_command_is_its_law():
    run, ours = pd_run(), pd_simulated()
    law = np.multiply(GAINS["Kg"], GAINS["Kp"]) * (run.q_ref - ours.q)
    law -= np.multiply(GAINS["Kg"], GAINS["Kv"]) * ours.v
    np.testing.assert_allclose(ours.tau, law, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(ours.tau, ours.delivered)


def test_gains_default_and_become_vectors():
    law = PD(Kp=3.0, Kv=[1.0])
    assert law.Kp.shape == law.Kv.shape == law.Kg.shape == (1,)
    assert float(law.Kg[0]) == 1.0


def test_known_torque_is_added():
    run = pd_run()
    pulse = np.where((run.time > 0.5) & (run.time < 0.6), 1.0, 0.0)[:, None] * (0.5, 0.0)
    loop = scara_under(PD(**GAINS))
    (ours,) = jaxid.simulate(loop, recorded(run, tau_ff=pulse))
    law = np.multiply(GAINS["Kg"], GAINS["Kp"]) * (run.q_ref - ours.q)
    law -= np.multiply(GAINS["Kg"], GAINS["Kv"]) * ours.v
    np.testing.assert_allclose(ours.tau, law + pulse, rtol=0, atol=1e-12)
    assert np.abs(ours.q - pd_simulated().q).max() > 1e-3


# --- sampled PD -------------------------------------------------------------------------------


def test_sampled_pd_with_a_period_that_is_not_the_sample_time():
    """A law every 6 ms, recorded every 10 ms: both have an instant in common every 30 ms."""
    period = 6e-3
    run = sim.simulate(sim.Scara(), LINES, sim.SampledPD(period), duration=1.2, sample=period)
    time = np.arange(0.0, 1.2 + 1e-9, 0.01)
    q_ref = np.array([LINES.position(t) for t in time])
    record = jaxid.Recording(time, q_ref, 0 * q_ref, q_ref=q_ref, v=0 * q_ref)
    (ours,) = jaxid.simulate(scara_under(Sampled(PD(**GAINS), every=period), substeps=4), record)
    both = slice(None, None, 3), slice(None, None, 5)
    np.testing.assert_allclose(time[both[0]], run.time[both[1]], atol=1e-12)
    for signal in ("tau", "q", "v"):
        # As for the continuous law: the spline of the reference decides.
        here, there = getattr(ours, signal)[both[0]], getattr(run, signal)[both[1]]
        np.testing.assert_allclose(here, there, atol=5e-5)
        assert np.all(gap(here, there) < 1e-5), signal
    # In between, the command is that of the last tick.
    last = np.floor(time / period + 1e-9).astype(int)
    np.testing.assert_allclose(ours.tau, run.tau[last], atol=5e-5)
    assert np.abs(np.diff(run.tau, axis=0)).max() > 1e-2


# --- the EMPS cascade -------------------------------------------------------------------------


# The EMPS's friction turns over within 0.02 ms, too quick for either simulator's steps.
SOFT = sim.Axis(gamma=500.0)


def emps_under(controller):
    """The EMPS axis with softer friction, in steps of a quarter of a millisecond."""
    return with_plant(jaxid.emps(controller), SOFT, stepping=jaxid.Stepping(substeps=4))


@cache
def emps_run(delay, limit):
    """The independent axis under its cascade, with an ideal encoder."""
    law = sim.EmpsCascade(delay_samples=int(delay), limit=limit, resolution=0.0)
    return sim.simulate(SOFT, MOVES, law, duration=0.9, sample=1e-3, step=2.5e-4)


@pytest.mark.parametrize("delay", [False, True])
@pytest.mark.parametrize("limit", [10.0, 4.0])
def test_cascade_agrees_with_the_independent_one(delay, limit):
    run = emps_run(delay, limit)
    (ours,) = jaxid.simulate(emps_under(Cascade(limit=limit, delay=delay)), recorded(run))
    if limit < 10:
        # The moves ask for more than that, again and again.
        assert np.mean(np.abs(run.tau) > 0.999 * limit * 35.15065) > 0.01
    assert np.abs(run.tau).max() <= limit * 35.15065 * (1 + 1e-12)
    # The same method with the same steps between the same ticks: rounding alone differs.
    assert np.all(gap(ours.tau, run.tau) < 1e-9)
    np.testing.assert_allclose(ours.q, run.q, atol=1e-11)


def test_cascade_saturates_known_torque_as_well():
    run = emps_run(False, 4.0)
    push = 200.0 * np.sin(40 * run.time)[:, None]
    (ours,) = jaxid.simulate(emps_under(Cascade(limit=4.0)), recorded(run, tau_ff=push))
    q = ours.q[:, 0]
    # Before the first tick the axis stood where it stands.
    speed = (q - np.r_[q[0], q[0], q[:-2]]) / 2e-3
    volts = 160.18 * 243.45 * (run.q_ref[:, 0] - q) - 243.45 * speed + push[:, 0] / 35.15065
    law = 35.15065 * np.clip(volts, -4.0, 4.0)
    # Rounding of positions, 1e-17 m, times 4e4 V/m and more.
    np.testing.assert_allclose(ours.tau[:, 0], law, rtol=0, atol=1e-9)
    assert 0.05 < np.mean(np.abs(volts) > 4.0) < 0.95


def test_delayed_cascade_delivers_one_period_later():
    run = emps_run(True, 10.0)
    (ours,) = jaxid.simulate(emps_under(Cascade(delay=True)), recorded(run))
    np.testing.assert_array_equal(ours.delivered[1:], ours.tau[:-1])


# --- open loop --------------------------------------------------------------------------------


def test_open_loop_gives_the_recorded_torque():
    time = np.arange(0.0, 1.005, 0.01)
    tau = np.stack([0.8 * np.sin(5 * time), 0.1 * np.cos(9 * time) - 0.1], axis=1)
    pieces = sim.OpenLoop(lambda t: [float(np.interp(t, time, column)) for column in tau.T])
    run = sim.simulate(sim.Scara(), sim.MultiSine(((), ())), pieces, duration=1.0)
    record = jaxid.Recording(time, run.q, tau)
    (ours,) = jaxid.simulate(scara_under(OpenLoop(), substeps=16), record)
    np.testing.assert_allclose(ours.tau, tau, rtol=0, atol=1e-14)
    # Steps of 0.6 ms at a rate of 160/s of friction at standstill: 0.1^4 · 0.1^1 in those few.
    np.testing.assert_allclose(ours.q, run.q, atol=1e-6)


# --- tracking ---------------------------------------------------------------------------------


# The low-pass has no samples before the start and after the end: about five time constants.
INSIDE = slice(10, -30)


@pytest.fixture(scope="module")
def tracked():
    """The recorded PD motion followed with virtual loops of 10 and 40 Hz."""
    record, simulated = recorded(pd_run()), {}
    for bandwidth in (10.0, 40.0):
        law = Tracking(bandwidth=bandwidth, cutoff=20.0)
        (simulated[bandwidth],) = jaxid.simulate(scara_under(law), record)
    return law.signals(record).q, simulated


def unknown_acceleration(loop, run):
    """What bias and friction would accelerate the arm by, (samples, joints)."""

    def one(q, v):
        zeros = jnp.zeros(loop.joints)
        motion = Motion(jnp.zeros(()), q, v, zeros, zeros, jnp.zeros(0), jnp.asarray(0))
        load = inverse(loop, motion, tuple(e.initial_state() for e in loop.effects))
        return jnp.linalg.solve(loop.arm.mass_matrix(q), load)

    return np.asarray(jax.vmap(one)(jnp.asarray(run.q), jnp.asarray(run.v)))


def test_tracking_follows_the_recorded_motion(tracked):
    smooth, simulated = tracked
    worst = np.abs(unknown_acceleration(scara_under(Tracking()), pd_run())).max(axis=0)
    for bandwidth, run in simulated.items():
        # Without the model, bias and friction would accelerate the error, which obeys
        # e'' + 2 w e' + w² e = that: at most its maximum over w², as its response never swings.
        bound = worst / (2 * math.pi * bandwidth) ** 2
        # The law adds what the model takes, so that hardly any of it is left to follow.
        assert np.all(np.abs(run.q - smooth)[INSIDE].max(axis=0) < 0.01 * bound)


def test_tracking_torque_is_that_of_inverse_dynamics(tracked):
    _, simulated = tracked
    errors = {f: gap(run.tau[INSIDE], pd_run().tau[INSIDE]) for f, run in simulated.items()}
    # Motions of 1 Hz pass the low-pass of 20 Hz. Of friction's jumps, 10 % of the torque on joint 1
    # and a third on joint 2, the low-passed motion has all but what lasts less than a sample.
    for error in errors.values():
        assert np.all(error < (0.002, 0.01))


@pytest.mark.parametrize("late", [0.0007, 0.005, -0.012])
def test_the_delay_of_a_virtual_law_advances_the_simulated_torque(late):
    record = recorded(pd_run())
    laws = Tracking(cutoff=20.0), Tracking(cutoff=20.0, delay=late)
    now, then = (jaxid.compare(scara_under(law), record).judged() for law in laws)
    sections = scipy.signal.butter(4, 20.0, fs=record.rate, output="sos")
    (run,) = jaxid.simulate(scara_under(laws[0]), record)
    smooth = scipy.signal.sosfiltfilt(sections, run.tau, axis=0)
    expected = scipy.interpolate.CubicSpline(record.time, smooth)(then[0] + late)
    # The two filters differ at the ends of a recording; rows of a joint at rest are zero.
    away = (then[2] != 0) & ((then[0] > 0.4) & (then[0] < 1.6))[:, None]
    left = np.where(away, np.abs(then[2] - expected), 0.0)
    assert np.all(left < 1e-3 * np.abs(expected).max(axis=0))
    assert away.sum() > 50
    np.testing.assert_array_equal(then[1], now[1])


def test_tracking_needs_no_reference_and_takes_uneven_time():
    run = pd_run()
    keep = np.sort(np.random.default_rng(2).permutation(len(run.time))[:170])
    keep = np.unique(np.r_[0, keep, len(run.time) - 1])
    record = jaxid.Recording(run.time[keep], run.q[keep], run.tau[keep])
    smooth = Tracking(cutoff=10.0).signals(record).q
    assert smooth.shape == record.q.shape
    # A tenth of a second at the ends belongs to the filter; straight lines over 30 ms of motions
    # with some 10 rad/s² err by 10 · 0.03²/8, and the low-pass by less.
    inside = (record.time > 0.1) & (record.time < 1.9)
    np.testing.assert_allclose(smooth[inside], record.q[inside], atol=4e-3)


# --- sensors ----------------------------------------------------------------------------------


def test_sensor_noise_goes_round_the_loop():
    run, clean = pd_run(), pd_simulated()
    rng = np.random.default_rng(4)
    noise = 1e-3 * rng.standard_normal(run.q.shape)
    loop = scara_under(PD(**GAINS))
    (noisy,) = jaxid.simulate(loop, recorded(run), noise=[noise])
    kg, kp, kv = (np.asarray(GAINS[k]) for k in ("Kg", "Kp", "Kv"))
    law = kg * (kp * (run.q_ref - noisy.q) - kv * noisy.v)
    np.testing.assert_allclose(noisy.tau, law, rtol=0, atol=1e-12)
    # What is read is where the arm is, and the noise; its rate is that of the lines between.
    np.testing.assert_allclose(noisy.q - noisy.states[:, :2], noise, rtol=0, atol=1e-14)
    slope = np.diff(noise, axis=0) / np.diff(run.time)[:, None]
    np.testing.assert_allclose((noisy.v - noisy.states[:, 2:4])[:-1], slope, rtol=0, atol=1e-11)
    first = -kg * (kp * noise[0] + kv * slope[0])
    np.testing.assert_allclose((noisy.tau - clean.tau)[0], first, rtol=0, atol=1e-12)
    # It moves the arm.
    moved = np.abs(noisy.states[:, :2] - clean.states[:, :2]).max(axis=0)
    assert np.all((moved > 1e-5) & (moved < 1e-2))


def test_no_noise_is_no_change():
    run = pd_run()
    loop = scara_under(PD(**GAINS))
    (silent,) = jaxid.simulate(loop, recorded(run), noise=[np.zeros_like(run.q)])
    # Another program: the last digit may differ, times what 200 samples of the loop make of it.
    np.testing.assert_allclose(silent.tau, pd_simulated().tau, rtol=0, atol=1e-11)


def test_controller_sees_steps_of_the_encoder():
    run = pd_run()
    step = np.array([2e-3, 5e-3])
    loop = scara_under(PD(**GAINS), resolution=tuple(step.tolist()))
    (ours,) = jaxid.simulate(loop, recorded(run))
    counts = ours.q / step
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    assert np.all(np.abs(ours.q - ours.states[:, :2]) <= step / 2 + 1e-12)
    kg, kp, kv = (np.asarray(GAINS[k]) for k in ("Kg", "Kp", "Kv"))
    law = kg * (kp * (run.q_ref - ours.q) - kv * ours.v)
    np.testing.assert_allclose(ours.tau, law, rtol=0, atol=1e-12)
    # The arm low-passes the steps: it moves by less than what half a step commands for good.
    assert np.abs(ours.states[:, :2] - pd_simulated().states[:, :2]).max() < step.max()


# --- messages ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("loop", "law"),
    [
        (jaxid.scara(), "PD"),
        (jaxid.scara(Sampled(PD(**GAINS), every=0.01)), "PD"),
        (jaxid.emps(), "Cascade"),
    ],
)
def test_missing_reference_names_the_remedy(loop, law):
    time = np.arange(0.0, 0.3, 0.01)
    q = np.sin(time)[:, None] * np.ones(loop.joints)
    record = jaxid.Recording(time, q, q, name="drive_7")
    with pytest.raises(ModelError) as raised:
        jaxid.simulate(loop, record)
    message = str(raised.value)
    for part in ("drive_7", "q_ref", law, "OpenLoop()", "Tracking()"):
        assert part in message


def test_recording_of_another_robot_names_both():
    time = np.arange(0.0, 0.3, 0.01)
    q = np.sin(time)[:, None]
    with pytest.raises(jaxid.errors.RecordingError, match="1 joints.*robot scara has 2"):
        jaxid.simulate(jaxid.scara(), jaxid.Recording(time, q, q, q_ref=q))


def test_laws_of_other_joints_are_refused():
    time = np.linspace(0, 3, 301)
    q = np.stack([np.sin(2 * time), np.cos(3 * time)], axis=1)
    recording = jaxid.Recording.from_arrays(time, q, q, q_ref=q, name="one")
    three = [9.0, 9.0, 9.0]
    for law, why in (
        (PD(Kp=three, Kv=1.0), "set all gains: Kp has 3 values"),
        (PID(Kp=1.0, Ki=three, Kd=three), "set all gains: Ki has 3 values, Kd has 3 values"),
        (Sampled(PD(Kp=1.0, Kv=three), every=1e-3), "set all gains: Kv has 3 values"),
        (jaxid.emps().controller, "of shape|set all gains"),
    ):
        loop = dataclasses.replace(jaxid.scara(), controller=law)
        for work in (jaxid.simulate, jaxid.fit, jaxid.compare):
            with pytest.raises(ModelError, match=f"of scara gives .*2 joints.*{why}"):
                work(loop, recording)
    for noise in ([], [np.zeros((300, 2))]):
        with pytest.raises(RecordingError, match="noise"):
            jaxid.simulate(jaxid.scara(), recording, noise=noise)


class Counting(AbstractController):
    """A law with a state that nothing changes."""

    every: float | None = eqx.field(static=True, default=None)

    @property
    def period(self):
        return self.every

    def initial_state(self, reading):
        return jnp.zeros(2)

    def command(self, reading, reference, state, mass):
        return reference.q - reading.q + state


@pytest.mark.parametrize(("every", "method"), [(None, "derivative"), (0.002, "tick")])
def test_laws_whose_states_never_change_are_refused(every, method):
    time = np.linspace(0, 3, 301)
    q = np.stack([np.sin(2 * time), np.cos(3 * time)], axis=1)
    recording = jaxid.Recording.from_arrays(time, q, q, q_ref=q)
    loop = dataclasses.replace(jaxid.scara(), controller=Counting(every))
    with pytest.raises(ModelError, match=f"has 2 states and .*: write `{method}`"):
        jaxid.simulate(loop, recording)


class Halved(Counting):
    """A law whose derivative lacks a state."""

    def derivative(self, reading, reference, state):
        return state[:1]


class Paired(Halved):
    """A law with two vectors of states."""

    def initial_state(self, reading):
        return jnp.zeros(1), jnp.zeros(1)

    def command(self, reading, reference, state, mass):
        return reference.q - reading.q + state[0]


@pytest.mark.parametrize(
    ("law", "why"),
    [(Halved(), r"has 2 states, but `derivative` gives \(1,\)"), (Paired(), "than one vector")],
)
def test_laws_with_states_of_a_wrong_form_are_refused(law, why):
    time = np.linspace(0, 3, 301)
    q = np.stack([np.sin(2 * time), np.cos(3 * time)], axis=1)
    recording = jaxid.Recording.from_arrays(time, q, q, q_ref=q)
    with pytest.raises(ModelError, match=why):
        jaxid.simulate(dataclasses.replace(jaxid.scara(), controller=law), recording)
