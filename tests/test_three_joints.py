"""An arm of three joints that a user brings, its recordings made by MuJoCo and SciPy."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxid
from jaxid.arms import AbstractArm
from jaxid.effects import AbstractTransmission

LENGTHS = (0.4, 0.3, 0.2)
MASSES = (1.2, 0.8, 0.5)
VISCOUS = (0.3, 0.2, 0.1)
KP, KV = np.array([150.0, 60.0, 12.0]), np.array([20.0, 6.0, 0.8])
BUMP = 2.5


class ThreeLink(AbstractArm):
    """Three turning links in a horizontal plane, a mass at the end of each."""

    m1: jax.Array = jaxid.parameter(1.0, symbol="m1", unit="kg", lower=0.0)
    m2: jax.Array = jaxid.parameter(1.0, symbol="m2", unit="kg", lower=0.0)
    m3: jax.Array = jaxid.parameter(1.0, symbol="m3", unit="kg", lower=0.0)

    @property
    def joints(self):
        return 3

    def ends(self, q):
        angle = jnp.cumsum(q)
        steps = jnp.array(LENGTHS)[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
        return jnp.cumsum(steps, axis=0)

    def mass_matrix(self, q):
        jacobian = jax.jacfwd(self.ends)(q)
        return jnp.einsum("k,kxi,kxj->ij", jnp.stack([self.m1, self.m2, self.m3]), *[jacobian] * 2)

    def bias(self, q, v):
        turning = jax.jvp(lambda at: self.mass_matrix(at) @ v, (q,), (v,))[1]
        return turning - jax.grad(lambda at: 0.5 * v @ self.mass_matrix(at) @ v)(q)


def chain() -> mujoco.MjModel:
    body = ""
    for length, mass in zip(LENGTHS[::-1], MASSES[::-1], strict=True):
        body = (
            f'<body pos="{{}} 0 0"><joint axis="0 0 1"/><inertial pos="{length} 0 0" mass="{mass}" '
            f'diaginertia="1e-9 1e-9 1e-9"/>{body.format(length)}</body>'
        )
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option gravity="0 0 0"/><worldbody>{body.format(0)}</worldbody></mujoco>'
    )


def recording(seed: int, name: str) -> jaxid.Recording:
    rng = np.random.default_rng(seed)
    f, size = rng.uniform(0.2, 1.2, (3, 4)), rng.uniform(0.1, 0.4, (3, 4))
    time = np.arange(601) * 0.01

    def reference(t):
        ramp = min(t, 1.0) ** 3 * (10 - 15 * min(t, 1.0) + 6 * min(t, 1.0) ** 2)
        return ramp * np.sum(size * np.sin(2 * np.pi * f * t), axis=1)

    reference_at = np.stack([reference(t) for t in time])
    model = chain()
    data = mujoco.MjData(model)

    def torque(t, q, v):
        return KP * (reference(t) - q) - KV * v

    def missing(q):
        return np.array([0.0, 0.0, BUMP * q[2]])

    def slope(t, x):
        q, v = x[:3], x[3:]
        data.qpos[:], data.qvel[:] = q, v
        data.qfrc_applied[:] = torque(t, q, v) - np.array(VISCOUS) * v - missing(q)
        mujoco.mj_forward(model, data)
        return np.concatenate([v, data.qacc])

    run = solve_ivp(
        slope, (0, time[-1]), np.zeros(6), "DOP853", time, rtol=1e-8, atol=1e-9, max_step=0.01
    )
    q, v = run.y[:3].T, run.y[3:].T
    tau = np.stack([torque(t, a, b) for t, a, b in zip(time, q, v, strict=True)])
    tau = tau + 0.02 * rng.standard_normal(tau.shape)
    return jaxid.Recording(time, q, tau, q_ref=reference_at, name=name)


@pytest.fixture(scope="module")
def recordings() -> jaxid.Recordings:
    return jaxid.Recordings.of([recording(1, "one"), recording(2, "two")])


@pytest.fixture(scope="module")
def loop() -> jaxid.ClosedLoop:
    return jaxid.ClosedLoop(
        arm=ThreeLink(),
        controller=jaxid.control.PD(Kp=KP, Kv=KV),
        effects=[jaxid.effects.Viscous(joint=j) for j in (1, 2, 3)],
        name="three links",
    )


def test_workspace_is_of_all_joints(loop):
    assert loop.arm.workspace().shape[1] == 3
    assert float(loop.arm.smallest_inertia()) > 0
    # Positive over the line q2 = 0 alone, negative where the elbow bends.
    bad = ThreeLink(m1=1.0, m2=1.0, m3=-0.3)
    assert float(bad.smallest_inertia()) < 0


@pytest.mark.slow
def test_masses_are_found_with_the_missing_spring_named(loop, recordings):
    fit = jaxid.fit(loop, recordings, jaxid.OEM(start="given", progress=False))
    # Elasticity and backlash on three joints are programs that take half a minute to compile.
    chosen = [e for e in jaxid.catalogue if not issubclass(e, AbstractTransmission)]
    diagnosis = jaxid.diagnose(fit, catalogue=chosen, progress=False)
    found = diagnosis.ranking[0]
    assert found.key == ("spring", 3)
    grown = fit.loop.add(diagnosis.predicted(found))
    again = jaxid.fit(grown, recordings, jaxid.OEM(start="given", progress=False))
    values = dict(zip(again.names, again.theta, strict=True))
    for k, (mass, viscous) in enumerate(zip(MASSES, VISCOUS, strict=True), start=1):
        for name, truth in ((f"m{k}", mass), (f"Fv{k}", viscous)):
            std = again.std[again.names.index(name)]
            assert abs(values[name] - truth) < 4 * std + 1e-3 * truth, name
