"""Type aliases for array arguments and results. The docstrings of the functions give contents and shapes.

`Floats` is float32 or float64, for functions that work with both. `Singles` and `Doubles` are used where the width is
part of a format or a memory budget.

An array whose dtype is known only at run time, such as a part of a descriptor, is an `Array`."""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[Any]
Floats: TypeAlias = NDArray[np.floating[Any]]
Singles: TypeAlias = NDArray[np.float32]
Doubles: TypeAlias = NDArray[np.float64]
Bools: TypeAlias = NDArray[np.bool_]

# Points and directions on the ground or in a picture: east + i north, or right + i up.
Complexes: TypeAlias = NDArray[np.complexfloating[Any, Any]]

# Integers that identify something: rows ("slots") of an index, ids of places, regions of a picture.
Ints: TypeAlias = NDArray[np.integer[Any]]

# Packed bits, and raw bytes read from a file.
Bytes: TypeAlias = NDArray[np.uint8]

# uint8, (H, W) grey or (H, W, 3) blue, green, red.
Image: TypeAlias = NDArray[np.uint8]

# bool, (H, W): False where a picture does not show the ground, for example under an on-screen display.
Mask: TypeAlias = NDArray[np.bool_]

# Degrees on WGS 84, one or many.
Degrees: TypeAlias = float | Floats

# A point (lat_deg, lon_deg) in degrees on WGS 84, without altitude.
LatLon: TypeAlias = tuple[float, float]

# A covariance on the ground or in a picture: variance along the first axis, covariance, variance along the second.
Covariance: TypeAlias = tuple[float, float, float]
