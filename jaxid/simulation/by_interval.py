"""Solvers and step-size controllers that go from interval to interval between samples.

The unit of time is an interval: time runs from 0 at the start of the first interval to the number
of intervals. In this unit the loop's inputs are looked up without a search. They may have a kink or
a jump between intervals, so no step crosses a boundary.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from .batch import Interval
from .fixed_step import AbstractFixedStep

Time = Float[Array, ""]
Scalars = tuple[Float[Array, ""], ...]


# A flat state, `(states,)`, alone or with its tangents, `(states, columns)`; and the same row by
# row, so that functions of a state become functions of scalars.
Rows = PyTree[Float[Array, "..."]]
Rate = Callable[[Interval, Float[Array, ""], Rows], Rows]


def apart(y: PyTree[Array]) -> Rows:
    """Splits a state into its rows."""
    return jax.tree.map(tuple, y)


def together(rows: Rows, like: PyTree[Array]) -> PyTree[Array]:
    """Joins rows into a state with the structure of `like`."""
    kind = jax.tree.structure(like)
    return jax.tree.unflatten(kind, [jnp.stack(leaf) for leaf in kind.flatten_up_to(rows)])


def one_of(intervals: Interval, k: Int[Array, ""]) -> Interval:
    """One of several intervals."""
    return jax.tree.map(lambda leaf: leaf[k], intervals)


# --- solvers ------------------------------------------------------------------------------------


class Window(eqx.Module):
    """Consecutive intervals from number `first` on; the first axis of leaves is `(intervals,)`."""

    intervals: Interval
    first: int | Int[Array, ""] = 0

    def at(self, t: Any) -> "Window":
        """The interval that contains a time; beyond an end, the interval at that end."""
        count = self.intervals.h.shape[0]
        if count == 1:
            return self
        number = jnp.clip(jnp.floor(t).astype(int) - self.first, 0, count - 1)
        alone = jax.tree.map(lambda leaf: leaf[None], one_of(self.intervals, number))
        return Window(alone, self.first + number)


class WithinIntervals(diffrax.AbstractSolver):
    """A solver whose stages all use the interval in which the step begins.

    A stage may lie at the end of a step or, with some methods, beyond it.
    """

    solver: diffrax.AbstractSolver

    @property
    def term_structure(self):
        """As in the wrapped solver."""
        return self.solver.term_structure

    @property
    def interpolation_cls(self):
        """As in the wrapped solver."""
        return self.solver.interpolation_cls

    def order(self, terms):
        """As in the wrapped solver."""
        return self.solver.order(terms)

    def error_order(self, terms):
        """As in the wrapped solver."""
        return self.solver.error_order(terms)

    def init(self, terms, t0, t1, y0, args):
        """As in the wrapped solver."""
        return self.solver.init(terms, t0, t1, y0, args.at(t0))

    def func(self, terms, t0, y0, args):
        """The vector field."""
        return self.solver.func(terms, t0, y0, args)

    def step(self, terms, t0: Any, t1: Any, y0, args, solver_state, made_jump):
        """One step of the wrapped solver."""
        return self.solver.step(terms, t0, t1, y0, args.at(t0), solver_state, made_jump)


class ThroughIntervals(AbstractFixedStep):
    """One of jaxid's own methods, whose step is a whole interval.

    The loop's inputs are looked up once per interval. Within an interval time is in seconds, and
    the state is split into rows if `split`.
    """

    method: Any
    rate: Rate
    substeps: int | Int[Array, ""]
    split: bool = True

    def order(self, terms) -> int:
        """Order of the method."""
        return self.method.order(terms)

    def step(self, terms, t0: Any, t1: Any, y0, args, solver_state, made_jump):
        """One step through one interval."""
        interval = one_of(args.at(t0).intervals, jnp.asarray(0))
        dt = interval.h / self.substeps
        inside = diffrax.ODETerm(lambda t, y, args: self.rate(interval, jnp.asarray(t), y))

        def substep(k, y):
            start = interval.t0 + k * dt
            return self.method.step(inside, start, start + dt, y, None, None, False)[0]

        rows = apart(y0) if self.split else y0
        if not isinstance(self.substeps, int):
            rows = jax.lax.fori_loop(0, self.substeps, substep, rows)
        elif self.substeps == 1:
            rows = substep(0, rows)
        else:
            numbers = jnp.arange(self.substeps)
            rows, _ = jax.lax.scan(lambda y, k: (substep(k, y), None), rows, numbers)
        y1 = together(rows, y0) if self.split else rows
        return y1, None, {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful


# --- controllers --------------------------------------------------------------------------------


class OneStep(diffrax.AbstractStepSizeController):
    """One step for each interval."""

    def wrap(self, direction):
        """Time runs forward only."""
        return self

    def init(self, terms, t0: Any, t1: Any, y0, dt0, args, func, error_order):
        """The end of the first step."""
        return t0 + 1, None

    def adapt_step_size(
        self, t0: Any, t1: Any, y0, y1_candidate, args, y_error, error_order, state
    ):
        """The next step."""
        return True, t1, t1 + 1, False, None, diffrax.RESULTS.successful


class EqualSteps(diffrax.AbstractStepSizeController):
    """Equal steps through each interval.

    **Arguments:**

    - `count`: number of steps per interval.
    """

    count: int | Int[Array, ""]

    def wrap(self, direction):
        """Time runs forward only."""
        return self

    def init(self, terms, t0: Any, t1: Any, y0, dt0, args, func, error_order):
        """The end of the first step."""
        first = jnp.asarray(1)
        return first / self.count, first

    def adapt_step_size(
        self, t0: Any, t1: Any, y0, y1_candidate, args, y_error, error_order, state
    ):
        """The next step."""
        # Reported as a jump; otherwise a solver could reuse a slope from another interval.
        end = (state + 1) / self.count
        return True, t1, end, True, state + 1, diffrax.RESULTS.successful


class CutSteps(diffrax.AbstractAdaptiveStepSizeController):
    """The steps of another controller, shortened so that none crosses the end of an interval.

    **Arguments:**

    - `control`: the other controller, in seconds.
    - `start`, `length`: of the intervals, s; `length` is positive.
    - `first`: length of the first trial step, s.
    """

    control: diffrax.AbstractAdaptiveStepSizeController
    start: Float[Array, " intervals"]
    length: Float[Array, " intervals"]
    first: Any

    @property
    def rtol(self):
        """Relative tolerance of the other controller, which implicit solvers read."""
        return self.control.rtol

    @property
    def atol(self):
        """Absolute tolerance of the other controller."""
        return self.control.atol

    @property
    def norm(self):
        """Norm of the other controller."""
        return self.control.norm

    def wrap(self, direction):
        """The same controller with the other one wrapped; time runs forward only."""
        return dataclasses.replace(self, control=self.control.wrap(direction))

    def _seconds(self, t: Time, interval: Int[Array, ""]) -> Time:
        return self.start[interval] + (t - interval) * self.length[interval]

    def _within(self, t: Any, step: Any, interval: Int[Array, ""]) -> Time:
        """The end of a step of given length, s, that begins at `t`."""
        after = jnp.maximum(t + step / self.length[interval], jnp.nextafter(t, jnp.inf))
        return jnp.minimum(after, (interval + 1).astype(t.dtype))

    def init(self, terms, t0: Any, t1: Any, y0, dt0, args, func, error_order):
        """The end of the first step, and the other controller's state."""
        begin, end = self.start[0], self.start[-1] + self.length[-1]
        then, state = self.control.init(terms, begin, end, y0, self.first, args, func, error_order)
        return self._within(t0, then - begin, jnp.asarray(0)), state

    def adapt_step_size(
        self, t0: Any, t1: Any, y0, y1_candidate, args, y_error, error_order, state
    ):
        """Whether to accept the step, and the next step."""
        last = self.start.shape[0] - 1
        now = jnp.clip(jnp.floor(t0).astype(int), 0, last)
        keep, begin, end, jump, state, result = self.control.adapt_step_size(
            self._seconds(t0, now),
            self._seconds(t1, now),
            y0,
            y1_candidate,
            args,
            y_error,
            error_order,
            state,
        )
        over = keep & (t1 >= (now + 1).astype(t1.dtype))
        following = jnp.where(over, jnp.minimum(now + 1, last), now)
        start = jnp.where(keep, t1, t0)
        return keep, start, self._within(start, end - begin, following), over | jump, state, result
