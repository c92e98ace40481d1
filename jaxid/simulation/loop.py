"""The closed loop: arm, effects, controller and sensors, and its equations of motion."""

import dataclasses
import html
import math
import re
from collections.abc import Iterable
from typing import Any

import equinox as eqx

from ..arms import AbstractArm
from ..control import AbstractController
from ..effects import AbstractEffect, AbstractTransmission
from ..errors import ModelError
from ..parameters import (
    Parameter,
    Place,
    Vector,
    list_parameters,
    read_values,
    set_by_name,
    sliding_unit,
    write_values,
)
from ..signals.standstill import Standstill
from .stepping import Stepping


class ClosedLoop(eqx.Module):
    """An arm with its effects under feedback control.

    **Arguments:**

    - `arm`: rigid bodies.
    - `controller`: acts on what the sensors read.
    - `effects`: friction and others, in the order in which the signal passes through the drive.
    - `name`: name of the robot in results.
    - `held`: places of parameters that fits hold fixed; names are converted to places.
    - `freed`: places of parameters that fits estimate although they are not free by default.
    - `resolution`: step of the simulated encoders, `(joints,)`, rad or m; None for ideal ones.
    - `stepping`: how it is integrated.
    - `standstill`: where joints count as standing still, so that their torque is not compared.
    """

    arm: AbstractArm
    controller: AbstractController
    effects: tuple[AbstractEffect, ...] = eqx.field(default=(), converter=tuple)
    name: str = eqx.field(static=True, default="robot")
    # By place, because another parameter may get the name when effects are added or removed.
    held: frozenset[Place] = eqx.field(static=True, default=frozenset(), converter=frozenset)
    freed: frozenset[Place] = eqx.field(static=True, default=frozenset(), converter=frozenset)
    resolution: tuple[float, ...] | None = eqx.field(static=True, default=None)
    stepping: Stepping = Stepping()
    standstill: Standstill = Standstill()

    def __post_init__(self):
        # Converters have not run yet at this point.
        self.effects = tuple(self.effects)
        self.held, self.freed = self._places(self.held), self._places(self.freed)

    def __check_init__(self):
        for effect in self.effects:
            if not isinstance(effect, AbstractEffect):
                raise ModelError(
                    f"{effect!r} is not an effect of {self.name}: give an object such as "
                    "jaxid.effects.Viscous(joint=1)"
                )
            joint = getattr(effect, "joint", None)
            if joint is not None and not 1 <= joint <= self.joints:
                raise ModelError(
                    f"{effect.effect_name()} is on joint {joint}, but {self.name} has joints 1 to "
                    f"{self.joints}: joints are counted from 1"
                )
        joints = [e.joint for e in self.effects if isinstance(e, AbstractTransmission)]
        for joint in joints:
            if joints.count(joint) > 1:
                raise ModelError(
                    f"{self.name} has two transmissions on joint {joint}: keep one of them"
                )

    @property
    def joints(self) -> int:
        """Number of joints of the arm."""
        return self.arm.joints

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Every parameter of the arm, the effects and the controller."""
        return list_parameters(self)

    @property
    def free_parameters(self) -> tuple[Parameter, ...]:
        """The parameters that a fit estimates, in the order of its vectors."""
        return tuple(
            p
            for p in self.parameters
            if (p.declaration.free or p.place in self.freed) and p.place not in self.held
        )

    @property
    def held_names(self) -> frozenset[str]:
        """Names of the parameters that fits hold fixed on request."""
        return frozenset(p.name for p in self.parameters if p.place in self.held)

    @property
    def freed_names(self) -> frozenset[str]:
        """Names of the parameters that fits estimate on request."""
        return frozenset(p.name for p in self.parameters if p.place in self.freed)

    @property
    def names(self) -> tuple[str, ...]:
        """One name for each value that a fit estimates."""
        return tuple(name for p in self.free_parameters for name in p.names)

    def units(self, parameter: Parameter) -> tuple[str, ...]:
        """One unit for each value of a parameter; with m and N for a prismatic joint."""
        joint = parameter.joint
        slides = joint is not None and self.arm.prismatic()[joint - 1]
        return tuple(map(sliding_unit, parameter.units)) if slides else parameter.units

    @property
    def theta(self) -> Vector:
        """The values that a fit estimates, `(parameters,)`."""
        return read_values(self, self.free_parameters)

    def with_theta(self, theta: Vector) -> "ClosedLoop":
        """The same loop with other values for its free parameters, `(parameters,)`.

        **Raises:** `ModelError` if the number of values differs.
        """
        parameters = self.free_parameters
        count = sum(p.size for p in parameters)
        if theta.shape != (count,):
            raise ModelError(
                f"theta has shape {theta.shape}, but {self.name} has {count} free parameters: give "
                "one value for each of loop.names, in that order"
            )
        return write_values(self, parameters, theta)

    def with_values(self, **values: float) -> "ClosedLoop":
        """The same loop with parameters set by name.

        **Raises:** `ModelError` for a name it does not have.
        """
        return set_by_name(self, **values)

    def hold(self, *names: str, **values: float) -> "ClosedLoop":
        """The same loop with parameters that fits hold fixed, at the given values if any.

        **Raises:** `ModelError` for a name it does not have.
        """
        chosen = self._places({*names, *values})
        loop = self.with_values(**values) if values else self
        return dataclasses.replace(loop, held=loop.held | chosen, freed=loop.freed - chosen)

    def free(self, *names: str) -> "ClosedLoop":
        """The same loop with parameters that fits estimate.

        **Raises:** `ModelError` for a name it does not have.
        """
        chosen = self._places(names)
        return dataclasses.replace(self, held=self.held - chosen, freed=self.freed | chosen)

    def _places(self, given: Iterable[str | Place]) -> frozenset[Place]:
        """Places of parameters that are given by name or by place."""
        given = list(given)
        if not any(isinstance(one, str) for one in given):
            return frozenset(given)  # type: ignore[arg-type]
        known = {p.name: p.place for p in self.parameters}
        for one in given:
            if isinstance(one, str) and one not in known:
                raise ModelError(
                    f"there is no parameter {one!r} in this model: it has {', '.join(known)}"
                )
        return frozenset(known[one] if isinstance(one, str) else one for one in given)

    def add(self, *effects: AbstractEffect) -> "ClosedLoop":
        """The same loop with more effects."""
        return dataclasses.replace(self, effects=(*self.effects, *effects))

    def with_effects(self, effects: Iterable[AbstractEffect]) -> "ClosedLoop":
        """The same loop with these effects; held and freed parameters of kept effects stay so.

        A parameter's name may change if another of its kind is added or removed.
        """
        after = tuple(effects)
        left = list(enumerate(after))
        now: dict[str | int, int] = {}
        for k, effect in enumerate(self.effects):
            found = next((pair for pair in left if pair[1] is effect), None)
            if found is not None:
                left.remove(found)
                now[k] = found[0]

        def moved(places: frozenset[Place]) -> frozenset[Place]:
            others = {place for place in places if place[0] != "effects"}
            kept = [place for place in places - others if place[1] in now]
            return frozenset(others) | {("effects", now[p[1]], *p[2:]) for p in kept}

        return dataclasses.replace(
            self, effects=after, held=moved(self.held), freed=moved(self.freed)
        )

    def without(self, name: str, joint: int | None = None) -> "ClosedLoop":
        """The same loop without the effects of a given name, on one joint or on all.

        **Arguments:**

        - `name`: as in tables, for instance `"coulomb"`.
        - `joint`: counted from 1; None for all.

        **Raises:** `ModelError` if there is no such effect.
        """

        def named(effect: AbstractEffect) -> bool:
            where = getattr(effect, "joint", None)
            return effect.effect_name() == name and (joint is None or where == joint)

        kept = tuple(effect for effect in self.effects if not named(effect))
        if len(kept) == len(self.effects):
            there = sorted({effect.effect_name() for effect in self.effects})
            where = "" if joint is None else f" on joint {joint}"
            raise ModelError(
                f"there is no effect {name!r}{where} to remove: the loop has {', '.join(there)}"
            )
        return self.with_effects(kept)

    @classmethod
    def fields_of_format(cls, fields: dict[str, Any], written: int) -> dict[str, Any]:
        """Fields of a saved loop of an older format, held and freed names converted to new ones."""

        def named(one: str | Place) -> str | Place:
            if isinstance(one, str):
                return re.sub(r"^gamma(?=\d)", "eps", one)
            return tuple("smoothing" if step == "gamma" else step for step in one)

        if written > 2:
            return fields
        return {
            name: frozenset(map(named, value)) if name in ("held", "freed") else value
            for name, value in fields.items()
        }

    def of_format(self, written: int) -> "ClosedLoop":
        """The loop of a saved result of an older format; the first format held and freed names."""
        return dataclasses.replace(self) if written == 1 else self

    def _repr_html_(self) -> str:
        rows = "".join(
            "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in _row(self, p)) + "</tr>"
            for p in self.parameters
        )
        head = "".join(f"<th>{name}</th>" for name in ("parameter", "value", "unit", "bounds", ""))
        return (
            f"<p>{html.escape(repr(self).split(';')[0])}; {type(self.controller).__name__})</p>"
            f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"
        )

    def __repr__(self) -> str:
        effects = ", ".join(
            effect.effect_name() + (f"({effect.joint})" if hasattr(effect, "joint") else "")  # type: ignore[attr-defined]
            for effect in self.effects
        )
        values = ", ".join(
            f"{p.name} {float(p.where(self)):.4g}" for p in self.free_parameters if not p.several
        )
        return (
            f"ClosedLoop({self.name}: {type(self.arm).__name__} with {effects}; "
            f"{type(self.controller).__name__}; {values})"
        )


def _row(loop: ClosedLoop, p: Parameter) -> tuple[str, ...]:
    """A parameter's row in the loop's table: name, value, unit, bounds, whether it is held."""
    low, high = p.declaration.lower, p.declaration.upper
    bounds = [f"≥ {low:g}" if low > -math.inf else "", f"≤ {high:g}" if high < math.inf else ""]
    value = "several" if p.several else f"{float(p.where(loop)):.4g}"
    free = any(p.place == other.place for other in loop.free_parameters)
    unit = ", ".join(dict.fromkeys(loop.units(p)))
    return p.name, value, unit, " ".join(filter(None, bounds)), "" if free else "held"
