"""Many sampled loops at once: two-link arms under computed torque, their encoders in counts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .plants import TwoLink


@dataclass(frozen=True)
class SampledComputedTorque:
    """tau = M̂ (a_ref + Kd e' + Kp e + Ki ∫e) + ĥ every `period` s; e' from `window` readings."""

    model: TwoLink
    Kp: tuple[float, float]
    Ki: tuple[float, float]
    Kd: tuple[float, float]
    period: float = 0.002
    window: int = 5


@dataclass(frozen=True)
class Batch:
    """What was recorded: time (samples,) s; q, tau (runs, samples, 2); q_true without encoders."""

    time: np.ndarray
    q: np.ndarray
    q_true: np.ndarray
    tau: np.ndarray


def arrays(plants: list[TwoLink]) -> dict[str, np.ndarray]:
    """Parameters of arms, one array each."""
    names = (*TwoLink.base, "g", "gamma")
    return {name: np.array([getattr(p, name) for p in plants]) for name in names}


def inverse_terms(p: dict, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, ...]:
    """Mass matrix entries m11, m12, m22 and bias b1, b2 of many arms."""
    c, s = np.cos(q[:, 1]), np.sin(q[:, 1])
    m12 = p["p2"] + p["p3"] * c
    m11 = p["p1"] + p["p2"] + 2 * p["p3"] * c
    outer = p["g"] * p["p5"] * np.sin(q[:, 0] + q[:, 1])
    b1 = -p["p3"] * s * v[:, 1] * (2 * v[:, 0] + v[:, 1])
    b1 = b1 + p["g"] * p["p4"] * np.sin(q[:, 0]) + outer
    b2 = p["p3"] * s * v[:, 0] ** 2 + outer
    return m11, m12, p["p2"], b1, b2


def rate(p: dict, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Accelerations of many arms, (runs, 2)."""
    m11, m12, m22, b1, b2 = inverse_terms(p, q, v)
    f = 2 / np.pi * np.arctan(p["gamma"][:, None] * v)
    r1 = tau[:, 0] - b1 - p["Fv1"] * v[:, 0] - p["Fc1"] * f[:, 0]
    r2 = tau[:, 1] - b2 - p["Fv2"] * v[:, 1] - p["Fc2"] * f[:, 1]
    det = m11 * m22 - m12**2
    return np.stack([(m22 * r1 - m12 * r2) / det, (m11 * r2 - m12 * r1) / det], axis=1)


def step(p: dict, q: np.ndarray, v: np.ndarray, tau: np.ndarray, h: float) -> tuple:
    """One classical Runge-Kutta step under a torque that holds."""
    a1 = rate(p, q, v, tau)
    q2, v2 = q + h / 2 * v, v + h / 2 * a1
    a2 = rate(p, q2, v2, tau)
    q3, v3 = q + h / 2 * v2, v + h / 2 * a2
    a3 = rate(p, q3, v3, tau)
    q4, v4 = q + h * v3, v + h * a3
    a4 = rate(p, q4, v4, tau)
    return q + h / 6 * (v + 2 * v2 + 2 * v3 + v4), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)


def simulate_batch(
    plants: list[TwoLink],
    reference: np.ndarray,
    law: SampledComputedTorque,
    resolution: np.ndarray,
    offset: np.ndarray | float = 0.0,
    substeps: int = 4,
    noise: np.ndarray | None = None,
    q0: np.ndarray | None = None,
) -> Batch:
    """All runs side by side.

    `reference` is position, velocity and acceleration at the ticks, (3, samples, 2); `resolution`
    an encoder's step of each run in rad, zero for none; `offset` the place of its first edge in
    steps, (runs, 2); `noise` is added to the torque that acts and not recorded, (runs, samples, 2).
    """
    p, model = arrays(plants), arrays([law.model] * len(plants))
    runs, samples = len(plants), reference.shape[1]
    Q = np.asarray(resolution, float)[:, None] * np.ones(2)
    Kp, Ki, Kd = (np.asarray(k) for k in (law.Kp, law.Ki, law.Kd))
    q = np.tile(reference[0, 0], (runs, 1)) if q0 is None else q0.copy()
    v, integral = np.zeros((runs, 2)), np.zeros((runs, 2))

    def read(q: np.ndarray) -> np.ndarray:
        safe = np.where(Q > 0, Q, 1.0)
        counted = safe * (np.round(q / safe - offset) + offset)
        return np.where(Q > 0, counted, q)

    past = [read(q)] * law.window
    seen, true, torque = (np.empty((runs, samples, 2)) for _ in range(3))
    for k in range(samples):
        now = read(q)
        ref, ref_v, ref_a = reference[:, k]
        speed = (now - past.pop(0)) / (law.window * law.period)
        past.append(now)
        integral = integral + law.period * (ref - now)
        asked = ref_a + Kd * (ref_v - speed) + Kp * (ref - now) + Ki * integral
        m11, m12, m22, b1, b2 = inverse_terms(model, now, speed)
        tau = np.stack(
            [
                m11 * asked[:, 0] + m12 * asked[:, 1] + b1,
                m12 * asked[:, 0] + m22 * asked[:, 1] + b2,
            ],
            axis=1,
        )
        seen[:, k], true[:, k], torque[:, k] = now, q, tau
        acting = tau if noise is None else tau + noise[:, k]
        for _ in range(substeps):
            q, v = step(p, q, v, acting, law.period / substeps)
    return Batch(law.period * np.arange(samples), seen, true, torque)
