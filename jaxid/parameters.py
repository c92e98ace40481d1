"""Physical parameters: fields that are declared once with symbol, unit, bounds and scale."""

import dataclasses
import math
import re
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from .errors import ModelError

if TYPE_CHECKING:
    # Fields accept numbers and hold arrays; a type checker does not see the converter.
    Scalar: TypeAlias = Any
    Vector: TypeAlias = Any
else:
    Scalar = Float[Array, ""]
    Vector = Float[Array, " parameters"]


def as_float64(value: Any) -> Any:
    """A number or a sequence as a float64 array: the converter of fields that are not static."""
    # Equinox runs converters while tree operations hold placeholders in the fields.
    if isinstance(value, jax.Array):
        return jnp.asarray(value, dtype=jnp.float64)
    if isinstance(value, (int, float, complex, list, tuple)) or hasattr(value, "__array__"):
        if any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(value)):
            return jnp.asarray(value, dtype=jnp.float64)
        # JAX compiles a program for each shape that it converts.
        return jax.device_put(np.asarray(value, np.float64))
    return value


class Declaration(eqx.Module):
    """Properties of a parameter, as declared by its field."""

    symbol: str
    unit: str
    lower: float = -math.inf
    upper: float = math.inf
    scale: float = 1.0
    free: bool = True
    linear: bool = True


def parameter(
    default: Any = dataclasses.MISSING,
    *,
    symbol: str,
    unit: str,
    lower: float = -math.inf,
    upper: float = math.inf,
    scale: float = 1.0,
    free: bool = True,
    linear: bool = True,
) -> Any:
    """Declares a physical parameter as a field of an arm, an effect or a controller.

    **Arguments:**

    - `default`: value if none is given, in `unit`.
    - `symbol`: its name in the literature, without the joint (`"Fv"`).
    - `unit`: SI unit as shown in tables; empty if the values have units of their own.
    - `lower`, `upper`: bounds of estimates.
    - `scale`: typical size.
    - `free`: whether a fit estimates it by default.
    - `linear`: whether torque is linear in it; regressions hold nonlinear parameters fixed.
    """
    declaration = Declaration(symbol, unit, float(lower), float(upper), float(scale), free, linear)
    extra = {} if default is dataclasses.MISSING else {"default": default}
    return eqx.field(converter=as_float64, metadata={"parameter": declaration}, **extra)


# Metadata of a field whose module is known; its parameters are not parameters of the model.
KNOWN = MappingProxyType({"known": True})


# Attributes and tuple indices from a model to a field of it.
Place: TypeAlias = tuple[str | int, ...]


class Parameter(eqx.Module):
    """One parameter of a model: its declaration, its unique name and its place in the model.

    A field that holds several values (the coefficients of a curve) is one parameter with `size`
    above one. Its values are named by number, or by the `labels` in the owner's `field_names`. They
    have the declared unit, or the `units` in the owner's `field_units`.
    """

    name: str = eqx.field(static=True)
    declaration: Declaration = eqx.field(static=True)
    where: Callable[[Any], Any] = eqx.field(static=True)
    joint: int | None = eqx.field(static=True, default=None)
    size: int = eqx.field(static=True, default=1)
    several: bool = eqx.field(static=True, default=False)
    labels: tuple[str, ...] = eqx.field(static=True, default=())
    units: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def place(self) -> Place:
        """Its place in the model: the attributes and tuple indices that lead to it."""
        return self.where.steps  # type: ignore[attr-defined]

    @property
    def names(self) -> list[str]:
        """One name for each value."""
        if not self.several:
            return [self.name]
        if self.labels:
            return list(self.labels)
        return [f"{self.name}[{k}]" for k in range(1, self.size + 1)]


def sliding_unit(unit: str) -> str:
    """The unit, for a sliding joint, of a parameter declared for a turning one: N·m becomes N."""
    unit = unit.replace("N·m", "N").replace("rad", "m").replace("kg·m²", "kg")
    # Brackets around a single unit are superfluous: m/(N) is m/N.
    return re.sub(r"\((\w+)\)", r"\1", unit)


class _Path(eqx.Module):
    """Follows attributes and tuple indices; hashable, so that it can be static."""

    steps: Place = eqx.field(static=True)

    def __call__(self, tree: Any) -> Any:
        for step in self.steps:
            tree = tree[step] if isinstance(step, int) else getattr(tree, step)
        return tree


def _declared(module: Any, steps: Place) -> Iterator[tuple[Any, str, _Path]]:
    if isinstance(module, (tuple, list)):
        for k, item in enumerate(module):
            yield from _declared(item, (*steps, k))
    elif dataclasses.is_dataclass(module):
        for field in dataclasses.fields(module):
            if "parameter" in field.metadata:
                yield module, field.name, _Path((*steps, field.name))
            elif not field.metadata.get("static") and not field.metadata.get("known"):
                yield from _declared(getattr(module, field.name), (*steps, field.name))


def list_parameters(model: Any) -> tuple[Parameter, ...]:
    """All parameters declared anywhere in a module, in the order of its fields.

    The name is the symbol followed by the owner's joint, if it has one. If two names would be
    equal, the later gets `_2`, `_3` and so on.
    """
    leaves, structure = jax.tree.flatten(model)
    return _listed(structure, tuple(np.shape(leaf) for leaf in leaves))


@lru_cache(maxsize=1024)
def _listed(structure: Any, shapes: tuple[tuple[int, ...], ...]) -> tuple[Parameter, ...]:
    """The parameters of a module, cached by structure: a fit needs them dozens of times."""
    model = jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(s, float) for s in shapes])
    found: list[Parameter] = []
    taken: set[str] = set()
    for owner, field, where in _declared(model, ()):
        value = getattr(owner, field)
        if value is None:
            continue
        declaration = type(owner).__dataclass_fields__[field].metadata["parameter"]
        joint = getattr(owner, "joint", None)
        symbol = declaration.symbol + ("" if joint is None else str(joint))
        name, number = symbol, 1
        while name in taken:
            number += 1
            name = f"{symbol}_{number}"
        taken.add(name)
        size, several = math.prod(value.shape), bool(value.shape)
        labels = tuple(getattr(owner, f"{field}_names", ()))
        units = tuple(getattr(owner, f"{field}_units", (declaration.unit,) * size))
        found.append(Parameter(name, declaration, where, joint, size, several, labels, units))
    return tuple(found)


def read_values(model: Any, parameters: Sequence[Parameter]) -> Vector:
    """The values of some parameters of a model as one vector.

    **Arguments:**

    - `model`: what `list_parameters` was called on.
    - `parameters`: which, and in which order.
    """
    values = [p.where(model) for p in parameters]
    if any(isinstance(x, Tracer) for x in values):
        return jnp.concatenate([jnp.ravel(x) for x in values])
    return jax.device_put(np.concatenate([np.zeros(0), *map(np.ravel, values)]))


def write_values(
    model: Any,
    parameters: Sequence[Parameter],
    values: Float[Array | np.ndarray, " parameters"],
) -> Any:
    """The model with other values for some of its parameters.

    **Arguments:**

    - `model`: what `list_parameters` was called on.
    - `parameters`: which, and in which order.
    - `values`: `(parameters,)`, in their units.
    """
    if not parameters:
        return model
    traced = isinstance(values, Tracer)
    pieces, start = [], 0
    for p in parameters:
        piece = (values if traced else np.asarray(values))[start : start + p.size]
        pieces.append(piece.reshape(jnp.shape(p.where(model))))
        start += p.size
    pieces = pieces if traced else jax.device_put(pieces)
    return eqx.tree_at(lambda tree: [p.where(tree) for p in parameters], model, pieces)


def set_by_name(model: Any, **values: float) -> Any:
    """The model with the named parameters set.

    A parameter that holds several values is set as a whole, or by element as `name[1]`, ….

    **Raises:** `ModelError` for a name the model does not have.
    """
    if not values:
        return model
    known = {p.name: p for p in list_parameters(model)}
    values = _whole(model, known, values)
    for name in values:
        if name not in known:
            raise ModelError(
                f"there is no parameter {name!r} in this model: it has {', '.join(known)}"
            )
    for name, value in values.items():
        if np.size(value) != known[name].size:
            raise ModelError(
                f"{name} has {known[name].size} values, but {np.size(value)} are given: give all"
            )
    chosen = [known[name] for name in values]
    flat = jnp.concatenate([jnp.ravel(as_float64(v)) for v in values.values()])
    return write_values(model, chosen, flat)


def _whole(model: Any, known: dict[str, Parameter], values: dict[str, float]) -> dict[str, Any]:
    """Values by parameter; those given as `name[1]` replace elements of the model's values."""
    found: dict[str, Any] = {}
    labelled = {n: (p.name, k) for p in known.values() for k, n in enumerate(p.labels, start=1)}
    for name, value in values.items():
        indexed = re.fullmatch(r"(.+)\[(\d+)\]", name)
        whole, place = (indexed[1], int(indexed[2])) if indexed else (name, 0)
        whole, place = labelled.get(name, (whole, place))
        if whole in known and 1 <= place <= known[whole].size:
            had = found.get(whole, np.asarray(known[whole].where(model), float))
            found[whole] = np.ravel(had).copy()
            found[whole][place - 1] = value
        else:
            found[name] = value
    return found


class Bounds(eqx.Module):
    """Maps unbounded coordinates to parameter values inside their bounds.

    Away from a bound the map is almost the identity, so it hardly changes Gauss-Newton steps.
    """

    lower: Vector
    upper: Vector
    scale: Vector

    @classmethod
    def of(cls, parameters: Sequence[Parameter]) -> "Bounds":
        """The bounds that the parameters declare."""

        def gather(pick: Callable[[Declaration], float]) -> Vector:
            return as_float64([pick(p.declaration) for p in parameters for _ in range(p.size)])

        return cls(gather(lambda d: d.lower), gather(lambda d: d.upper), gather(lambda d: d.scale))

    def inside(self, z: Vector) -> Vector:
        """Parameter values from unbounded coordinates."""
        low, high = jnp.isfinite(self.lower), jnp.isfinite(self.upper)
        base = jnp.where(low, self.lower, 0.0)
        top = jnp.where(high, self.upper, 0.0)
        one_sided = base + self.scale * _squareplus(z)
        from_above = top - self.scale * _squareplus(-z)
        both = base + (top - base) * jax.nn.sigmoid(z)
        free = self.scale * z
        return jnp.where(
            low & high, both, jnp.where(low, one_sided, jnp.where(high, from_above, free))
        )

    def outside(self, values: Vector) -> Vector:
        """Unbounded coordinates of parameter values; values on a bound are moved just inside."""
        low, high = jnp.isfinite(self.lower), jnp.isfinite(self.upper)
        base = jnp.where(low, self.lower, 0.0)
        top = jnp.where(high, self.upper, 0.0)
        one_sided = _inverse_squareplus((values - base) / self.scale)
        from_above = -_inverse_squareplus((top - values) / self.scale)
        width = jnp.where(low & high, top - base, 1.0)
        share = jnp.clip((values - base) / width, _SHARE, 1 - _SHARE)
        both = jnp.log(share) - jnp.log1p(-share)
        free = values / self.scale
        return jnp.where(
            low & high, both, jnp.where(low, one_sided, jnp.where(high, from_above, free))
        )

    def moved_inside(self, values: Vector) -> Vector:
        """The values, `(parameters,)`, with those on or beyond a bound moved just inside.

        Values inside are unchanged, even close to a bound: all values of a small robot are small.
        """
        traced = isinstance(values, Tracer)
        xp = jnp if traced else np
        x, low, high, scale = map(xp.asarray, (values, self.lower, self.upper, self.scale))
        # As far inside as `outside` moves them.
        between = xp.isfinite(low) & xp.isfinite(high)
        room = xp.where(between, _SHARE * (high - low), _CORNER * scale)
        moved = xp.where((x > low) & (x < high), x, xp.clip(x, low + room, high - room))
        return moved if traced else jax.device_put(moved)


# Rounding of the corner at a bound, in units of the parameter's scale; between two bounds the
# share of their distance that values keep from them.
_CORNER, _SHARE = 1e-3, 1e-6


def _squareplus(z: Vector) -> Vector:
    return 0.5 * (z + jnp.sqrt(z**2 + 4 * _CORNER**2))


def _inverse_squareplus(y: Vector) -> Vector:
    y = jnp.maximum(y, _CORNER)
    return y - _CORNER**2 / y
