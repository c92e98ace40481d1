"""Possible mistakes in the recordings of a fit that explains little, each tested in turn."""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ..effects import RotorInertia
from ..errors import JaxidError
from ..parameters import Bounds, Parameter, write_values
from ..recording import Recording, Recordings
from ..simulation.loop import ClosedLoop
from .idim import stack_with_motion
from .regression import linear_parameters
from .result import Fit

# Relative error, %, above which a mistake is looked for.
LARGE_PERCENT = 10.0
# A mistake is named if its correction reduces the squared error to less than this share, and the
# relative error to less than this, %.
_SHARE, _GOOD = 0.25, 20.0
# Ratio of the errors with and without a law above which the law is doubtful.
_BETTER = 3.0
# Ratio of squared errors below which two corrections are equally good.
_ALIKE = 1.02
# Share of samples at the largest torque above which a drive may be at its limit.
_OFTEN = 0.05
# Weight of the coefficients of columns of unit length in the regressions.
_RIDGE = 1e-3
# Range of a long recording of white noise, in standard deviations.
_STILL = 12.0
# Factors between units that are often confused.
_FACTORS = {
    "in degrees, not in rad": np.pi / 180,
    "in rad, not in degrees": 180 / np.pi,
    "in mm or mrad, not in m or rad": 1e-3,
    "in m or rad, not in mm or mrad": 1e3,
}
# Differences between zero positions of a joint in a file and in its drive, degrees.
_ZEROS = (90, -90, 180)
# Factors that correct time stamps.
_CLOCKS = {
    "in ms, not in s": 1e-3,
    "of a clock that is twice as fast": 2.0,
    "of a clock that is half as fast": 0.5,
}


def likely_mistake(loop: ClosedLoop, recordings: Recordings) -> str:
    """The mistake in the recordings whose correction improves a regression enough, or empty.

    Signs, zeros, units, the order of joints and the clock are tested one at a time. Each is tested
    by a regression of the inverse dynamics along the filtered motion, with the parameters inside
    their bounds. Every joint has in addition an inertia of any sign, and a torque that is a cubic
    function of its position: wrong bodies may look like a wrong unit, and a missing spring like an
    inertia of the wrong sign.
    """
    for label, span in _still(recordings):
        return f"{label} moves by {span:.2g} only: record motions of all joints"
    had = {e.joint for e in loop.effects if isinstance(e, RotorInertia)}
    loop = loop.add(*(RotorInertia(joint=j) for j in range(1, loop.joints + 1) if j not in had))
    loop = loop.free(*(p.name for p in loop.parameters if _of_rotor(p, loop)))
    before = _left(loop, recordings)
    if before is None or np.sqrt(np.mean(before**2)) < LARGE_PERCENT:
        return ""
    found = []
    turns = ~np.array(loop.arm.prismatic())
    for said, mended, faster in _mistakes(recordings, before > LARGE_PERCENT, turns):
        after = _left(_at_speeds(loop, faster), mended)
        if after is not None and np.sqrt(np.mean(after**2)) < _GOOD:
            found.append((float(np.mean(after**2)), said))
    best = min((size for size, _ in found), default=np.inf)
    # Of mistakes that one motion cannot distinguish, the first one.
    size, said = next((one for one in found if one[0] <= _ALIKE * best), (np.inf, ""))
    if not size < _SHARE * np.mean(before**2):
        return ""
    return (
        f"{said}: with this corrected, the error of a regression is {np.sqrt(size):.2g} % instead "
        f"of {np.sqrt(np.mean(before**2)):.3g} %"
    )


def doubtful_law(found: Fit) -> str:
    """A sentence if a regression without the law explains much more than the simulated loop.

    What a model lacks is missing in both. Both errors are those of the low-passed torque.
    """
    law, recordings = found.loop.controller, found.recordings
    if law.imposes or law.judged != "torque" or not found.status.simulated:
        return ""
    if found.error_percent.to_numpy().max() < LARGE_PERCENT:
        return ""
    if [len(x) for x in found.residuals] != [len(r.tau) for r in recordings]:
        # A regression does not simulate the loop.
        return ""
    pairs = zip(recordings, found.residuals, strict=True)
    try:
        rest = Recordings.of([dataclasses.replace(r, tau=x) for r, x in pairs])
        left, torque = (stack_with_motion(found.loop, r)[1]["tau"] for r in (rest, recordings))
    except JaxidError:
        return ""
    without = _left(found.loop, recordings, position=False)
    if without is None:
        return ""
    size = np.maximum(np.linalg.norm(torque, axis=0), 1e-300)
    percent = 100 * np.linalg.norm(left, axis=0) / size
    j = int(np.argmax(percent - without))
    if percent[j] < LARGE_PERCENT or percent[j] < _BETTER * without[j]:
        return ""
    return (
        f"the simulated loop leaves {percent[j]:.2g} % of the torque of joint {j + 1}, and a "
        f"regression along the recorded motion, without the law, {without[j]:.2g} %: check the "
        "law, its gains, signs, time stamps and the reference, or use Tracking() (--controller "
        "tracking)"
    )


def at_limit(recordings: Recordings, joints: Sequence[int] | None = None) -> str:
    """The joints whose torque often has one largest value, as a sentence; empty if there are none.

    It is a mistake only if the model does not describe this torque, because a limited drive can be
    part of the model.

    **Arguments:**

    - `joints`: the joints to test, from 0; by default all.
    """
    tau = np.concatenate([np.abs(r.tau) for r in recordings])
    share = np.mean(tau >= (1 - 1e-9) * tau.max(axis=0), axis=0)
    said = [
        f"the torque of joint {j + 1} is at its largest value in {100 * share[j]:.0f} % of the "
        "samples, so its drive may be at its limit"
        for j in np.flatnonzero(share > _OFTEN)
        if joints is None or j in joints
    ]
    return " and ".join(said)


def _still(recordings: Recordings) -> Iterator[tuple[str, float]]:
    """Joints that show only sensor noise in every recording, and their range, rad or m."""
    span = np.max([np.ptp(r.q, axis=0) for r in recordings], axis=0)
    # Third differences of white noise are √20 times as large; those of a motion are almost zero.
    noise = [np.std(np.diff(r.q, 3, axis=0), axis=0) / np.sqrt(20) for r in recordings]
    for j in np.flatnonzero(span <= _STILL * np.max(noise, axis=0)):
        yield f"joint {j + 1}", float(span[j])


def _left(
    loop: ClosedLoop, recordings: Recordings, position: bool = True
) -> Float[np.ndarray, " joints"] | None:
    """Relative error of each joint's torque in a bounded regression, %; None if it fails.

    **Arguments:**

    - `position`: whether joints have an additional torque by position.
    """
    import scipy

    try:
        stacked, rows = stack_with_motion(loop, recordings)
        chosen = linear_parameters(loop)
    except JaxidError:
        return None
    own = [_of_position(rows["q"])] if position else []
    wide = np.concatenate([stacked.columns, *own], axis=-1)
    # Relative to the recorded torque; the right-hand side is without that of held bodies.
    size = np.maximum(np.linalg.norm(rows["tau"], axis=0), 1e-300)
    columns = (wide / size[:, None]).reshape(-1, wide.shape[-1])
    right = (stacked.right / size).ravel()
    length = np.linalg.norm(columns, axis=0)
    length[length == 0] = 1.0
    if not np.isfinite(columns).all():
        return None
    bounds = Bounds.of(chosen)
    rotor = np.repeat([_of_rotor(p, loop) for p in chosen], [p.size for p in chosen])
    low, high = np.where(rotor, -np.inf, bounds.lower), np.asarray(bounds.upper)
    open_ = np.full(wide.shape[-1] - len(low), np.inf)
    limits = np.append(low, -open_) * length, np.append(high, open_) * length
    # Almost equal columns, such as the gravity terms of small angles, must not become polynomials.
    p = len(length)
    penalised = np.concatenate([columns / length, _RIDGE * np.eye(p)])
    found = scipy.optimize.lsq_linear(penalised, np.append(right, np.zeros(p)), limits)
    rest = right - columns / length @ found.x
    return 100 * np.linalg.norm(rest.reshape(-1, len(size)), axis=0)


def _of_rotor(p: Parameter, loop: ClosedLoop) -> bool:
    """Whether a parameter is the inertia of a rotor."""
    return p.place[0] == "effects" and isinstance(loop.effects[int(p.place[1])], RotorInertia)


def _of_position(
    q: Float[np.ndarray, "samples joints"],
) -> Float[np.ndarray, "samples joints columns"]:
    """Torque on each joint by the powers 0 to 3 of its position in the middle of its range."""
    low, high = q.min(axis=0), q.max(axis=0)
    x = (2 * q - low - high) / np.maximum(high - low, 1e-300)
    powers = np.stack([x**k for k in range(4)], axis=-1)
    own = np.eye(q.shape[1])[None, :, :, None] * powers[:, None]
    return own.reshape(*q.shape, -1)


def _mistakes(
    recordings: Recordings, large: Bool[np.ndarray, " joints"], turns: Bool[np.ndarray, " joints"]
) -> Iterator[tuple[str, Recordings, Float[np.ndarray, " joints"]]]:
    """Possible mistakes, each with the corrected recordings, and the factors on their speeds.

    **Arguments:**

    - `large`: joints with a large error; mistakes of other joints are not tried.
    - `turns`: joints that turn.
    """
    n = recordings[0].joints
    same = np.ones(n)
    several = [("all joints", same)] if n > 1 else []
    chosen = [(f"joint {j + 1}", np.eye(n)[j]) for j in np.flatnonzero(large)] + several
    for label, which in chosen:
        mended = _changed(recordings, tau=1 - 2 * which)
        yield f"the torque of {label} seems to have the wrong sign", mended, same
    for label, which in chosen:
        sign = 1 - 2 * which
        mended = _changed(recordings, q=sign)
        yield f"the position of {label} seems to have the wrong sign", mended, same
        mended = _changed(recordings, q=sign, tau=sign)
        said = f"the axis of {label} seems to point the other way (signs of position and torque)"
        yield said, mended, same
    for j in np.flatnonzero(large & turns):
        for angle in _ZEROS:
            mended = _changed(recordings, zero=np.deg2rad(angle) * np.eye(n)[j])
            said = f"the position of joint {j + 1} seems to be off by {-angle} degrees"
            yield said, mended, same
    for label, which in chosen:
        for unit, factor in _FACTORS.items():
            scale = 1 + (factor - 1) * which
            mended = _changed(recordings, q=scale)
            yield f"the position of {label} seems to be {unit}", mended, scale
    for said, factor in _CLOCKS.items():
        mended = _changed(recordings, time=factor)
        yield f"the time stamps seem to be {said}", mended, same / factor
    for i, j in itertools.combinations(range(n), 2):
        if not (large[i] or large[j]):
            continue
        order = np.arange(n)
        order[[i, j]] = j, i
        swapped = [dataclasses.replace(r, tau=r.tau[:, order]) for r in recordings]
        said = f"the torques (or positions) of joints {i + 1} and {j + 1} seem to be swapped"
        yield said, Recordings.of(swapped), same


def _at_speeds(loop: ClosedLoop, factors: Float[np.ndarray, " joints"]) -> ClosedLoop:
    """The loop with signs of velocity that are as sharp at speeds changed by factors.

    Otherwise a friction that is sharper than the model assumes would look like a wrong unit.
    """
    chosen, values = [], []
    for p in loop.parameters:
        if p.place[0] == "effects" and p.place[2:] == ("smoothing",) and p.size == 1:
            # An effect that a user wrote may have no joint.
            joint = getattr(loop.effects[int(p.place[1])], "joint", None)
            chosen.append(p)
            values.append(float(p.where(loop)) * (1.0 if joint is None else factors[joint - 1]))
    return write_values(loop, tuple(chosen), jnp.asarray(values)) if chosen else loop


def _changed(
    recordings: Recordings,
    q: np.ndarray | float = 1.0,
    tau: np.ndarray | float = 1.0,
    time: float = 1.0,
    zero: np.ndarray | float = 0.0,
) -> Recordings:
    """Recordings with positions, torques and times multiplied by factors, and another zero."""

    def one(r: Recording) -> Recording:
        ref = None if r.q_ref is None else r.q_ref * q + zero
        v = None if r.v is None else r.v * q / time
        return dataclasses.replace(
            r, time=r.time * time, q=r.q * q + zero, q_ref=ref, v=v, tau=r.tau * tau
        )

    return Recordings.of([one(r) for r in recordings])
