"""A serial chain read from a URDF: joints, limits and bodies; meshes are ignored."""

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..errors import ModelError

# Larger than the file of any robot, and small enough to be parsed at once.
_LARGEST = 20_000_000


class DescribedJoint(eqx.Module):
    """A moving joint as in `Chain`, with its name, its link's name and its limits."""

    name: str = eqx.field(static=True)
    link: str = eqx.field(static=True)
    rotation: Float[np.ndarray, "3 3"]
    offset: Float[np.ndarray, "3"]
    axis: Float[np.ndarray, "3"]
    slides: bool = eqx.field(static=True)
    lower: float = eqx.field(static=True)
    upper: float = eqx.field(static=True)


class Described(eqx.Module):
    """A chain as described by a URDF.

    - `name`: name of the robot. `joints`: the moving joints, beginning at the base.
    - `bodies`: ten parameters of each joint's link and all that is fixed to it, `(joints, 10)`, in
      the link's frame and the order of `jaxid.arms.BODY`.
    - `carried`: names of the links that these bodies include.
    - `tip`: origin of the chain's last link, in the frame of the last joint, m.
    """

    name: str = eqx.field(static=True)
    joints: tuple[DescribedJoint, ...]
    bodies: Float[np.ndarray, "joints 10"]
    carried: tuple[str, ...] = eqx.field(static=True, default=())
    tip: tuple[float, ...] = eqx.field(static=True, default=(0.0, 0.0, 0.0))


def parsed_urdf(source: str | os.PathLike[str]) -> Any:
    """The document of a URDF, path or text, as an `ElementTree` element.

    **Raises:** `ModelError` for a file that cannot be read or is not a URDF.
    """
    return _parsed(source)[0]


def read_urdf(
    source: str | os.PathLike[str], base: str | None = None, tip: str | None = None
) -> Described:
    """The chain of joints from one link of a URDF to another.

    Everything that is fixed to a link of the chain moves with it. Joints beyond the tip or off the
    chain are fixed at zero.

    **Arguments:**

    - `source`: path of the file, or its text.
    - `base`, `tip`: names of the first and last link; if None, the root and the only leaf.

    **Raises:** `ModelError` for a file that cannot be read or describes no such chain.
    """
    root, where = _parsed(source)
    links = {_name(link, where): link for link in root.findall("link")}
    if len(links) < len(root.findall("link")):
        raise ModelError(f"{where} has two links of one name: rename one")
    parents: dict[str, Any] = {}
    for joint in root.findall("joint"):
        child, parent = (_end(joint, what, links, where) for what in ("child", "parent"))
        if child in parents:
            raise ModelError(
                f"{where} has two joints with child {child!r}: each link of a serial arm has one"
            )
        parents[child] = (parent, joint)
    _check_circles(parents, where)
    base = _base(base, links, parents, where)
    tip = _tip(tip, base, links, parents, where)
    path = _path(base, tip, parents, where)
    owner, joints = _chain(path, where)
    if not joints:
        raise ModelError(
            f"{where} has no moving joint between {base!r} and {tip!r}: name other links"
        )
    bodies, carried = _bodies(links, parents, owner, base, len(joints), where)
    _check_masses(bodies, joints, where)
    return Described(
        root.get("name") or "robot", tuple(joints), bodies, carried, tuple(owner[tip][2].tolist())
    )


# --- the tree -----------------------------------------------------------------------------------


def _parsed(source: str | os.PathLike[str]) -> tuple[Any, str]:
    """The root of the document, and its name in messages."""
    text, where = str(source), "this URDF"
    if not text.lstrip().startswith("<"):
        where = str(source)
        try:
            path = Path(source)
            if path.stat().st_size > _LARGEST:
                raise ModelError(f"{where} has more than {_LARGEST} bytes: give the URDF alone")
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError, ValueError) as error:
            raise ModelError(f"{where} cannot be read ({error}): give a URDF file") from error
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ModelError(f"{where} declares entities, which a URDF does not need: remove them")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise ModelError(f"{where} is not XML ({error}): correct that line") from error
    if root.tag != "robot":
        hint = " (run xacro on it first)" if "xacro" in text else ""
        raise ModelError(f"{where} has the root <{root.tag}>, but a URDF has <robot>{hint}")
    return root, where


def _name(element: Any, where: str) -> str:
    name = element.get("name")
    if not name:
        raise ModelError(f"{where} has a <{element.tag}> without a name: give it one")
    return name


def _end(joint: Any, what: str, links: dict[str, Any], where: str) -> str:
    """The link at one end of a joint."""
    found = joint.find(what)
    name = None if found is None else found.get("link")
    if name not in links:
        raise ModelError(
            f"joint {_name(joint, where)!r} in {where} has {name!r} as its {what}, but there is no "
            "such link: correct the name"
        )
    return name


def _check_circles(parents: dict, where: str) -> None:
    for link in parents:
        at, seen = link, set()
        while at in parents:
            if at in seen:
                raise ModelError(
                    f"{where} has a closed chain through link {at!r}: a serial arm is open"
                )
            seen.add(at)
            at = parents[at][0]


def _base(base: str | None, links: dict, parents: dict, where: str) -> str:
    roots = [name for name in links if name not in parents]
    if base is None:
        if len(roots) > 1:
            raise ModelError(f"{where} has several roots, {', '.join(roots)}: give base=")
        return roots[0]
    if base not in links:
        raise ModelError(f"{where} has no link {base!r} (base): it has {', '.join(links)}")
    return base


def _tip(tip: str | None, base: str, links: dict, parents: dict, where: str) -> str:
    if tip is not None:
        if tip not in links:
            raise ModelError(f"{where} has no link {tip!r} (tip): it has {', '.join(links)}")
        return tip
    # A leaf has no moving joint after it; flanges and tool frames are fixed.
    ends: dict[str, str] = {}
    carrying = {parent for parent, _ in parents.values()}
    for leaf in (name for name in links if name not in carrying):
        last = leaf
        while last in parents and parents[last][1].get("type") == "fixed":
            last = parents[last][0]
        ends.setdefault(last, leaf)
    inner = set()
    for end in ends:
        at = end
        while at in parents:
            at = parents[at][0]
            inner.add(at)
    outer = [end for end in ends if end not in inner]
    if len(outer) != 1:
        said = ", ".join(sorted(ends[e] for e in outer)) or "none"
        raise ModelError(f"{where} has several tips ({said}): give tip=, the last link of the arm")
    return ends[outer[0]]


def _path(base: str, tip: str, parents: dict, where: str) -> list[tuple[str, Any]]:
    """Links from the base to the tip, each with the joint that carries it."""
    path, at = [], tip
    while at != base:
        if at not in parents:
            raise ModelError(
                f"{where} has no chain of joints from {base!r} to {tip!r}: name other links"
            )
        path.append((at, parents[at][1]))
        at = parents[at][0]
    return path[::-1]


# --- joints -------------------------------------------------------------------------------------


def _chain(
    path: Sequence[tuple[str, Any]], where: str
) -> tuple[dict[str, tuple[int, np.ndarray, np.ndarray]], list[DescribedJoint]]:
    """The moving joints; for each link on the path, the number of its joint and its frame."""
    owner, joints = {}, []
    turn, place = np.eye(3), np.zeros(3)
    for link, joint in path:
        name, kind = _name(joint, where), joint.get("type")
        own_turn, own_place = _origin(joint, f"joint {name!r} in {where}")
        place, turn = place + turn @ own_place, turn @ own_turn
        if joint.find("mimic") is not None:
            raise ModelError(
                f"joint {name!r} in {where} mimics another: the joints of a serial arm must be "
                "independent, so end the chain before it by tip="
            )
        if kind in ("revolute", "continuous", "prismatic"):
            joints.append(_moving(joint, name, link, kind, (turn, place), where))
            turn, place = np.eye(3), np.zeros(3)
        elif kind != "fixed":
            raise ModelError(
                f"joint {name!r} in {where} is {kind!r}: a serial arm has revolute, continuous, "
                "prismatic and fixed joints"
            )
        owner[link] = (len(joints) - 1, turn, place)
    return owner, joints


def _moving(
    joint: Any, name: str, link: str, kind: str, frame: tuple[np.ndarray, np.ndarray], where: str
) -> DescribedJoint:
    said = f"joint {name!r} in {where}"
    element = joint.find("axis")
    axis = _numbers("1 0 0" if element is None else element.get("xyz"), 3, f"the axis of {said}")
    length = np.linalg.norm(axis)
    if not length > 0:
        raise ModelError(f"{said} has an axis of zero length: give its direction")
    limit = joint.find("limit")
    low, high = (-math.pi, math.pi) if kind != "prismatic" else (-1.0, 1.0)
    if kind != "continuous" and limit is not None:
        low = float(_numbers(limit.get("lower", "0"), 1, f"the lower limit of {said}")[0])
        high = float(_numbers(limit.get("upper", "0"), 1, f"the upper limit of {said}")[0])
        if not low < high:
            raise ModelError(f"{said} has limits {low:g} and {high:g}: lower must be below upper")
    turn, place = frame
    return DescribedJoint(name, link, turn, place, axis / length, kind == "prismatic", low, high)


def _origin(element: Any, said: str) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and position of an element's origin in its parent frame."""
    origin = None if element is None else element.find("origin")
    if origin is None:
        return np.eye(3), np.zeros(3)
    place = _numbers(origin.get("xyz", "0 0 0"), 3, f"the origin of {said}")
    roll, pitch, yaw = _numbers(origin.get("rpy", "0 0 0"), 3, f"the origin of {said}")
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix(), place


def _numbers(text: str | None, count: int, said: str) -> np.ndarray:
    try:
        values = np.array([float(x) for x in (text or "").split()])
    except ValueError:
        values = np.array([math.nan])
    if len(values) != count or not np.isfinite(values).all():
        raise ModelError(f"{said} is {text!r}: give {count} finite numbers")
    return values


# --- bodies -------------------------------------------------------------------------------------


def _bodies(
    links: dict[str, Any],
    parents: dict[str, Any],
    owner: dict[str, tuple[int, np.ndarray, np.ndarray]],
    base: str,
    count: int,
    where: str,
) -> tuple[Float[np.ndarray, "joints 10"], tuple[str, ...]]:
    """Bodies of the chain's links, including all links fixed to them, and the names of these."""
    found, carried = np.zeros((count, 10)), []
    for link, element in links.items():
        frame, at = (np.eye(3), np.zeros(3)), link
        while at not in owner and at != base and at in parents:
            parent, joint = parents[at]
            turn, place = _origin(joint, f"joint {_name(joint, where)!r} in {where}")
            frame = turn @ frame[0], place + turn @ frame[1]
            at = parent
        number, turn, place = owner.get(at, (-1, np.eye(3), np.zeros(3)))
        if number < 0:
            continue
        inertial = element.find("inertial")
        if inertial is not None:
            frame = turn @ frame[0], place + turn @ frame[1]
            found[number] += _body(inertial, frame, f"link {link!r} in {where}")
            carried.append(link)
    return found, tuple(carried)


def _body(
    inertial: Any, frame: tuple[np.ndarray, np.ndarray], said: str
) -> Float[np.ndarray, "10"]:
    """The ten parameters of a body in a frame, from its inertia about the centre of mass."""
    element, tensor = inertial.find("mass"), inertial.find("inertia")
    if element is None or tensor is None:
        raise ModelError(f"{said} has an <inertial> without its mass or inertia: give both")
    mass = float(_numbers(element.get("value"), 1, f"the mass of {said}")[0])
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    values = [float(_numbers(tensor.get(k, "0"), 1, f"{k} of {said}")[0]) for k in names]
    xx, xy, xz, yy, yz, zz = values
    about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    # Numbers in files are rounded, so a thin plate may violate the inequality in its last digit.
    least = np.linalg.eigvalsh(0.5 * np.trace(about) * np.eye(3) - about).min()
    if mass < 0 or least < -1e-2 * max(np.trace(about), 1e-9):
        raise ModelError(
            f"{said} has mass {mass:g} and an inertia that is not physical: masses and principal "
            "moments must be positive, and no moment may exceed the sum of the others"
        )
    turn, centre = _origin(inertial, said)
    turn, centre = frame[0] @ turn, frame[1] + frame[0] @ centre
    about = turn @ about @ turn.T + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    upper = about[np.triu_indices(3)]
    return np.concatenate([upper, mass * centre, [mass]])


def _check_masses(
    bodies: Float[np.ndarray, "joints 10"], joints: Sequence[DescribedJoint], where: str
) -> None:
    beyond = np.cumsum(bodies[::-1, 9])[::-1]
    empty = [joint.name for joint, mass in zip(joints, beyond, strict=True) if not mass > 0]
    if empty:
        raise ModelError(
            f"{where} has no mass beyond joint {empty[0]!r}: give its links an <inertial>"
        )
