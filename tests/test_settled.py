"""Arms that carry their weight through a compliant transmission at the start, against SciPy."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from test_servo import Pendulum

import jaxid
from jaxid.control import PD, Tracking
from jaxid.effects import Backlash, EncoderEccentricity, JointElasticity, Viscous
from jaxid.estimate.minimise.residual import raw_residual, unfiltered
from jaxid.simulation.batch import prepare

INERTIA, WEIGHT, DRAG, ROTOR, SOFT, DAMPING = 0.5, 8.0, 0.6, 0.12, 4e-3, 2e-3
GAP, STIFF = 0.02, 500.0
TRUE = {"J": INERTIA, "G": WEIGHT, "compliance1": SOFT}
KP, KD = 300.0, 12.0
NOISE = 0.02
RATE = 400.0


def passed(kind, twist, rate):
    """Torque from the drive to the link."""
    if kind == "elastic":
        return -(twist + DAMPING * rate) / SOFT
    depth, side = np.maximum(np.abs(twist) - GAP / 2, 0.0), np.sign(twist)
    return -side * STIFF * depth * np.maximum(1 + 3.0 * side * rate, 0.0)


def reference(t):
    return 1.2 + 0.5 * np.sin(2.1 * t) * np.sin(0.9 * t)


def recorded(kind, held=True, end=6.0):
    """A drive and a link that starts in equilibrium, or without twist."""

    def law(t, q, v):
        return KP * (reference(t) - q) - KD * v

    def rates(t, x):
        q, v, twist, rate = x
        torque = passed(kind, twist, rate)
        link = (torque - WEIGHT * np.sin(q + twist)) / (INERTIA - ROTOR)
        drive = (law(t, q, v) - DRAG * v - torque) / ROTOR
        return [v, drive, rate, link - drive]

    def balance(x):
        q, twist = x
        torque = passed(kind, twist, 0.0)
        return [law(0.0, q, 0.0) - torque, torque - WEIGHT * np.sin(q + twist)]

    q, twist = reference(0.0), 0.0
    if held:
        q, twist = scipy.optimize.fsolve(balance, [q, -GAP / 2 - WEIGHT / STIFF], xtol=1e-13)
    time = np.arange(0, end, 1 / RATE)
    run = scipy.integrate.solve_ivp(
        rates, (0.0, time[-1] + 0.01), [q, 0.0, twist, 0.0], t_eval=time, method="DOP853",
        rtol=1e-9, atol=1e-11, max_step=1e-3,
    )  # fmt: skip
    tau = law(time, *run.y[:2]) + NOISE * np.random.default_rng(3).standard_normal(len(time))
    return jaxid.Recording.from_arrays(time, run.y[0], tau, q_ref=reference(time))


def gear(kind, wrong=1.0):
    if kind == "elastic":
        return JointElasticity(1, compliance=SOFT * wrong, rotor=ROTOR, damping=DAMPING)
    return Backlash(1, gap=GAP * wrong, rotor=ROTOR, stiffness=STIFF)


def pendulum(kind, wrong=1.0, law=None):
    arm = Pendulum(J=jnp.asarray(INERTIA), G=jnp.asarray(WEIGHT))
    drag = Viscous(joint=1, coefficient=jnp.asarray(DRAG))
    law = PD(KP, KD) if law is None else law
    return jaxid.ClosedLoop(arm=arm, controller=law, effects=[drag, gear(kind, wrong)])


@pytest.mark.parametrize("kind", ["elastic", "gap"])
@pytest.mark.parametrize("held", [True, False])
def test_a_drive_that_holds_the_weight_has_twisted_its_transmission(kind, held):
    recording = recorded(kind, held)
    (run,) = jaxid.simulate(pendulum(kind), recording)
    left = np.sqrt(np.mean((np.asarray(run.tau) - recording.tau) ** 2))
    assert left < 1.05 * NOISE


@pytest.mark.parametrize("held", [True, False])
def test_the_compliance_is_that_of_the_loaded_arm(held):
    recording = recorded("elastic", held)
    loop = pendulum("elastic", wrong=0.8)
    others = [p.name for p in loop.parameters if p.name not in TRUE]
    fit = jaxid.fit(loop.free(*TRUE).hold(*others), recording)
    off = (fit.theta - [TRUE[name] for name in fit.names]) / fit.std
    assert np.abs(off).max() < 4
    noise = 100 * NOISE / np.sqrt(np.mean(recording.tau**2))
    assert fit.error_percent.to_numpy().max() < 1.05 * noise


def test_the_twist_holds_the_links_if_the_law_is_unknown():
    recording = recorded("elastic")
    (run,) = jaxid.simulate(pendulum("elastic", law=Tracking()), recording)
    first = (np.asarray(run.tau) - recording.tau)[:40]
    # Without twist, the falling link would make it 6 N·m.
    assert np.abs(first).max() < 0.5


@pytest.mark.parametrize(
    ("effect", "name"),
    [(gear("elastic"), "compliance1"), (EncoderEccentricity(1, A=0.02, B=0.03), "EA1")],
)
def test_derivatives_include_that_of_the_start(effect, name):
    """The start depends on parameters: by the twist, and by what an encoder reads."""
    drag = Viscous(joint=1, coefficient=jnp.asarray(DRAG))
    arm = Pendulum(J=jnp.asarray(INERTIA), G=jnp.asarray(WEIGHT))
    loop = jaxid.ClosedLoop(arm=arm, controller=PD(KP, KD), effects=[drag, effect])
    loop = loop.free(name).hold(*(p.name for p in loop.parameters if p.name != name))
    batch = prepare(loop, jaxid.Recordings.of(recorded("elastic", end=0.5)))
    weights, (value,) = jnp.ones(1), loop.theta
    slope = unfiltered(loop, batch, weights, ("tau",), free_start=False).jacobian
    step = 1e-5 * float(value)
    ends = [
        raw_residual(loop.with_theta(jnp.array([value + d])), batch, weights, ("tau",))
        for d in (step, -step)
    ]
    difference = np.asarray(ends[0] - ends[1]) / (2 * step)
    worst = np.abs(np.asarray(slope)[..., 0] - difference).max()
    assert worst < 1e-5 * np.abs(difference).max()
