"""Results as bytes and back: JSON and NumPy arrays in a zip, without executable content.

The zip holds `manifest.json`, its SHA-256 in `manifest.sha256`, and `0.npy`, `1.npy`, … for the
arrays. Members are stored without compression, so a file cannot unpack to more than its own size.
The manifest lists modules as class name and fields, each after those it refers to.
"""

import dataclasses
import enum
import hashlib
import importlib.metadata
import io
import json
import math
import zipfile
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import MissingClassError, SaveError, sentence
from .arrays import npy
from .classes import Registry, agrees, hints, origin, rebuilt

if TYPE_CHECKING:
    import pandas as pd

# Increased if an older jaxid cannot read the new files. Older formats stay readable: if the fields
# of a class changed their meaning, its `of_format(format)` converts the object; if they changed
# their names, its `fields_of_format(fields, format)` converts the fields.
# 2: a loop stores held and freed parameters by place instead of by name.
# 3: the smoothing of a sign is a speed instead of its inverse.
# 4: signatures are stored by output.
# 5: a diagnosis has no pair of effects.
FORMAT = 5

# Limit of the manifest, which contains all but arrays; a long story has about one megabyte.
_LARGEST_MANIFEST = 256 * 2**20
_PACKAGES = ("jaxid-robotics", "jax", "jaxlib", "equinox", "diffrax", "numpy", "scipy")


def versions() -> dict[str, str]:
    """Versions of the packages that a result depends on."""
    found = {}
    for package in _PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found


def pack(value: Any) -> bytes:
    """A tree of modules, containers, numbers, text, arrays and tables as the bytes of a file.

    The same tree gives the same bytes.

    **Raises:** `SaveError` for values that need Python code, such as functions.
    """
    packer = _Packer()
    root = packer.node(value, "result")
    manifest = {
        "format": FORMAT,
        "versions": versions(),
        "root": root,
        "objects": packer.objects,
        "arrays": [digest for digest, _ in packer.arrays],
    }
    text = json.dumps(manifest, separators=(",", ":"), allow_nan=False).encode()
    members = {"manifest.json": text, "manifest.sha256": _digest(text).encode()}
    members |= {f"{k}.npy": content for k, (_, content) in enumerate(packer.arrays)}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, content in members.items():
            # With a date, equal results would give different files.
            archive.writestr(zipfile.ZipInfo(name), content)
    return buffer.getvalue()


class _Packer:
    """Converts values to JSON, and collects each module and array once."""

    def __init__(self) -> None:
        self.objects: list[dict[str, Any]] = []
        self.arrays: list[tuple[str, bytes]] = []
        # Fits of the same recordings contain equal arrays, each of which is written once.
        self._places: dict[str, int] = {}
        # The objects of the tree stay alive, so identities are unique.
        self._seen: dict[int, Any] = {}

    def node(self, value: Any, where: str) -> Any:
        """The JSON of a value; `where` names it in error messages."""
        import pandas as pd

        match value:
            case enum.Enum():
                package, name = origin(type(value))
                return {"enum": name, "package": package, "member": value.name}
            case None | bool() | str():
                return value
            case np.generic() if not isinstance(value, (float, bool)):
                return self.node(value.item(), where)
            case int():
                return int(value)
            case float():
                return float(value) if math.isfinite(value) else {"float": str(float(value))}
            case tuple():
                return {"tuple": [self.node(x, f"{where}[{k}]") for k, x in enumerate(value)]}
            case list():
                return [self.node(x, f"{where}[{k}]") for k, x in enumerate(value)]
            case frozenset():
                return {"set": [self.node(x, where) for x in sorted(value)]}
            case dict():
                pairs = [[self.node(k, where), self.node(x, where)] for k, x in value.items()]
                return {"dict": pairs}
            case pd.DataFrame():
                return self._frame(value, where)
            case np.ndarray() | jax.Array():
                return self._once(value, lambda: self._array(value, where))
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            return self._once(value, lambda: self._object(value, where))
        raise SaveError(
            f"{where} is {value!r}, which cannot be stored as JSON or arrays: save a result "
            "without it"
        )

    def _once(self, value: Any, make: Callable[[], Any]) -> Any:
        if id(value) not in self._seen:
            self._seen[id(value)] = make()
        return self._seen[id(value)]

    def _object(self, value: Any, where: str) -> Any:
        package, name = origin(type(value))
        fields = {}
        for field in dataclasses.fields(value):
            held = getattr(value, field.name)
            try:
                fields[field.name] = self.node(held, f"{where}.{field.name}")
            except SaveError:
                # A function or the like: it is restored from the class's default.
                if held is not field.default:
                    raise
        self.objects.append({"class": name, "package": package, "fields": fields})
        return {"object": len(self.objects) - 1}

    def _array(self, value: Any, where: str) -> Any:
        array = np.asarray(value)
        if array.dtype.kind not in "fiub":
            raise SaveError(f"{where} is an array of {array.dtype}: only numbers can be saved")
        buffer = io.BytesIO()
        # One byte order, so equal results give equal files.
        plain = np.ascontiguousarray(array.astype(array.dtype.newbyteorder("<"), copy=False))
        np.lib.format.write_array(buffer, plain.reshape(array.shape), allow_pickle=False)
        content = buffer.getvalue()
        digest = _digest(content)
        if digest not in self._places:
            self._places[digest] = len(self.arrays)
            self.arrays.append((digest, content))
        return {"array": self._places[digest], "jax": isinstance(value, jax.Array)}

    def _frame(self, frame: "pd.DataFrame", where: str) -> Any:
        levels = [frame.index.get_level_values(k) for k in range(frame.index.nlevels)]
        return {
            "frame": self._array(frame.to_numpy(np.float64), where),
            "columns": [str(name) for name in frame.columns],
            "index": [[str(label) for label in level] for level in levels],
            "names": [None if n is None else str(n) for n in frame.index.names],
        }


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def unpack(content: bytes, source: str, registry: Registry) -> Any:
    """The value that `pack` was given.

    **Arguments:**

    - `content`: the bytes of the file. `source`: its name in messages.
    - `registry`: the classes that it may contain; no others are accepted, and nothing is imported.

    **Raises:** `SaveError` for a file that is damaged, of a later format, or of other classes.
    """
    try:
        return _Unpacker(source, registry).read(content)
    except SaveError:
        raise
    # Constructors may raise any exception for a forged file.
    except Exception as error:
        raise _complaint(
            source,
            f"is damaged ({type(error).__name__}: {error})",
            "save or copy it again",
        ) from error


def _complaint(source: str, what: str, remedy: str) -> SaveError:
    return SaveError(sentence(source, what, remedy))


class _Unpacker:
    def __init__(self, source: str, registry: Registry) -> None:
        self.source, self.registry = source, registry
        self.arrays: list[np.ndarray] = []
        self.objects: list[Any] = []
        self._device: dict[int, jax.Array] = {}
        self.format = FORMAT

    def read(self, content: bytes) -> Any:
        members = self._members(content)
        if len(members["manifest.json"]) > _LARGEST_MANIFEST:
            raise self._damaged("its manifest is larger than any that jaxid writes")
        manifest = json.loads(members["manifest.json"])
        self._check_format(manifest)
        if members.get("manifest.sha256", b"") != _digest(members["manifest.json"]).encode():
            raise self._damaged("its manifest was changed after it was written")
        for k, digest in enumerate(manifest["arrays"]):
            self.arrays.append(self._array(members.get(f"{k}.npy", b""), digest, f"{k}.npy"))
        if len(members) != len(self.arrays) + 2:
            raise self._damaged("it has members that its manifest does not name")
        for entry in manifest["objects"]:
            self.objects.append(self._object(entry))
        return self.value(manifest["root"])

    def _members(self, content: bytes) -> dict[str, bytes]:
        try:
            archive = zipfile.ZipFile(io.BytesIO(content))
            entries = archive.infolist()
            if any(e.compress_type != zipfile.ZIP_STORED or e.flag_bits & 1 for e in entries):
                raise self._damaged("it was packed again by another program")
            # Entries that share bytes would unpack to more than the file's size.
            if sum(e.file_size for e in entries) > len(content):
                raise self._damaged("it would unpack to more than its own size")
            if len({e.filename for e in entries}) < len(entries):
                raise self._damaged("it has a member twice")
            members = {e.filename: archive.read(e) for e in entries}
        except SaveError:
            raise
        except Exception as error:  # zipfile may raise any exception for broken files
            raise _complaint(
                self.source,
                f"is truncated, damaged or not a saved result ({type(error).__name__}: {error})",
                "save or copy it again",
            ) from error
        if "manifest.json" not in members:
            raise _complaint(self.source, "is a zip but not a saved result", "check its name")
        return members

    def _check_format(self, manifest: Any) -> None:
        written = manifest.get("format") if isinstance(manifest, dict) else None
        if type(written) is not int or written < 1:
            raise self._damaged("its manifest names no format")
        if written > FORMAT:
            by = manifest.get("versions", {})
            by = by.get("jaxid-robotics", "") if isinstance(by, dict) else ""
            raise _complaint(
                self.source,
                f"is of format {written} (jaxid {by}), but this jaxid reads formats up to {FORMAT}",
                "upgrade jaxid",
            )
        self.format = written

    def _damaged(self, what: str) -> SaveError:
        return _complaint(self.source, f"is damaged: {what}", "save or copy it again")

    def _array(self, content: bytes, digest: str, name: str) -> np.ndarray:
        if _digest(content) != digest:
            raise self._damaged(f"{name} is missing or was changed after it was written")
        array = npy(content)
        if array.dtype.kind not in "fiub":
            raise self._damaged(f"{name} holds {array.dtype}")
        return array

    def _class(self, package: str, name: str) -> type:
        found = self.registry.get((package, name))
        if found is None and package not in ("", "diffrax"):
            # A user's class, which may have moved to another module.
            same = [c for (p, n), c in self.registry.items() if p and n == name]
            found = same[0] if len(same) == 1 else None
        if found is None and package not in ("", "diffrax"):
            said = sentence(
                self.source,
                f"has an object of your class {name} (of {package})",
                f"pass it: jaxid.load(path, classes=[{name}])",
            )
            raise MissingClassError(said, name)
        if found is None:
            raise _complaint(
                self.source,
                f"has a {name}, which this version of {package or 'jaxid'} does not have",
                "load it with the version that wrote it",
            )
        return found

    def _object(self, entry: dict[str, Any]) -> Any:
        cls = self._class(entry["package"], entry["class"])
        given = {name: self.value(node) for name, node in entry["fields"].items()}
        if self.format < FORMAT and hasattr(cls, "fields_of_format"):
            given = cls.fields_of_format(given, self.format)
        fields = {field.name for field in dataclasses.fields(cls)}
        for name in given:
            if name not in fields:
                raise _complaint(
                    self.source,
                    f"has a {cls.__name__} with a field {name}, which this version does not have",
                    "load it with the version that wrote it",
                )
        made = rebuilt(cls, given)
        if self.format < FORMAT and hasattr(cls, "of_format"):
            made = made.of_format(self.format)
        for name, hint in hints(cls).items():
            if name in fields and not agrees(getattr(made, name), hint):
                raise self._damaged(f"{cls.__name__}.{name} is of a wrong type")
        return made

    def value(self, node: Any) -> Any:
        """The object of a node of the manifest."""
        match node:
            case None | bool() | int() | float() | str():
                return node
            case list():
                return [self.value(x) for x in node]
            case {"object": int(k)}:
                return self.objects[k]
            case {"array": int(k), "jax": bool(on_device)}:
                return self._on_device(k) if on_device else self.arrays[k]
            case {"tuple": list(items)}:
                return tuple(self.value(x) for x in items)
            case {"set": list(items)}:
                return frozenset(self.value(x) for x in items)
            case {"dict": list(pairs)}:
                return {self.value(k): self.value(x) for k, x in pairs}
            case {"float": str(text)} if text in ("nan", "inf", "-inf"):
                return float(text)
            case {"enum": str(name), "package": str(package), "member": str(member)}:
                cls = self._class(package, name)
                if issubclass(cls, enum.Enum) and member in cls.__members__:
                    return cls[member]
            case {"frame": frame, "columns": columns, "index": index, "names": names}:
                return self._frame(frame, columns, index, names)
        raise self._damaged("its manifest has an unknown kind of node")

    def _on_device(self, k: int) -> jax.Array:
        # Objects that shared an array share it again.
        if k not in self._device:
            self._device[k] = jnp.asarray(self.arrays[k])
        return self._device[k]

    def _frame(self, frame: Any, columns: Any, index: Any, names: Any) -> "pd.DataFrame":
        import pandas as pd

        if len(index) == 1:
            labels = pd.Index(index[0], name=names[0])
        else:
            labels = pd.MultiIndex.from_arrays(index, names=names)
        return pd.DataFrame(self.value(frame), index=labels, columns=columns)
