"""Knowledge of values before the recordings, with torque from Pinocchio's regressor."""

import dataclasses
from functools import cache

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from loops import four_joints

import jaxid
from jaxid.arms import drawn_covariance
from jaxid.control import Tracking
from jaxid.discovery.likelihood import score, score_of
from jaxid.discovery.predict import Predictor
from jaxid.discovery.system import System
from jaxid.errors import ModelError
from jaxid.estimate.minimise import residual_at
from jaxid.estimate.prior import prior_of
from jaxid.noise import ARFilter
from tests.test_serial import PINOCCHIO

pinocchio = pytest.importorskip("pinocchio")
UNCERTAINTY, NOISE = 0.2, 0.5
VISCOUS = np.array([2.0, 1.5, 3.0, 0.5])


@cache
def near():
    """An arm whose bodies and viscous friction are estimated."""
    loop = jaxid.serial(
        four_joints(),
        Tracking(cutoff=8.0),
        rotors=(0.0,) * 4,
        bodies="near",
        uncertainty=UNCERTAINTY,
    )
    others = [n for n in loop.names if not n.startswith("Fv") and n not in loop.arm.base_names]
    return loop.hold(*others)


def deviations(body):
    """Of `BODY`, as the documentation says it."""
    inertia = max(abs(body[0]), abs(body[3]), abs(body[5]))
    moment = max(np.linalg.norm(body[6:9]), np.sqrt(inertia * body[9]))
    return UNCERTAINTY * np.array([inertia] * 6 + [moment] * 3 + [body[9]])


def by_bodies(q, v, a):
    """Pinocchio's torque by the parameters of all bodies, `(samples, joints, 40)`."""
    model = pinocchio.buildModelFromXML(four_joints())
    data = model.createData()
    places = [10 * link + k for link in range(4) for k in PINOCCHIO]
    rows = zip(q, v, a, strict=True)
    return np.array(
        [
            np.array(pinocchio.computeJointTorqueRegressor(model, data, *row))[:, places]
            for row in rows
        ]
    )


@cache
def motion(seed, duration=12.0):
    """Slow sines, which do not determine all base parameters."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, duration, 0.005)
    q, v, a = np.zeros((3, len(time), 4))
    for _ in range(3):
        w, phase = 2 * np.pi * rng.uniform(0.1, 0.5, 4), rng.uniform(0, 6, 4)
        size = rng.uniform(0.05, 0.25, 4)
        angle = np.outer(time, w) + phase
        q += size * np.sin(angle)
        v += size * w * np.cos(angle)
        a -= size * w**2 * np.sin(angle)
    return time, q, v, by_bodies(q, v, a)


def drawn_case(seed, motions=(1, 2)):
    """Recordings of an arm whose bodies are those of the drawing with random errors."""
    rng = np.random.default_rng(seed)
    bodies = np.asarray(near().arm.bodies)
    true = bodies + rng.normal(size=bodies.shape) * np.stack([deviations(b) for b in bodies])
    made = []
    for k in motions:
        time, q, v, regressor = motion(k)
        tau = regressor @ true.ravel() + VISCOUS * v
        noise = NOISE * rng.normal(size=tau.shape) if k == motions[0] else 0.0
        made.append(jaxid.Recording.from_arrays(time, q, tau + noise, name=f"motion {k}"))
    theta = np.append(np.asarray(near().arm.combined) @ true.ravel(), VISCOUS)
    return made, theta


@pytest.fixture(scope="module")
def fitted():
    """A fit of uncertain bodies."""
    (fitting, _), _ = drawn_case(0)
    return jaxid.fit(near(), fitting)


def test_torque_is_as_uncertain_as_the_bodies_make_it():
    arm = near().arm
    rng = np.random.default_rng(1)
    q, v, a = rng.normal(size=(3, 20, 4))
    bodies = np.stack([deviations(b) for b in np.asarray(arm.bodies)]).ravel()
    expected = by_bodies(q, v, a) * bodies
    ours = np.stack(
        [np.asarray(arm.regressor(*map(jnp.asarray, x))) for x in zip(q, v, a, strict=True)]
    )
    covariance = drawn_covariance(arm, UNCERTAINTY)
    found = np.einsum("sjb,bc,skc->sjk", ours, covariance, ours)
    whole = np.einsum("sjb,skb->sjk", expected, expected)
    np.testing.assert_allclose(found, whole, rtol=1e-5, atol=1e-6 * whole.max())


def test_a_rotor_of_unknown_inertia_is_left_to_the_recordings():
    known = jaxid.serial(four_joints(), bodies="near", rotors=(0.0,) * 4).arm
    unknown = jaxid.serial(four_joints(), bodies="near").arm
    ratio = np.sqrt(np.diag(unknown.covariance) / np.diag(known.covariance))
    loose = np.flatnonzero(ratio > 5)
    # The joints turn about z and y of their own frames.
    assert [unknown.base_names[k][:3] for k in loose] == ["ZZ1", "YY2"]
    assert np.all(np.delete(ratio, loose) < 1.01)


@pytest.mark.slow
def test_deviations_hold_and_unseen_motions_are_followed_best():
    """Of bodies drawn from the prior: errors of estimates are of the size that the fit states."""
    loop, errors = near(), {"drawn": [], "near": [], "free": []}
    unknown = dataclasses.replace(loop.arm, covariance=None)
    free = dataclasses.replace(loop, arm=unknown)
    drawn = loop.hold("base")
    scores = []
    for seed in range(6):
        (fitting, unseen), true = drawn_case(seed)
        for name, model in (("drawn", drawn), ("near", loop), ("free", free)):
            fit = jaxid.fit(model, fitting)
            errors[name].append(jaxid.compare(fit.loop, unseen).error_percent.to_numpy()[0])
            if name == "near":
                scores.append((fit.theta - true) / fit.std)
    spread = np.sqrt(np.mean(np.square(scores)))
    assert 0.8 < spread < 1.25, spread
    typical = {name: np.median(x) for name, x in errors.items()}
    assert typical["near"] < min(0.1 * typical["drawn"], 0.85 * typical["free"]), typical


def test_the_optimum_is_that_of_recordings_and_knowledge_together(fitted):
    """The gradient by finite differences of residual and distance, without jaxid's products."""
    problem, theta = fitted.optimum.problem, np.asarray(fitted.optimum.theta)
    start = jnp.asarray(fitted.optimum.start)

    @eqx.filter_jit
    def residual(at):
        return residual_at(problem, at, start)

    def losses(at):
        rows = np.asarray(residual(jnp.asarray(at)))
        return np.array([np.sum(rows**2), np.sum(np.square(problem.prior.left(at)))])

    steps = np.diag(0.1 * fitted.std)
    slopes = np.array([(losses(theta + d) - losses(theta - d)) / 0.2 for d in steps])
    assert np.all(np.abs(slopes.sum(axis=1)) < 0.1)
    assert np.abs(slopes[:, 0]).max() > 0.5


def test_values_that_only_the_drawing_tells_are_named(fitted):
    (said,) = [n for n in fitted.notes if "those of the drawing" in n]
    before = np.sqrt(np.diag(np.asarray(fitted.loop.arm.covariance)))
    count = len(before)
    ratio = fitted.std[:count] / before
    assert np.all(ratio < 1.001)
    named = [n for n, x in zip(fitted.names[:count], ratio, strict=True) if x > 0.7]
    assert named
    assert said.startswith(f"{len(named)} of {count} parameters of the links")
    assert said.endswith(", ".join(named))


def test_another_solver_finds_the_same(fitted):
    (fitting, _), _ = drawn_case(0)
    other = jaxid.fit(near(), fitting, method=jaxid.OEM(solver=optx.LevenbergMarquardt(1e-9, 1e-9)))
    assert np.all(np.abs(other.theta - fitted.theta) < 0.1 * fitted.std)


def test_the_linear_system_of_a_fit_has_the_same_optimum_and_score(fitted):
    """Predicted changes of a fitted model's own values are none, and its score is that of a fit."""
    system = System.of(fitted)
    noise = [ARFilter(np.zeros(0), float(x) ** -2) for x in fitted.optimum.problem.weights]
    predictor = Predictor.of(system, noise)
    plain = predictor.predict(())
    count = len(fitted.names)
    assert np.all(np.abs(plain.taken[:count]) < 0.2 * fitted.std)
    without = Predictor.of(dataclasses.replace(system, prior=None), noise).predict(())
    assert np.abs(without.taken[:count] / fitted.std).max() > 0.5
    predicted = score(predictor.data, plain.rest, count, 0, 0, plain.taken).value
    assert predicted == pytest.approx(score_of(fitted).value, abs=0.5)
    prior = prior_of(fitted.loop, fitted.recordings)
    alone = dataclasses.replace(fitted.loop.arm, covariance=None)
    bare = dataclasses.replace(fitted, loop=dataclasses.replace(fitted.loop, arm=alone))
    distance = np.sum(prior.left(fitted.theta) ** 2)
    assert score_of(fitted).value - score_of(bare).value == pytest.approx(distance)


def test_an_offset_that_the_motion_shows_is_not_drawn_to_zero():
    loop = near().free("offset2").hold("base")
    time, q, v, regressor = motion(1)
    tau = regressor @ np.asarray(loop.arm.bodies).ravel() + VISCOUS * v
    offset = 0.2 * np.sqrt(np.mean(tau[:, 1] ** 2))
    tau = tau + [0, offset, 0, 0] + NOISE * np.random.default_rng(5).normal(size=tau.shape)
    fit = jaxid.fit(loop, jaxid.Recording.from_arrays(time, q, tau))
    found = fit.table().loc["offset2"]
    assert abs(found["value"] - offset) < 3 * found["std"] < 0.05 * offset
    prior = prior_of(fit.loop, fit.recordings)
    assert prior.rows.shape == (1, len(fit.names))
    size = np.sqrt(np.mean(np.asarray(fit.recordings[0].tau)[:, 1] ** 2))
    assert prior.rows.sum() == pytest.approx(10 / size)
    assert prior_of(jaxid.scara(), fit.recordings) is None


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"bodies": "close"}, "'drawn', 'near', 'physical' or 'free'"),
        ({"uncertainty": 0.0}, "positive number"),
    ],
)
def test_what_cannot_be_is_refused(given, said):
    with pytest.raises(ModelError, match=said):
        jaxid.serial(four_joints(), **given)
