"""Builds wheel and sdist, and installs the wheel into a fresh environment of each Python given.

python tests/fresh_install.py python3.11 python3.12 python3.13 [--demo]

Every environment gets the package's own dependencies from the package index, within
`constraints.txt`, and runs `jaxid --version`; with `--demo` also `jaxid demo`.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]


def build(source: Path, out: Path, *targets: str) -> list[Path]:
    """What hatchling builds of a source tree: `wheel`, `sdist`; both where nothing is named."""
    chosen = [word for target in targets for word in ("-t", target)]
    command = [sys.executable, "-m", "hatchling", "build", "-d", str(out), *chosen]
    built = subprocess.run(command, cwd=source, capture_output=True, text=True, check=False)
    if built.returncode:
        raise RuntimeError(built.stdout + built.stderr)
    return sorted(out.iterdir())


def install(python: str, wheel: Path, folder: Path) -> Path:
    """The `bin` of a fresh environment with the wheel and its dependencies."""
    subprocess.run([python, "-m", "venv", str(folder)], check=True)
    pip = [str(folder / "bin" / "python"), "-m", "pip", "install", "--quiet"]
    limits = ["--disable-pip-version-check", "--constraint", str(ROOT / "constraints.txt")]
    subprocess.run([*pip, *limits, str(wheel)], check=True)
    return folder / "bin"


def main() -> None:
    """Prints what each environment says, and how long it took."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pythons", nargs="*", default=[sys.executable])
    parser.add_argument("--demo", action="store_true", help="run jaxid demo as well")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        built = build(ROOT, work / "dist")
        print(*(f"{path.name}: {path.stat().st_size / 1e6:.2f} MB" for path in built), sep="\n")
        wheel = next(path for path in built if path.suffix == ".whl")
        for number, python in enumerate(given.pythons):
            started = time.perf_counter()
            programs = install(python, wheel, work / f"environment {number}")
            took = time.perf_counter() - started
            # Away from the checkout, whose package would be imported instead.
            command = [
                [str(programs / "python"), "--version"],
                [str(programs / "jaxid"), "--version"],
            ]
            command += [[str(programs / "jaxid"), "demo"]] if given.demo else []
            for words in command:
                subprocess.run(words, cwd=work, check=True)
            print(
                f"{python}: installed in {took:.0f} s, all in {time.perf_counter() - started:.0f} s"
            )


if __name__ == "__main__":
    main()
