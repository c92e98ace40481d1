"""Closed-loop simulation: DOP853 for continuous controllers, RK4 inside each hold otherwise."""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.integrate import DOP853, DenseOutput

from .controllers import PD, EmpsCascade, OpenLoop, SampledPD
from .effects import (
    AccelerationSquare,
    Effect,
    EncoderEccentricity,
    LoadDependentFriction,
    Payload,
    ThermalDrift,
)
from .plants import TWO_OVER_PI, Plant, solve_accelerations
from .references import Reference

Controller = PD | SampledPD | EmpsCascade | OpenLoop


@dataclass(frozen=True)
class Simulation:
    """Noise-free signals at the sample times, (samples, joints); q, v, a as the encoder sees them.

    `tau` is the controller's output, the torque commanded; `q_link` the links' true positions.
    """

    time: np.ndarray
    q_ref: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    tau: np.ndarray
    q_link: np.ndarray
    v_link: np.ndarray


class Loop:
    """Equations of motion of plant, effects and drive chain; states: links, then the rest."""

    def __init__(self, plant: Plant, effects: Sequence[Effect], recording: str | None) -> None:
        for e in effects:
            # Named recordings carry the payload; without a name it is always there.
            if isinstance(e, Payload) and (recording is None or recording in e.recordings):
                plant = plant.with_payload(e.mass, e.reach)
        n = plant.joints
        self.plant, self.n = plant, n

        def at(place: str, joint: int) -> list:
            return [e for e in effects if e.place == place and e.joint == joint + 1]

        def only(place: str, joint: int) -> Effect | None:
            found = at(place, joint)
            if len(found) > 1:
                raise ValueError(f"two effects at {place} of joint {joint + 1}")
            return found[0] if found else None

        joints = range(n)
        self.base = plant.friction_parameters()
        self.offsets = plant.drive_offsets()
        self.motor = [[e.needed for e in at("motor", j)] for j in joints]
        self.link = [[e.needed for e in at("link", j)] for j in joints]
        self.drift: list[list[ThermalDrift]] = [at("base_friction", j) for j in joints]
        self.load: list[LoadDependentFriction | None] = [only("load", j) for j in joints]
        self.sensor: list[EncoderEccentricity | None] = [only("sensor", j) for j in joints]
        self.gain = [math.prod(1.0 + e.gain for e in at("gain", j)) for j in joints]
        self.limit = [min([e.limit for e in at("saturation", j)] + [math.inf]) for j in joints]
        self.lag = [sum(e.time_constant for e in at("lag", j)) for j in joints]
        self.delay = [sum(e.delay for e in at("delay", j)) for j in joints]
        self.rotor = [sum(e.inertia for e in at("rotor", j)) for j in joints]
        self.gravity = [e for e in effects if e.place == "gravity"]
        odd: list[AccelerationSquare] = [e for j in joints for e in at("acceleration", j)]
        if len(odd) > 1:
            raise ValueError("one acceleration_square at most")
        self.odd = odd[0] if odd and odd[0].coefficient else None
        shaft = [only("transmission", j) for j in joints]
        self.shaft = [None if s is None or s.absent() else s for s in shaft]
        self.breaks = sorted(e.time for e in effects if e.name == "friction_step")
        known = {"motor", "link", "base_friction", "load", "sensor", "gain", "saturation", "lag"}
        known |= {"delay", "rotor", "gravity", "acceleration", "transmission", "payload", "bristle"}
        for e in effects:
            if e.place not in known or not (e.joint is None or 1 <= e.joint <= n):
                raise ValueError(f"{e} does not fit this plant")
            if n == 1 and e.name in ("gravity", "cross_coupling", "cross_bump"):
                raise ValueError(f"{e.name} needs two joints")
        heavy = [s.motor_inertia if s else 0.0 for s in self.shaft]
        for turned in (0.0, math.pi):
            m = plant.inertia([turned] * n)
            for j in range(n):
                m[j][j] += self.rotor[j] - heavy[j]
            if m[0][0] <= 0 or (n == 2 and m[0][0] * m[1][1] <= m[0][1] * m[1][0]):
                raise ValueError("a motor takes more inertia from its joint than the joint has")
        self._lay_out([at("bristle", j) for j in joints])

    def _lay_out(self, bristles: list[list]) -> None:
        """Give each additional state its place."""
        size = 2 * self.n
        self.motor_at, self.lag_at, self.bristles = [], [], []
        for j in range(self.n):
            self.motor_at.append(size if self.shaft[j] else None)
            size += 2 if self.shaft[j] else 0
            self.lag_at.append(size if self.lag[j] else None)
            size += 1 if self.lag[j] else 0
            mine = []
            for b in bristles[j]:
                mine.append((size, b))
                size += 1
            self.bristles.append(mine)
        self.size = size

    def start(self, q: Sequence[float], v: Sequence[float], command: Sequence[float]) -> list:
        """Initial state; lags start settled at the first command, motors on their links."""
        x = [*q, *v] + [0.0] * (self.size - 2 * self.n)
        for j in range(self.n):
            if self.motor_at[j] is not None:
                x[self.motor_at[j]], x[self.motor_at[j] + 1] = q[j], v[j]
            if self.lag_at[j] is not None:
                x[self.lag_at[j]] = self._amplify(j, command[j])
        return x

    def read(self, x: Sequence[float]) -> tuple[list[float], list[float]]:
        """Positions and velocities as the encoders give them."""
        q, v = [], []
        for j in range(self.n):
            k = self.motor_at[j]
            p, w = (x[j], x[self.n + j]) if k is None else (x[k], x[k + 1])
            if self.sensor[j] is not None:
                p, w = self.sensor[j].read(p, w)
            q.append(p)
            v.append(w)
        return q, v

    def read_acceleration(self, x: Sequence[float], dx: Sequence[float], j: int) -> float:
        """Second derivative of the reading of joint j (from 0)."""
        k = self.motor_at[j]
        p, w, a = (x[j], dx[j], dx[self.n + j]) if k is None else (x[k], dx[k], dx[k + 1])
        s = self.sensor[j]
        if s is not None:
            angle = p + s.phase
            a = a * (1 + s.amplitude * math.cos(angle)) - s.amplitude * math.sin(angle) * w * w
        return a

    def _amplify(self, j: int, u: float) -> float:
        """Command to drive torque: gain, then the amplifier's limit."""
        u *= self.gain[j]
        limit = self.limit[j]
        return min(limit, max(-limit, u))

    def rate(self, t: float, x: Sequence[float], command: Sequence[float]) -> list[float]:
        """State derivative under the commands that reach the drives now."""
        n, plant = self.n, self.plant
        q, v = x[:n], x[n : 2 * n]
        dx = [*v] + [0.0] * (self.size - n)
        r = [-b for b in plant.bias(q, v)]
        splits = None
        for j in range(n):
            u = self._amplify(j, command[j])
            k = self.lag_at[j]
            if k is not None:
                dx[k] = (u - x[k]) / self.lag[j]
                u = x[k]
            k = self.motor_at[j]
            p, w = (q[j], v[j]) if k is None else (x[k], x[k + 1])
            fv, fc = self.base[j]
            friction = fv * w + fc * TWO_OVER_PI * math.atan(plant.gamma * w)
            for d in self.drift[j]:
                friction *= d.factor(t)
            friction += self.offsets[j]
            for f in self.motor[j]:
                friction += f(t, p, w)
            for i, b in self.bristles[j]:
                dx[i] = b.rate(x[i], w)
                friction += b.needed_of_state(x[i], w)
            net = u - friction
            load = self.load[j]
            if k is None:
                r[j] += net if load is None else load.delivered(net, w)
            else:
                shaft = self.shaft[j]
                twist = shaft.transmitted(p - q[j], w - v[j])
                if load is not None:
                    s = TWO_OVER_PI * math.atan(load.gamma * w)
                    net -= load.ratio * abs(twist) * s
                dx[k], dx[k + 1] = w, (net - twist) / shaft.motor_inertia
                r[j] += twist
                splits = splits or [0.0] * n
                splits[j] = shaft.motor_inertia
            for f in self.link[j]:
                r[j] -= f(t, q, v)
        for g in self.gravity:
            first, second = g.needed_of_moments(*plant.second_link_moments(), q)
            r[0] -= first
            r[1] -= second
        m = plant.inertia(q)
        for j in range(n):
            m[j][j] += self.rotor[j]
            if splits:
                m[j][j] -= splits[j]
        dx[n : 2 * n] = solve_accelerations(m, r) if self.odd is None else self._odd(m, r)
        return dx

    def _odd(self, m: list[list[float]], r: list[float]) -> list[float]:
        """Accelerations when one joint also has c a|a|: eliminate the other, solve the square."""
        j, c = self.odd.joint - 1, self.odd.coefficient
        if self.n == 1:
            return [root_of_square(m[0][0], c, r[0])]
        o = 1 - j
        own = root_of_square(
            m[j][j] - m[j][o] * m[o][j] / m[o][o], c, r[j] - m[j][o] * r[o] / m[o][o]
        )
        other = (r[o] - m[o][j] * own) / m[o][o]
        return [own, other] if j == 0 else [other, own]


def root_of_square(m: float, c: float, r: float) -> float:
    """The a of m a + c a|a| = r for m > 0, c >= 0."""
    return 2.0 * r / (m + math.sqrt(m * m + 4.0 * c * abs(r)))


def simulate(
    plant: Plant,
    reference: Reference,
    controller: Controller | None = None,
    effects: Sequence[Effect] = (),
    duration: float = 20.0,
    sample: float = 0.01,
    *,
    q0: Sequence[float] | None = None,
    v0: Sequence[float] | None = None,
    recording: str | None = None,
    rtol: float = 1e-9,
    atol: float = 1e-11,
    step: float | None = None,
) -> Simulation:
    """Simulate `duration` s sampled every `sample` s; `step` s is RK4's in sampled loops."""
    controller = PD() if controller is None else controller
    loop = Loop(plant, effects, recording)
    q0 = list(q0) if q0 is not None else [0.0] * loop.n
    v0 = list(v0) if v0 is not None else [0.0] * loop.n
    count = round(duration / sample)
    if controller.period is None:
        rows = _continuous(loop, controller, reference, q0, v0, count, sample, rtol, atol)
    else:
        # The axis is stiff at standstill: Fc 2/pi gamma / M = 1400 1/s wants 0.25 ms.
        step = step or (2.5e-4 if loop.n == 1 else 5e-4)
        rows = _sampled(loop, controller, reference, q0, v0, count, sample, step)
    time, ref, q, v, a, tau, ql, vl = (np.array(c) for c in zip(*rows, strict=True))
    return Simulation(time, ref, q, v, a, tau, ql, vl)


def _row(loop: Loop, t: float, x: list, ref: Sequence, dx: Sequence, tau: Sequence[float]) -> tuple:
    """What is recorded at one sample."""
    n = loop.n
    q, v = loop.read(x)
    a = [loop.read_acceleration(x, dx, j) for j in range(n)]
    return t, ref, q, v, a, list(tau), x[:n], x[n : 2 * n]


class _History:
    """States of the past, from the solver's own interpolation, for delayed commands."""

    def __init__(self, start: list[float]) -> None:
        self.start, self.ends, self.pieces = start, [], []

    def append(self, dense: DenseOutput) -> None:
        """Add one accepted step, its polynomial as plain floats: it is evaluated very often."""
        self.ends.append(dense.t)
        self.pieces.append((dense.t_old, dense.h, dense.y_old.tolist(), dense.F[::-1].tolist()))

    def __call__(self, t: float) -> list[float]:
        if t <= 0.0 or not self.ends:
            return self.start
        k = min(bisect.bisect_left(self.ends, t), len(self.ends) - 1)
        begin, h, old, terms = self.pieces[k]
        s = (t - begin) / h
        y = [0.0] * len(old)
        # Hairer's nesting: factors s and 1 - s take turns, the last factor being s.
        for i, term in enumerate(terms):
            w = 1.0 - s if i % 2 else s
            y = [(p + f) * w for p, f in zip(y, term, strict=True)]
        return [p + o for p, o in zip(y, old, strict=True)]


def _continuous(
    loop: Loop,
    controller: PD | OpenLoop,
    reference: Reference,
    q0: list[float],
    v0: list[float],
    count: int,
    sample: float,
    rtol: float,
    atol: float,
) -> list[tuple]:
    """DOP853 from sample to sample, so that samples are step ends and need no interpolation."""
    torque, position, read, rate = controller.torque, reference.position, loop.read, loop.rate
    delays = sorted({d for d in loop.delay if d})

    def command(t: float, x: list[float]) -> Sequence[float]:
        return torque(position(t), *read(x), t)

    first = torque(position(0.0), *_start_reading(loop, q0, v0), 0.0)
    x0 = loop.start(q0, v0, first)
    history = _History(x0)

    def arriving(t: float, x: list[float]) -> Sequence[float]:
        u = list(command(t, x))
        for d in delays:
            past = command(max(0.0, t - d), history(t - d))
            for j, own in enumerate(loop.delay):
                if own == d:
                    u[j] = past[j]
        return u

    reach = arriving if delays else command

    def fun(t: float, x: np.ndarray) -> list[float]:
        state = x.tolist()
        return rate(t, state, reach(t, state))

    # Steps no longer than the shortest delay: what arrives is then always known already.
    # Equal parts of a sample, because a tiny remainder would make the next step tiny too.
    parts = math.ceil(sample / min(delays) - 1e-9) if delays else 1
    solver = DOP853(fun, 0.0, x0, sample, max_step=1.001 * sample / parts, rtol=rtol, atol=atol)
    rows = [_row(loop, 0.0, x0, position(0.0), solver.f.tolist(), command(0.0, x0))]
    for k in range(1, count + 1):
        t0, t1 = (k - 1) * sample, k * sample
        inside = [b for b in loop.breaks if t0 < b < t1]
        for bound in sorted([*inside, *(t0 + i * sample / parts for i in range(1, parts)), t1]):
            solver.t_bound, solver.status = bound, "running"
            while solver.status == "running":
                message = solver.step()
                if solver.status == "failed":
                    raise RuntimeError(f"simulation failed at {solver.t:.3f} s: {message}")
                if delays:
                    history.append(solver.dense_output())
            if inside or t1 in loop.breaks:
                # The right-hand side jumps here; the solver's last slope is of before.
                solver.f = solver.fun(solver.t, solver.y)
        x = solver.y.tolist()
        rows.append(_row(loop, t1, x, position(t1), solver.f.tolist(), command(t1, x)))
    return rows


def _start_reading(loop: Loop, q0: list[float], v0: list[float]) -> tuple[list, list]:
    """First reading; the motors stand where their links stand."""
    pairs = [
        (q, v) if s is None else s.read(q, v) for s, q, v in zip(loop.sensor, q0, v0, strict=True)
    ]
    return [p for p, _ in pairs], [w for _, w in pairs]


def _sampled(
    loop: Loop,
    controller: SampledPD | EmpsCascade,
    reference: Reference,
    q0: list[float],
    v0: list[float],
    count: int,
    sample: float,
    step: float,
) -> list[tuple]:
    """RK4 between controller ticks; delayed holds switch inside a period at their own times."""
    period = controller.period
    every = round(sample / period)
    if every < 1 or abs(every * period - sample) > 1e-9:
        raise ValueError("the sample time must be a multiple of the controller's period")
    reading = _start_reading(loop, q0, v0)
    law = controller.start(reading[0])
    late = getattr(controller, "delay_samples", 0) * period
    delays = [d + late for d in loop.delay]
    outputs: list[Sequence[float]] = []
    x, rows = None, []
    for k in range(count * every + 1):
        t = k * period
        ref = reference.position(t)
        if x is not None:
            reading = loop.read(x)
        outputs.append(law(ref, *reading, t))
        if x is None:
            x = loop.start(q0, v0, outputs[0])

        def held(moment: float) -> list[float]:
            """What reaches the drives: the latest output that is older than the delay."""
            return [
                outputs[max(0, min(len(outputs) - 1, math.floor((moment - d) / period)))][j]
                for j, d in enumerate(delays)
            ]

        edges = {t, t + period} | {t + math.fmod(d, period) for d in delays}
        edges |= {b for b in loop.breaks if t < b < t + period}
        spans = [e for e in sorted(edges) if e <= t + period]
        if k % every == 0:
            dx = loop.rate(t, x, held(t + 1e-9))
            rows.append(_row(loop, t, x, ref, dx, outputs[k]))
        for a, b in pairwise(spans):
            if b - a < 1e-12:
                continue
            x = _rk4(loop, a, b, x, held(0.5 * (a + b)), step)
    return rows


def _rk4(
    loop: Loop, t: float, end: float, x: list[float], u: list[float], step: float
) -> list[float]:
    """Classical Runge-Kutta of order 4 in equal steps no longer than `step`."""
    n = max(1, math.ceil((end - t) / step - 1e-9))
    h = (end - t) / n
    for _ in range(n):
        k1 = loop.rate(t, x, u)
        k2 = loop.rate(t + h / 2, [p + h / 2 * s for p, s in zip(x, k1, strict=True)], u)
        k3 = loop.rate(t + h / 2, [p + h / 2 * s for p, s in zip(x, k2, strict=True)], u)
        k4 = loop.rate(t + h, [p + h * s for p, s in zip(x, k3, strict=True)], u)
        x = [
            p + h / 6 * (a + 2 * b + 2 * c + d)
            for p, a, b, c, d in zip(x, k1, k2, k3, k4, strict=True)
        ]
        t += h
    return x
