"""Effects without a derivative at zero: each is simulated at a finite size."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..compiling import compiled
from ..effects import AbstractEffect, AbstractTransmission, TorqueSaturation
from ..effects.placed import by_structure
from ..parameters import KNOWN
from ..simulation.batch import Batch
from ..simulation.dynamics import imposed
from ..simulation.integration import initial
from ..simulation.loop import ClosedLoop
from ..simulation.runs import each, run
from ..simulation.sharing import at_once, one_by_one
from ..simulation.steps import with_rolled_stages

# Settings that one call simulates: as many as fit into one vector instruction. Screening and
# predictions use the same number, so that they share one compiled program.
_AT_ONCE = 4


class OneOf(AbstractTransmission):
    """One of several transmissions on a joint, by its number; none if the number is negative.

    The number is an array, so that one compiled program simulates all of them.
    """

    joint: int = eqx.field(static=True)
    options: tuple[AbstractTransmission, ...] = eqx.field(metadata=KNOWN)
    chosen: Int[Array, ""]

    @property
    def rotor(self) -> Float[Array, ""]:
        """Rotor inertia of the chosen transmission."""
        return self._of_chosen([option.rotor for option in self.options], 1.0)

    def present(self) -> Bool[Array, ""]:
        """Whether a transmission is chosen, and is compliant."""
        return self._of_chosen([option.present() for option in self.options], False)

    def through(self, twist: Float[Array, ""], rate: Float[Array, ""]) -> Float[Array, ""]:
        """Torque that the chosen transmission transmits, N·m."""
        return self._of_chosen([option.through(twist, rate) for option in self.options], 0.0)

    def twisted(self, torque: Float[Array, ""]) -> Float[Array, ""]:
        """Twist at rest of the chosen transmission with this torque (N·m or N), rad."""
        return self._of_chosen([option.twisted(torque) for option in self.options], 0.0)

    def _of_chosen(self, values: Sequence[Any], otherwise: float | bool) -> Any:
        found = jnp.asarray(otherwise)
        for k, value in enumerate(values):
            found = jnp.where(self.chosen == k, value, found)
        return found


def differences(
    loop: ClosedLoop,
    batch: Batch,
    effects: Sequence[AbstractEffect],
    row: int,
    nominal: Float[Array, "recordings points joints"],
) -> list[Float[np.ndarray, "recordings points joints"]]:
    """Changes of a signal by effects, from one simulation with each of them.

    All transmissions and limits of all joints share one compiled program. Other finite effects have
    one program for each structure.

    **Arguments:**

    - `effects`: effects at finite settings. A transmission must be on a joint that has none.
    - `row`: index of the signal in `SIGNALS`.
    - `nominal`: the signal of the loop without the effects.

    **Returns:** for each effect an array `(recordings, points, joints)`, N·m or N for a torque, rad
    or m for a position.
    """
    if not effects:
        return []
    if not imposed(loop):
        return [run - np.asarray(nominal) for run in _simulated(loop, batch, effects, row)]
    still = [k for k, e in enumerate(effects) if imposed(loop.add(e))]
    runs = _simulated(loop, batch, [effects[k] for k in still], row)
    found = {k: run - np.asarray(nominal) for k, run in zip(still, runs, strict=True)}
    parted = [k for k in range(len(effects)) if k not in found]
    if parted:
        # With these effects the motion is not imposed. The virtual law then has a tracking error,
        # which cancels if the nominal signal is simulated in the same way: with a limit that
        # does not act.
        several = [*(effects[k] for k in parted), TorqueSaturation(joint=1)]
        *runs, without = _simulated(loop, batch, several, row)
        found |= {k: run - without for k, run in zip(parted, runs, strict=True)}
    return [found[k] for k in range(len(effects))]


def _simulated(
    loop: ClosedLoop, batch: Batch, effects: Sequence[AbstractEffect], row: int
) -> list[Float[np.ndarray, "recordings points joints"]]:
    """The signal with each effect."""
    shared = [k for k, e in enumerate(effects) if isinstance(e, _SHARED)]
    groups = [(shared, _together([effects[k] for k in shared]))] if shared else []
    others = [k for k in range(len(effects)) if k not in shared]
    for group in by_structure([effects[k] for k in others]):
        places = [others[k] for k in group]
        groups.append((places, [(effects[k],) for k in places]))
    jobs = []
    for places, settings in groups:
        for first in range(0, len(places), _AT_ONCE):
            # The last call repeats its last setting, so that its program is that of the others.
            rows = np.minimum(np.arange(first, first + _AT_ONCE), len(places) - 1)
            stacked = jax.tree.map(lambda *x: np.stack(x), *(settings[k] for k in rows))
            jobs.append(([places[k] for k in rows], stacked))
    batch = batch.uncompared()

    def with_them(job):
        return one_by_one(lambda one: _with_effects(loop, job[1], one, row), batch)

    runs = [np.moveaxis(np.asarray(x), 0, 1) for x in at_once(with_them, jobs)]
    found: dict[int, np.ndarray] = {}
    for (places, _), several in zip(jobs, runs, strict=True):
        found |= dict(zip(places, several, strict=True))
    return [found[k] for k in range(len(effects))]


_SHARED = (AbstractTransmission, TorqueSaturation)


def _together(effects: Sequence[AbstractEffect]) -> list[tuple[AbstractEffect, ...]]:
    """For each effect a set with all transmissions and limits, of which only this one acts.

    The sets have the same structure, so that they share one program.
    """
    kinds: dict[int, dict[Any, AbstractTransmission]] = {}
    for e in effects:
        if isinstance(e, AbstractTransmission):
            kinds.setdefault(e.joint, {}).setdefault(jax.tree.structure(e), e)
    nothing = {j: _one_of(tuple(of.values()), -1) for j, of in kinds.items()}
    limited = sorted({e.joint for e in effects if isinstance(e, TorqueSaturation)})
    unlimited = {j: TorqueSaturation(joint=j) for j in limited}
    made = []
    for e in effects:
        parts, limits = dict(nothing), dict(unlimited)
        if isinstance(e, TorqueSaturation):
            limits[e.joint] = e
        else:
            assert isinstance(e, AbstractTransmission)
            options = list(nothing[e.joint].options)
            place = [jax.tree.structure(o) for o in options].index(jax.tree.structure(e))
            options[place] = e
            parts[e.joint] = _one_of(tuple(options), place)
        made.append((*parts.values(), *limits.values()))
    return made


def _one_of(options: tuple[AbstractTransmission, ...], chosen: int) -> OneOf:
    joint, number = options[0].joint, jnp.asarray(chosen)
    return OneOf(joint=joint, options=options, chosen=number)  # type: ignore[reportCallIssue]


@compiled
def _with_effects(
    loop: ClosedLoop, stacked: tuple[AbstractEffect, ...], batch: Batch, row: int
) -> Float[Array, "recordings settings points joints"]:
    """One signal of simulations with the effects, at all their settings."""
    loop = with_rolled_stages(loop)

    def one(effects, intervals, q0, v0):
        grown = loop.add(*effects)
        return run(grown, intervals, initial(grown, intervals, q0, v0), rows=(row,))[1][:, 0]

    def setting(effects):
        return each(lambda i, q, v: one(effects, i, q, v), batch.intervals, batch.q0, batch.v0)

    return eqx.filter_vmap(setting, in_axes=eqx.if_array(0), out_axes=1)(stacked)
