"""Arrays from the bytes of untrusted `.npy` files."""

import io
import math

import numpy as np


def npy(content: bytes) -> np.ndarray:
    """The array in the bytes of a `.npy`; the size in the header must match the bytes.

    `numpy.load` allocates whatever size the header claims before it reads.

    **Raises:** `ValueError` for another size, or for Python objects.
    """
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    if version not in header:
        raise ValueError(f"version {version} of .npy is not supported")
    shape, fortran, dtype = header[version](stream)
    if dtype.hasobject:
        raise ValueError("it contains Python objects, which are refused")
    size, there = math.prod(shape) * dtype.itemsize, len(content) - stream.tell()
    if any(n < 0 for n in shape) or size != there:
        raise ValueError(f"its header declares {size} bytes of data, but there are {there}")
    values = np.frombuffer(content, dtype, count=math.prod(shape), offset=stream.tell())
    shaped = values.reshape(shape[::-1]).T if fortran else values.reshape(shape)
    return shaped.copy()
