"""Arrays of a program that is unrolled: whole, as scalars, or both."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

# Arrays above these sizes are not unrolled: unrolling a spline's dozen knots would only make
# programs long. Arrays with two or more axes belong to a few joints and their derivatives.
WHOLE, WHOLE_MATRIX = 9, 36


class Value:
    """An array as one tracer, as an object array of scalars, or both if both were needed."""

    def __init__(self, shape, dtype, array=None, scalars=None):
        self.shape, self.dtype = tuple(shape), dtype
        self._array: Any = array
        self._scalars: Any = scalars

    @classmethod
    def of(cls, array) -> "Value":
        if not isinstance(array, Tracer):
            array = np.asarray(array)
        return cls(np.shape(array), jnp.result_type(array), array=array)

    def whole(self):
        if self._array is None:
            flat = [jnp.asarray(x, self.dtype) for x in self._scalars.ravel()]
            if self.shape == ():
                self._array = flat[0]
            elif not flat:
                self._array = jnp.zeros(self.shape, self.dtype)
            else:
                self._array = jnp.stack(flat).reshape(self.shape)
        return self._array

    def scalars(self) -> np.ndarray:
        if self._scalars is None:
            self._scalars = np.empty(self.shape, object)
            for at in np.ndindex(self.shape):
                self._scalars[at] = self._array[at]
        return self._scalars

    @classmethod
    def constant(cls, array) -> "Value":
        """Of an array that the function refers to; its numbers are `Fixed` if they are known."""
        value = cls.of(array)
        if isinstance(value._array, np.ndarray) and value.dtype == float and value.small:
            value._scalars = np.empty(value.shape, object)
            for at in np.ndindex(value.shape):
                value._scalars[at] = Fixed(value._array[at])
        return value

    @classmethod
    def like(cls, aval) -> "Value":
        return cls(aval.shape, aval.dtype)

    @property
    def small(self) -> bool:
        return math.prod(self.shape) <= (WHOLE if len(self.shape) < 2 else WHOLE_MATRIX)

    @property
    def written_out(self) -> bool:
        return self.small or self._scalars is not None


class Fixed(np.float64):
    """A number that follows from constant arrays alone, such as the frames of an arm."""
