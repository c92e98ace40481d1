"""The same simulation and the same Jacobian by jaxid, C, CasADi, SciPy and MuJoCo."""

import ctypes
import dataclasses
import functools
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import integrate

import jaxid
from jaxid.estimate.minimise import linearisation, point_around
from jaxid.simulation.batch import prepare
from jaxid.simulation.integration import initial
from jaxid.simulation.runs import each, run

from ._problem import SUBSTEPS, TRUTH, arrays, cad, once, problem

KP, KV, KG = np.array([6.25, 156.25]), np.array([2.0, 25.0]), np.array([3.5, 0.06])
GAMMA, LENGTH, P = 100.0, 0.5, 8


class Peer:
    """Simulated torque and its derivatives, each for a list of recordings."""

    def __init__(
        self,
        name: str,
        simulate: Callable[[np.ndarray], Any],
        jacobian: Callable[[np.ndarray], Any],
        cold: float,
    ):
        self.name, self.simulate, self.jacobian, self.cold = name, simulate, jacobian, cold


def of_jaxid(recs: jaxid.Recordings, alone: bool = False) -> Peer:
    """The repeated part of a fit by jaxid: weighted residual, Jacobian and normal equations.

    On all cores, over which recordings are distributed, or on one core. It simulates the padding
    of its batch as well, which the other programs do not have.
    """
    samples = recs[0].samples
    started = time.perf_counter()
    loop = cad()
    batch = prepare(loop, recs)
    # Simulated minus measured, so its derivative is that of the torque.
    asked = dataclasses.replace(problem(loop, batch), weights=-jnp.ones(2))
    start = jnp.concatenate([batch.q0, batch.v0], axis=1)
    around = functools.partial(point_around, asked) if alone else linearisation(asked)

    @jax.jit
    def simulate(theta):
        changed = loop.with_theta(theta)

        def one(intervals, q0, v0):
            return run(changed, intervals, initial(changed, intervals, q0, v0))[1][:, 0]

        return each(one, batch.intervals, batch.q0, batch.v0)[:, :samples]

    def jacobian(theta):
        found = around(jnp.asarray(theta), start).found
        return found.raw[:, :samples], found.jacobian[:, :samples]

    once(lambda: jacobian(np.asarray(loop.theta)))
    name = "jaxid, one core" if alone else "jaxid"
    return Peer(name, simulate, jacobian, time.perf_counter() - started)


def of_c(recs: jaxid.Recordings) -> Peer | None:
    """Hand-written dual numbers in C."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        return None
    started = time.perf_counter()
    folder = Path(tempfile.mkdtemp())
    source, library = Path(__file__).with_name("scara.c"), folder / "scara.so"
    flags = ["-O3", "-march=native", "-ffast-math", "-shared", "-fPIC"]
    subprocess.run([compiler, *flags, str(source), "-o", str(library), "-lm"], check=True)
    code = ctypes.CDLL(str(library))
    data = arrays(recs)
    tau = [np.empty((len(d["h"]), 2)) for d in data]
    slopes = [np.empty((len(d["h"]), 2, P)) for d in data]

    def at(array: np.ndarray) -> ctypes.c_void_p:
        return ctypes.c_void_p(array.ctypes.data)

    def given(d: dict[str, np.ndarray], theta: np.ndarray) -> tuple:
        return (len(d["h"]), SUBSTEPS, at(d["h"]), at(d["reference"]), at(theta), at(d["start"]))

    def simulate(theta):
        for d, out in zip(data, tau, strict=True):
            code.simulate(*given(d, theta), at(out))
        return np.stack(tau)

    def jacobian(theta):
        for d, out, slope in zip(data, tau, slopes, strict=True):
            code.jacobian(*given(d, theta), at(out), at(slope))
        return np.stack(tau), np.stack(slopes)

    return Peer("C, dual numbers", simulate, jacobian, time.perf_counter() - started)


def physics(np_, p, c, t, x):
    """Torque and rate of the loop, by the functions of `np_`, for peers that call Python."""
    reference = [c[j] + t * (c[2 + j] + t * (c[4 + j] + t * c[6 + j])) for j in range(2)]
    tau = [KG[j] * (KP[j] * (reference[j] - x[j]) - KV[j] * x[2 + j]) for j in range(2)]
    v1, v2, cs, sn = x[2], x[3], np_.cos(x[1]), np_.sin(x[1])
    coupling, moment = LENGTH * (p[2] * cs - p[3] * sn), LENGTH * (p[2] * sn + p[3] * cs)
    m11, m12, m22 = p[0] + p[1] + 2 * coupling, p[1] + coupling, p[1]
    dry = 2 / np.pi * np_.arctan(GAMMA * v1), 2 / np.pi * np_.arctan(GAMMA * v2)
    b1 = tau[0] - p[4] * v1 - p[5] * dry[0] + moment * v2 * (2 * v1 + v2)
    b2 = tau[1] - p[6] * v2 - p[7] * dry[1] - moment * v1 * v1
    scale = 1 / (m11 * m22 - m12 * m12)
    return tau, [v1, v2, (m22 * b1 - m12 * b2) * scale, (m11 * b2 - m12 * b1) * scale]


def of_casadi(recs: jaxid.Recordings, compiled: bool) -> Peer | None:
    """CasADi: the same step in SX, with its sensitivities; mapped along the recording."""
    try:
        import casadi as ca
    except ImportError:
        return None
    if compiled and shutil.which("gcc") is None:
        return None
    started = time.perf_counter()
    x, s, p = ca.SX.sym("x", 4), ca.SX.sym("s", 4, P), ca.SX.sym("p", P)
    c, t, h = ca.SX.sym("c", 8), ca.SX.sym("t"), ca.SX.sym("h")

    def rate(t, x):
        return ca.vertcat(*physics(ca, p, ca.vertsplit(c), t, ca.vertsplit(x))[1])

    k1 = rate(t, x)
    k2 = rate(t + h / 2, x + h / 2 * k1)
    k3 = rate(t + h / 2, x + h / 2 * k2)
    k4 = rate(t + h, x + h * k3)
    after = x + h / 6 * (k1 + 2 * (k2 + k3) + k4)
    tau = ca.vertcat(*physics(ca, p, ca.vertsplit(c), t, ca.vertsplit(x))[0])
    moved = ca.jacobian(after, x) @ s + ca.jacobian(after, p)
    shown = ca.jacobian(tau, x) @ s
    plain = ca.Function("plain", [x, c, t, h, p], [after, tau])
    both = ca.Function(
        "both", [ca.horzcat(x, s), c, t, h, p], [ca.horzcat(after, moved), tau, shown]
    )
    if compiled:
        folder = Path(tempfile.mkdtemp())
        generator = ca.CodeGenerator("steps.c")
        generator.add(plain)
        generator.add(both)
        generator.generate(f"{folder}/")
        command = ["gcc", "-O3", "-march=native", "-ffast-math", "-shared", "-fPIC"]
        library = str(folder / "steps.so")
        subprocess.run([*command, str(folder / "steps.c"), "-o", library, "-lm"], check=True)
        plain, both = ca.external("plain", library), ca.external("both", library)
    runs = []
    for d in arrays(recs):
        fine = np.repeat(d["h"] / SUBSTEPS, SUBSTEPS)
        offsets = (np.arange(len(fine)) % SUBSTEPS) * fine
        cubics = np.repeat(d["reference"].reshape(len(d["h"]), 8), SUBSTEPS, axis=0).T
        first = np.concatenate([d["start"][:, None], np.zeros((4, P))], axis=1)
        runs.append(
            (
                plain.mapaccum("plains", len(fine)),
                both.mapaccum("boths", len(fine)),
                (ca.DM(cubics), ca.DM(offsets[None]), ca.DM(fine[None])),
                ca.DM(d["start"]),
                ca.DM(first),
            )
        )

    def simulate(theta):
        out = [f(x0, *given, ca.DM(theta))[1] for f, _, given, x0, _ in runs]
        return np.stack([np.asarray(tau)[:, ::SUBSTEPS].T for tau in out])

    def jacobian(theta):
        out = [f(x0, *given, ca.DM(theta)) for _, f, given, _, x0 in runs]
        tau = np.stack([np.asarray(o[1])[:, ::SUBSTEPS].T for o in out])
        slopes = [np.asarray(o[2]).reshape(2, -1, P)[:, ::SUBSTEPS].swapaxes(0, 1) for o in out]
        return tau, np.stack(slopes)

    name = "CasADi, compiled C" if compiled else "CasADi, virtual machine"
    peer = Peer(name, simulate, jacobian, 0.0)
    once(lambda: jacobian(np.array(list(TRUTH.values()))))
    peer.cold = time.perf_counter() - started
    return peer


def differences(simulate: Callable[[np.ndarray], Any]) -> Callable[[np.ndarray], Any]:
    """A Jacobian by two-point differences."""

    def jacobian(theta):
        base = np.asarray(simulate(theta))
        steps = 1e-6 * np.maximum(np.abs(theta), 0.1)
        moved = [np.asarray(simulate(theta + s * e)) for s, e in zip(steps, np.eye(P), strict=True)]
        return base, np.stack([(m - base) / s for m, s in zip(moved, steps, strict=True)], axis=-1)

    return jacobian


def of_scipy(recs: jaxid.Recordings) -> Peer:
    """`solve_ivp` with the accuracy of the fixed steps, and differences."""
    data = arrays(recs)

    def simulate(theta):
        out = []
        for d in data:
            time_, cubics = d["time"], d["reference"].reshape(-1, 8)

            def rate(t, x, time_=time_, cubics=cubics):
                k = min(int((t - time_[0]) / (time_[1] - time_[0])), len(time_) - 1)
                return physics(np, theta, cubics[k], t - time_[k], x)[1]

            ends = (time_[0], time_[-1])
            solved = integrate.solve_ivp(
                rate, ends, d["start"], t_eval=time_, rtol=1e-6, atol=1e-8, max_step=sampling(d)
            )
            tau = [
                physics(np, theta, c, 0.0, x)[0] for c, x in zip(cubics, solved.y.T, strict=True)
            ]
            out.append(tau)
        return np.array(out)

    return Peer("SciPy solve_ivp, differences", simulate, differences(simulate), 0.0)


def sampling(d: dict[str, np.ndarray]) -> float:
    """Largest step, s; the solver's own choice would be too large for the arctan at standstill."""
    return float(d["time"][1] - d["time"][0])


MODEL = """
<mujoco>
  <option timestep="{step}" integrator="RK4" gravity="0 0 0"><flag contact="disable"/></option>
  <worldbody>
    <body name="one">
      <joint name="j1" axis="0 0 1" armature="3.3" damping="0.03" frictionloss="0.8"/>
      <inertial pos="0 0 0" mass="0.1" diaginertia="0.001 0.001 0.001"/>
      <body name="two" pos="0.5 0 0">
        <joint name="j2" axis="0 0 1" damping="0.01" frictionloss="0.14"/>
        <inertial pos="0.2 0.01 0" mass="0.6" diaginertia="0.01 0.03 0.04"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="j1" kp="21.875" kv="7"/>
    <position joint="j2" kp="9.375" kv="1.5"/>
  </actuator>
</mujoco>
"""


def of_mujoco(recs: jaxid.Recordings) -> Peer | None:
    """MuJoCo's RK4 with one thread per core, as in its sysid toolbox."""
    try:
        import mujoco
        from mujoco import rollout
    except ImportError:
        return None
    started = time.perf_counter()
    data = arrays(recs)
    step = sampling(data[0]) / SUBSTEPS
    base = mujoco.MjModel.from_xml_string(MODEL.format(step=step))
    offsets = np.arange(SUBSTEPS) * step
    control = []
    for d in data:
        c = d["reference"][:-1, None]
        t = offsets[None, :, None]
        wave = c[:, :, 0] + t * (c[:, :, 1] + t * (c[:, :, 2] + t * c[:, :, 3]))
        control.append(wave.reshape(-1, 2))
    control = np.stack(control)
    count = len(data)
    threads = [mujoco.MjData(base) for _ in range(2)]
    first = mujoco.MjData(base)
    size = mujoco.mj_stateSize(base, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    state = np.zeros(size)
    mujoco.mj_getState(base, first, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)

    def model(theta):
        made = mujoco.MjModel.from_xml_string(MODEL.format(step=step))
        made.dof_armature[0], made.body_inertia[2, 2] = theta[0], max(theta[1], 1e-3)
        made.body_ipos[2, :2] = theta[2] / 0.6, theta[3] / 0.6
        made.dof_damping[:] = theta[4], theta[6]
        made.dof_frictionloss[:] = theta[5], theta[7]
        mujoco.mj_setConst(made, mujoco.MjData(made))
        return made

    def rolled(thetas):
        models = [m for theta in thetas for m in [model(theta)] * count]
        controls = np.concatenate([control] * len(thetas))
        out, _ = rollout.rollout(models, threads, np.tile(state, (len(models), 1)), controls)
        return np.asarray(out).reshape(len(thetas), count, -1, size)

    def simulate(theta):
        return rolled([theta])[0]

    def jacobian(theta):
        steps = 1e-6 * np.maximum(np.abs(theta), 0.1)
        out = rolled([theta, *(theta + s * e for s, e in zip(steps, np.eye(P), strict=True))])
        return out[0], np.stack([(o - out[0]) / s for o, s in zip(out[1:], steps, strict=True)], -1)

    name = "MuJoCo RK4 rollouts, differences"
    return Peer(name, simulate, jacobian, time.perf_counter() - started)
