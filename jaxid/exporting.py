"""Export of fitted arms: URDF has kinematics and bodies, MJCF also has drives."""

import os
import warnings
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from .arms import AbstractSerialArm
from .arms.urdf import parsed_urdf, read_urdf
from .chain import moved_body
from .effects import AbstractEffect, CarriedBody, Coulomb, Viscous
from .errors import JaxidWarning, ModelError
from .parameters import list_parameters, read_values
from .simulation.loop import ClosedLoop
from .simulation.terms import SAID, JointTerms, joint_terms

# What to do about bodies that are not physical.
_NEAREST = "give bodies=jaxid.arms.physical_bodies(arm, covariance).bodies"
# Relative error of an inertia by rounding.
_ROUNDED = 1e-9


def write_urdf(
    loop: ClosedLoop,
    source: str | os.PathLike[str],
    path: str | os.PathLike[str],
    *,
    bodies: Float[np.ndarray, "joints 10"] | None = None,
    base: str | None = None,
    tip: str | None = None,
) -> Path:
    """Writes a copy of a URDF with identified bodies and friction; the rest is unchanged.

    Each joint's link gets the inertia of everything that moves with it, the last one also that of a
    payload on all recordings; links fixed to it get none. `<dynamics>` gets viscous and Coulomb
    friction. A warning names the effects that are left out, such as rotors, which `write_mjcf`
    writes, and links whose bodies are not physical.

    **Arguments:**

    - `loop`: of an arm that was read from a URDF, fitted.
    - `source`: the URDF that the arm was read from, path or text. `path`: where to write.
    - `bodies`: as `physical_bodies` returns them, `(joints, 10)`; the loop's own if None.
    - `base`, `tip`: as given to `SerialArm.from_urdf`.

    **Raises:** `ModelError` if the loop's arm is not that of the URDF.
    """
    arm = _serial(loop)
    found = read_urdf(source, base, tip)
    if len(found.joints) != arm.joints:
        raise ModelError(
            f"this URDF has {len(found.joints)} joints, but {loop.name} has {arm.joints}: give the "
            "URDF that the arm was read from"
        )
    masses = _with_payload(loop, arm.inertias() if bodies is None else bodies)
    _warn_of_the_rest(loop, path, (Viscous, Coulomb))
    wrong = [k for k, body in enumerate(masses, start=1) if not _is_physical(body)]
    if wrong:
        warnings.warn(
            f"the bodies of link{'s' * (len(wrong) > 1)} {', '.join(map(str, wrong))} "
            f"are not physical, and simulators may refuse {path}: {_NEAREST}",
            JaxidWarning,
            stacklevel=2,
        )
    root = parsed_urdf(source)
    links = {link.get("name"): link for link in root.findall("link")}
    for name in found.carried:
        for inertial in links[name].findall("inertial"):
            links[name].remove(inertial)
    joints = {joint.get("name"): joint for joint in root.findall("joint")}
    drives = joint_terms(loop)
    for k, joint in enumerate(found.joints):
        links[joint.link].append(_inertial(masses[k]))
        element = joints[joint.name]
        for old in element.findall("dynamics"):
            element.remove(old)
        damping, friction = _text(drives[k].damping), _text(drives[k].frictionloss)
        ElementTree.SubElement(element, "dynamics", damping=damping, friction=friction)
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode")
    Path(path).write_text(f'<?xml version="1.0"?>\n{text}\n', encoding="utf-8")
    return Path(path)


def write_mjcf(
    loop: ClosedLoop,
    path: str | os.PathLike[str],
    *,
    bodies: Float[np.ndarray, "joints 10"] | None = None,
) -> Path:
    """Writes a MuJoCo model of the arm: bodies, rotors (armature), viscous and dry friction.

    The last link has a payload on all recordings as well. If the law has constant gains on position
    and velocity, joints get position actuators; `simulator_terms` lists the properties of the
    drives that are left out. A warning names the effects that are left out.

    **Arguments:**

    - `loop`: of an arm that was read from a URDF, fitted. `path`: where to write.
    - `bodies`: as `physical_bodies` returns them, `(joints, 10)`; the loop's own if None.

    **Raises:** `ModelError` for another arm, or bodies that MuJoCo would refuse.
    """
    from scipy.spatial.transform import Rotation

    arm = _serial(loop)
    masses = _with_payload(loop, arm.inertias() if bodies is None else bodies)
    _warn_of_the_rest(loop, path, SAID)
    chain = arm.chain
    root = ElementTree.Element("mujoco", model=loop.name)
    ElementTree.SubElement(root, "compiler", angle="radian", autolimits="true")
    ElementTree.SubElement(root, "option", gravity=_text(*np.asarray(chain.gravity)))
    parent = ElementTree.SubElement(root, "worldbody")
    drives = joint_terms(loop)
    for k in range(arm.joints):
        x, y, z, w = Rotation.from_matrix(np.asarray(chain.rotations[k])).as_quat()
        place = _text(*np.asarray(chain.offsets[k]))
        parent = ElementTree.SubElement(
            parent, "body", name=f"link{k + 1}", pos=place, quat=_text(w, x, y, z)
        )
        mass, centre, about = _about_centre(masses[k])
        xx, xy, xz, yy, yz, zz = about[np.triu_indices(3)]
        if not _is_physical(masses[k]):
            raise ModelError(
                f"link {k + 1} has mass {mass:.3g} kg and an inertia that is not physical: "
                f"{_NEAREST}"
            )
        ElementTree.SubElement(
            parent,
            "inertial",
            pos=_text(*centre),
            mass=_text(mass),
            fullinertia=_text(xx, yy, zz, xy, xz, yz),
        )
        ElementTree.SubElement(
            parent,
            "joint",
            name=f"joint{k + 1}",
            type="slide" if chain.slides[k] else "hinge",
            axis=_text(*np.asarray(chain.axes[k])),
            range=_text(arm.lower[k], arm.upper[k]),
            damping=_text(drives[k].damping),
            frictionloss=_text(drives[k].frictionloss),
            armature=_text(drives[k].armature),
        )
    _actuators(root, drives)
    ElementTree.indent(root)
    Path(path).write_text(ElementTree.tostring(root, encoding="unicode") + "\n", encoding="utf-8")
    return Path(path)


def _is_physical(body: Float[np.ndarray, "10"]) -> bool:
    """Whether a simulator accepts a body: positive, no principal inertia above the other two."""
    mass, _, about = _about_centre(body)
    small, middle, large = np.linalg.eigvalsh(about)
    return bool(mass > 0 and small > 0 and small + middle >= large * (1 - _ROUNDED))


def _with_payload(loop: ClosedLoop, bodies: Any) -> Float[np.ndarray, "joints 10"]:
    """The bodies, the last one with what it carries on all recordings."""
    found = np.array(bodies)
    for effect in loop.effects:
        if isinstance(effect, CarriedBody) and not effect.recordings:
            found[-1] += np.asarray(moved_body(effect.about_tip(), effect.chain.tip))
    return found


def _warn_of_the_rest(
    loop: ClosedLoop, path: str | os.PathLike[str], written: tuple[type[AbstractEffect], ...]
) -> None:
    """Warns of effects that a file does not describe.

    **Arguments:**

    - `written`: classes of effects that it describes, beside a payload.
    """
    joints: dict[str, list[str]] = {}
    for effect in loop.effects:
        carried = isinstance(effect, CarriedBody) and not effect.recordings
        sizes = [p for p in list_parameters(effect) if p.declaration.linear]
        absent = bool(sizes) and not np.any(read_values(effect, sizes))
        if not (carried or absent or isinstance(effect, written)):
            own, joint = joints.setdefault(effect.effect_name(), []), getattr(effect, "joint", None)
            own += [] if joint is None else [str(joint)]
    left = [f"{name} on joint {', '.join(own)}" if own else name for name, own in joints.items()]
    if left:
        warnings.warn(
            f"{path} has no {'; '.join(left)}: this format cannot describe them, so what reads the "
            "file has less than the fitted model",
            JaxidWarning,
            stacklevel=3,
        )


def _serial(loop: ClosedLoop) -> AbstractSerialArm:
    if not isinstance(loop.arm, AbstractSerialArm):
        raise ModelError(
            f"{loop.name} is a {type(loop.arm).__name__}, which has no links in space: only arms "
            "that were read from a URDF (jaxid.serial) can be written"
        )
    return loop.arm


def _actuators(root: ElementTree.Element, drives: tuple[JointTerms, ...]) -> None:
    """Position actuators of the joints whose gains are known."""
    if not any(terms.kp for terms in drives):
        return
    element = ElementTree.SubElement(root, "actuator")
    for k, terms in enumerate(drives, start=1):
        if terms.kp is None or terms.kd is None:
            continue
        most = terms.forcerange
        limit = {} if np.isinf(most) else {"forcerange": _text(-most, most)}
        said = {"joint": f"joint{k}", "kp": _text(terms.kp), "kv": _text(terms.kd)} | limit
        ElementTree.SubElement(element, "position", said)


def _about_centre(
    body: Float[np.ndarray, "10"],
) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Mass, centre and inertia about it of a body."""
    mass, moment = float(body[9]), body[6:9]
    about = np.zeros((3, 3))
    about[np.triu_indices(3)] = body[:6]
    about = about + np.triu(about, 1).T
    centre = moment / mass if mass else np.zeros(3)
    return mass, centre, about - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))


def _inertial(body: Float[np.ndarray, "10"]) -> Any:
    mass, centre, about = _about_centre(body)
    element = ElementTree.Element("inertial")
    ElementTree.SubElement(element, "origin", xyz=_text(*centre), rpy="0 0 0")
    ElementTree.SubElement(element, "mass", value=_text(mass))
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    values = about[np.triu_indices(3)]
    tensor = {name: _text(x) for name, x in zip(names, values, strict=True)}
    ElementTree.SubElement(element, "inertia", tensor)
    return element


def _text(*values: float) -> str:
    """Numbers as XML text, with all their digits."""
    return " ".join(repr(float(x)) for x in values)
