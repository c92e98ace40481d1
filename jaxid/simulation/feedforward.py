"""The torque that a model needs for a planned motion."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..compiling import compiled
from ..effects import AbstractEffect, AbstractTransmission, Motion, recording_label
from ..errors import ModelError
from .loads import inverse
from .loop import ClosedLoop
from .own_states import settled_states


def inverse_dynamics(
    loop: ClosedLoop,
    time: Float[np.ndarray, " samples"],
    q: Float[np.ndarray, "samples joints"],
    v: Float[np.ndarray, "samples joints"],
    a: Float[np.ndarray, "samples joints"],
    *,
    recording: str = "",
) -> Float[np.ndarray, "samples joints"]:
    """The torque that a motion needs, for instance as a feed-forward, N·m or N.

    It contains the arm and all effects at the joints; states of effects, such as those of
    hysteresis, are integrated along the motion. The control law and the delay of an unknown law are
    not used.

    **Arguments:**

    - `loop`: the model, such as `fit.loop` or `story.loop`.
    - `time`: `(samples,)`, s. `q`, `v`, `a`: planned position, velocity and acceleration of the
      joints, `(samples, joints)`, rad or m and their derivatives.
    - `recording`: name of the recording whose effects act, such as a payload that only one has.

    **Returns:** torque at the joints, `(samples, joints)`.

    **Raises:** `ModelError` for a motion of another arm, and for effects that make the arm deviate
    from its drives or readings (transmissions, drives with errors, sensors).
    """
    for name, x in (("q", q), ("v", v), ("a", a)):
        if np.shape(x) != (len(time), loop.joints):
            raise ModelError(
                f"{name} has shape {np.shape(x)}, but {loop.name} needs ({len(time)}, "
                f"{loop.joints}): one row for each time, one column for each joint"
            )
    for effect in loop.effects:
        kind = type(effect)
        own = kind.command is not AbstractEffect.command or kind.read is not AbstractEffect.read
        if own or isinstance(effect, AbstractTransmission):
            raise ModelError(
                f"{effect.effect_name()} of {loop.name} changes what the drive delivers or the "
                "sensor reads, so a motion does not determine the torque: leave the effect out"
            )
    label = jnp.asarray(recording_label(recording))
    given = [jnp.asarray(x, float) for x in (time, q, v, a)]
    return np.asarray(_needed(loop, given[0], given[1], given[2], given[3], label))


@compiled
def _needed(
    loop: ClosedLoop,
    time: Float[Array, " samples"],
    q: Float[Array, "samples joints"],
    v: Float[Array, "samples joints"],
    a: Float[Array, "samples joints"],
    label: Int[Array, ""],
) -> Float[Array, "samples joints"]:
    def at(t, q, v, a):
        return Motion(t, q, v, a, jnp.zeros_like(q), jnp.zeros(0), label, imposed=True)

    motion = jax.vmap(at)(time, q, v, a)
    states = tuple(settled_states(effect, motion) for effect in loop.effects)
    return jax.vmap(lambda at, own: inverse(loop, at, own))(motion, states)
