"""Predefined robots: arm, friction, controller and start values from the papers."""

import dataclasses
import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from .arms import SCARA, Axis, PhysicalArm, SerialArm, TwoLink, drawn_covariance
from .arms.urdf import read_urdf
from .control import PD, AbstractController, Cascade, Tracking
from .effects import Coulomb, RotorInertia, TorqueOffset, Viscous
from .errors import ModelError
from .simulation.loop import ClosedLoop


def _friction(joints: int, smoothing: float = 0.01) -> tuple[Viscous | Coulomb, ...]:
    pairs = [
        (Viscous(joint=j), Coulomb(joint=j, smoothing=smoothing)) for j in range(1, joints + 1)
    ]
    return tuple(effect for pair in pairs for effect in pair)


def scara(controller: AbstractController | None = None) -> ClosedLoop:
    """The SCARA of Brunot et al. 2016 at its CAD values, under the PD law of their Table 1.

    **Arguments:**

    - `controller`: another law, for instance `Tracking()`.
    """
    law = PD(Kp=[6.25, 156.25], Kv=[2.0, 25.0], Kg=[3.5, 0.06])
    return ClosedLoop(SCARA(), controller or law, _friction(2), name="scara")


def two_link(
    controller: AbstractController | None = None, link_length: float | None = None
) -> ClosedLoop:
    """A two-link arm under gravity with the nine parameters of Li, Peng and Juang 2023.

    **Arguments:**

    - `controller`: its law; a plain PD by default. `OpenLoop()` and `Tracking()` need none.
    - `link_length`: of the first link, m; gives p3 = link_length · p5.
    """
    law = controller or PD(Kp=[100.0, 100.0], Kv=[20.0, 20.0])
    arm = TwoLink(link_length=link_length)
    return ClosedLoop(arm, law, _friction(2), name="two-link")


def emps(controller: AbstractController | None = None) -> ClosedLoop:
    """The EMPS axis of Janot, Gautier and Brunot 2019 with its cascade, and a force offset.

    **Arguments:**

    - `controller`: another law, for instance `Cascade(delay=True)`.
    """
    friction = Viscous(joint=1, coefficient=100.0), Coulomb(joint=1, level=10.0, smoothing=5e-5)
    effects = (*friction, TorqueOffset(joint=1))
    # At these speeds the unknown smoothing of the sign affects the force, so it is estimated.
    law = controller or Cascade()
    return ClosedLoop(Axis(), law, effects, name="emps").free("eps1")


def serial(
    source: str | os.PathLike[str],
    controller: AbstractController | None = None,
    *,
    rotors: Sequence[float] | np.ndarray | None = None,
    gears: Any = None,
    bodies: str = "drawn",
    uncertainty: float = 0.2,
    base: str | None = None,
    tip: str | None = None,
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
) -> ClosedLoop:
    """An arm from its URDF, with friction, a torque offset and a rotor on every joint.

    **Arguments:**

    - `source`: path of the URDF, or its text.
    - `controller`: its law; `Tracking()` if None, for an unknown law.
    - `rotors`: inertia of each drive at its joint, kg·m² or kg; if None, it is estimated, starting
      at zero.
    - `gears`: turns of each motor per turn of each joint, `(joints, joints)`, if motors drive more
      than their own joint.
    - `bodies`: `"drawn"` to hold the links' bodies at the values of the file, `"free"` to estimate
      their base parameters, `"near"` to estimate these as far as the recordings contradict the
      values of the file, `"physical"` to deform the bodies of the file as far as the recordings
      contradict them, so that all links are physically consistent (`jaxid.arms.PhysicalArm`).
    - `uncertainty`: relative standard deviation of masses and inertias in the file, for `"near"`
      (`jaxid.arms.drawn_covariance`) and `"physical"`. Regressions (`IDIM`, `DIDIM`) ignore it,
      and hold bodies that are deformed.
    - `base`, `tip`, `gravity`: as for `SerialArm.from_urdf`.

    **Raises:** `ModelError` for a file that describes no serial arm.
    """
    if bodies not in ("drawn", "free", "near", "physical"):
        raise ModelError(f"bodies is {bodies!r}: give 'drawn', 'near', 'physical' or 'free'")
    if not uncertainty > 0:
        raise ModelError(f"uncertainty is {uncertainty}: give a positive number, such as 0.2")
    found = read_urdf(source, base, tip)
    if bodies == "physical":
        deformed = PhysicalArm.of(found, gravity, gears)
        arm = dataclasses.replace(deformed, uncertainty=uncertainty)
    else:
        arm = SerialArm.of(found, gravity, gears)
    n = arm.joints
    if rotors is not None and len(rotors) != n:
        raise ModelError(f"rotors are given for {len(rotors)} of {n} joints: give one for each")
    own = np.zeros(n) if rotors is None else np.asarray(rotors, float)
    effects = (
        *_friction(n),
        *(TorqueOffset(joint=j) for j in range(1, n + 1)),
        *(RotorInertia(joint=j, inertia=float(own[j - 1])) for j in range(1, n + 1)),
    )
    held = [] if rotors is None else [f"Ia{j}" for j in range(1, n + 1)]
    if isinstance(arm, SerialArm) and bodies == "drawn":
        held += ["base"]
    elif isinstance(arm, SerialArm):
        # The inertias of the first rotor and of some others are parts of base parameters.
        inside = [j for j, within in enumerate(arm.absorbed_rotors(), start=1) if within]
        held = [f"Ia{j}" for j in inside]
        if bodies == "near":
            unknown = inside if rotors is None else []
            known = drawn_covariance(arm, uncertainty, unknown)
            arm = dataclasses.replace(arm, covariance=known)
    loop = ClosedLoop(arm, controller or Tracking(), effects, name=found.name)
    # The smoothing of friction near standstill is unknown; it matters most for motions with rests.
    smoothings = [p.name for p in loop.parameters if p.declaration.symbol == "eps"]
    return loop.hold(*held).free(*smoothings)
