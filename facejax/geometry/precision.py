"""The precision of products whose result is geometry.

By default GPUs multiply float32 with ten bits of mantissa (TF32): 0.05 mm on a position of 100 mm. TPUs have seven.
Products of positions, displacements and statistics therefore ask for all bits. Layers of networks do not.
"""

import jax

HIGHEST = jax.lax.Precision.HIGHEST
