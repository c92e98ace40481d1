"""Cases as the project is judged by: one robot, its effects, three recordings, from one seed."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from .controllers import PD, EmpsCascade
from .draws import Noise, Scale, draw_effect, draw_noise, draw_parameters
from .effects import Effect
from .plants import Axis, Plant, Scara, TwoLink, inverse_dynamics
from .references import Reference, draw_multisine, draw_trapezoids
from .simulate import Controller, Simulation, simulate

RECORDINGS = ("fit_1", "fit_2", "held_out")
COUNTS = 40_000
Recording = dict[str, np.ndarray]


@dataclass(frozen=True)
class Case:
    """A robot with effects and noise; `resolution` of the encoders in rad or m (0: none)."""

    robot: str
    plant: Plant
    controller: Controller
    effects: tuple[Effect, ...] = ()
    noise: Noise = field(default_factory=Noise)
    duration: float = 20.0
    sample: float = 0.01
    resolution: float = 2 * math.pi / COUNTS
    seed: int | None = None
    multiples: tuple[float, ...] = ()
    references: dict[str, Reference] = field(default_factory=dict)
    recordings: dict[str, Recording] = field(default_factory=dict)


def robot_controller(robot: str) -> Controller:
    """The controller that belongs to a robot: Table 1's PD, own gains, or the EMPS cascade."""
    if robot == "scara":
        return PD()
    if robot == "two_link":
        return PD(Kp=(60.0, 120.0), Kv=(10.0, 15.0), Kg=(0.15, 0.045))
    return EmpsCascade()


def draw_reference(rng: np.random.Generator, robot: str, duration: float) -> Reference:
    """A reference within the robot's limits."""
    if robot == "scara":
        return draw_multisine(rng, duration)
    if robot == "two_link":
        return draw_multisine(rng, duration, (0.8, 1.6), ((0.1, 0.9), (0.1, 1.3)))
    return draw_trapezoids(rng, duration)


def record(
    case: Case, reference: Reference, rng: np.random.Generator, name: str | None = None
) -> Recording:
    """One recording: time, q_ref, q, tau as measured, and the truth behind them.

    `noise_floor_percent` is what a perfect model leaves, per joint. Noise is on the measured
    torque only; the encoders' resolution is on the recorded position only.
    """
    run = simulate(
        case.plant,
        reference,
        case.controller,
        case.effects,
        case.duration,
        case.sample,
        recording=name or "",
    )
    noise = case.noise.samples(run.tau, rng)
    tau = run.tau + noise
    res = case.resolution
    return {
        "time": run.time,
        "q_ref": run.q_ref,
        "q": np.round(run.q / res) * res if res else run.q,
        "tau": tau,
        "q_true": run.q,
        "v_true": run.v,
        "a_true": run.a,
        "tau_true": run.tau,
        "q_link": run.q_link,
        "noise": noise,
        "noise_floor_percent": 100 * np.linalg.norm(noise, axis=0) / np.linalg.norm(tau, axis=0),
    }


def visibility(with_it: Sequence[Simulation], without: Sequence[Simulation], level: float) -> float:
    """Torque difference of the most affected joint, over all runs, in multiples of the noise."""
    d = sum(np.sum((a.tau - b.tau) ** 2, axis=0) for a, b in zip(with_it, without, strict=True))
    return float(np.sqrt(d / sum(np.sum(b.tau**2, axis=0) for b in without)).max() / level)


def calibrate(
    effect: Effect,
    multiple: float,
    plant: Plant,
    references: Sequence[Reference],
    controller: Controller,
    others: Sequence[Effect] = (),
    *,
    level: float = 0.015,
    duration: float = 20.0,
    sample: float = 0.01,
    tolerance: float = 0.1,
    runs: int = 8,
    baseline: Sequence[Simulation] | None = None,
) -> tuple[Effect, float]:
    """Scale `effect` so that it changes the torque by `multiple` times the noise, before a refit.

    Returns the effect and what it reached, which is less where a physical cap was hit.
    """

    def run(effects: Sequence[Effect]) -> list[Simulation]:
        return [
            simulate(plant, r, controller, effects, duration, sample, rtol=1e-6, atol=1e-8)
            for r in references
        ]

    without = baseline if baseline is not None else run(others)
    # A limit near the top of the torque acts on few samples, so it is steep.
    slope = 6.0 if effect.name == "torque_saturation" else 1.0
    reach = 1.3 if effect.name == "torque_saturation" else 10.0
    factor, before, best = 1.0, None, (effect, 0.0)
    low, high = 0.0, math.inf
    for _ in range(runs):
        tried = effect.scaled(factor)
        # An unstable loop is too much of an effect, however much it is.
        seen = visibility(run([*others, tried]), without, level)
        reached = min(1e6, max(1e-9, seen)) if math.isfinite(seen) else 1e6
        miss = abs(math.log(reached / multiple))
        if miss < abs(math.log(max(best[1], 1e-9) / multiple)):
            best = (tried, reached)
        if miss < math.log1p(tolerance):
            break
        low, high = (factor, high) if reached < multiple else (low, factor)
        if before is not None:
            change = math.log(reached / before[1]) / math.log(factor / before[0])
            slope = min(12.0, max(0.4, change))
        before = (factor, reached)
        ratio = (multiple / reached) ** (1 / slope)
        factor *= min(reach, max(1 / reach, ratio))
        if not low < factor < high:
            factor = math.sqrt(low * high)
        if effect.scaled(factor) == tried:
            break
    return best


def make_case(
    seed: int,
    effects: Sequence[str | tuple[str, int | None] | Effect] = (),
    noise: str | Noise = "moderate",
    robot: str = "scara",
    *,
    multiple: float | tuple[float, float] = (2.0, 8.0),
    duration: float | None = None,
    controller: Controller | None = None,
    level: float = 0.015,
) -> Case:
    """A case with its three recordings.

    `effects`: names, (name, joint) or finished effects; those named are drawn and calibrated to
    `multiple` times the noise (drawn log-uniformly if a range). Robot, references, effects and
    noise have random streams of their own, so the same seed with other effects is the same robot.
    """
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(5)]
    plant = draw_parameters(streams[0], robot)
    axis = robot == "axis"
    duration = duration or (10.0 if axis else 20.0)
    sample = 1e-3 if axis else 0.01
    controller = controller or robot_controller(robot)
    references = [draw_reference(streams[1], robot, duration) for _ in RECORDINGS]
    # An effect that only the held-out motion shows could not be found: sizes come from the others.
    fitting = references[:2]
    drawn = draw_noise(streams[3], noise, plant.joints, level) if isinstance(noise, str) else noise
    chosen: list[Effect] = []
    multiples: list[float] = []
    scale = None
    for wanted in effects:
        if isinstance(wanted, Effect):
            chosen.append(wanted)
            multiples.append(math.nan)
            continue
        name, joint = (wanted, None) if isinstance(wanted, str) else wanted
        fast = {"rtol": 1e-6, "atol": 1e-8}
        without = [
            simulate(plant, r, controller, chosen, duration, sample, **fast) for r in fitting
        ]
        scale = scale or Scale.of(plant, without)
        start = draw_effect(name, joint, streams[2], scale, plant)
        if isinstance(multiple, tuple):
            goal = math.exp(streams[2].uniform(math.log(multiple[0]), math.log(multiple[1])))
        else:
            goal = multiple
        effect, reached = calibrate(
            start,
            goal,
            plant,
            fitting,
            controller,
            chosen,
            level=drawn.level,
            duration=duration,
            sample=sample,
            baseline=without,
        )
        chosen.append(effect)
        multiples.append(reached)
    case = Case(
        robot=robot,
        plant=plant,
        controller=controller,
        effects=tuple(chosen),
        noise=drawn,
        duration=duration,
        sample=sample,
        resolution=1e-7 if axis else 2 * math.pi / COUNTS,
        seed=seed,
        multiples=tuple(multiples),
        references=dict(zip(RECORDINGS, references, strict=True)),
    )
    rows = {name: record(case, r, streams[4], name) for name, r in case.references.items()}
    return replace(case, recordings=rows)


def remaining_after_refit(
    case: Case, recordings: Sequence[str] = ("fit_1", "fit_2"), step: float = 0.01
) -> list[float]:
    """What an output-error refit of the base model would leave per joint, in multiples of noise.

    To first order: the effects' change of the closed loop's torque, less what the base parameters'
    derivatives (differences of relative `step`) can take. A small number means that the effect
    hides in the base parameters. Costs a simulation per parameter and recording.
    """

    def torque(plant: Plant, name: str) -> np.ndarray:
        reference = case.references[name]
        return simulate(plant, reference, case.controller, (), case.duration, case.sample).tau

    plant, names = case.plant, case.plant.base
    runs = [case.recordings[name] for name in recordings]
    noise = np.sqrt(sum(np.sum(r["noise"] ** 2, axis=0) for r in runs))
    columns, target = [], []
    for name, r in zip(recordings, runs, strict=True):
        without = torque(plant, name)
        moved = [replace(plant, **{k: getattr(plant, k) * (1 + step)}) for k in names]
        columns.append(np.stack([(torque(p, name) - without) / noise for p in moved], axis=2))
        target.append((r["tau_true"] - without) / noise)
    return _unexplained(np.concatenate(columns), np.concatenate(target))


def remaining_in_inverse_dynamics(
    case: Case, recordings: Sequence[str] = ("fit_1", "fit_2")
) -> list[float]:
    """What least squares of the base model on the true q, v, a leaves, in multiples of noise."""
    plant: Scara | TwoLink | Axis = case.plant
    zero = replace(plant, **dict.fromkeys(plant.base, 0.0))
    units = [replace(zero, **{name: 1.0}) for name in plant.base]
    runs = [case.recordings[name] for name in recordings]
    noise = np.sqrt(sum(np.sum(r["noise"] ** 2, axis=0) for r in runs))
    columns, target = [], []
    for r in runs:
        motion = zip(*(r[f"{s}_true"].tolist() for s in "qva"), strict=True)
        rows = [[inverse_dynamics(u, *state) for u in units] for state in motion]
        columns.append(np.swapaxes(np.array(rows), 1, 2) / noise[:, None])
        target.append(r["tau_true"] / noise)
    return _unexplained(np.concatenate(columns), np.concatenate(target))


def _unexplained(columns: np.ndarray, target: np.ndarray) -> list[float]:
    """Norm per joint of what least squares leaves; (samples, joints, parameters)."""
    w = columns.reshape(-1, columns.shape[2])
    size = np.linalg.norm(w, axis=0)
    size[size == 0] = 1.0
    theta = np.linalg.lstsq(w / size, target.reshape(-1), rcond=None)[0]
    return np.linalg.norm(target - (columns / size) @ theta, axis=0).tolist()


def truth(case: Case) -> dict:
    """What is hidden in a case, in the form of the project's truth.json, and more."""
    return {
        "robot": case.robot,
        "effects": [
            {"effect": e.name, "joint": e.joint, "parameters": _plain(e)} for e in case.effects
        ],
        "base_parameters": {name: getattr(case.plant, name) for name in case.plant.base},
        "noise_floor_percent": {
            name: r["noise_floor_percent"].tolist() for name, r in case.recordings.items()
        },
        "multiples_of_noise": [None if math.isnan(m) else m for m in case.multiples],
    }


def _plain(effect: Effect) -> dict:
    """Fields of an effect but its joint, fit for JSON."""
    return {
        k: (None if isinstance(x, float) and math.isinf(x) else x)
        for k, x in asdict(effect).items()
        if k != "joint"
    }


def write_csv(
    path: str | Path, recording: Recording, decimals: int | tuple[int, int, int] = 8
) -> Path:
    """Write `time,q_ref_1,...,q_1,...,tau_1,...`; decimals for all, or for q_ref, q and tau."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    places = (decimals,) * 3 if isinstance(decimals, int) else decimals
    joints = recording["q"].shape[1]
    signals = ("q_ref", "q", "tau")
    header = ",".join(["time"] + [f"{s}_{j + 1}" for s in signals for j in range(joints)])
    step = recording["time"][1] - recording["time"][0]
    formats = ["%.2f" if step > 0.005 else "%.4f"]
    formats += [f"%.{p}f" for p in places for _ in range(joints)]
    # Rounded here, plus zero, so that no "-0.00000" is written.
    rounded = (np.round(recording[s], p) + 0.0 for s, p in zip(signals, places, strict=True))
    data = np.column_stack([recording["time"], *rounded])
    np.savetxt(path, data, fmt=formats, delimiter=",", header=header, comments="")
    return path


def write_case(folder: str | Path, case: Case, decimals: int | tuple[int, int, int] = 8) -> Path:
    """Write the three CSV files of a case and, beside the folder's files, its truth.json."""
    folder = Path(folder)
    for name, recording in case.recordings.items():
        write_csv(folder / f"{name}.csv", recording, decimals)
    (folder / "truth.json").write_text(json.dumps(truth(case), indent=1) + "\n")
    return folder
