"""Export of fitted arms: URDF has kinematics and bodies, MJCF also has drives."""

import os
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from .arms import SerialArm
from .arms.urdf import parsed_urdf, read_urdf
from .errors import ModelError
from .simulation.loop import ClosedLoop
from .simulation.terms import JointTerms, joint_terms


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

    Each joint's link gets the inertia of everything that moves with it; links fixed to it get none.
    `<dynamics>` gets viscous and Coulomb friction. A URDF cannot describe rotors; `write_mjcf`
    does.

    **Arguments:**

    - `loop`: of a `SerialArm`, fitted.
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
    masses = np.asarray(arm.inertias() if bodies is None else bodies)
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

    If the law has constant gains on position and velocity, joints get position actuators as well;
    `simulator_terms` lists the properties of the drives that are left out.

    **Arguments:**

    - `loop`: of a `SerialArm`, fitted. `path`: where to write.
    - `bodies`: as `physical_bodies` returns them, `(joints, 10)`; the loop's own if None.

    **Raises:** `ModelError` for another arm, or bodies that MuJoCo would refuse.
    """
    from scipy.spatial.transform import Rotation

    arm = _serial(loop)
    masses = np.asarray(arm.inertias() if bodies is None else bodies)
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
        if mass <= 0 or np.linalg.eigvalsh(about)[0] <= 0:
            raise ModelError(
                f"link {k + 1} has mass {mass:.3g} kg and an inertia that is not physical: give "
                "bodies=jaxid.arms.physical_bodies(arm).bodies"
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


def _serial(loop: ClosedLoop) -> SerialArm:
    if not isinstance(loop.arm, SerialArm):
        raise ModelError(
            f"{loop.name} is a {type(loop.arm).__name__}, which has no links in space: only arms "
            "of SerialArm.from_urdf can be written"
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
