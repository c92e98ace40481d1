"""Ready robots: arm, friction, controller and start values of the papers."""

from .arms import SCARA, Axis, TwoLink
from .control import PD, AbstractController, Cascade
from .effects import Coulomb, TorqueOffset, Viscous
from .simulation.loop import ClosedLoop


def _friction(joints: int, gamma: float = 100.0) -> tuple[Viscous | Coulomb, ...]:
    pairs = [(Viscous(joint=j), Coulomb(joint=j, gamma=gamma)) for j in range(1, joints + 1)]
    return tuple(effect for pair in pairs for effect in pair)


def scara(controller: AbstractController | None = None) -> ClosedLoop:
    """The SCARA of Brunot et al. 2016 at its CAD start, under the PD law of their Table 1.

    **Arguments:**

    - `controller`: another law, for instance `Tracking()`.
    """
    law = PD(Kp=[6.25, 156.25], Kv=[2.0, 25.0], Kg=[3.5, 0.06])
    return ClosedLoop(SCARA(), controller or law, _friction(2), name="scara")


def two_link(
    controller: AbstractController | None = None, link_length: float | None = None
) -> ClosedLoop:
    """A two-link arm under gravity with the nine parameters of Li, Peng and Juang 2023.

    **Arguments:**

    - `controller`: its law; a plain PD by default. `OpenLoop()` and `Tracking()` need none.
    - `link_length`: of the first link, m; gives p3 = link_length · p5.
    """
    law = controller or PD(Kp=[100.0, 100.0], Kv=[20.0, 20.0])
    arm = TwoLink(link_length=link_length)
    return ClosedLoop(arm, law, _friction(2), name="two-link")


def emps(controller: AbstractController | None = None) -> ClosedLoop:
    """The EMPS axis of Janot, Gautier and Brunot 2019 with its cascade, and a force offset.

    **Arguments:**

    - `controller`: another law, for instance `Cascade(delay=True)`.
    """
    friction = Viscous(joint=1, coefficient=100.0), Coulomb(joint=1, level=10.0, gamma=2e4)
    effects = (*friction, TorqueOffset(joint=1))
    # At these speeds the sign's sharpness shows in the force, and nobody knows it: fits find it.
    law = controller or Cascade()
    return ClosedLoop(Axis(), law, effects, name="emps").free("gamma1")
