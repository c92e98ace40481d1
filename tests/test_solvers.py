"""Every kind of diffrax solver, with fixed and with adaptive steps: simulations, fits, reasons.

The loop is an axis with smooth friction under a PD law along a cubic, which the spline through its
samples reproduces exactly. Its equation is written a second time for SciPy, so that the two share
no code; nothing in it has a kink, so that every method shows its order.
"""

from functools import cache

import diffrax
import numpy as np
import optimistix
import pytest
from scipy.integrate import solve_ivp

import jaxid
from jaxid.arms import Axis
from jaxid.control import PD, Sampled
from jaxid.discovery.linear import linearise
from jaxid.effects import Coulomb, Viscous
from jaxid.errors import ModelError
from jaxid.simulation import RK4, reason
from jaxid.simulation.batch import prepare

MASS, DRAG, DRY, SHARP = 0.1, 0.3, 0.2, 4.0
GAINS = {"Kp": 15.0, "Kv": 0.4}
SAMPLE, SAMPLES = 0.05, 13
TIME = SAMPLE * np.arange(SAMPLES)
SOLVERS = (
    diffrax.Euler(),
    diffrax.Heun(),
    diffrax.Midpoint(),
    diffrax.Tsit5(),
    diffrax.Dopri5(),
    diffrax.Dopri8(),
    diffrax.ImplicitEuler(),
    diffrax.Kvaerno3(),
)
ADAPTIVE = tuple(s for s in SOLVERS if isinstance(s, diffrax.AbstractAdaptiveSolver))
name_of = lambda solver: type(solver).__name__  # noqa: E731
fixed = pytest.mark.parametrize("solver", SOLVERS, ids=name_of)
adaptive = pytest.mark.parametrize("solver", ADAPTIVE, ids=name_of)


def within(tolerance):
    """A controller that keeps this relative error."""
    return diffrax.PIDController(rtol=tolerance, atol=1e-2 * tolerance)


def cubic(t):
    """The reference, rad: from rest and back."""
    return 1.6 * t**2 - 1.8 * t**3


def loop(law=None, drag=DRAG, **stepping):
    """The axis under its law."""
    friction = Viscous(1, drag), Coulomb(1, DRY, smoothing=1 / SHARP)
    settings = jaxid.Stepping(**stepping)
    return jaxid.ClosedLoop(Axis(M=MASS), law or PD(**GAINS), friction, stepping=settings)


def recording(samples=SAMPLES, tau=None):
    """The axis along the cubic; it begins at rest, away from its reference."""
    time, q_ref = TIME[:samples], cubic(TIME[:samples])[:, None]
    tau = np.zeros_like(q_ref) if tau is None else tau
    return jaxid.Recording(time, q_ref * 0 + 0.05, tau, q_ref=q_ref)


def command(q_ref, q, v):
    """The law, a second time."""
    return GAINS["Kp"] * (q_ref - q) - GAINS["Kv"] * v


def solved(q_ref, begin, end, start, at):
    """SciPy's position and velocity at times, by the axis's equation written a second time."""

    def rate(t, y):
        q, v = y
        friction = DRAG * v + DRY * 2 / np.pi * np.arctan(SHARP * v)
        return [v, (command(q_ref(t), q, v) - friction) / MASS]

    return solve_ivp(rate, (begin, end), start, "DOP853", at, rtol=1e-12, atol=1e-14).y


@cache
def truth():
    """Torque along the cubic, `(samples, 1)`."""
    q, v = solved(cubic, 0.0, TIME[-1], [0.05, 0.0], TIME)
    return command(cubic(TIME), q, v)[:, None]


def simulated(model, *records):
    """jaxid's runs, those of one recording by itself."""
    runs = jaxid.simulate(model, records or recording())
    return runs if len(runs) > 1 else runs[0]


def error(**stepping):
    """Largest error of the simulated torque, N·m."""
    run = simulated(loop(**stepping))
    assert run.result == 0
    assert reason(run.result) == ""
    return np.abs(run.tau - truth()).max()


@fixed
def test_fixed_steps_have_the_order_of_the_solver(solver):
    # The loop's time constant is 0.1 s, so steps of 12 ms show the order; those of 50 ms, of a
    # method whose errors are rounding otherwise.
    few = 1 if solver.order(None) > 6 else 4
    coarse, fine = (error(solver=solver, substeps=n) for n in (few, 2 * few))
    assert coarse / fine > 2 ** (solver.order(None) - 0.5)
    assert coarse < 0.1


def test_own_method_has_its_order():
    coarse, fine = (error(solver=RK4(), substeps=n) for n in (4, 8))
    assert 16 < coarse / fine < 20


@adaptive
def test_adaptive_steps_keep_their_tolerance(solver):
    loose, tight = (error(solver=solver, control=within(rtol)) for rtol in (1e-4, 1e-6))
    # The error follows the tolerance's root at the least, that of implicit Euler; methods of high
    # order need no more than the one step between samples, which they take anyway.
    assert tight < max(loose / 5, 1e-7)
    assert tight < 2e-2


@pytest.mark.parametrize(
    "stepping",
    [
        {"solver": RK4(), "substeps": 32},
        {"solver": diffrax.Dopri5(), "substeps": 8},
        {"solver": diffrax.Kvaerno5(), "substeps": 8},
        {"solver": diffrax.Dopri5(), "control": within(1e-9)},
    ],
    ids=["RK4", "Dopri5 fixed", "Kvaerno5 fixed", "Dopri5 adaptive"],
)
def test_order_survives_jumps_of_the_reference(stepping):
    run = simulated(loop(interpolation="hold", **stepping))
    state, states = [0.05, 0.0], [[0.05, 0.0]]
    for k in range(SAMPLES - 1):
        level = cubic(TIME[k])
        state = solved(lambda t, level=level: level, TIME[k], TIME[k + 1], state, [TIME[k + 1]])
        state = state[:, 0]
        states.append(state)
    # One stage in the wrong interval would cost 1e-3.
    np.testing.assert_allclose(run.states, states, rtol=0, atol=1e-7)


@pytest.mark.parametrize("solver", [diffrax.Tsit5(), diffrax.Kvaerno3()], ids=name_of)
@pytest.mark.parametrize("control", [None, within(1e-8)], ids=["fixed", "adaptive"])
def test_sampled_law_with_ticks_between_samples(solver, control):
    law = Sampled(PD(**GAINS), every=0.013)
    substeps = 16 if control is None else None
    expected = simulated(loop(law, substeps=16))
    found = simulated(loop(law, solver=solver, control=control, substeps=substeps))
    np.testing.assert_allclose(found.tau, expected.tau, rtol=0, atol=1e-5)


def test_recordings_of_different_lengths_are_as_alone():
    model = loop(solver=diffrax.Tsit5(), control=within(1e-8))
    long, short = recording(), recording(7)
    both = simulated(model, long, short)
    for run, alone in zip(both, (simulated(model, long), simulated(model, short)), strict=True):
        np.testing.assert_allclose(run.states, alone.states, rtol=0, atol=1e-12)
        assert run.result == 0


# --- fits -------------------------------------------------------------------------------------


@cache
def measured():
    """The torque with noise of a hundredth of it, so that what a solver errs by is little."""
    noise = 0.01 * np.random.default_rng(1).standard_normal(truth().shape)
    return recording(tau=truth() + noise)


def fitted(**stepping):
    """The fit from given values."""
    method = jaxid.OEM(start="given", initial="rest", deviations="white", progress=False)
    return jaxid.fit(loop(**stepping), measured(), method)


@cache
def expected_fit():
    """That of the default method with fine steps."""
    return fitted(substeps=32)


def same_minimum(found):
    """Whether a fit ended where that of the default method did, to a tenth of a deviation."""
    assert found.succeeded
    gap = (found.theta - expected_fit().theta) / expected_fit().std
    return np.abs(gap).max() < 0.1


@fixed
def test_fit_with_fixed_steps(solver):
    steps = {1: 2048, 2: 64, 3: 16}.get(solver.order(None), 8)
    assert same_minimum(fitted(solver=solver, substeps=steps))


@adaptive
def test_fit_with_adaptive_steps(solver):
    # At implicit Euler's order, 1e-8 in each of thousands of steps leave 1e-3 of the torque.
    tolerance = 1e-8 if solver.order(None) == 1 else 1e-6
    assert same_minimum(fitted(solver=solver, control=within(tolerance), max_steps=10_000))


@pytest.mark.parametrize(
    "stepping",
    [
        {"solver": diffrax.Dopri8(), "substeps": 2},
        {"solver": diffrax.Kvaerno3(), "control": within(1e-9)},
        {"adjoint": diffrax.RecursiveCheckpointAdjoint(), "substeps": 32},
    ],
    ids=["fixed", "adaptive", "adjoint"],
)
def test_linear_system_is_that_of_the_default_method(stepping):
    systems = []
    for model in (loop(substeps=32), loop(**stepping)):
        systems.append(linearise(model, prepare(model, measured_only()), "tau"))
    expected, found = systems
    for matrix in "ABCD":
        there = np.asarray(getattr(expected, matrix))
        size = np.abs(there).max()
        np.testing.assert_allclose(getattr(found, matrix), there, rtol=0, atol=1e-6 * size)


def measured_only():
    """The measured recording as recordings."""
    return jaxid.Recordings.of(measured())


# --- what fails says why ------------------------------------------------------------------------

STIFF = 1e7


def failed(message, **stepping):
    """Whether the stiff axis, alone of two recordings or not, ends with a reason like this."""
    runs = simulated(loop(drag=STIFF, **stepping), recording(), recording(7))
    for run in runs:
        assert message in reason(run.result)
        assert not np.isfinite(run.tau).all()
    return True


def test_stiff_loop_says_why_an_explicit_solver_fails():
    # A rate of 1e8/s: 5e6 of the 3e-8 s that explicit methods bear, in each interval.
    assert failed("maximum number of solver steps", solver=diffrax.Tsit5(), control=within(1e-6))
    assert failed("Nonfinite", solver=RK4(), substeps=4)
    assert failed("Nonfinite", solver=diffrax.Tsit5(), substeps=4)
    law = Sampled(PD(**GAINS), every=0.02)
    tight = {"solver": diffrax.Tsit5(), "control": within(1e-6)}
    run = simulated(loop(law, drag=STIFF, **tight))
    assert "maximum number of solver steps" in reason(run.result)
    assert not np.isfinite(run.tau).all()


@pytest.mark.parametrize(
    ("stepping", "status", "said"),
    [
        ({"control": within(1e-6)}, jaxid.Status.out_of_solver_steps, "number of solver steps"),
        ({"substeps": 4}, jaxid.Status.diverged, "Nonfinite"),
    ],
    ids=["adaptive", "fixed"],
)
def test_fit_of_a_stiff_loop_says_why_an_explicit_solver_fails(stepping, status, said):
    found = fitted(drag=STIFF, solver=diffrax.Tsit5(), **stepping)
    assert not found.succeeded
    assert found.status is status
    assert any("diffrax" in note and said in note for note in found.notes)


def test_stiff_loop_is_nothing_to_an_implicit_solver():
    for control in (None, within(1e-6)):
        run = simulated(loop(drag=STIFF, solver=diffrax.Kvaerno5(), control=control))
        assert run.result == 0
        # It creeps: where it is after 0.6 s is where it began, but for force over drag.
        assert np.abs(run.q - 0.05).max() < 15 * 0.6 / STIFF


def test_a_root_finder_that_gives_up_says_so():
    newton = optimistix.Newton(rtol=1e-12, atol=1e-12)
    solver = diffrax.ImplicitEuler(root_finder=newton, root_find_max_steps=1)
    run = simulated(loop(solver=solver, substeps=4))
    assert "maximum number of steps was reached in the nonlinear solver" in reason(run.result)
    assert not np.isfinite(run.tau[1:]).any()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"solver": diffrax.KenCarp3()}, "in several terms"),
        ({"solver": diffrax.SemiImplicitEuler()}, "in several terms"),
        ({"solver": diffrax.Euler(), "control": within(1e-6)}, "gives no error estimate"),
        ({"control": within(1e-6)}, "gives no error estimate"),
        ({"solver": diffrax.Tsit5(), "control": diffrax.ConstantStepSize()}, "does not adapt"),
        ({"substeps": 0}, "at least 1"),
    ],
)
def test_settings_that_cannot_work_are_refused(settings, said):
    with pytest.raises(ModelError, match=said):
        jaxid.Stepping(**settings)
