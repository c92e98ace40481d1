"""Marks of a discovery, by case and in total."""

import json
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from tests import independent as sim

from ._hidden_cases import KINDS
from ._hidden_truth import Key, same, true_key

# An effect is invisible if its p-value is above this value.
INVISIBLE = 0.01


def groups(story: dict[str, Any]) -> list[list[Key]]:
    """Each added effect with its indistinguishable alternatives."""
    return [
        [(a["effect"], a["joint"])] + [(i["effect"], i["joint"]) for i in a["indistinguishable"]]
        for a in story["added"]
    ]


def expected_place(effect: Any) -> tuple[str, int]:
    """The coordinate and joint of an effect outside the catalogue."""
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


def judge(
    case: sim.Case, kind: str, story: dict[str, Any], floor: Sequence[float] | None = None
) -> dict[str, Any]:
    """The marks of a story.

    **Arguments:**

    - `floor`: error of the held-out recording due to noise, %, if it is compared in a band.
    """
    found, true = groups(story), [true_key(e) for e in case.effects]
    floor = case.recordings["held_out"]["noise_floor_percent"] if floor is None else floor
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
    """Whether a case should be examined."""
    if kind == "clean":
        return marks["alarm"]
    if kind == "outside":
        return not marks["right"]
    wrong = not marks["first"] if kind == "single" else not all(marks["found"])
    return wrong or marks["extra"] > 0 or not marks["complete"] or marks["ratio"] > 1.05


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
    """Scores with their goals: (right, of, aim)."""
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


def _by_noise(chi: dict[str, float]) -> str:
    fit, held_out, count = (chi[k] for k in ("fit", "held_out", "parameters"))
    return f", chi squared {fit:.0f}, held out {held_out:.0f}, {count} parameters"


def show_failure(record: dict[str, Any]) -> None:
    """Prints the truth of a case, the result, and the result of an oracle."""
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
        print(f"  {step['label']}: {step['status']}{'' if chi is None else _by_noise(chi)}")
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
