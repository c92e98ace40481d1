"""What every benchmark script shares: its two options, and where tables go."""

import argparse
import json
from pathlib import Path

import pandas as pd


def options(description: str | None) -> argparse.Namespace:
    """The options `--quick` and `--json FILE`."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--quick", action="store_true", help="a smaller run of the same kind")
    parser.add_argument("--json", type=Path, help="also write the table to this file")
    return parser.parse_args()


def report(table: pd.DataFrame, json_file: Path | None, form: str = ".3f") -> None:
    """Prints a table, and writes it as JSON records where a file is named."""
    print(table.to_string(float_format=lambda x: format(x, form)))
    if json_file is not None:
        records = table.reset_index().to_dict(orient="records")
        json_file.write_text(json.dumps(records, indent=1, ensure_ascii=False) + "\n")
