"""The least-squares problem of a simulated loop, and its products around a point."""

import dataclasses
from types import ModuleType
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int

from ...compiling import compiled
from ...simulation.batch import Batch
from ...simulation.dynamics import imposed
from ...simulation.loop import ClosedLoop
from ...simulation.sharing import (
    shared_out,
)
from .arrow import Arrow, Unknowns
from .descent import Products
from .filtering import Coefficients, known_rows
from .prior import Prior
from .residual import Sensitivity, mixed, raw_residual, through_filter, unfiltered


class Sums(eqx.Module):
    """Products of residual and derivatives, separately for each output.

    They can be scaled to new weights of the outputs without another simulation. The rows of a prior
    are one more output, whose weight stays the same.

    - `loss`: r'r. `gram`, `slope`: J'J and J'r of the parameters.
    - `start_gram`, `start_slope`: J'J and J'r of each recording's initial state. `cross`: J'J
      between initial states and parameters. Empty if no initial state is estimated.
    """

    loss: Float[Any, " outputs"]
    gram: Float[Any, "outputs parameters parameters"]
    slope: Float[Any, "outputs parameters"]
    start_gram: Float[Any, "outputs recordings estimated estimated"]
    start_slope: Float[Any, "outputs recordings estimated"]
    cross: Float[Any, "outputs recordings estimated parameters"]

    @classmethod
    def of(cls, found: Sensitivity, free: Float[Array, " recordings"]) -> "Sums":
        """The products of a linearisation.

        **Arguments:**

        - `free`: one for recordings whose initial state is estimated, else zero.
        """
        r, j = found.residual, found.jacobian
        s = jnp.zeros((0, *j.shape[1:3], 0))
        across = jnp.zeros((j.shape[2], 0, 0, j.shape[3]))
        if found.start is not None:
            s = found.start * free[:, None, None, None]
            across = jnp.einsum("rkoa,rkop->orap", s, j)
        return cls(
            jnp.einsum("rko,rko->o", r, r),
            jnp.einsum("rkop,rkoq->opq", j, j),
            jnp.einsum("rkop,rko->op", j, r),
            jnp.einsum("rkoa,rkob->orab", s, s),
            jnp.einsum("rkoa,rko->ora", s, r[: len(s)]),
            across,
        )

    def added(self) -> tuple[Any, ...]:
        """The sums over all outputs, in the order of the fields."""
        fields = (self.loss, self.gram, self.slope, self.start_gram, self.start_slope, self.cross)
        return tuple(x.sum(axis=0) for x in fields)

    def products(self, loss: Float[Any, ""]) -> Products:
        """Half the squared error, its gradient and J'J, summed over all outputs.

        **Arguments:**

        - `loss`: infinite if the point is not acceptable.
        """
        _, gram, slope, start_gram, start_slope, cross = self.added()
        return Products(loss / 2, (slope, start_slope), Arrow(gram, start_gram, cross))

    def beside(self, prior: Prior, theta: Float[Any, " parameters"], xp: ModuleType) -> "Sums":
        """The products with those of a prior as one more output.

        **Arguments:**

        - `theta`: parameter values. `xp`: `numpy` or `jax.numpy`.
        """
        own = dict(zip(("loss", "gram", "slope"), prior.products(theta, xp), strict=True))

        def more(name: str) -> Any:
            x = getattr(self, name)
            last = own[name] if name in own else xp.zeros(x.shape[1:])
            return xp.concatenate([xp.asarray(x), last[None]])

        return Sums(**{f.name: more(f.name) for f in dataclasses.fields(self)})

    def weighted(self, ratio: Float[np.ndarray, " outputs"]) -> "Sums":
        """The products for other weights of the outputs.

        **Arguments:**

        - `ratio`: new weights over former ones.
        """
        ratio = np.append(ratio, np.ones(len(self.loss) - len(ratio)))

        def scaled(x: Any) -> np.ndarray:
            return np.asarray(x) * np.reshape(ratio**2, (-1, *(1,) * (np.ndim(x) - 1)))

        return Sums(**{f.name: scaled(getattr(self, f.name)) for f in dataclasses.fields(self)})

    def with_only(self, kept: Int[np.ndarray, " kept"]) -> "Sums":
        """The products of some parameters, given by their indices."""
        gram = np.asarray(self.gram)[:, kept[:, None], kept]
        slope, cross = (np.asarray(x)[..., kept] for x in (self.slope, self.cross))
        return dataclasses.replace(self, gram=gram, slope=slope, cross=cross)


class Point(eqx.Module):
    """A set of parameter values and initial states, and the least-squares problem around it.

    - `theta`: parameter values; `start`: initial position and velocity of each recording.
    - `found`: residual and derivatives. The latter are None if they would fill the memory;
      `with_derivatives` gives them.
    - `loss`: sum of squared weighted residuals; infinite if values are not physical or the
      simulation fails.
    """

    theta: Float[Any, " parameters"]
    start: Float[Any, "recordings initials"]
    found: Sensitivity
    sums: Sums
    loss: Float[Any, ""]

    def with_only(self, kept: Int[np.ndarray, " kept"]) -> "Point":
        """The point with only some of its parameters, given by their indices."""
        found = self.found
        if found.jacobian is not None:
            found = dataclasses.replace(found, jacobian=np.asarray(found.jacobian)[..., kept])
        theta = jnp.asarray(np.asarray(self.theta)[kept])
        return dataclasses.replace(self, theta=theta, found=found, sums=self.sums.with_only(kept))

    def beside(self, prior: Prior | None, xp: ModuleType) -> "Point":
        """The point of a problem with a prior.

        **Arguments:**

        - `xp`: `numpy` or `jax.numpy`.
        """
        if prior is None:
            return self
        sums = self.sums.beside(prior, xp.asarray(self.theta), xp)
        return dataclasses.replace(self, sums=sums, loss=self.loss + sums.loss[-1])


class Problem(eqx.Module):
    """The residual to minimise, and the bounds of its parameters.

    - `free`: one for recordings whose initial state is estimated, else zero.
    - `mesh`: devices that share the recordings; None for one device.
    - `coefficients`: estimated coefficients of the noise filter, after the loop's parameters in one
      vector; None if the filter is given.
    - `mix`: matrix that makes filtered outputs white and uncorrelated, `(outputs, outputs)`; None
      if the weights suffice.
    - `prior`: knowledge of the loop's parameters before the recordings; None if there is none.
    """

    loop: ClosedLoop
    batch: Batch
    weights: Float[Array, " outputs"]
    noise: Float[Array, "outputs *taps"]
    free: Float[Array, " recordings"]
    lower: Float[Array, " parameters"]
    upper: Float[Array, " parameters"]
    signals: tuple[str, ...] = eqx.field(static=True)
    free_start: bool = eqx.field(static=True)
    mesh: Mesh | None = eqx.field(static=True, default=None)
    coefficients: Coefficients | None = None
    mix: Float[Array, "outputs outputs"] | None = None
    prior: Prior | None = None

    @property
    def rows(self) -> int:
        """Number of residuals without padding."""
        return int(np.sum(np.asarray(self.batch.kept))) * self.weights.shape[0]

    def unknowns(
        self,
        theta: Float[Any, " parameters"],
        start: Float[Any, "recordings initials"],
    ) -> Unknowns:
        """The unknowns: parameters, and initial states if they are estimated."""
        estimated = start if self.free_start else jnp.zeros((0, 0))
        return jnp.asarray(theta), jnp.asarray(estimated)

    def known(
        self,
        kept: Bool[Array, "recordings samples"],
        before: Int[Array, " recordings"] | None = None,
    ) -> Bool[Array, "recordings samples outputs"]:
        """Filtered rows that do not depend on values before the first sample.

        **Arguments:**

        - `kept`: samples that count. `before`: number of earlier samples.
        """
        before = jnp.zeros(len(kept), int) if before is None else before
        if self.coefficients is None:
            return known_rows(self.noise, kept, before)
        return self.coefficients.known(kept, before)

    def linearised(self, loop: ClosedLoop, batch: Batch, extra: Float[Array, " _"]) -> Sensitivity:
        """Residual and derivatives, with one run of the simulation.

        **Arguments:**

        - `extra`: values of the noise filter's coefficients.
        """

        def part(loop: ClosedLoop, batch: Batch) -> Sensitivity:
            return unfiltered(loop, batch, self.weights, self.signals, self.free_start)

        plain = part(loop, batch) if self.mesh is None else shared_out(part, self.mesh, loop, batch)
        return self.whitened(plain, extra)

    def whitened(
        self,
        plain: Sensitivity,
        extra: Float[Array, " _"],
        known: Bool[Array, "recordings samples _"] | None = None,
    ) -> Sensitivity:
        """The unfiltered residual through the noise filter, with the coefficients' derivatives.

        **Arguments:**

        - `known`: filtered rows that count, if not those of whole recordings.
        """
        known = self.known(self.batch.kept) if known is None else known
        if self.coefficients is None:
            found = through_filter(plain, self.noise, known)
        else:
            noise = self.coefficients.into(self.noise, extra)
            found = through_filter(plain, noise, known)
            past = self.coefficients.derivative(plain.raw) * known[..., None]
            wide = jnp.concatenate([found.jacobian, past], axis=-1)
            found = dataclasses.replace(found, jacobian=wide)
        return found if self.mix is None else mixed(found, self.mix)

    def around(
        self,
        theta: Float[Array, " parameters"],
        start: Float[Array, "recordings initials"],
        found: Sensitivity,
    ) -> Point:
        """The point of a linearisation."""
        loop = self.loop.with_theta(theta[: self.loop.theta.shape[0]])
        sums = Sums.of(found, self.free)
        # For a nearly diverging loop squares overflow; its derivatives are finite but useless.
        sound = jnp.isfinite(jnp.sum(sums.gram)) & jnp.isfinite(jnp.sum(sums.start_gram))
        loss = jnp.sum(sums.loss)
        sound = sound & jnp.isfinite(loss)
        if not imposed(loop):
            # Inverse dynamics allows any inertia; a simulation needs a positive one.
            sound = sound & (loop.arm.smallest_inertia() > 0)
        point = Point(theta, start, found, sums, jnp.where(sound, loss, jnp.inf))
        return point.beside(self.prior, jnp)


@compiled
def point_around(
    problem: Problem,
    theta: Float[Array, " parameters"],
    start: Float[Array, "recordings initials"],
) -> Point:
    """A linearised problem by one compiled function, which other functions may call."""
    n, own = problem.loop.joints, problem.loop.theta.shape[0]
    loop = problem.loop.with_theta(theta[:own])
    batch = dataclasses.replace(problem.batch, q0=start[:, :n], v0=start[:, n:])
    found = problem.linearised(loop, batch, theta[own:])
    return problem.around(theta, start, found)


def residual_at(
    problem: Problem,
    theta: Float[Array, " parameters"],
    start: Float[Array, "recordings initials"],
) -> Float[Array, "recordings samples outputs"]:
    """The filtered residual alone, by a simulation without derivatives."""
    n, own = problem.loop.joints, problem.loop.theta.shape[0]
    loop = problem.loop.with_theta(theta[:own])
    batch = dataclasses.replace(problem.batch, q0=start[:, :n], v0=start[:, n:])
    raw = raw_residual(loop, batch, problem.weights, problem.signals)
    blank = jnp.zeros((*raw.shape, 0))
    plain = Sensitivity(raw, raw, blank, None, jnp.zeros(len(raw), int))
    return problem.whitened(plain, theta[own:]).residual


def reweighted(problem: Problem, point: Point, ratio: Float[Any, " outputs"]) -> Point:
    """The linearisation of a problem with new weights, without another simulation.

    **Arguments:**

    - `point`: the linearisation with the former weights.
    - `ratio`: new weights over former ones; not used with a mix, which has no weights.
    """
    raw = np.asarray(ratio)
    scale = raw if problem.mix is None else np.ones_like(raw)
    found = point.found

    def by_output(x: Any) -> Any:
        return None if x is None else np.asarray(x) * scale[:, None]

    changed = Sensitivity(
        np.asarray(found.raw) * raw,
        np.asarray(found.residual) * scale,
        by_output(found.jacobian),
        by_output(found.start),
        found.result,
    )
    sums = point.sums.weighted(scale)
    loss = np.where(np.isfinite(point.loss), np.sum(np.asarray(sums.loss)), np.inf)
    return Point(point.theta, point.start, changed, sums, loss)
