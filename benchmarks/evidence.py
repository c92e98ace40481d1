"""Writes tables from the results of `benchmarks.worlds` and `benchmarks.baselines` into pages.

Only the text between `<!-- made: NAME -->` and `<!-- end: NAME -->` is replaced, where NAME is
worlds, by world, calibration, baselines or power; each is in one of the pages. The figure of the
power curves (needs the extra `static`) is written to `img/power.png` in the folder of the first
page.

python -m benchmarks.evidence RESULTS... [--pages docs/evidence.md docs/runs.md] [--no-figure]
"""

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from ._evidence_power import alone, named, power_figure, power_table
from ._evidence_tables import WORLDS, Line, by_tool, by_world, calibration
from ._world_results import read_lines

DOCS = Path(__file__).parents[1] / "docs"
PAGES = DOCS / "evidence.md", DOCS / "runs.md"
PICTURE = Path("img") / "power.png"


def sections(lines: Sequence[Line]) -> dict[str, str]:
    """The text of every section for which there are results."""
    ours = [x for x in lines if x["tool"] == "jaxid"]
    found = {}
    if ours:
        several = [world for world in WORLDS if len({x[world] for x in ours}) > 1]
        tables = [f"By {world}:\n\n{markdown(by_world(ours, world))}" for world in several]
        found["worlds"] = f"{origins(ours)}\n\n{markdown(by_tool(ours))}"
        found["by world"] = "\n\n".join([origins(ours), *tables])
        found["calibration"] = f"{origins(ours)}\n\n{markdown(calibration(ours), 'probability')}"
    shared = same_cases(lines)
    if any(x["tool"] != "jaxid" for x in shared):
        found["baselines"] = f"{origins(shared)}\n\n{markdown(by_tool(shared))}"
    if trials := named(shared):
        found["power"] = "\n\n".join(
            [
                origins(shared),
                f"![Share of effects named over their size]({PICTURE.as_posix()})",
                f"Named, by size over the noise:\n\n{markdown(power_table(trials), 'size')}",
                "All named, and nothing else, by the size of the smallest:\n\n"
                + markdown(power_table(alone(shared)), "size"),
            ]
        )
    return found


def same_cases(lines: Sequence[Line]) -> list[Line]:
    """The lines of cases that were given to every tool, with the law unknown."""
    unknown = [x for x in lines if x["law"] == "unknown"]
    tools = {x["tool"] for x in unknown}
    asked: dict[int, set[str]] = {}
    for line in unknown:
        asked.setdefault(line["seed"], set()).add(line["tool"])
    return [x for x in unknown if asked[x["seed"]] == tools]


def origins(lines: Sequence[Line]) -> str:
    """Number of cases, seeds, dates and commits."""
    cases = len({(x["seed"], x["law"]) for x in lines})
    runs = [x["run"] for x in lines]
    seeds, dates, commits = (
        ", ".join(sorted({str(r[name] or "not noted") for r in runs}))
        for name in ("seed", "date", "commit")
    )
    return f"{cases} cases; seed {seeds}; date {dates}; commit {commits}."


def markdown(table: pd.DataFrame, corner: str = "") -> str:
    """A table in Markdown."""
    head = [f"| {' | '.join([corner, *map(str, table.columns)])} |"]
    rule = [f"|{' --- |' * (len(table.columns) + 1)}"]
    cells = [[str(k), *row] for k, row in zip(table.index, table.to_numpy(), strict=True)]
    return "\n".join([*head, *rule, *(f"| {' | '.join(row)} |" for row in cells)])


def placed(pages: Sequence[str], texts: dict[str, str]) -> list[str]:
    """The pages with new sections between their marks.

    **Raises:** `ValueError` if a section has no marks in the pages, or several pairs.
    """
    written = list(pages)
    for name, text in texts.items():
        begin, end = f"<!-- made: {name} -->", f"<!-- end: {name} -->"
        pattern = re.compile(f"{re.escape(begin)}.*?{re.escape(end)}", re.DOTALL)
        if sum(len(pattern.findall(page)) for page in written) != 1:
            raise ValueError(
                f"the pages have no place for {name}, or more than one: "
                f"put one pair of lines {begin} and {end} where it is to stand"
            )
        made = f"{begin}\n\n{text}\n\n{end}"
        written = [pattern.sub(lambda _, made=made: made, page) for page in written]
    return written


def main(arguments: Sequence[str] | None = None) -> None:
    """Writes the pages; see the module's first lines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path, nargs="+", help="files that --results wrote")
    parser.add_argument("--pages", type=Path, nargs="+", default=PAGES)
    parser.add_argument("--no-figure", action="store_true", help="leave the picture as it is")
    given = parser.parse_args(arguments)
    lines = read_lines(given.results)
    made = sections(lines)
    pages = placed([page.read_text(encoding="utf-8") for page in given.pages], made)
    if "power" in made and not given.no_figure:
        picture = given.pages[0].parent / PICTURE
        picture.parent.mkdir(parents=True, exist_ok=True)
        figure = power_figure(same_cases(lines))
        figure.write_image(picture, width=860, height=380, scale=1.5)
    for path, page in zip(given.pages, pages, strict=True):
        path.write_text(page, encoding="utf-8")
    where = ", ".join(map(str, given.pages))
    print(f"{len(lines)} lines, sections {', '.join(made) or 'none'}, written to {where}")


if __name__ == "__main__":
    main()
