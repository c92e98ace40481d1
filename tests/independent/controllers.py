"""Controllers: what turns reference and reading into the commanded torque (N m or N)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class PD:
    """tau_j = Kg_j (Kp_j (qref_j - q_j) - Kv_j v_j), continuous."""

    Kp: tuple[float, ...] = (6.25, 156.25)
    Kv: tuple[float, ...] = (2.0, 25.0)
    Kg: tuple[float, ...] = (3.5, 0.06)
    period = None

    def torque(
        self, ref: Sequence[float], q: Sequence[float], v: Sequence[float], t: float
    ) -> list[float]:
        """Commanded torques, N m."""
        return [
            g * (p * (r - x) - d * w)
            for g, p, d, r, x, w in zip(self.Kg, self.Kp, self.Kv, ref, q, v, strict=True)
        ]


@dataclass(frozen=True)
class SampledPD:
    """The same law computed every `period` s and held; position and velocity as read then."""

    period: float = 0.01
    law: PD = PD()

    def start(self, q: Sequence[float]) -> Callable[..., list[float]]:
        """A function (ref, q, v, t) -> torques to be called once a period."""
        return self.law.torque


@dataclass(frozen=True)
class EmpsCascade:
    """EMPS cascade at 1 kHz: kp 1/s, kv V/(m/s), gtau N/V; +-limit V; resolution m."""

    kp: float = 160.18
    kv: float = 243.45
    gtau: float = 35.15065
    limit: float = 10.0
    period: float = 1e-3
    delay_samples: int = 0
    resolution: float = 1e-7

    def start(self, q: Sequence[float]) -> Callable[..., list[float]]:
        """A function (ref, q, v, t) -> [force N] that remembers the last two readings."""
        last = [q[0], q[0]]

        def step(
            ref: Sequence[float], q: Sequence[float], v: Sequence[float], t: float
        ) -> list[float]:
            x = round(q[0] / self.resolution) * self.resolution if self.resolution else q[0]
            # Mean of this and the last sample, minus the same one period earlier.
            speed = 0.5 * (x - last[1]) / self.period
            last[1], last[0] = last[0], x
            volt = self.kp * self.kv * (ref[0] - x) - self.kv * speed
            return [self.gtau * min(self.limit, max(-self.limit, volt))]

        return step


@dataclass(frozen=True)
class OpenLoop:
    """Torques (N m) given as a function of time (s)."""

    function: Callable[[float], Sequence[float]]
    period = None

    def torque(
        self, ref: Sequence[float], q: Sequence[float], v: Sequence[float], t: float
    ) -> Sequence[float]:
        """Commanded torques, N m."""
        return self.function(t)
