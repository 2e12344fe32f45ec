"""One call for every generator of motion: the GAN, the GAN as its authors built it, the flow.

Which one it is follows from the type of its parameters, which is known when a function is traced.
"""

from functools import partial

import jax

from facejax.models.motion import flow_matching, motion3dgan, motion3dgan_reference
from facejax.models.motion.tangent_pca import Motion

Generator = motion3dgan.Motion3DGAN | motion3dgan_reference.Motion3DGANReference | flow_matching.FlowMatching
KINDS = {
    "gan": motion3dgan.Motion3DGAN,
    "reference": motion3dgan_reference.Motion3DGANReference,
    "flow": flow_matching.FlowMatching,
}


@partial(jax.jit, static_argnames="steps")
def sample(
    params: Generator, key: jax.Array, start, end, pose: jax.Array, *, steps: int = flow_matching.STEPS
) -> Motion:
    """Draw a motion between two labels that starts at a pose (D,): q (T-1, L, 3), log-length and log-seconds ().

    `start`, `end` are label numbers (0: neutral), which are taken as they come: `pipeline.label_indices` checks names.
    A pose to start from is drawn by `starts.sample`, measured by `charts.pose`, or zero: the mean peak. `steps` of
    integration are the flow's alone. The curve of a motion is `srvf.decode(q, log_length, charts.unpose(chart, pose,
    start))`: displacements from neutral, unitless. On this sphere a point's Frobenius norm is the root of T-1.
    Raises `TypeError` for parameters that are no generator's.
    """
    if isinstance(params, flow_matching.FlowMatching):
        return flow_matching.sample(params, key, start, end, pose, steps=steps)
    return _module(params).sample(params, key, start, end, pose)


def kind(params: Generator) -> str:
    """ "gan", "reference" or "flow". Raises `TypeError` for anything else."""
    for name, of in KINDS.items():
        if isinstance(params, of):
            return name
    raise TypeError(f"expected the parameters of a generator, such as models.motion; got {type(params).__name__}")


def uses_start_pose(params: Generator) -> bool:
    """Whether the motion depends on the pose that it starts from. The authors' does not."""
    return not isinstance(params, motion3dgan_reference.Motion3DGANReference)


def _module(params: Generator):
    return {"gan": motion3dgan, "reference": motion3dgan_reference, "flow": flow_matching}[kind(params)]
