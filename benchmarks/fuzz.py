"""Every reader, and `jaxid.load`, with malformed bytes.

python -m benchmarks.fuzz [--seconds 60] [--seed N] [--quick] [--json FILE] [--atheris FOLDER]

Valid files are cut, flipped, spliced and forged (members of archives are changed and checksums
adapted). The outcome must be a result, or one sentence of jaxid, within limits of time and memory.
With `--atheris` libFuzzer searches for bytes that reach new code instead, if the package atheris is
installed; FOLDER keeps its corpus.
"""

import argparse
import collections
import faulthandler
import gzip
import hashlib
import inspect
import io
import json
import secrets
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import scipy.io

import jaxid
from jaxid.errors import JaxidError
from jaxid.storage import archive, saved

# Limits of a reader for a file of a few kilobytes, on a machine with other work.
SLOWEST = 20.0
EDGES = (0, 1, 127, 128, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1)


def table() -> pd.DataFrame:
    """A small valid recording."""
    t = 0.01 * np.arange(60)
    columns = {"time": t}
    for k, name in enumerate(("q_1", "q_2", "tau_1", "tau_2", "q_ref_1", "q_ref_2")):
        columns[name] = np.sin((3 + k) * t + k)
    return pd.DataFrame(columns)


def valid_files() -> dict[str, list[bytes]]:
    """Files that can be read, by ending."""
    frame = table()
    arrays = {name: frame[name].to_numpy() for name in frame}
    text = frame.to_csv(index=False).encode()
    made: dict[str, list[bytes]] = {
        "csv": [text, frame.to_csv(index=False, sep=";").encode()],
        "tsv": [frame.to_csv(index=False, sep="\t").encode()],
        "csv.gz": [gzip.compress(text)],
    }
    for ending, writes in {
        "npz": (lambda b: np.savez(b, **arrays), lambda b: np.savez_compressed(b, **arrays)),
        "mat": (
            lambda b: scipy.io.savemat(b, arrays),
            lambda b: scipy.io.savemat(b, arrays, do_compression=True),
            lambda b: scipy.io.savemat(b, arrays, format="4"),
        ),
        "parquet": (lambda b: frame.to_parquet(b, write_page_checksum=True),),
    }.items():
        made[ending] = [_written(write) for write in writes]
    recording = jaxid.Recording.from_dataframe(frame, name="run")
    made["jaxid"] = [archive.pack(jaxid.Recordings.of(recording)), archive.pack(jaxid.scara())]
    return made


def _written(write: Callable[[io.BytesIO], Any]) -> bytes:
    buffer = io.BytesIO()
    write(buffer)
    return buffer.getvalue()


def mutated(rng: np.random.Generator, content: bytes, other: bytes) -> bytes:
    """A file with a few errors."""
    data = bytearray(content)
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(len(data) + 1))
        match int(rng.integers(8)):
            case 0:
                del data[at:]
            case 1:
                del data[at : at + int(rng.integers(1, 40))]
            case 2:
                data[at:at] = rng.bytes(int(rng.integers(1, 40)))
            case 3:
                data[at:at] = data[at : at + int(rng.integers(1, 200))]
            case 4:
                size = int(rng.choice([1, 2, 4, 8]))
                edge = int(rng.choice(np.array(EDGES, object))) % 2 ** (8 * size)
                data[at : at + size] = edge.to_bytes(size, rng.choice(["little", "big"]))
            case 5:
                start = int(rng.integers(len(other)))
                data[at:] = other[start:]
            case 6 if data:
                data[at % len(data)] ^= 1 << int(rng.integers(8))
            case _ if data:
                data[at % len(data)] = int(rng.integers(256))
    return bytes(data)


def forged(rng: np.random.Generator, content: bytes, other: bytes) -> bytes:
    """An archive with an error inside, and matching checksums."""
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        members = {name: file.read(name) for name in file.namelist()}
    name = str(rng.choice([n for n in members if n != "manifest.sha256"]))
    members[name] = mutated(rng, members[name], other)
    if "manifest.json" in members:
        try:
            manifest = json.loads(members["manifest.json"])
            arrays = [v for k, v in members.items() if k.endswith(".npy")]
            manifest["arrays"] = [hashlib.sha256(array).hexdigest() for array in arrays]
            members["manifest.json"] = json.dumps(manifest).encode()
        except (ValueError, TypeError, RecursionError):
            pass
        seal = hashlib.sha256(members["manifest.json"]).hexdigest()
        members["manifest.sha256"] = seal.encode()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file:
        for key, value in members.items():
            file.writestr(key, value)
    return buffer.getvalue()


def attempt(ending: str, content: bytes, folder: Path) -> str:
    """The outcome of a file: `read` or `refused`.

    **Raises:** any other exception of the reader.
    """
    path = folder / f"run.{ending}"
    path.write_bytes(content)
    try:
        if ending == "jaxid":
            saved.load(path)
        else:
            jaxid.read(path, largest=2**24)
    except JaxidError as error:
        sentence = str(error)
        assert sentence.isprintable()
        assert sentence.endswith(".")
        return "refused"
    return "read"


def fuzz(seconds: float, seed: int) -> tuple[pd.DataFrame, list[dict[str, Any]]]:
    """Counts by ending, and unexpected outcomes."""
    rng = np.random.default_rng(seed)
    files = valid_files()
    every = [content for contents in files.values() for content in contents]
    counts: dict[str, collections.Counter[str]] = {e: collections.Counter() for e in files}
    slowest = dict.fromkeys(files, 0.0)
    findings: list[dict[str, Any]] = []
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        while time.perf_counter() - started < seconds:
            for ending, contents in files.items():
                content = contents[int(rng.integers(len(contents)))]
                other = every[int(rng.integers(len(every)))]
                change = mutated
                if content.startswith(b"PK") and rng.random() < 0.7:
                    change = forged
                content = change(rng, content, other)
                before = time.perf_counter()
                try:
                    outcome = attempt(ending, content, Path(folder))
                except Exception:
                    outcome = "other"
                    said = traceback.format_exc()
                    findings.append({"ending": ending, "bytes": content.hex(), "said": said})
                took = time.perf_counter() - before
                slowest[ending] = max(slowest[ending], took)
                counts[ending][outcome] += 1
                if took > SLOWEST:
                    findings.append({"ending": ending, "bytes": content.hex(), "said": "slow"})
    rows = [
        {"ending": e, "tried": sum(c.values()), **{k: c[k] for k in ("read", "refused", "other")}}
        | {"slowest_s": slowest[e]}
        for e, c in counts.items()
    ]
    return pd.DataFrame(rows).set_index("ending"), findings


def atheris_fuzz(corpus: Path, seconds: float) -> None:
    """Coverage-guided; ends the process. The first byte of an input chooses the reader."""
    import atheris  # type: ignore[import-not-found]

    files = valid_files()
    endings = list(files)
    corpus.mkdir(parents=True, exist_ok=True)
    for k, contents in enumerate(files.values()):
        for n, content in enumerate(contents):
            (corpus / f"valid-{k}-{n}").write_bytes(bytes([k]) + content)
    folder = Path(tempfile.mkdtemp())
    for module in [m for name, m in sys.modules.items() if name.startswith("jaxid.recording")]:
        for name, value in list(vars(module).items()):
            if inspect.isfunction(value) and value.__module__.startswith("jaxid.recording"):
                setattr(module, name, atheris.instrument_func(value))

    def one(data: bytes) -> None:
        if data:
            attempt(endings[data[0] % len(endings)], data[1:], folder)

    warnings.simplefilter("ignore")
    arguments = [sys.argv[0], str(corpus), f"-max_total_time={int(seconds)}", "-max_len=16384"]
    atheris.Setup([*arguments, "-timeout=60", "-rss_limit_mb=4096"], one)
    atheris.Fuzz()


def main() -> None:
    """Runs it; see the module's first lines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int)
    parser.add_argument("--quick", action="store_true", help="two seconds")
    parser.add_argument("--json", type=Path, help="file for counts and findings")
    parser.add_argument("--atheris", type=Path, metavar="FOLDER")
    given = parser.parse_args()
    # A reader in C may end the process; its input then remains in the temporary folder.
    faulthandler.enable()
    seconds = 2.0 if given.quick else given.seconds
    if given.atheris is not None:
        atheris_fuzz(given.atheris, seconds)
    seed = secrets.randbits(31) if given.seed is None else given.seed
    counts, findings = fuzz(seconds, seed)
    print(f"seed {seed}, {seconds:g} s")
    print(counts.to_string(float_format=lambda x: f"{x:.2f}"))
    for finding in findings[:10]:
        print(f"\n{finding['ending']}: {finding['said']}")
    if given.json is not None:
        content = {"seed": seed, "counts": counts.reset_index().to_dict("records")}
        given.json.write_text(json.dumps(content | {"findings": findings}, indent=1) + "\n")
    sys.exit(1 if findings else 0)


if __name__ == "__main__":
    main()
