"""Common parts of all benchmark scripts: the two options, and the output of tables."""

import argparse
import json
from pathlib import Path
from typing import Any

import pandas as pd


def options(description: str | None) -> argparse.Namespace:
    """The options `--quick` and `--json FILE`."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--quick", action="store_true", help="a smaller run of the same kind")
    parser.add_argument("--json", type=Path, help="also write the table to this file")
    return parser.parse_args()


def report(table: pd.DataFrame, json_file: Path | None, form: str = ".3f") -> None:
    """Prints a table, and writes it as JSON records if a file is given."""
    show(table, form)
    write(records(table), json_file)


def show(table: pd.DataFrame, form: str = ".3f") -> None:
    """Prints a table."""
    print(table.to_string(float_format=lambda x: format(x, form)))


def records(table: pd.DataFrame, **more: str) -> list[dict[str, Any]]:
    """The rows of a table with their index, and further values for each."""
    return [{**more, **row} for row in table.reset_index().to_dict(orient="records")]


def write(rows: list[dict[str, Any]], json_file: Path | None) -> None:
    """Writes rows as JSON if a file is given."""
    if json_file is not None:
        json_file.write_text(json.dumps(rows, indent=1, ensure_ascii=False) + "\n")
