"""Discoveries for many robots, with one table for comparison."""

import os
from collections.abc import Mapping
from concurrent.futures import Executor
from typing import TYPE_CHECKING, Any

import equinox as eqx

from ..display.progress import working
from ..errors import ModelError
from ..recording import Recordings
from ..simulation.loop import ClosedLoop
from ..storage.campaign import Campaign, Failed
from ..storage.classes import classes_of
from ._discover import discover

if TYPE_CHECKING:
    import pandas as pd


class FleetRobot(eqx.Module):
    """One robot of a fleet: its model, its recordings, and held-out recordings.

    - `settings`: settings of its discovery, instead of those for all robots.
    """

    loop: ClosedLoop
    recordings: Recordings = eqx.field(converter=Recordings.of)
    validate: Recordings | None = eqx.field(
        converter=lambda given: None if given is None else Recordings.of(given), default=None
    )
    settings: dict[str, Any] = eqx.field(static=True, default_factory=dict)


class Fleet(eqx.Module):
    """The results of all robots.

    - `stories`: result of `Discovery.to_dict` by robot.
    - `failed`: reason of a failure by robot.
    """

    stories: dict[str, dict[str, Any]] = eqx.field(static=True)
    failed: dict[str, str] = eqx.field(static=True)

    def table(self) -> "pd.DataFrame":
        """One row for each robot: verdict, effects, parameters, errors before and after, %."""
        import pandas as pd

        rows = []
        for robot, story in self.stories.items():
            errors = [story["error_percent"][k] for k in ("before", "after")]
            # A model may diverge along a held-out recording.
            kind = "validate" if all("validate" in x for x in errors) else "fit"
            before, after = (max(x[kind]) for x in errors)
            rows.append(
                {
                    "robot": robot,
                    "verdict": story["verdict"],
                    "effects": " + ".join(map(_named, story["added"])),
                    "parameters": ", ".join(map(_values, story["added"])),
                    "before": before,
                    "after": after,
                    "said": story["sentence"],
                }
            )
        rows += [{"robot": r, "verdict": "failed", "said": why} for r, why in self.failed.items()]
        columns = ["robot", "verdict", "effects", "parameters", "before", "after", "said"]
        return pd.DataFrame(rows, columns=columns).set_index("robot").sort_index()

    def to_dict(self) -> dict[str, Any]:
        """The same as plain JSON."""
        return {"robots": self.stories, "failed": self.failed}

    def __repr__(self) -> str:
        import pandas as pd

        shown = self.table().drop(columns="said").astype(object).fillna("")
        with pd.option_context("display.width", 100, "display.max_colwidth", 44):
            return shown.to_string(float_format=lambda x: f"{x:.3g}")


def discover_all(
    problems: Mapping[str, FleetRobot],
    executor: Executor | None = None,
    *,
    jobs: int | None = None,
    resume: str | os.PathLike[str] | None = None,
    progress: bool = True,
    **settings: Any,
) -> Fleet:
    """Runs a discovery for each of many robots; a failure does not stop the others.

    **Arguments:**

    - `problems`: robots by name.
    - `executor`: any executor of `concurrent.futures`, including Dask's `client.get_executor()` and
      that of mpi4py; processes of this machine if None.
    - `jobs`: number of processes; by default one for each core.
    - `resume`: a folder in which each robot's result is saved when it finishes; the same call
      continues from it.
    - `settings`: settings of each discovery, as for `discover`.

    **Raises:** `ModelError` if there is no robot; `SaveError` if the folder contains other work.
    """
    if not problems:
        raise ModelError("no robot is given: give at least one problem")
    plan = {"problems": dict(problems), "settings": settings}
    work = {name: (problem, settings) for name, problem in problems.items()}
    classes = {c for problem in problems.values() for c in classes_of(problem)}
    stories, failed = {}, {}
    with (
        working(f"{len(problems)} robots", progress) as say,
        Campaign(resume, plan, classes) as campaign,
    ):
        count = jobs or min(len(problems), os.cpu_count() or 1)
        for name, found in campaign.run(_solved, work, jobs=count, executor=executor):
            if isinstance(found, Failed):
                failed[name] = found.reason
            else:
                stories[name] = found
            done = len(stories) + len(failed)
            say(f"{done} of {len(problems)}, last {name}", done / len(problems))
    return Fleet(stories, failed)


def _solved(given: tuple[FleetRobot, dict[str, Any]]) -> dict[str, Any]:
    problem, settings = given
    chosen = {**settings, **problem.settings, "progress": False}
    story = discover(problem.loop, problem.recordings, problem.validate, **chosen)
    if story.interrupted:
        # An interrupted robot is not saved, and no other robot is started.
        raise KeyboardInterrupt
    return story.to_dict()


def _named(added: Mapping[str, Any]) -> str:
    joint = added["joint"]
    return added["effect"] + ("" if joint is None else f"({joint})")


def _values(added: Mapping[str, Any]) -> str:
    found = added["parameters"].items()
    return ", ".join(f"{name} {entry['value']:.3g} {entry['unit']}" for name, entry in found)
