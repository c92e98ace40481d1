"""Sensitivities along a run against extrapolated differences of the simulation itself.

Both are of the same discrete loop, with steps far shorter than it needs, so that any difference
is an error of the derivative; that the default's derivative is close to it is shown apart.
"""

import dataclasses
import inspect
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid import effects
from jaxid.arms import Axis
from jaxid.control import PD, Cascade, OpenLoop, Sampled, Tracking
from jaxid.effects import AbstractEffect, Coulomb, Viscous
from jaxid.recording import Recordings
from jaxid.simulation.batch import prepare
from jaxid.simulation.integration import SIGNALS, initial
from jaxid.simulation.loop import ClosedLoop
from jaxid.simulation.runs import run, run_with_sensitivities
from jaxid.simulation.steps import set_substeps, with_substeps

ROWS = tuple(SIGNALS.index(name) for name in ("tau", "q", "v", "delivered"))
FINE = 32
# Programs that run once: compiling them matters, not their speed.
QUICKLY = {"xla_backend_optimization_level": 0}


def record(joints, duration=0.4, sample=0.01, size=0.6):
    """A recording with motions of some 4 rad/s that turn back on the way."""
    time = np.arange(0.0, duration + sample / 2, sample)
    phase = np.arange(joints)
    q = size * np.sin(4.0 * time[:, None] * (1 + 0.4 * phase) + 0.9 + 0.1 * phase)
    tau = 0.4 * np.cos(7.0 * time[:, None] + phase)
    return jaxid.Recording(time, q, tau, q_ref=q + 0.05 * size * np.cos(9.0 * time)[:, None])


@dataclasses.dataclass
class Problem:
    """A loop along one recording, from a start that moves."""

    loop: ClosedLoop
    record: jaxid.Recording

    def __post_init__(self):
        batch = prepare(self.loop, Recordings.of(self.record))
        self.intervals = jax.tree.map(lambda leaf: leaf[0], batch.intervals)
        q = jnp.asarray(self.record.q[0])
        self.x0 = initial(self.loop, self.intervals, q, 0.3 + 0.5 * jnp.abs(q))
        self.theta = self.loop.theta
        self.columns = len(self.theta) + len(self.x0)

    def simulated(self, z):
        """Signals by parameters and initial state in one vector."""
        p = len(self.theta)
        return run(self.loop.with_theta(z[:p]), self.intervals, z[p:])[1][:, jnp.asarray(ROWS)]

    def sensitivities(self, z):
        """Signals and their derivative by parameters and initial state."""
        p, n = len(self.theta), len(self.x0)
        start = jnp.concatenate([jnp.zeros((n, p)), jnp.eye(n)], axis=1)
        loop = self.loop.with_theta(z[:p])
        found = run_with_sensitivities(loop, self.intervals, z[p:], start, ROWS)
        return found.seen, found.slopes

    @property
    def z(self):
        """Parameters and initial state."""
        return jnp.concatenate([self.theta, self.x0])


def computed(function, *arguments):
    """A function of arrays, compiled for one call."""
    return jax.tree.map(
        np.asarray, jax.jit(function).lower(*arguments).compile(QUICKLY)(*arguments)
    )


def extrapolated(plus, minus, steps):
    """Derivatives from central differences at steps that shrink by four (Ridders 1982).

    Each extrapolation takes off the next even power of the step; the one that differs least from
    its neighbours is taken, as too long a step errs by its order and too short a one by rounding.
    """
    table = [[(plus[0] - minus[0]) / (2 * steps[0])]]
    best, error = table[0][0], np.inf
    for k in range(1, len(steps)):
        row = [(plus[k] - minus[k]) / (2 * steps[k])]
        for j in range(1, k + 1):
            row.append(row[-1] + (row[-1] - table[-1][j - 1]) / (16.0**j - 1))
            gap = max(np.linalg.norm(row[-1] - row[-2]), np.linalg.norm(row[-1] - table[-1][j - 1]))
            if gap < error:
                best, error = row[-1], gap
        table.append(row)
    return best


def step_sizes(z, levels=6):
    """Steps of a hundredth of each value and less, (levels, columns); of 1e-3 where it is zero."""
    first = 0.01 * np.where(z == 0, 0.1, np.abs(z))
    return first * 4.0 ** -np.arange(levels)[:, None]


def compare(problem, through_run=False):
    """Sensitivities, extrapolated differences, and `jacfwd` through the run if asked for."""
    z, steps = np.asarray(problem.z), step_sizes(np.asarray(problem.z))
    shifts = steps[..., None] * np.eye(problem.columns)
    points = jnp.asarray(np.stack([z + shifts, z - shifts]).reshape(-1, problem.columns))

    def everything(z, points):
        jacobian = jax.jacfwd(problem.simulated)(z) if through_run else jnp.zeros(0)
        return problem.sensitivities(z), jax.vmap(problem.simulated)(points), jacobian

    (signals, exact), values, jacobian = computed(everything, problem.z, points)
    plus, minus = values.reshape(2, len(steps), problem.columns, *signals.shape)
    # Every signal in units of its own size, so that none is lost beside another.
    unit = np.sqrt(np.mean(signals**2, axis=(0, 2)))[:, None]
    differences = [
        extrapolated(plus[:, k] / unit, minus[:, k] / unit, steps[:, k])
        for k in range(problem.columns)
    ]
    return exact / unit[..., None], np.stack(differences, axis=-1), jacobian, unit[..., None]


def column_gap(ours, theirs):
    """Difference of each column in norm, relative to the column; one that is zero is zero twice."""
    axes = tuple(range(ours.ndim - 1))
    norm = np.sqrt(np.sum(theirs**2, axis=axes))
    return np.sqrt(np.sum((ours - theirs) ** 2, axis=axes)) / np.where(norm > 0, norm, 1e-300)


def table1():
    """The SCARA near the truth, friction's sharpness among its parameters."""
    loop = jaxid.scara().with_values(
        ZZ1r=3.44, ZZ2=0.06, MX2=0.24, MY2=0.01, Fv1=0.07, Fc1=0.23, Fv2=0.003, Fc2=0.05
    )
    return loop.free("eps1", "eps2")


def two_link(link_length=None):
    """The two-link arm under a PD law."""
    law = PD(Kp=[60.0, 120.0], Kv=[10.0, 15.0], Kg=[0.15, 0.045])
    values = {"p1": 0.108, "p2": 0.0443, "p4": 0.349, "p5": 0.111}
    if link_length is None:
        values["p3"] = 0.0333
    friction = {"Fv1": 0.005, "Fc1": 0.08, "Fv2": 0.003, "Fc2": 0.05}
    return jaxid.two_link(law, link_length).with_values(**values, **friction)


def emps(controller=None):
    """The EMPS axis, its friction soft enough for a step of 30 microseconds."""
    return jaxid.emps(controller).with_values(M=95.1, Fv1=203.5, Fc1=20.4, eps1=0.002)


def one_joint(controller=None, *more):
    """The plainest loop with one joint, whose numbers are those of a small arm."""
    law = controller or PD(Kp=150.0, Kv=20.0, Kg=0.1)
    return ClosedLoop(Axis(M=0.1), law, (Viscous(1, 0.02), *more), name="one joint")


CASES = {
    "scara": (table1, record(2)),
    "two_link": (two_link, record(2)),
    "two_link of known length": (lambda: two_link(0.3), record(2)),
    "emps": (emps, record(1, 0.06, 2e-3, 0.02)),
    "emps with delay": (lambda: emps(Cascade(delay=True)), record(1, 0.06, 2e-3, 0.02)),
    "sampled": (
        lambda: one_joint(Sampled(PD(Kp=150.0, Kv=20.0, Kg=0.1), every=0.004), Coulomb(1, 0.1)),
        record(1),
    ),
    "tracking": (lambda: one_joint(Tracking(cutoff=15.0), Coulomb(1, 0.1)), record(1, 0.6)),
    "open loop": (lambda: one_joint(OpenLoop(), Coulomb(1, 0.1)), record(1)),
}


@cache
def solved(case):
    """The comparison of one case, with steps that are short."""
    build, recording = CASES[case]
    problem = Problem(set_substeps(build(), FINE), recording)
    return problem, compare(problem, through_run=True)


@pytest.mark.parametrize("case", CASES)
def test_every_arm_and_controller(case):
    _, (exact, differences, jacobian, unit) = solved(case)
    # Steps h of the ladder err by a high power of h over the width of friction's sign, and by
    # 1e-16/h in rounding: 1e-9 of a column and less, where it is not tiny.
    assert np.all(column_gap(exact, differences) < 1e-6)
    # The same derivative in another order of sums: rounding over a thousand steps.
    assert np.all(column_gap(exact, jacobian / unit) < 1e-10)


def at_substeps(case, substeps):
    """How far the derivative with that many steps, None for the default, is from the fine one."""
    problem, (exact, *_, unit) = solved(case)
    build, recording = CASES[case]
    loop = build() if substeps is None else set_substeps(build(), substeps)
    coarse = Problem(with_substeps(loop, Recordings.of(recording)), recording)
    jacobian = computed(coarse.sensitivities, problem.z)[1] / unit
    # Together: an almost zero column has no digits to lose.
    return np.linalg.norm(jacobian - exact) / np.linalg.norm(exact)


@pytest.mark.parametrize("case", ["scara", "two_link of known length", "emps"])
def test_default_derivative_is_close_to_the_fine_one(case):
    # Where friction turns over within a step, a step has the error of one of first order, some
    # per mille of that step; Gauss-Newton asks for two digits.
    assert at_substeps(case, None) < 1e-3


def test_derivative_converges_with_the_order_of_the_method():
    gaps = [at_substeps("open loop", n) for n in (2, 4, 8)]
    # Nothing turns over here: twice the steps leave a sixteenth.
    np.testing.assert_allclose(np.divide(gaps[:-1], gaps[1:]), 16, rtol=0.1)


# --- every effect there is --------------------------------------------------------------------

KINDS = sorted(
    (
        kind
        for kind in vars(effects).values()
        if isinstance(kind, type)
        and issubclass(kind, AbstractEffect)
        and not inspect.isabstract(kind)
        and not kind.__name__.startswith("Abstract")
        # These need an arm in space, and are linear in their parameters: `test_space.py` compares
        # their torque with Pinocchio's.
        and "chain" not in {field.name for field in dataclasses.fields(kind)}
    ),
    key=lambda kind: kind.__name__,
)
# Fields that are no parameters and have no default.
SETTINGS = {"coordinate": "q"}
# Further settings of an effect that take another way through the loop.
# So soft a contact never lets go while it is pressed: where it does there is a kink, and
# differences taken across a kink have no order to extrapolate by.
# One joint without gravity has no load that drives its gear back.
PLAIN = {"Backlash": {"damping": 0.2}, "GearFriction": {"back": None, "slow_back": None}}
VARIANTS = {
    "Curve": [
        # Wide enough for all accelerations: at its ends a curve has a kink.
        {"coordinate": "a", "low": -40.0, "high": 40.0},
        {"coordinate": "tau", "signed": True},
    ]
}


def typical(kind, **settings):
    """An effect on joint 1 with what its parameters are by default, or half a scale where zero."""
    values = dict(settings)
    for field in dataclasses.fields(kind):
        if field.name in values or not field.init:
            continue
        if field.name == "joint":
            values["joint"] = 1
        elif "parameter" in field.metadata:
            declared, default = field.metadata["parameter"], field.default
            default = 0.0 if default in (dataclasses.MISSING, None) else np.asarray(default, float)
            # Values of a vector must not be alike.
            some = 0.5 * declared.scale * (1 + 0.3 * np.arange(np.size(default)))
            some = np.clip(some.reshape(np.shape(default)), declared.lower, declared.upper)
            values[field.name] = np.where(np.isfinite(default) & (default != 0), default, some)
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            assert field.name in SETTINGS, f"say in SETTINGS what {field.name} is to be"
            values[field.name] = SETTINGS[field.name]
    return kind(**values)


EFFECTS = [
    pytest.param(kind, settings, id=" ".join([kind.__name__, *map(str, settings.values())]))
    for kind in KINDS
    for settings in [PLAIN.get(kind.__name__, {}), *VARIANTS.get(kind.__name__, [])]
]


@pytest.mark.parametrize(("kind", "settings"), EFFECTS)
def test_every_effect(kind, settings):
    effect = typical(kind, **settings)
    if hasattr(effect, "joint") and not hasattr(effect, "following"):
        loop, recording = one_joint(None, effect), record(1)
    else:
        loop, recording = dataclasses.replace(table1(), effects=(effect,)), record(2)
    loop = loop.free(*(p.name for p in loop.parameters))
    problem = Problem(set_substeps(loop, FINE), recording)
    exact, differences, _, _ = compare(problem)
    gaps, size = column_gap(exact, differences), np.sqrt(np.sum(exact**2, axis=(0, 1, 2)))
    names = [p.name for p in loop.free_parameters for _ in range(p.size)]
    for p in loop.free_parameters:
        # Otherwise the motion does not meet the effect, and nothing has been compared.
        met = size[: len(names)][np.array(names) == p.name].max() > 1e-6
        assert met or not p.declaration.free, p.name
    assert np.all(gaps < 1e-6), dict(zip(names, gaps, strict=False))
