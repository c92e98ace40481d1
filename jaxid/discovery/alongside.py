"""Searches along the recorded motion although a law is given."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..control import Tracking
from ..effects import AbstractEffect, AbstractTransmission, ActuatorLag, TimeDelay
from ..errors import FitError, ModelError
from ..estimate import Fit, Status
from ..recording import Recordings
from ..simulation.dynamics import imposed
from ..simulation.loop import ClosedLoop
from ..simulation.steps import UNROLLED, needed_substeps
from .comparison import compare
from .diagnosis import Diagnosis
from .explore import DECISIVE
from .landscape import form
from .predict import Prediction, Predictor
from .ranking import Screened
from .score import Whitened, strong_directions
from .separate import columns_of, select
from .step import Step
from .system import System

# Largest delay of a torque in samples that a sampled law explains.
LATE = 2.0
# Smallest significant delay, in standard deviations, and largest ratio of delays with one cause.
_SURE, _ALIKE = 3.0, 2.0
# Delays of a drive.
DELAYS = (TimeDelay, ActuatorLag)
# Effects that are the same as the delay of a drive, or approximate it.
_LAGS = (*DELAYS, AbstractTransmission)
# Steps between two grid points up to which a simulation is fast enough.
_STEPS = 16


def along_recorded(loop: ClosedLoop) -> ClosedLoop:
    """The loop in which sets of effects are compared: along the recorded motion if fits are slow.

    One fit of six joints in the simulated loop takes minutes, and a search needs dozens. A sampled
    law is slow, too. Below the bandwidth of the law, recorded motion and torque have the same
    information. The loop is unchanged if positions are compared, or if its effects have a motion of
    their own, which only a simulation gives.
    """
    slow = loop.joints > UNROLLED or loop.controller.period is not None
    return without_law(loop) if slow else loop


def slow_or_wrong(first: Fit, wrong: str) -> str:
    """Why the search goes on without the law after the fit of the starting model; empty if not.

    Under a continuous law the fit shows whether simulations are slow: an arm that sticks needs up
    to a hundred steps between two samples.

    **Arguments:**

    - `wrong`: why the law is doubtful; empty if it is not.
    """
    if first.mistake or first.status is Status.misfit:
        return ""
    if (first.loop.stepping.substeps or 1) > _STEPS:
        return f"the starting model needs more than {_STEPS} steps between two samples, so"
    return "the law is doubtful, so" if wrong else ""


def sampled(diagnosis: Diagnosis, screened: Screened) -> str:
    """Why the search goes on without the law if it seems to be sampled; empty if it does not.

    **Arguments:**

    - `diagnosis`: of a fit under a continuous law. `screened`: its linear system and hypotheses.
    """
    return _as_sampled(delays_of_drives(diagnosis, screened))


def late_drives(given: ClosedLoop, effects: Sequence[AbstractEffect], period: float) -> str:
    """Why the search goes on without the law if it has made all drives late; empty if it has not.

    Drives that are late by about the same time have a common cause: the law is sampled.

    **Arguments:**

    - `given`: the starting model. `effects`: those that the search has added. `period`: of the
      samples, s.
    """
    return _as_sampled(_late(given, effects, period)) if given.joints > 1 else ""


def one_late_drive(given: ClosedLoop, effects: Sequence[AbstractEffect], period: float) -> str:
    """Why a search on one joint is repeated without the law; empty if it need not be.

    A single drive that is late may be an effect, or the law is sampled. A sampled law that is
    simulated as continuous has further errors, which other effects then approximate.

    **Arguments:** those of `late_drives`.
    """
    others = [e for e in effects if not isinstance(e, DELAYS)]
    return _as_sampled(_late(given, effects, period)) if given.joints == 1 and others else ""


def approximating(steps: Sequence[Step], along: Sequence[Step]) -> tuple[AbstractEffect, ...]:
    """Effects beside a late drive that only approximate a sampled law.

    They are those that a search without the law does not add, if it adds fewer, and if nothing else
    speaks for any of them: held-out recordings do not confirm it, or the recorded motion
    contradicts it. (An effect that acts above the cutoff may be missed without the law.)

    **Arguments:**

    - `steps`: of a search under the law. `along`: of a search without it.
    """
    others = [s for s in steps if s.added is not None and not isinstance(s.added, DELAYS)]
    kept = [form(s.added) for s in along if s.added is not None]
    if len(kept) >= len(others):
        return ()
    gone = [s for s in others if s.added is not None and form(s.added) not in kept]
    possible = [
        s.added for s in gone if s.added is not None and s.unseen in (None, "lowers", "mixed")
    ]
    if possible and not _contradicted(along[-1], possible):
        return ()
    return tuple(s.added for s in gone if s.added is not None)


def _contradicted(along: Step, effects: Sequence[AbstractEffect]) -> bool:
    """Whether a model without the law is worse with each effect at its values.

    All other values are estimated again. A transmission has a motion of its own, which the recorded
    motion does not give.
    """
    assert along.diagnosis is not None
    if any(isinstance(e, AbstractTransmission) for e in effects):
        return False
    data, noise = along.diagnosis.data, along.diagnosis.noise
    predictor = Predictor.of(System.of(along.fit), noise, data.level)
    rows, without = int(predictor.data.compared.sum()), predictor.predict(()).loss
    losses = [predictor.predict((e,), steps=1).loss for e in effects]
    return all(rows * np.log(loss / without) > DECISIVE for loss in losses)


def _late(given: ClosedLoop, effects: Sequence[AbstractEffect], period: float) -> tuple[float, ...]:
    """Delays of the drives, s, by added effects, if all drives are late by about the same time."""
    late: dict[int, float] = {}
    for effect in effects:
        if isinstance(effect, DELAYS):
            late[effect.joint] = late.get(effect.joint, 0.0) + float(effect.late)
    times = tuple(late.values())
    if not simulated_continuously(given) or len(times) < given.joints:
        return ()
    return times if max(times) < min(_ALIKE * min(times), LATE * period) else ()


def _as_sampled(late: Sequence[float]) -> str:
    """Why the search goes on without the law if its drives have these delays, s."""
    if not late:
        return ""
    return (
        f"the torques seem to act {', '.join(f'{1e3 * x:.2g}' for x in late)} ms late, like a law "
        "that is sampled and held, although the law is declared as continuous: declare it by "
        "jaxid.control.Sampled(law, every=...); until then,"
    )


def without_law(loop: ClosedLoop) -> ClosedLoop:
    """The loop along its recorded motion; unchanged if that is not possible."""
    law = loop.controller
    if law.imposes or law.judged != "torque":
        return loop
    along = dataclasses.replace(loop, controller=Tracking(delay=law.lag))
    return along if imposed(along) else loop


def delays_of_drives(diagnosis: Diagnosis, screened: Screened) -> tuple[float, ...]:
    """Delays of the drives, s, if all are late as under a sampled law; empty if they are not.

    The delays are estimated together in the linear system. Any missing effect leaves a residual
    that delays explain in part, so they compete with the effects and curves of the catalogue and
    are estimated beside those that explain more. (Those that explain less may be substitutes for a
    part of the delays.) A single drive that is late is an effect. With one joint the two are the
    same.

    **Arguments:** those of `sampled`.
    """
    loop, period = screened.system.loop, diagnosis.fit.recordings.common_period()
    if not simulated_continuously(loop) or loop.joints == 1:
        return ()
    data = dataclasses.replace(screened.data, level=diagnosis.data.level)
    predictor = Predictor.of(screened.system, diagnosis.noise, data.level)
    drives = [TimeDelay(joint=j + 1, delay=jnp.asarray(period / 2)) for j in range(loop.joints)]
    nothing, late = predictor.predict(()), predictor.predict(drives)
    rows = int(data.compared.sum())
    gain = rows * np.log(nothing.loss / late.loss) - len(drives) * np.log(rows)
    if not late.possible or gain < DECISIVE:
        return ()
    white = Whitened.of(data, diagnosis.noise)
    known = len(white.size)
    white = white.beside(late.slopes)
    blocks = [h.columns for h in screened.hypotheses if not isinstance(h.effect, _LAGS)]
    own = len(blocks)
    chosen = select(white, [*blocks, range(known, known + len(drives))])
    if own not in chosen:
        return ()
    others = white.columns(columns_of(blocks, chosen[: chosen.index(own)]))
    found, std = _beside(late, strong_directions(others))
    sure = np.all((found > _SURE * std) & (std > 0) & (found < LATE * period))
    return tuple(found.tolist()) if sure else ()


def simulated_continuously(loop: ClosedLoop) -> bool:
    """Whether a law that is declared as continuous is simulated, and torque is compared."""
    law = loop.controller
    return law.period is None and not law.imposes and law.judged == "torque"


def _beside(
    late: Prediction, others: Float[np.ndarray, "rows columns"]
) -> tuple[Float[np.ndarray, " joints"], Float[np.ndarray, " joints"]]:
    """Delays, s, that are estimated together with other effects, and their deviations.

    **Arguments:**

    - `late`: the delays without others. `others`: orthonormal columns of the other effects.
    """
    slopes = late.slopes - others @ (others.T @ late.slopes)
    rest = late.residual - others @ (others.T @ late.residual)
    inverse = np.linalg.pinv(slopes.T @ slopes)
    alone = np.array([float(e.delay) for e in late.effects if isinstance(e, TimeDelay)])
    found = alone + inverse @ (slopes.T @ late.residual)
    # Rows that are not compared are zero.
    freedom = np.count_nonzero(late.residual) - late.freedom - others.shape[1]
    return found, np.sqrt(np.diag(inverse) * (rest @ rest) / max(freedom, 1))


def in_the_loop(loop: ClosedLoop, models: Sequence[ClosedLoop], recordings: Recordings) -> str:
    """A note with the error of the first and of the last model in the simulated loop.

    **Arguments:**

    - `loop`: the given loop, with its law. `models`: loops along the recorded motion, the starting
      model first. `recordings`: held-out recordings, if there are any.
    """
    where = ", ".join(recordings.names)
    said = f"in the simulated loop the error of the torque on {where}, mean over the joints, is"
    if along_recorded(loop) is not loop:
        many = loop.joints > UNROLLED
        why = f"{loop.name} has {loop.joints} joints" if many else "the law is sampled"
        said = (
            f"{why}, so sets of effects were compared along the recorded motion, without the law; "
            f"{said}"
        )
    try:
        last = _error(loop, models[-1], recordings)
        before = ""
        if len(models) > 1:
            before = f", and {_error(loop, models[0], recordings):.3g} % of the starting model"
    except (FitError, ModelError) as error:
        return f"{said} not known: {error}"
    except KeyboardInterrupt:
        # The search has ended, and its result is kept.
        return f"{said} not known: the simulation was interrupted"
    return f"{said} {last:.3g} %{before}"


def _error(given: ClosedLoop, found: ClosedLoop, recordings: Recordings) -> float:
    """Relative error of a torque under the given law, mean over recordings and joints, %."""
    loop = dataclasses.replace(
        found,
        controller=given.controller,
        stepping=given.stepping,
        standstill=given.standstill,
    )
    loop = _softened(loop, recordings)
    return float(compare(loop, recordings).error_percent.to_numpy().mean())


# Shares of a joint's highest speed to which the smoothing of its signs is raised, until simulations
# are fast enough.
_SHARES = np.geomspace(1e-6, 1e-1, 11)


def _softened(loop: ClosedLoop, recordings: Recordings) -> ClosedLoop:
    """The loop with signs of velocity that are smooth enough for fixed steps.

    Along a recorded motion they may be estimated as sharp as the samples can tell, which is zero.
    """
    speeds = [np.abs(np.diff(r.q, axis=0)).max(axis=0) / r.period for r in recordings]
    highest = np.max(speeds, axis=0)
    signs = [
        (p, highest[p.joint - 1])
        for p in loop.parameters
        if p.place[-1] == "smoothing" and p.joint is not None
    ]
    for share in _SHARES:
        if needed_substeps(loop, recordings) <= _STEPS:
            break
        values = {p.name: max(float(p.where(loop)), share * speed) for p, speed in signs}
        loop = loop.with_values(**values)
    return loop
