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
from .effects import Effect
from .loop import Loop
from .plants import Plant
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
