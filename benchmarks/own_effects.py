"""Run time of a user's effect: a linear solve, a network or eigenvalues in a joint's torque.

Times of one simulation and of one residual with its Jacobian, also relative to those of the loop
without the effect.

python -m benchmarks.own_effects [--quick] [--json FILE]
"""

import warnings
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import pandas as pd

import jaxid
from jaxid.effects import AbstractEffect
from jaxid.errors import JaxidWarning
from jaxid.estimate.minimise import linearisation
from jaxid.simulation.batch import prepare
from jaxid.simulation.runs import simulate_batch

from ._output import options, report
from ._problem import interleaved, machine, problem, recordings, truth


class Own(AbstractEffect):
    """A torque by any function of positions and velocities."""

    rule: Callable
    level: jax.Array = jaxid.parameter(0.01, symbol="own", unit="N·m", scale=0.01)

    def torque(self, motion):
        """The function's two values, N·m."""
        return self.level * self.rule(jnp.concatenate([motion.q, motion.v]))


def _matrix(x: jax.Array, n: int) -> tuple[jax.Array, jax.Array]:
    long = jnp.concatenate([x, jnp.sin(x), jnp.cos(x)])[:n]
    return jnp.outer(long, long) + jnp.eye(n), long


def solve(n: int) -> Callable[[jax.Array], jax.Array]:
    """A system of n unknowns."""
    return lambda x: jnp.linalg.solve(*_matrix(x, n))[:2]


def network(width: int, depth: int) -> Callable[[jax.Array], jax.Array]:
    """Layers of tanh."""
    return eqx.nn.MLP(4, 2, width, depth, activation=jnp.tanh, key=jax.random.key(0))


def eigenvalues(x: jax.Array) -> jax.Array:
    """Eigenvalues of a two by two matrix: a call of LAPACK."""
    return jnp.linalg.eigvalsh(_matrix(x, 2)[0])


def main() -> None:
    """Times the loop with each effect, in turns."""
    args = options(__doc__)
    rules = {"none": None, "solve 6": solve(6), "network 16": network(16, 1), "eigh": eigenvalues}
    if not args.quick:
        rules |= {f"solve {n}": solve(n) for n in (2, 4, 8, 10)}
        rules |= {f"network {n}, {n}": network(n, 2) for n in (8, 16, 32, 48)}
    recs = recordings(1, 1.0 if args.quick else 5.0)
    runs, jacobians = {}, {}
    for name, rule in rules.items():
        loop = truth() if rule is None else truth().add(Own(rule))
        batch = prepare(loop, recs)
        around = linearisation(problem(loop, batch))
        at = loop.theta, jnp.concatenate([batch.q0, batch.v0], axis=1)
        runs[name] = lambda loop=loop, batch=batch: simulate_batch(loop, batch)
        jacobians[name] = lambda around=around, at=at: around(*at)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", JaxidWarning)
            runs[name]()
            jacobians[name]()
    budget = 2.0 if args.quick else 30.0
    found = {"simulation": interleaved(runs, budget), "Jacobian": interleaved(jacobians, budget)}
    table = pd.DataFrame({f"{what}_ms": 1e3 * pd.Series(s) for what, s in found.items()})
    for what in found:
        table[f"{what}_times"] = table[f"{what}_ms"] / table[f"{what}_ms"]["none"]
    print(machine())
    report(table.rename_axis("effect"), args.json, ".2f")


if __name__ == "__main__":
    main()
