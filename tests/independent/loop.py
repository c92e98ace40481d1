"""Equations of motion of a plant with effects and its drives."""

from __future__ import annotations

import math
from collections.abc import Sequence

from .effects import (
    AccelerationSquare,
    Effect,
    EncoderEccentricity,
    LoadDependentFriction,
    Payload,
    ThermalDrift,
)
from .plants import TWO_OVER_PI, Plant, solve_accelerations


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
