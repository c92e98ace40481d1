"""The truth of a case as a model of jaxid, and the evidence for it from the recordings."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import signal, stats

import jaxid
from jaxid import effects as fx
from tests import independent as sim

from ._hidden_cases import start_model

Key = tuple[str, int | None]
WHOLE_ARM = ("payload", "gravity")


def true_key(effect: sim.Effect) -> Key:
    """Name and joint; None for effects of the whole arm."""
    return effect.name, None if effect.name in WHOLE_ARM else effect.joint


def same(found: Key, true: Key) -> bool:
    """Whether a finding names the true effect; on the whole arm the joint does not matter."""
    return found[0] == true[0] and (found[0] in WHOLE_ARM or found[1] == true[1])


def in_jaxid(effect: Any, plant: Any) -> fx.AbstractEffect:
    """The simulator's effect as an effect of jaxid, with the values of common parameters.

    **Raises:** `ValueError` for effects outside the catalogue.
    """
    e, j = effect, effect.joint
    match type(effect).__name__:
        case "Stribeck":
            return fx.Stribeck(j, e.torque, e.velocity, 1 / e.gamma)
        case "AsymmetricFriction":
            return fx.AsymmetricFriction(j, e.viscous, e.coulomb, e.exponent, 1 / e.gamma)
        case "QuadraticDrag":
            return fx.QuadraticDrag(j, e.drag)
        case "LoadDependentFriction":
            return fx.LoadDependentFriction(j, e.ratio, 1 / e.gamma)
        case "PositionDependentFriction":
            return fx.PositionDependentFriction(j, e.A1, e.B1, e.A2, e.B2, 1 / e.gamma)
        case "Dahl":
            return fx.Hysteresis(j, e.torque, e.displacement)
        case "LuGre":
            return fx.LuGre(j, e.torque, e.displacement, e.excess, e.velocity, e.damping)
        case "JointElasticity":
            return fx.JointElasticity(j, e.compliance, e.motor_inertia, e.damping)
        case "Backlash":
            return fx.Backlash(j, e.gap, e.motor_inertia, e.stiffness)
        case "TorqueRipple":
            return fx.TorqueRipple(j, e.A, e.B, e.harmonic)
        case "TorqueOffset":
            return fx.TorqueOffset(j, e.torque)
        case "DriveGain":
            return fx.DriveGain(j, e.gain)
        case "ActuatorLag":
            return fx.ActuatorLag(j, e.time_constant)
        case "TimeDelay":
            return fx.TimeDelay(j, e.delay)
        case "TorqueSaturation":
            return fx.TorqueSaturation(j, e.limit)
        case "Gravity":
            mx, my = plant.second_link_moments()
            return fx.Gravity(
                (-e.gy * e.first_moment, e.gx * my - e.gy * mx),
                (e.gx * e.first_moment, e.gx * mx + e.gy * my),
            )
        case "Spring":
            return fx.Spring(j, e.stiffness, e.stiffness * e.rest)
        case "Payload" if plant.joints == 1:
            return fx.Payload(e.mass, 0.0, e.recordings, slides=True)
        case "Payload":
            return fx.Payload(e.mass, e.reach, e.recordings, (plant.L,))
        case "RotorInertia":
            return fx.RotorInertia(j, e.inertia)
        case "ThermalDrift":
            viscous, coulomb = plant.friction_parameters()[j - 1]
            viscous, coulomb = e.amplitude * viscous, e.amplitude * coulomb
            return fx.ThermalDrift(j, viscous, coulomb, e.time_constant, 1 / plant.gamma)
        case "PeriodicDisturbance":
            cos, sin = e.amplitude * np.sin(e.phase), e.amplitude * np.cos(e.phase)
            return fx.PeriodicDisturbance(j, float(cos), float(sin), e.frequency)
        case "EndStop":
            return fx.EndStop(j, e.stiffness, e.angle, 1 if e.angle > 0 else -1)
        case "EncoderEccentricity":
            sin, cos = e.amplitude * np.cos(e.phase), e.amplitude * np.sin(e.phase)
            return fx.EncoderEccentricity(j, float(sin), float(cos))
    raise ValueError(f"{effect} is not in jaxid's catalogue")


def innovations(case: sim.Case, names: Sequence[str], errors: Sequence[np.ndarray]) -> float:
    """Squared residuals whitened by the true noise filter: the chi squared of the truth.

    **Arguments:**

    - `names`: of the case's recordings. `errors`: `(samples, joints)` for each recording.
    """
    total = 0.0
    for name, error in zip(names, errors, strict=True):
        noise = case.recordings[name]["noise"]
        for j, coefficients in enumerate(case.noise.ar):
            skip = len(coefficients)
            a = [1.0, *coefficients]
            level = np.mean(signal.lfilter(a, [1.0], noise[:, j])[skip:] ** 2)
            total += float(np.sum(signal.lfilter(a, [1.0], error[:, j])[skip:] ** 2) / level)
    return total


def chi_squared(case: sim.Case, fit: jaxid.Fit, held_out: jaxid.Recordings) -> dict[str, float]:
    """Chi squared of a fit by the true noise, on fitted and on held-out recordings."""
    found = innovations(case, list(fit.recordings.names), fit.residuals)
    unseen = jaxid.compare(fit, held_out).residuals
    return {
        "fit": found,
        "held_out": innovations(case, list(held_out.names), unseen),
        "parameters": len(fit.names),
    }


def oracle(case: sim.Case, without: Sequence[int], fitting: jaxid.Recordings) -> jaxid.Fit:
    """The fit of an oracle: the true effects without some, started at the true values."""
    keep = [e for k, e in enumerate(case.effects) if k not in without]
    loop = start_model(case)
    # The friction of an axis has no joint number in the plant, but it has one in the loop.
    base = {
        name if name in loop.names else f"{name}1": getattr(case.plant, name)
        for name in case.plant.base
    }
    loop = loop.with_values(**base).add(*(in_jaxid(e, case.plant) for e in keep))
    return jaxid.fit(loop, fitting, jaxid.OEM(start="given", progress=False))


def visible(
    case: sim.Case, fitting: jaxid.Recordings, held_out: jaxid.Recordings, base: jaxid.Fit
) -> dict[str, Any]:
    """Whether an oracle can prove each true effect on the fitted recordings.

    **Returns:** the oracle's chi squared, and for each effect its decrease in addition to the
    others, with the p-value.
    """
    full = oracle(case, (), fitting)
    best = chi_squared(case, full, held_out)
    proofs = []
    for k, effect in enumerate(case.effects):
        less = base if len(case.effects) == 1 else oracle(case, (k,), fitting)
        worse = chi_squared(case, less, held_out)
        gained, freedom = worse["fit"] - best["fit"], best["parameters"] - worse["parameters"]
        p = float(stats.chi2.sf(gained, freedom))
        proofs.append({"effect": effect.name, "joint": effect.joint, "gained": gained, "p": p})
    return {"chi_squared": best, "status": full.status.name, "proofs": proofs}


def hidden_in_base(case: sim.Case) -> dict[str, float]:
    """For effects outside the catalogue: their power beyond the base parameters and the noise."""
    beyond = sim.remaining_after_refit(case)
    return {"beyond_base_in_noise": max(beyond)}
