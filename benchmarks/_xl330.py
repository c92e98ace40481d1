"""The XL330 servo with its pendulum: recordings, arm, law, and five models of its friction."""

import dataclasses
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import jaxid
from jaxid.control import Servo
from jaxid.effects import Coulomb, DCMotor, GearFriction, RotorInertia, Stribeck, Viscous
from jaxid.parameters import Scalar, parameter

DATA = Path(__file__).parents[1].parent / "shared" / "data" / "xl330"
NOMINAL, FULL, GRAVITY = 7.4, 885.0, 9.81
# Duty cycle by error for kp = 1: 4096 counts per turn, and the law's divisors.
GAIN = 4096 / (2 * np.pi) / 256 / FULL
# As in the publication, all signals are on one clock of 5 ms.
STEP = 0.005


class Pendulum(jaxid.arms.AbstractArm):
    """A known mass on an arm: m l² a + m g l sin(q + q0)."""

    mass: float = 0.49
    length: float = 0.1
    zero: Scalar = parameter(0.0, symbol="q0", unit="rad", scale=0.01, linear=False)

    @property
    def joints(self):
        """One."""
        return 1

    def mass_matrix(self, q):
        """Inertia, `(1, 1)`, kg·m²."""
        return jnp.full((1, 1), self.mass * self.length**2)

    def bias(self, q, v):
        """Gravity, `(1,)`, N·m."""
        return self.mass * GRAVITY * self.length * jnp.sin(q + self.zero)


def recordings(even: bool = True, supply: bool = False) -> dict[str, jaxid.Recording]:
    """The twelve recordings by name, with the duty cycle as a voltage.

    **Arguments:**

    - `even`: on a clock of 5 ms; otherwise on their own times, which are not uniform.
    - `supply`: with the measured voltage instead of the nominal one.
    """
    found = {}
    for log in json.loads((DATA / "logs.json").read_text(encoding="utf-8"))["logs"]:
        volts = "volts" if supply else f"{NOMINAL}"
        columns = {
            "time": "t",
            "q": "q",
            "q_ref": "q_goal",
            "tau": f"pwm*{volts}*{1 / FULL!r}",
            "on": "torque_on",
            "kp": str(log["kp"]),
        }
        if supply:
            columns["supply"] = "volts"
        (one,) = jaxid.read(DATA / log["file"], columns=columns)
        name = one.name.split(".")[0]
        found[name] = evenly(one, name) if even else one
    return found


def evenly(one: jaxid.Recording, name: str) -> jaxid.Recording:
    """A recording at steps of 5 ms, positions by straight lines."""
    assert one.q_ref is not None
    time = np.arange(one.time[0], one.time[-1], STEP)
    q, q_ref, tau = (
        np.interp(time, one.time, signal[:, 0]) for signal in (one.q, one.q_ref, one.tau)
    )
    held = one.held_at(time)
    return jaxid.Recording.from_arrays(
        time,
        q,
        tau,
        q_ref=q_ref,
        kp=held["kp"],
        on=held["on"],
        supply=held.get("supply"),
        name=name,
    )


def models(sharp: float = 0.003) -> dict[str, jaxid.ClosedLoop]:
    """The loop with the five models of friction, M1 to M5 of the recordings' README.

    **Arguments:**

    - `sharp`: smoothing of the sign of velocity, rad/s.
    """
    smooth = {"smoothing": jnp.asarray(sharp), "form": jnp.asarray(1.0)}
    small = jnp.asarray(0.02)
    motor = DCMotor(joint=1, constant=0.33, resistance=4.3)
    rotor = RotorInertia(joint=1, inertia=jnp.asarray(0.002))
    viscous = Viscous(joint=1, coefficient=jnp.asarray(0.01))
    coulomb = Coulomb(joint=1, level=small, **smooth)
    m1 = jaxid.ClosedLoop(
        arm=Pendulum(),
        controller=Servo(gain=[GAIN], supply=[NOMINAL]),
        effects=[motor, rotor, viscous, coulomb],
        name="XL330",
    )
    stribeck = Stribeck(joint=1, level=small, velocity=jnp.asarray(0.3), smoothing=sharp)
    gear = GearFriction(joint=1, drive=jnp.asarray(0.15), **smooth)
    slow, speed = jnp.asarray(0.1), jnp.asarray(0.3)
    peaked = dataclasses.replace(gear, slow=slow, level=small, velocity=speed)
    sides = dataclasses.replace(peaked, back=jnp.asarray(0.15), slow_back=slow)
    return {
        "M1": m1,
        "M2": m1.add(stribeck),
        "M3": m1.add(gear),
        "M4": m1.add(peaked).free("power1"),
        "M5": m1.add(sides).free("power1"),
    }


def error_mrad(loop: jaxid.ClosedLoop, given: dict[str, jaxid.Recording]) -> dict[str, float]:
    """Mean absolute position error of each recording, simulated from its first sample, mrad."""
    runs = jaxid.simulate(loop, list(given.values()))
    pairs = zip(given.items(), runs, strict=True)
    return {name: 1e3 * float(np.mean(np.abs(r.q - run.q))) for (name, r), run in pairs}
