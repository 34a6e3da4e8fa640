"""Names for array arguments shared by every signature."""

import jax
import numpy as np
from jaxtyping import Array as Array
from jaxtyping import Bool as Bool
from jaxtyping import Float as Float
from jaxtyping import Int as Int
from jaxtyping import PRNGKeyArray as PRNGKeyArray
from jaxtyping import UInt8 as UInt8

# What a public entry accepts: device arrays, tracers and host arrays alike. It returns `Array`.
ArrayLike = jax.Array | np.ndarray
