"""Arms of six and seven joints from published URDFs, simulated by MuJoCo under a sampled law.

MuJoCo reads the URDF; jaxid's formulas are not used.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np

from ._world_physics import Friction, Reference

# Robots by file below the robots of `example-robot-data`, with the last link of the arm.
ROBOTS = {
    "ur3": ("ur_description/urdf/ur3_robot.urdf", "ee_link"),
    "ur5": ("ur_description/urdf/ur5_robot.urdf", "ee_link"),
    "ur10": ("ur_description/urdf/ur10_robot.urdf", "ee_link"),
    "z1": ("z1_description/urdf/z1.urdf", "link06"),
    "kinova": ("kinova_description/robots/kinova.urdf", "j2s6s200_end_effector"),
    "panda": ("panda_description/urdf/panda.urdf", "panda_link8"),
}
# The same up to an earlier link; the other joints are locked.
PARTS = {
    "ur5_1": (ROBOTS["ur5"][0], "shoulder_link"),
    "ur5_2": (ROBOTS["ur5"][0], "upper_arm_link"),
    "ur5_3": (ROBOTS["ur5"][0], "forearm_link"),
}
TICK, STEPS = 1e-3, 10
STEP = TICK / STEPS


def folder() -> Path:
    """The folder of the package's robots."""
    import example_robot_data

    start = Path(example_robot_data.__file__)
    for above in start.parents:
        if (found := above / "share" / "example-robot-data" / "robots").is_dir():
            return found
    raise FileNotFoundError("example-robot-data has no folder of robots: install it anew")


def arm_alone(name: str) -> tuple[ET.Element, str]:
    """The robot's URDF without meshes, with fixed fingers, and the last link of the arm."""
    path, tip = (ROBOTS | PARTS)[name]
    root = ET.parse(folder() / path).getroot()
    for link in root.findall("link"):
        for what in ("visual", "collision"):
            for element in link.findall(what):
                link.remove(element)
    for what in ("gazebo", "transmission", "material"):
        for element in root.findall(what):
            root.remove(element)
    parents = {_of(joint, "child"): joint for joint in root.findall("joint")}
    chain, at = set(), tip
    while at in parents:
        chain.add(parents[at].get("name"))
        at = _of(parents[at], "parent")
    for joint in root.findall("joint"):
        if joint.get("name") not in chain:
            joint.set("type", "fixed")
            for mimic in joint.findall("mimic"):
                joint.remove(mimic)
        for dynamics in joint.findall("dynamics"):
            joint.remove(dynamics)
    return root, tip


def _of(joint: ET.Element, what: str) -> str:
    """The link at one end of a joint."""
    found = joint.find(what)
    return "" if found is None else found.get("link", "")


def text(root: ET.Element) -> str:
    """A URDF as text, which MuJoCo and jaxid can read."""
    return ET.tostring(root, encoding="unicode")


def with_payload(root: ET.Element, tip: str, mass: float, centre: Sequence[float]) -> ET.Element:
    """The URDF with a cuboid fixed to its last link; its centre in that link's frame, m."""
    loaded = ET.fromstring(ET.tostring(root))
    link = ET.SubElement(loaded, "link", name="hidden_payload")
    body = ET.SubElement(link, "inertial")
    ET.SubElement(body, "origin", xyz=" ".join(map(str, centre)))
    ET.SubElement(body, "mass", value=str(mass))
    sizes = mass / 12 * np.array([0.05**2 + 0.08**2, 0.04**2 + 0.08**2, 0.04**2 + 0.05**2])
    inertia = {f"i{a}{a}": str(x) for a, x in zip("xyz", sizes, strict=True)}
    ET.SubElement(body, "inertia", **inertia, ixy="0", ixz="0", iyz="0")
    joint = ET.SubElement(loaded, "joint", name="hidden_clamp", type="fixed")
    ET.SubElement(joint, "parent", link=tip)
    ET.SubElement(joint, "child", link="hidden_payload")
    return loaded


def with_wrong_bodies(root: ET.Element, rng: np.random.Generator, most: float) -> ET.Element:
    """The URDF with wrong masses, and inertias in proportion, by up to a share."""
    drawn = ET.fromstring(ET.tostring(root))
    for body in drawn.iter("inertial"):
        factor = float(rng.uniform(1 - most, 1 + most))
        for element, keys in ((body.find("mass"), ("value",)), (body.find("inertia"), None)):
            if element is not None:
                for key in keys or tuple(element.keys()):
                    element.set(key, str(float(element.get(key, "0")) * factor))
    return drawn


@dataclass
class Plant:
    """The true arm: bodies in MuJoCo's model, and further torques on its drives.

    - `rotors`: inertia of each drive at its joint, kg·m².
    - `extra`: torques that the user's model lacks: name, joint (from 0), numbers.
    """

    urdf: str
    rotors: tuple[float, ...]
    frictions: tuple[Friction, ...]
    tilt: tuple[float, float] = (0.0, 0.0)
    extra: tuple[tuple[str, int, dict[str, float]], ...] = field(default=())

    def model(self) -> mujoco.MjModel:
        """MuJoCo's own."""
        model = mujoco.MjModel.from_xml_string(self.urdf)
        model.opt.timestep = STEP
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        model.jnt_limited[:] = 0
        model.dof_armature[:] = self.rotors
        model.dof_damping[:] = [f.viscous for f in self.frictions]
        dry = [f.coulomb if f.family == "dry" else 0.0 for f in self.frictions]
        model.dof_frictionloss[:] = dry
        roll, pitch = self.tilt
        # The base is turned about its x axis, then about its y axis; gravity turns the other way.
        down = np.array([math.sin(pitch), -math.sin(roll) * math.cos(pitch), 0.0])
        down[2] = -math.sqrt(1.0 - down @ down)
        model.opt.gravity[:] = 9.81 * down
        return model

    def unseen(
        self, q: Sequence[float], v: Sequence[float], through: Sequence[float]
    ) -> list[float]:
        """Torque in addition to that of the bodies and the known friction, by joint, N·m.

        `through` is the torque that each gear transmitted to its link one step before.
        """
        taken = [0.0] * len(q)
        for name, j, d in self.extra:
            if name == "shared_shaft":
                speed = d["share"] * v[j] + v[j + 1]
                drag = d["size"] * (self.frictions[j + 1].edge(speed) + d["viscous"] * speed)
                taken[j] += d["share"] * drag
                taken[j + 1] += drag
            else:
                taken[j] += d["size"] * self._shape(name, j, d, q[j], v[j], through[j])
        return taken

    def _shape(
        self, name: str, j: int, d: dict[str, float], q: float, v: float, through: float
    ) -> float:
        """The torque for a size of one."""
        sign = self.frictions[j].edge(v)
        match name:
            case "stribeck":
                return sign * math.exp(-(abs(v / d["velocity"]) ** d["exponent"]))
            case "load_dependent_friction":
                return sign * abs(through)
            case "torque_offset":
                return 1.0
            case "torque_ripple":
                return math.sin(d["harmonic"] * q + d["phase"])
            case "counterbalance":
                # A gas cylinder between two points, whose pressure decreases as it opens.
                turned = q - d["angle"]
                length = math.sqrt(1 + d["ratio"] ** 2 - 2 * d["ratio"] * math.cos(turned))
                force = 1.0 - d["gas"] * (length - 1.0)
                return force * math.sin(turned) / length
        raise ValueError(name)


def bare(urdf: str) -> Plant:
    """The arm without rotors and friction."""
    n = mujoco.MjModel.from_xml_string(urdf).nv
    return Plant(urdf, (0.0,) * n, (Friction(0.0, 0.0, "tanh", 1.0),) * n)


@dataclass(frozen=True)
class Law:
    """PD with an integral at 1 kHz on encoders; vectors are `(joints,)`.

    The velocity is the difference of readings after a first-order low-pass, `cutoff` in Hz. `hold`
    is a constant torque, N·m, which holds the arm at its start.
    """

    Kp: np.ndarray
    Ki: np.ndarray
    Kd: np.ndarray
    hold: np.ndarray
    resolution: float
    cutoff: float = 150.0


# Distance from the reference at which a law does not control its arm, rad or m.
_LOST = 0.5


class Unstable(ValueError):
    """A drawn law that does not stabilise its arm."""


@dataclass(frozen=True)
class Run:
    """At 1 kHz, `(ticks, joints)`: encoders, reference, commanded torque, and torque of the hidden
    effects; and the law."""

    time: np.ndarray
    q: np.ndarray
    q_ref: np.ndarray
    tau: np.ndarray
    taken: np.ndarray
    law: Law


def simulate(
    plant: Plant,
    reference: Reference,
    home: np.ndarray,
    bandwidth: np.ndarray,
    resolution: float,
    duration: float,
) -> Run:
    """A run from rest under PD with an integral at 1 kHz; torque is held between its ticks.

    **Raises:** `Unstable` if a joint does not follow its reference.
    """
    model = plant.model()
    data = mujoco.MjData(model)
    data.qpos[:] = home
    mujoco.mj_forward(model, data)
    n = model.nv
    m = inertias(model, data)
    hold = np.array(data.qfrc_bias)
    law = Law(m * bandwidth**2, 0.3 * m * bandwidth**3, 1.4 * m * bandwidth, hold, resolution)
    integral = np.zeros(n)
    before, speed = np.round(home / resolution) * resolution, np.zeros(n)
    smooth = 1.0 - math.exp(-2 * math.pi * law.cutoff * TICK)
    rows: dict[str, list[np.ndarray]] = {"q": [], "q_ref": [], "tau": [], "taken": []}
    taken, through = [0.0] * n, np.array(data.qfrc_bias).tolist()
    ticks = round(duration / TICK)
    for k in range(ticks):
        q = np.round(data.qpos / resolution) * resolution
        asked, ahead = (home + np.array(reference.at((k + i) * TICK)) for i in (0, 1))
        speed = speed + smooth * ((q - before) / TICK - speed)
        integral = integral + (asked - q) * TICK
        tau = hold + law.Kp * (asked - q) + law.Ki * integral
        tau = tau + law.Kd * ((ahead - asked) / TICK - speed)
        before = q
        rows["q"].append(q)
        rows["q_ref"].append(asked)
        rows["tau"].append(tau)
        rows["taken"].append(np.array(taken))
        for _ in range(STEPS):
            at, v = data.qpos.tolist(), data.qvel.tolist()
            taken = plant.unseen(at, v, through)
            drag = [f.coulomb * f.sign(x) for f, x in zip(plant.frictions, v, strict=True)]
            net = tau - drag - taken
            data.qfrc_applied[:] = net
            mujoco.mj_step(model, data)
            if plant.extra:
                rest = data.qfrc_passive - model.dof_armature * data.qacc
                through = (net + rest + data.qfrc_constraint).tolist()
    arrays = {name: np.array(row) for name, row in rows.items()}
    apart = np.abs(arrays["q"] - arrays["q_ref"]).max()
    if not apart < _LOST or not all(np.isfinite(x).all() for x in arrays.values()):
        raise Unstable(f"a joint is {apart:.2g} rad or m away from its reference")
    return Run(np.arange(ticks) * TICK, **arrays, law=law)


def inertias(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Diagonal of the mass matrix at the current pose, `(joints,)`."""
    full = np.zeros((model.nv, model.nv))
    for row, unit in zip(full, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    return np.diag(full).copy()


def limits(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Limits of the joints, rad; half a turn in both directions for an unlimited joint."""
    low, high = model.jnt_range.T
    free = high <= low
    low, high = np.where(free, -np.pi, low), np.where(free, np.pi, high)
    return np.maximum(low, -np.pi), np.minimum(high, np.pi)


def torques(plant: Plant, reference: Reference, home: np.ndarray, duration: float) -> np.ndarray:
    """Torque of rigid bodies and rotors along the reference, `(samples, joints)`."""
    model = plant.model()
    model.dof_damping[:] = 0
    model.dof_frictionloss[:] = 0
    data = mujoco.MjData(model)
    step = 0.01
    times = np.arange(0.0, duration, step)
    q = home + np.array([reference.at(t) for t in times])
    v = np.gradient(q, step, axis=0)
    rows = []
    for at, rate, a in zip(q, v, np.gradient(v, step, axis=0), strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = at, rate, a
        mujoco.mj_inverse(model, data)
        rows.append(np.array(data.qfrc_inverse))
    return np.array(rows)
