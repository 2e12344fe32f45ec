"""Generators of motion behind one interface: Motion3DGAN, its authors' architecture, and flow matching.

The generator is selected by the type of its parameters, which is static when a function is traced.
"""

from __future__ import annotations

from functools import partial

import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from facejax.models.motion import flow_matching, motion3dgan, motion3dgan_reference
from facejax.models.motion.tangent_pca import Motion

Generator = motion3dgan.Motion3DGAN | motion3dgan_reference.Motion3DGANReference | flow_matching.FlowMatching
KINDS = {
    "gan": motion3dgan.Motion3DGAN,
    "reference": motion3dgan_reference.Motion3DGANReference,
    "flow": flow_matching.FlowMatching,
}


def noise_size(params: Generator) -> int:
    """Return the number n of standard normal numbers that one motion is generated from."""
    return _module(params).noise_size(params)


@partial(jax.jit, static_argnames="steps")
def sample(
    params: Generator,
    key: Array,
    start: ArrayLike,
    end: ArrayLike,
    pose: Float[Array | np.ndarray, " D"],
    *,
    steps: int = flow_matching.STEPS,
) -> Motion:
    """Draw a motion between two labels that starts at a pose: q (T-1, L, 3), log-length and log-seconds ().

    The curve of a motion is `srvf.decode(q, log_length, tangent_pca.decode_pose(chart, pose, start))`: unitless
    displacements from neutral. The Frobenius norm of q is the square root of T-1.

    Args:
      start, end: label indices (0: neutral), not checked; `models.labels.encode` looks up names.
      pose: from `start_poses.sample` or `tangent_pca.encode_pose`, or zero for the mean peak.
      steps: of integration, for flow matching only.

    Raises:
      TypeError: parameters that are not those of a generator.
    """
    noise = jax.random.normal(key, (noise_size(params),), params.chart.mean.dtype)
    return generate(params, noise, start, end, pose, steps=steps)


@partial(jax.jit, static_argnames="steps")
def generate(
    params: Generator,
    noise: Float[Array | np.ndarray, " n"],
    start: ArrayLike,
    end: ArrayLike,
    pose: Float[Array | np.ndarray, " D"],
    *,
    steps: int = flow_matching.STEPS,
) -> Motion:
    """Return the motion that belongs to standard normal noise (n,); otherwise as `sample`, and differentiable in it."""
    if isinstance(params, flow_matching.FlowMatching):
        return flow_matching.generate(params, noise, start, end, pose, steps=steps)
    return _module(params).generate(params, noise, start, end, pose)


def kind(params: object) -> str:
    """Return "gan", "reference" or "flow".

    Raises:
      TypeError: parameters that are not those of a generator.
    """
    for name, record in KINDS.items():
        if isinstance(params, record):
            return name
    raise TypeError(f"expected the parameters of a generator, such as models.motion; got {type(params).__name__}")


def uses_start_pose(params: Generator) -> bool:
    """Return whether the motion depends on the start pose; that of `motion3dgan_reference` does not."""
    return not isinstance(params, motion3dgan_reference.Motion3DGANReference)


def _module(params: Generator):
    return {"gan": motion3dgan, "reference": motion3dgan_reference, "flow": flow_matching}[kind(params)]
