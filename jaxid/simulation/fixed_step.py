"""What jaxid's own methods with fixed steps have in common."""

from typing import ClassVar

import diffrax


class AbstractFixedStep(diffrax.AbstractSolver):
    """A method that keeps nothing between steps, and has neither error estimate nor dense output.

    diffrax's own methods compute both. Even if unused, these cost more than the physics of four
    states.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def init(self, terms, t0, t1, y0, args) -> None:
        """No solver state is kept between steps."""
        return None

    def func(self, terms, t0, y0, args):
        """The vector field."""
        return terms.vf(t0, y0, args)
