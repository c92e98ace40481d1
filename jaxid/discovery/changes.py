"""Values of a model that differ between recordings, or that change during them.

A model has one value for all recordings. If a current offset, the friction of a cold gear or the
gain of a drive differs between them, what is left cannot be predicted from the motion of other
recordings, like noise. So values of each recording, and of its first part, are estimated in
the linear system, and what they explain is compared with what they explain of noise, and of
functions of the motion: during a short slow motion a missing effect resembles a change.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..estimate.result import joint_columns
from .diagnosis import Diagnosis, over_recordings
from .random_torques import random_function
from .relevance import allowed
from .score import spanned
from .text import joined

# Smallest share of a joint's squared residual that a change must explain. It must be larger than
# for each of so many draws of noise, which is a p-value of half a per cent, and of functions of the
# motion.
_SHARE, _DRAWS = 0.2, 200
# Number of parts of a recording, at whose limits a value may change.
_PARTS = 12


class JointValue(eqx.Module):
    """A value of a joint that may change.

    - `estimate`: with one value for all recordings. `place`: among the parameters; None if the
      model does not have it.
    - `slope`: derivative of the joint's output at the compared rows.
    """

    name: str
    unit: str
    estimate: float
    place: int | None
    slope: Float[np.ndarray, " rows"]


class JointRows(eqx.Module):
    """The compared rows of one joint, one recording after the other.

    - `residual`: N·m or N. `base`: what the model's own values change; `basis`: the same,
      orthonormal.
    - `parts`: indicators of each recording, and of its first parts. `ends`: of these, s; infinite
      for the whole recording.
    """

    residual: Float[np.ndarray, " rows"]
    base: Float[np.ndarray, "rows absorbed"]
    basis: Float[np.ndarray, "rows rank"]
    parts: Bool[np.ndarray, "rows recordings parts"]
    ends: Float[np.ndarray, "recordings parts"]

    @classmethod
    def of(cls, diagnosis: Diagnosis, joint: int) -> "JointRows":
        """The rows of a joint (from 0)."""
        data, there = diagnosis.data, diagnosis.data.there[..., joint]
        number, time = np.nonzero(there)[0], np.asarray(diagnosis.motion.t)[there]
        shares = np.arange(1, _PARTS) / _PARTS
        ends = [
            [np.inf, *(np.quantile(time[number == k], shares) if own.any() else shares)]
            for k, own in enumerate(there)
        ]
        each = number[:, None] == np.arange(len(there))
        parts = each[..., None] & (time[:, None, None] < np.array(ends))
        base = data.base[:, :, joint][there]
        return cls(data.residual[..., joint][there], base, spanned(base), parts, np.array(ends))

    def without_base(self, x: Float[np.ndarray, "rows *columns"]) -> Float[Any, "rows *columns"]:
        """What the model's own values cannot absorb."""
        return x - self.basis @ (self.basis.T @ x)


class Variation(eqx.Module):
    """A value that is not the same throughout the recordings.

    - `part`: number of the part of each recording in which the value differs; zero for the whole.
    - `share`: part of the joint's squared residual that it explains.
    """

    value: JointValue
    part: tuple[int, ...]
    share: float


def changed_values(
    diagnosis: Diagnosis, worth: float, chosen: Float[np.ndarray, " joints"] | None = None
) -> tuple[str, float]:
    """What is not the same throughout the recordings, and its share of a joint's squared error.

    Empty and zero if everything is the same.

    **Arguments:**

    - `worth`: smallest relevant change, in % of a joint's torque.
    - `chosen`: errors of the final model by joint, %, if it is not the one of the diagnosis.
    """
    fit, joints = diagnosis.fit, diagnosis.fit.loop.joints
    windows = len(fit.recordings) != len(diagnosis.data.residual)
    if windows or fit.loop.controller.judged != "torque":
        return "", 0.0
    own, least = over_recordings(fit.error_percent.to_numpy()), allowed(fit.loop, worth)[1]
    error = own if chosen is None else chosen
    found = []
    for j in range(joints):
        change = change_of(diagnosis, j)
        left = np.inf if change is None else own[j] * np.sqrt(max(1 - change.share, 0.0))
        share = 1 - (left / max(error[j], 1e-300)) ** 2
        if change is not None and share > _SHARE and error[j] * np.sqrt(share) > least:
            found.append((error[j] ** 2 * share, share, left, j, change))
    if not found:
        return "", 0.0
    _, share, left, j, change = max(found, key=lambda x: x[0])
    what = _told(change, JointRows.of(diagnosis, j), fit.recordings.names)
    said = (
        f"{what}; with this the error of {joint_columns(joints)[j]} on the fitted recordings is "
        f"{left:.3g} % instead of {error[j]:.3g} %, but a model has one value: find what changed, "
        "or fit the recordings separately"
    )
    return said, share


def change_of(diagnosis: Diagnosis, joint: int) -> Variation | None:
    """The change that explains most of a joint's residual.

    None if it explains as much of noise, or of random functions of the motion.

    **Arguments:**

    - `joint`: from 0.
    """
    rows = JointRows.of(diagnosis, joint)
    count = len(rows.residual)
    if count <= 2 * rows.basis.shape[1]:
        return None
    draws = random_draws(diagnosis, joint)
    series = rows.without_base(np.column_stack([rows.residual, draws]))
    series /= np.maximum(np.linalg.norm(series, axis=0), 1e-300)
    found, most = [], np.zeros(2 * _DRAWS)
    for value in _values(diagnosis, joint):
        for part, shares in _explained(rows, value, series):
            found.append(Variation(value, part, float(shares[0])))
            most = np.maximum(most, shares[1:])
    best = max(found, key=lambda c: c.share)
    return best if best.share > max(_SHARE, float(most.max())) else None


def random_draws(diagnosis: Diagnosis, joint: int) -> Float[np.ndarray, "rows draws"]:
    """Noise of a joint (from 0), and random functions of its motion, at its compared rows."""
    rng, there = np.random.default_rng(0), diagnosis.data.there[..., joint]
    data = diagnosis.data
    noise = diagnosis.noise[joint].simulate((_DRAWS, *data.mask.shape), rng)
    if data.level is not None:
        noise *= data.level[:, joint, None]
    q, v = (np.asarray(x)[..., joint][there] for x in (diagnosis.motion.q, diagnosis.motion.v))
    functions = [random_function(q, v, rng, odd=bool(k % 2)) for k in range(_DRAWS)]
    return np.column_stack([*noise[:, there], *functions])


def _explained(
    rows: JointRows, value: JointValue, series: Float[np.ndarray, "rows series"]
) -> Iterable[tuple[tuple[int, ...], Float[np.ndarray, " series"]]]:
    """The shares of series that a value explains, if it differs between recordings or during them.

    Of each recording the first part is chosen that alone explains most of the series; the result
    has the parts of the first series.
    """
    recordings, parts = rows.parts.shape[1:]
    columns = (value.slope[:, None, None] * rows.parts).reshape(len(value.slope), -1)
    columns = rows.without_base(columns)
    size = np.linalg.norm(columns, axis=0)
    # A column that the base absorbs consists of rounding errors.
    columns = columns / np.where(size > 1e-6 * np.linalg.norm(value.slope), size, np.inf)
    products, gram = (columns.T @ series).T, columns.T @ columns
    first = np.arange(recordings) * parts
    alone = (products**2).reshape(-1, recordings, parts)[..., 1:]
    for chosen in (np.zeros((len(alone), recordings), int), 1 + np.argmax(alone, axis=2)):
        at = first + chosen
        inverse = np.linalg.pinv(gram[at[:, :, None], at[:, None, :]], rcond=1e-6, hermitian=True)
        along = np.take_along_axis(products, at, axis=1)
        yield tuple(chosen[0].tolist()), np.einsum("si,sij,sj->s", along, inverse, along)


def _values(diagnosis: Diagnosis, joint: int) -> Iterable[JointValue]:
    """The values of a joint (from 0) that may change: of its friction and motor, and a gain."""
    loop, there, place = diagnosis.fit.loop, diagnosis.data.there[..., joint], 0
    for p in loop.free_parameters:
        own = p.place[0] == "effects" and p.joint == joint + 1
        if own and p.declaration.linear and p.size == 1:
            slope = diagnosis.data.base[:, :, joint, place][there]
            estimate = float(p.where(loop))
            yield JointValue(p.name, loop.units(p)[0], estimate, place, slope)
        place += p.size
    torque = np.asarray(diagnosis.motion.tau)[..., joint][there]
    name = f"the ratio of measured and modelled torque of joint {joint + 1}"
    yield JointValue(name, "1", 1.0, None, torque)


def _told(change: Variation, rows: JointRows, names: Sequence[str]) -> str:
    """The change in words."""
    value, each = change.value, range(len(names))
    where = np.stack([rows.parts[:, k, change.part[k]] for k in each], axis=1)
    columns = np.column_stack([rows.base, value.slope[:, None] * where])
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    taken = np.linalg.lstsq(columns / size, rows.residual, rcond=1e-9)[0] / size
    own, unit = taken[-len(names) :], "" if value.unit == "1" else f" {value.unit}"
    if any(change.part):
        ends = [rows.ends[k, change.part[k]] for k in each]
        said = [
            f"{x:+.2g}{unit} until {end:.3g} s in {name}"
            for x, end, name in zip(own, ends, names, strict=True)
        ]
        return f"{value.name} changes during the recordings: {joined(said)}"
    # The base absorbs a common factor of all torque.
    own = own if value.place is not None else own - np.mean(own)
    common = value.estimate + (0.0 if value.place is None else taken[value.place])
    said = [f"{common + x:.3g}{unit} in {name}" for x, name in zip(own, names, strict=True)]
    return f"{value.name} differs between the recordings: {joined(said)}"
