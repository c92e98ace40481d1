"""The blind bench: hidden effects drawn anew, given to `jaxid.discover`, judged by the truth.

python -m benchmarks.hidden_effects [--seed N] [--quick] [--json FILE] [--jobs 2] [--out DIR]
                                    [--robot scara|two_link|axis|any]
"""

import argparse
import json
import os
import secrets
import tempfile
import time
import traceback
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import signal, stats

import jaxid
from jaxid import effects as fx
from jaxid.parameters import list_parameters
from jaxid.storage.campaign import Campaign, Failed
from tests import independent as sim

from . import stepwise

Key = tuple[str, int | None]
KINDS = ("single", "double", "clean", "outside")
COLOURS = ("white", "moderate", "strong")
ROBOTS = ("scara", "two_link", "axis")
WHOLE_ARM = ("payload", "gravity")
TRANSMISSIONS = {"joint_elasticity", "backlash"}
# Beyond this chance of noise alone, the recordings do not show an effect.
INVISIBLE = 0.01


# --- which cases ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Wanted:
    """What a case is to be: its place in the bench, its seed, the effects' names, the noise."""

    number: int
    kind: str
    seed: int
    effects: tuple[str, ...]
    noise: str
    robot: str = "scara"

    @property
    def label(self) -> str:
        """For file names and tables."""
        return f"{self.number:03d}_{self.kind}_{'+'.join(self.effects) or self.noise}"


def draw_wanted(master: int, quick: bool = False, robot: str = "scara") -> list[Wanted]:
    """The cases of one run, shuffled, so that a part of them says something of all.

    With "any" robot, each case has one drawn from those on which its effects make sense.
    """
    rng = np.random.default_rng(master)
    robots = ROBOTS if robot == "any" else (robot,)
    there = {name for chosen in robots for name in sim.applicable(chosen)}
    known, strange = ([n for n in names if n in there] for names in (sim.CATALOGUE, sim.OUTSIDE))
    if quick:
        names = rng.choice(known, 5, replace=False).tolist()
        plain = [("single", (n,)) for n in names[:3]] + [("double", tuple(names[3:]))]
        plain += [("clean", ()), ("outside", (str(rng.choice(strange)),))]
    else:
        plain = [("single", (name,)) for name in known for _ in range(3)]
        plain += [("double", _pair(rng, known)) for _ in range(20)]
        plain += [("clean", ()) for _ in range(20)]
        again = rng.choice(strange, 5, replace=False).tolist()
        plain += [("outside", (name,)) for name in (*strange, *again)]
    colours = rng.choice(COLOURS, len(plain)).tolist()
    # Half of the clean cases in strongly coloured noise: there false alarms are born.
    clean = [k for k, (kind, _) in enumerate(plain) if kind == "clean"]
    for turn, k in enumerate(clean):
        colours[k] = "strong" if turn % 2 == 0 else str(rng.choice(COLOURS[:2]))
    seeds = rng.integers(1, 2**31, len(plain)).tolist()
    order = rng.permutation(len(plain)).tolist()
    return [
        Wanted(
            number, plain[k][0], seeds[k], plain[k][1], colours[k], _robot(rng, robots, plain[k][1])
        )
        for number, k in enumerate(order)
    ]


def _robot(rng: np.random.Generator, robots: Sequence[str], names: Sequence[str]) -> str:
    """One of the robots on which all these effects make sense."""
    fit = [robot for robot in robots if set(names) <= set(sim.applicable(robot))]
    return str(rng.choice(fit))


def _pair(rng: np.random.Generator, known: Sequence[str]) -> tuple[str, ...]:
    """Two names that can be on one robot, wherever they are put."""
    while True:
        names = tuple(rng.choice(known, 2, replace=False).tolist())
        if not set(names) <= TRANSMISSIONS:
            return names


def build(wanted: Wanted) -> sim.Case:
    """The case: robot, motions, effects and noise, all from its seed."""
    return sim.make_case(wanted.seed, wanted.effects, wanted.noise, wanted.robot)


def start_model(case: sim.Case) -> jaxid.ClosedLoop:
    """The model that a user would start from: the robot under its controller, without effects."""
    if case.robot == "scara":
        return jaxid.scara()
    if case.robot == "axis":
        return jaxid.emps()
    law = case.controller
    assert isinstance(law, sim.PD)
    return jaxid.two_link(jaxid.control.PD(Kp=list(law.Kp), Kv=list(law.Kv), Kg=list(law.Kg)))


def read_case(folder: Path, case: sim.Case) -> tuple[jaxid.Recordings, jaxid.Recordings]:
    """The case as a user has it: CSV files, written and read; to fit and held out."""
    sim.write_case(folder, case)
    fitting = jaxid.read(folder / "fit_1.csv", folder / "fit_2.csv")
    return jaxid.Recordings.of(fitting), jaxid.Recordings.of(jaxid.read(folder / "held_out.csv"))


# --- the truth in jaxid's terms ------------------------------------------------------------------


def true_key(effect: sim.Effect) -> Key:
    """Name and joint; None for effects of the whole arm."""
    return effect.name, None if effect.name in WHOLE_ARM else effect.joint


def same(found: Key, true: Key) -> bool:
    """Whether a finding names the true effect; on the whole arm the joint does not matter."""
    return found[0] == true[0] and (found[0] in WHOLE_ARM or found[1] == true[1])


def in_jaxid(effect: Any, plant: Any) -> fx.AbstractEffect:
    """The simulator's effect as an effect of jaxid, at the same values as far as they share them.

    **Raises:** `ValueError` for effects outside the catalogue.
    """
    e, j = effect, effect.joint
    match type(effect).__name__:
        case "Stribeck":
            return fx.Stribeck(j, e.torque, e.velocity, e.gamma)
        case "AsymmetricFriction":
            return fx.AsymmetricFriction(j, e.viscous, e.coulomb, e.gamma)
        case "QuadraticDrag":
            return fx.QuadraticDrag(j, e.drag)
        case "LoadDependentFriction":
            return fx.LoadDependentFriction(j, e.ratio, e.gamma)
        case "PositionDependentFriction":
            return fx.PositionDependentFriction(j, e.A1, e.B1, e.A2, e.B2, e.gamma)
        case "Dahl":
            return fx.Hysteresis(j, e.torque, e.displacement)
        case "LuGre":
            return fx.LuGre(j, e.torque, e.displacement, e.excess, e.velocity, e.damping)
        case "JointElasticity":
            return fx.JointElasticity(j, e.compliance, e.motor_inertia, e.damping)
        case "Backlash":
            return fx.Backlash(j, e.gap, e.motor_inertia, e.stiffness)
        case "TorqueRipple":
            return fx.TorqueRipple(j, e.A, e.B, e.harmonic)
        case "TorqueOffset":
            return fx.TorqueOffset(j, e.torque)
        case "DriveGain":
            return fx.DriveGain(j, e.gain)
        case "ActuatorLag":
            return fx.ActuatorLag(j, e.time_constant)
        case "TimeDelay":
            return fx.TimeDelay(j, e.delay)
        case "TorqueSaturation":
            return fx.TorqueSaturation(j, e.limit)
        case "Gravity":
            mx, my = plant.second_link_moments()
            return fx.Gravity(
                (-e.gy * e.first_moment, e.gx * my - e.gy * mx),
                (e.gx * e.first_moment, e.gx * mx + e.gy * my),
            )
        case "Spring":
            return fx.Spring(j, e.stiffness, e.stiffness * e.rest)
        case "Payload" if plant.joints == 1:
            return fx.Payload(e.mass, 0.0, e.recordings, slides=True)
        case "Payload":
            return fx.Payload(e.mass, e.reach, e.recordings, (plant.L,))
        case "RotorInertia":
            return fx.RotorInertia(j, e.inertia)
        case "ThermalDrift":
            viscous, coulomb = plant.friction_parameters()[j - 1]
            viscous, coulomb = e.amplitude * viscous, e.amplitude * coulomb
            return fx.ThermalDrift(j, viscous, coulomb, e.time_constant, plant.gamma)
        case "PeriodicDisturbance":
            cos, sin = e.amplitude * np.sin(e.phase), e.amplitude * np.cos(e.phase)
            return fx.PeriodicDisturbance(j, float(cos), float(sin), e.frequency)
        case "EndStop":
            return fx.EndStop(j, e.stiffness, e.angle, 1 if e.angle > 0 else -1)
        case "EncoderEccentricity":
            sin, cos = e.amplitude * np.cos(e.phase), e.amplitude * np.sin(e.phase)
            return fx.EncoderEccentricity(j, float(sin), float(cos))
    raise ValueError(f"{effect} is not in jaxid's catalogue")


def innovations(case: sim.Case, names: Sequence[str], errors: Sequence[np.ndarray]) -> float:
    """Squared residuals whitened by the noise filter that made the noise: the truth's chi squared.

    **Arguments:**

    - `names`: of the case's recordings. `errors`: `(samples, joints)` for each of them.
    """
    total = 0.0
    for name, error in zip(names, errors, strict=True):
        noise = case.recordings[name]["noise"]
        for j, coefficients in enumerate(case.noise.ar):
            skip = len(coefficients)
            a = [1.0, *coefficients]
            level = np.mean(signal.lfilter(a, [1.0], noise[:, j])[skip:] ** 2)
            total += float(np.sum(signal.lfilter(a, [1.0], error[:, j])[skip:] ** 2) / level)
    return total


def chi_squared(case: sim.Case, fit: jaxid.Fit, held_out: jaxid.Recordings) -> dict[str, float]:
    """How well a fit does by the true noise, on fitted and on held-out recordings."""
    found = innovations(case, list(fit.recordings.names), fit.residuals)
    unseen = jaxid.compare(fit, held_out).residuals
    return {
        "fit": found,
        "held_out": innovations(case, list(held_out.names), unseen),
        "parameters": len(fit.names),
    }


def oracle(case: sim.Case, without: Sequence[int], fitting: jaxid.Recordings) -> jaxid.Fit:
    """The fit of who knows the truth: its effects but some, from its values."""
    keep = [e for k, e in enumerate(case.effects) if k not in without]
    loop = start_model(case)
    # The one joint of an axis has friction without a number in its plant, and with one in the loop.
    base = {
        name if name in loop.names else f"{name}1": getattr(case.plant, name)
        for name in case.plant.base
    }
    loop = loop.with_values(**base).add(*(in_jaxid(e, case.plant) for e in keep))
    return jaxid.fit(loop, fitting, jaxid.OEM(start="given", progress=False))


def visible(
    case: sim.Case, fitting: jaxid.Recordings, held_out: jaxid.Recordings, base: jaxid.Fit
) -> dict[str, Any]:
    """Whether who knows each true effect can prove it on the fitted recordings.

    **Returns:** the oracle's chi squared, and for each effect what it takes away beside the
    others, with its p-value.
    """
    full = oracle(case, (), fitting)
    best = chi_squared(case, full, held_out)
    proofs = []
    for k, effect in enumerate(case.effects):
        less = base if len(case.effects) == 1 else oracle(case, (k,), fitting)
        worse = chi_squared(case, less, held_out)
        gained, freedom = worse["fit"] - best["fit"], best["parameters"] - worse["parameters"]
        p = float(stats.chi2.sf(gained, freedom))
        proofs.append({"effect": effect.name, "joint": effect.joint, "gained": gained, "p": p})
    return {"chi_squared": best, "status": full.status.name, "proofs": proofs}


def hidden_in_base(case: sim.Case) -> dict[str, float]:
    """For effects outside the catalogue: their power beyond the base parameters and the noise."""
    beyond = sim.remaining_after_refit(case)
    return {"beyond_base_in_noise": max(beyond)}


# --- judging -------------------------------------------------------------------------------------


def groups(story: dict[str, Any]) -> list[list[Key]]:
    """Each added effect with what it could not be told from."""
    return [
        [(a["effect"], a["joint"])] + [(i["effect"], i["joint"]) for i in a["indistinguishable"]]
        for a in story["added"]
    ]


def expected_place(effect: Any) -> tuple[str, int]:
    """On which coordinate, of which joint's torque, an effect outside the catalogue depends."""
    j = effect.joint
    coordinate = {
        "torque_bump": f"q{j}",
        "cubic_dead_spring": f"q{j}",
        "friction_step": "t",
        "cross_coupling": f"q{3 - j}",
        "cross_bump": f"q{3 - j}",
        "velocity_bump": f"v{j}",
        "acceleration_square": f"a{j}",
    }[effect.name]
    return coordinate, j


def judge(case: sim.Case, kind: str, story: dict[str, Any]) -> dict[str, Any]:
    """What was right of a story."""
    found, true = groups(story), [true_key(e) for e in case.effects]
    floor = case.recordings["held_out"]["noise_floor_percent"]
    after = np.array(story["error_percent"]["after"]["validate"])
    marks: dict[str, Any] = {"ratio": float((after / floor).max()), "verdict": story["verdict"]}
    if kind == "clean":
        return {**marks, "alarm": story["verdict"] != "adequate" or bool(found)}
    if kind == "outside":
        first = story["depends_on"][:1]
        place = expected_place(case.effects[0])
        marks["recognised"] = story["verdict"] == "outside_catalogue"
        marks["place"] = bool(first) and (first[0]["coordinate"], first[0]["joint"]) == place
        return {**marks, "right": marks["recognised"] and marks["place"]}
    screened = story["ranking"][:1]
    marks["screened"] = any(same((r["effect"], r["joint"]), t) for r in screened for t in true)
    marks["first"] = bool(found) and any(same(found[0][0], t) for t in true)
    marks["grouped"] = bool(found) and any(same(k, t) for k in found[0] for t in true)
    marks["found"] = [any(same(k, t) for group in found for k in group) for t in true]
    marks["extra"] = sum(not any(same(k, t) for k in group for t in true) for group in found)
    marks["complete"] = story["verdict"] == "explained"
    return marks


def failed(kind: str, marks: dict[str, Any]) -> bool:
    """Whether a case deserves a look."""
    if kind == "clean":
        return marks["alarm"]
    if kind == "outside":
        return not marks["right"]
    wrong = not marks["first"] if kind == "single" else not all(marks["found"])
    return wrong or marks["extra"] > 0 or not marks["complete"] or marks["ratio"] > 1.05


# --- one case ------------------------------------------------------------------------------------


def run_case(wanted: Wanted) -> dict[str, Any]:
    """Makes, solves and judges one case."""
    started = time.perf_counter()
    try:
        record = _solve(wanted)
    except Exception:
        record = {"error": traceback.format_exc()}
    return {**asdict(wanted), **record, "seconds": time.perf_counter() - started}


def _solve(wanted: Wanted) -> dict[str, Any]:
    case = build(wanted)
    with tempfile.TemporaryDirectory() as folder:
        fitting, held_out = read_case(Path(folder), case)
    started = time.perf_counter()
    found = jaxid.discover(start_model(case), fitting, validate=held_out, progress=False)
    story = {**found.to_dict(), "took": time.perf_counter() - started}
    marks = judge(case, wanted.kind, story)
    record = {"truth": sim.truth(case), "marks": marks, "story": story}
    record["truth"]["classes"] = [type(e).__name__ for e in case.effects]
    record["steps"] = [_seen(step, case, held_out) for step in found.steps]
    record["stepwise"] = _stepwise_marks(case, wanted.kind, fitting)
    record["failed"] = failed(wanted.kind, marks)
    if record["failed"]:
        if wanted.kind in ("single", "double"):
            record["oracle"] = visible(case, fitting, held_out, found.steps[0].fit)
        elif wanted.kind == "outside":
            record["oracle"] = hidden_in_base(case)
    return record


def _seen(step: Any, case: sim.Case, held_out: jaxid.Recordings) -> dict[str, Any]:
    """What a step of the story looked like from inside, to learn from failures."""

    def line(verdict: Any) -> dict[str, Any]:
        effect = verdict.hypothesis.effect
        shapes = {
            p.name: np.asarray(p.where(effect)).tolist()
            for p in list_parameters(effect)
            if p.declaration.free and not p.declaration.linear
        }
        return {
            "name": getattr(effect, "label", verdict.hypothesis.name),
            "joint": verdict.hypothesis.joint,
            "evidence": verdict.evidence,
            "p": verdict.p_value,
            "possible": verdict.possible,
            "shape": shapes,
        }

    values = dict(zip(step.fit.names, step.fit.theta.tolist(), strict=True))
    return {
        "label": step.label,
        "status": step.fit.status.name,
        "theta": values,
        "chi_squared": chi_squared(case, step.fit, held_out),
        "ranking": [line(v) for v in step.diagnosis.ranking[:8]],
        "where": [line(v) for v in step.diagnosis.where[:4]],
        "contenders": [
            {
                "name": c.name,
                "joint": c.joint,
                "criterion": c.criterion,
                "status": c.fit.status.name,
            }
            for c in step.contenders
        ],
    }


def _stepwise_marks(case: sim.Case, kind: str, fitting: jaxid.Recordings) -> dict[str, Any]:
    first = stepwise.first_effect(start_model(case), fitting)
    if kind == "clean":
        return {"first": first, "right": first is None}
    true = [true_key(e) for e in case.effects]
    right = kind != "outside" and first is not None and any(same(first, t) for t in true)
    return {"first": first, "right": right}


# --- tables --------------------------------------------------------------------------------------


def _name(name: str, joint: int | None) -> str:
    return name + ("" if joint is None else f"({joint})")


def _true(record: dict[str, Any]) -> str:
    if "truth" not in record:
        return " + ".join(record["effects"]) or "nothing"
    return " + ".join(_name(e["effect"], e["joint"]) for e in record["truth"]["effects"]) or "-"


def _found(record: dict[str, Any]) -> str:
    parts = []
    for a in record["story"]["added"]:
        alike = [_name(i["effect"], i["joint"]) for i in a["indistinguishable"]]
        parts.append(_name(a["effect"], a["joint"]) + (f" ~ {', '.join(alike)}" if alike else ""))
    where = [f"torque {d['joint']} on {d['coordinate']}" for d in record["story"]["depends_on"][:1]]
    return " + ".join(parts + where) or "-"


def row(record: dict[str, Any]) -> str:
    """One line of the table."""
    head = f"{record['number']:4d} {record['kind']:8s}{record['robot']:9s}{record['noise']:9s}"
    head += f"{_true(record):52s}"
    if "error" in record:
        return f"{head}ERROR {record['error'].strip().splitlines()[-1]}"
    marks = record["marks"]
    state = "WRONG" if record["failed"] else "ok"
    baseline = "ok" if record["stepwise"]["right"] else "no"
    return (
        f"{head}{state:6s}{marks['ratio']:7.3f} {record['story']['took']:6.0f} s  "
        f"stepwise {baseline}  {marks['verdict']}: {_found(record)}"
    )


def invisible(record: dict[str, Any], place: int = 0) -> bool:
    """Whether not even an oracle could prove the effect."""
    proofs = record.get("oracle", {}).get("proofs", [])
    return len(proofs) > place and proofs[place]["p"] > INVISIBLE


def summary(records: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Scores, with the aims beside them: (right, of, aim)."""
    done = [r for r in records if "marks" in r]
    of = {kind: [r for r in done if r["kind"] == kind] for kind in KINDS}
    seen = [r for r in of["single"] if not invisible(r)]
    marks = [r["marks"] for r in seen]
    hits = [
        (hit, invisible(r, k)) for r in of["double"] for k, hit in enumerate(r["marks"]["found"])
    ]
    both = [hit for hit, hidden in hits if hit or not hidden]
    ratios = [r["marks"]["ratio"] for r in done if r["kind"] in ("single", "double")]
    clean, outside = of["clean"], of["outside"]
    scores = {
        "one effect: right effect and joint added first": (
            sum(m["first"] for m in marks), len(marks), "97 %",
        ),
        "one effect: right or named indistinguishable": (
            sum(m["grouped"] for m in marks), len(marks), "100 %",
        ),
        "one effect: screened first, before any refit": (
            sum(m["screened"] for m in marks), len(marks), "",
        ),
        "one effect: nothing else added, explained": (
            sum(m["extra"] == 0 and m["complete"] for m in marks), len(marks), "",
        ),
        "two effects: found, each counted": (sum(both), len(both), "90 %"),
        "clean: false alarms": (sum(r["marks"]["alarm"] for r in clean), len(clean), "<= 1 in 20"),
        "outside: recognised": (
            sum(r["marks"]["recognised"] for r in outside), len(outside), "",
        ),
        "outside: recognised, right coordinate and joint": (
            sum(r["marks"]["right"] for r in outside), len(outside), "90 %",
        ),
        "stepwise, one effect: right first": (
            sum(r["stepwise"]["right"] for r in seen), len(seen), "",
        ),
        "stepwise, clean: left alone": (
            sum(r["stepwise"]["right"] for r in clean), len(clean), "",
        ),
    }  # fmt: skip
    return {
        "scores": scores,
        "ratio": {
            "median": float(np.median(ratios)) if ratios else None,
            "worst": sorted(ratios)[-5:],
            "aim": 1.03,
        },
        "invisible": [r["number"] for r in of["single"] if invisible(r)],
        "errors": [r["number"] for r in records if "error" in r],
    }


def show_summary(result: dict[str, Any]) -> None:
    """Prints the scores."""
    for name, (right, of, aim) in result["scores"].items():
        percent = f"{100 * right / of:5.1f} %" if of else "     -"
        print(f"{name:52s}{right:4d} of {of:3d}  {percent}" + (f"  (aim {aim})" if aim else ""))
    ratio = result["ratio"]
    if ratio["median"] is not None:
        worst = ", ".join(f"{x:.3f}" for x in ratio["worst"])
        print(f"held-out error over noise floor: median {ratio['median']:.4f} (aim 1.03)")
        print(f"  worst {worst}")
    print(f"invisible even to the oracle: {result['invisible'] or 'none'}")
    print(f"errors: {result['errors'] or 'none'}", flush=True)


def show_failure(record: dict[str, Any]) -> None:
    """Prints what a case was, what was found, and what an oracle finds."""
    print(
        f"\n{record['number']} {record['kind']}, seed {record['seed']}, {record['robot']}, "
        f"noise {record['noise']}"
    )
    if "error" in record:
        print(record["error"])
        return
    for effect in record["truth"]["effects"]:
        print(f"  truth {_name(effect['effect'], effect['joint'])} {effect['parameters']}")
    print(f"  {record['marks']['verdict']}: {_found(record)}; ratio {record['marks']['ratio']:.4f}")
    for step in record["steps"]:
        chi = step["chi_squared"]
        fit = f"{chi['fit']:.0f}, held out {chi['held_out']:.0f}, {chi['parameters']} parameters"
        print(f"  {step['label']}: {step['status']}, chi squared {fit}")
        for title, lines in (("", step["ranking"][:4]), ("curve ", step["where"][:2])):
            for v in lines:
                mark = "" if v["possible"] else " (not possible)"
                name = _name(v["name"], v["joint"])
                print(f"    {title}{name}: evidence {v['evidence']:.1f}, p {v['p']:.2g}{mark}")
        for c in step["contenders"]:
            print(
                f"    refitted {_name(c['name'], c['joint'])}: {c['criterion']:.1f} {c['status']}"
            )
    print(f"  oracle {json.dumps(record.get('oracle'), default=float)}", flush=True)


# --- running -------------------------------------------------------------------------------------


def configure_jax() -> None:
    """One thread for each worker; compiled programs are kept between workers and runs."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxid-bench"
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_multi_thread_eigen=false".strip()
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def settle(out: Path, seed: int | None, quick: bool, robot: str) -> tuple[int, bool, str]:
    """The run that a folder holds already, or a new one, noted there."""
    note = out / "bench.json"
    if note.exists():
        had = json.loads(note.read_text(encoding="utf-8"))
        if seed is not None and seed != had["seed"]:
            raise SystemExit(f"{out} holds a run of seed {had['seed']}: give another folder")
        return had["seed"], had["quick"], had["robot"]
    seed = secrets.randbits(31) if seed is None else seed
    out.mkdir(parents=True, exist_ok=True)
    content = json.dumps({"seed": seed, "quick": quick, "robot": robot})
    note.write_text(content + "\n", encoding="utf-8")
    return seed, quick, robot


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the bench; see the module's first lines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, help="of everything; drawn anew if not given")
    parser.add_argument("--quick", action="store_true", help="six cases")
    parser.add_argument("--json", type=Path, help="file for all results")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, help="folder in which a stopped run goes on")
    parser.add_argument("--robot", choices=(*ROBOTS, "any"), default="scara")
    parser.add_argument("--only", choices=KINDS, help="cases of one kind")
    parser.add_argument("--case", type=int, action="append", help="only the case of this number")
    given = parser.parse_args(arguments)
    out = given.out or Path(tempfile.mkdtemp(prefix="hidden_effects_"))
    seed, quick, robot = settle(out, given.seed, given.quick, given.robot)
    cases = [w for w in draw_wanted(seed, quick, robot) if given.only in (None, w.kind)]
    cases = [w for w in cases if given.case is None or w.number in given.case]
    print(f"seed {seed}, {robot}, {len(cases)} cases, results in {out}", flush=True)
    configure_jax()
    with Campaign(out, {"seed": seed, "quick": quick}) as campaign:
        records = list(_all(cases, campaign, given.jobs))
    result = summary(records)
    print()
    show_summary(result)
    for record in records:
        if record.get("failed", True):
            show_failure(record)
    if given.json is not None:
        content = {"seed": seed, **result, "cases": records}
        given.json.write_text(json.dumps(content, indent=1, default=float) + "\n", encoding="utf-8")


def _all(cases: Sequence[Wanted], campaign: Campaign, jobs: int) -> Iterable[dict[str, Any]]:
    """Stored cases first, then the others as they end."""
    wanted = {case.label: case for case in cases}
    for label, record in campaign.run(run_case, wanted, jobs=jobs):
        if isinstance(record, Failed):
            record = {**asdict(wanted[label]), "error": record.reason}
        print(row(record), flush=True)
        yield record


if __name__ == "__main__":
    main()
