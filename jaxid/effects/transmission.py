"""Compliance between drive and link: elasticity, backlash."""

import dataclasses
from collections.abc import Iterable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..parameters import Scalar, parameter
from ._base import AbstractTransmission
from ._scene import Scene

# Smallest twist of the contact, as a share of the gap, of a torque that closes the gap.
_LOADED = 1e-3


class JointElasticity(AbstractTransmission):
    """A compliant transmission: torque (drive - link) / compliance, slightly damped (Spong 1987).

    `rotor` is the part of the joint's inertia on the drive's side; `damping` is the ratio of
    damping to stiffness, s.
    """

    joint: int = eqx.field(static=True)
    compliance: Scalar = parameter(
        0.0, symbol="compliance", unit="rad/(N·m)", lower=0.0, scale=0.01, linear=False
    )
    rotor: Scalar = parameter(0.01, symbol="Jm", unit="kg·m²", lower=1e-6, scale=0.1, linear=False)
    damping: Scalar = parameter(
        1e-3, symbol="dk", unit="s", lower=0.0, scale=1e-3, free=False, linear=False
    )

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["JointElasticity"]:
        """Resonances against the link from 3 Hz to a tenth of the sample rate."""
        highest = 0.1 / scene.period
        rates = 2 * np.pi * np.geomspace(min(3.0, 0.3 * highest), highest, 4)
        return [
            cls(joint=j, compliance=1 / (inertia * rate**2), rotor=0.3 * inertia)
            for j, inertia in zip(scene.joints, scene.inertia, strict=True)
            for rate in rates
        ]

    def scaled(self, factor: float) -> "JointElasticity":
        """The compliance times a factor."""
        return dataclasses.replace(self, compliance=self.compliance * factor)

    def after(self, other: AbstractTransmission, load: float) -> "JointElasticity | None":
        """An elasticity as stiff as the contact, if its twist under load is wider than the gap."""
        if not isinstance(other, Backlash) or other.gap * other.stiffness > load:
            return None
        return dataclasses.replace(self, compliance=1 / other.stiffness, rotor=other.rotor)

    def present(self) -> Bool[Array, ""]:
        """Whether the compliance is above zero."""
        return self.compliance > 0

    def through(self, twist: Float[Array, ""], rate: Float[Array, ""]) -> Float[Array, ""]:
        """Transmitted torque, N·m."""
        soft = jnp.where(self.compliance > 0, self.compliance, 1.0)
        return -(twist + self.damping * rate) / soft

    def twisted(self, torque: Float[Array, ""]) -> Float[Array, ""]:
        """Twist at rest, rad."""
        return -self.compliance * torque


class Backlash(AbstractTransmission):
    """A gap in the transmission, with stiff contact on both sides.

    `gap` is its whole width; `rotor` as for `JointElasticity`. In contact the torque is
    kc depth (1 + dk rate), with the rate positive into the contact (Hunt, Crossley 1975), which is
    continuous where contact begins. Stiffness and damping are held unless freed.
    """

    joint: int = eqx.field(static=True)
    gap: Scalar = parameter(0.0, symbol="gap", unit="rad", lower=0.0, scale=0.01, linear=False)
    rotor: Scalar = parameter(0.01, symbol="Jm", unit="kg·m²", lower=1e-6, scale=0.1, linear=False)
    stiffness: Scalar = parameter(
        100.0, symbol="kc", unit="N·m/rad", lower=0.0, scale=100.0, free=False, linear=False
    )
    damping: Scalar = parameter(
        3.0, symbol="dk", unit="s/rad", lower=0.0, scale=1.0, free=False, linear=False
    )
    contact = True

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["Backlash"]:
        """Gaps up to three hundredths of the travel, contact at a quarter of the sample rate."""
        made = []
        for j in scene.joints:
            inertia = scene.inertia[j - 1]
            stiffness = 0.21 * inertia * (0.25 / scene.period * 2 * np.pi) ** 2
            for share in (0.0003, 0.001, 0.003, 0.01, 0.03):
                for part in (0.22, 0.32, 0.42):
                    gap, rotor = share * scene.travel(j), part * inertia
                    made.append(cls(joint=j, gap=gap, rotor=rotor, stiffness=stiffness))
        return made

    def scaled(self, factor: float) -> "Backlash":
        """The gap times a factor."""
        return dataclasses.replace(self, gap=self.gap * factor)

    def after(self, other: AbstractTransmission, load: float) -> "Backlash | None":
        """A contact as stiff as the elasticity, with a gap of its twist under load on both sides.

        A refit does not converge from a contact that is much too stiff.
        """
        if not isinstance(other, JointElasticity):
            return None
        gap, stiffness = 2 * other.compliance * load, 1 / other.compliance
        return dataclasses.replace(self, gap=gap, rotor=other.rotor, stiffness=stiffness)

    def present(self) -> Bool[Array, ""]:
        """Whether the gap is above zero."""
        return self.gap > 0

    def through(self, twist: Float[Array, ""], rate: Float[Array, ""]) -> Float[Array, ""]:
        """Transmitted torque, N·m; zero inside the gap."""
        depth = jnp.maximum(jnp.abs(twist) - self.gap / 2, 0.0)
        side = jnp.sign(twist)
        grip = jnp.maximum(1 + self.damping * side * rate, 0.0)
        return -side * self.stiffness * depth * grip

    def twisted(self, torque: Float[Array, ""]) -> Float[Array, ""]:
        """Twist at rest, rad; in the middle of the gap if there is hardly any torque."""
        loaded = jnp.abs(torque) > _LOADED * self.stiffness * self.gap
        return jnp.where(loaded, -jnp.sign(torque) * self.gap / 2 - torque / self.stiffness, 0.0)
