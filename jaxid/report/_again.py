"""Data needed to reproduce a discovery: versions, recordings and settings."""

import hashlib
import json
import platform
from importlib import metadata

import numpy as np

from ..discovery import Discovery
from ..excitation import Limits
from ..recording import Recording
from ._html import Content, Markup, details, join, number, section, table, tag


def settings(story: Discovery) -> Markup:
    """Versions, recordings and settings needed to reproduce the discovery."""
    fit = story.steps[0].fit
    packages = ("jaxid-robotics", "jax", "jaxlib", "diffrax", "equinox", "numpy", "scipy")
    facts = [
        ("robot", repr(fit.loop)),
        ("effects at the end", ", ".join(_effects(story)) or "none"),
        ("method of the last fit", repr(story.fit.method)),
        ("significance", f"{story.diagnosis.significance:g}"),
        ("duration", f"{story.seconds:.0f} s"),
        ("machine", platform.platform()),
        ("Python", platform.python_version()),
        *((package, _version(package)) for package in packages),
    ]
    rows = [[name, value] for name, value in facts]
    recordings = [["fitted", *_recording(r)] for r in fit.recordings]
    held = story.steps[0].held_out
    if held is not None:
        recordings += [["held out", *_recording(r)] for r in held.recordings]
    columns = ["used", "recording", "samples", "duration, s", "rate, Hz", "SHA-256 of its samples"]
    told = json.dumps(_plain(story.to_dict()), indent=1, ensure_ascii=False)
    # The element scrolls, so it must be reachable by keyboard.
    whole = tag("pre", told, tabindex="0", role="region", aria_label="the story as JSON")
    said = join("The story in the JSON format of ", tag("code", "jaxid discover --json"))
    return section(
        "How to reproduce this result",
        table(columns, recordings, "recordings"),
        details("Ranges of the recordings", _reach(story)),
        details("Settings and versions", table(["setting", "value"], rows, "settings, versions")),
        details(said, whole, class_="raw"),
    )


def _reach(story: Discovery) -> Markup:
    """Ranges of the fitted recordings; there are no data beyond them."""
    limits = Limits.of(story.fit.recordings)
    torque, position = story.loop.arm.units()
    rows: list[list[Content]] = [
        [
            f"joint {j + 1}",
            _range(limits.low[j], limits.high[j], position[j]),
            f"{limits.speed[j]:.3g}\u00a0{position[j]}/s",
            f"{limits.acceleration[j]:.3g}\u00a0{position[j]}/s²",
            f"{limits.torque[j]:.3g}\u00a0{torque[j]}",
        ]
        for j in range(len(limits.low))
    ]
    columns = ["joint", "position", "speed up to", "acceleration up to", "torque up to"]
    return table(
        columns, rows, "ranges of the fitted recordings; the model is untested outside them"
    )


def _range(low: float, high: float, unit: str) -> str:
    first, last = (number(float(f"{x:.3g}")) for x in (low, high))
    return f"{first}\u00a0…\u00a0{last}\u00a0{unit}"


def _plain(value: object) -> object:
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(inner) for inner in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _effects(story: Discovery) -> list[str]:
    named = ((e.effect_name(), getattr(e, "joint", None)) for e in story.loop.effects)
    return [name if joint is None else f"{name}({joint})" for name, joint in named]


def _recording(recording: Recording) -> list[Content]:
    digest = hashlib.sha256()
    for signal in (recording.time, recording.q, recording.tau, recording.q_ref, recording.v):
        if signal is not None:
            digest.update(np.ascontiguousarray(signal, dtype="<f8").tobytes())
    size = [recording.samples, recording.duration, recording.rate]
    return [recording.name, *size, digest.hexdigest()[:16]]


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed as a package"
