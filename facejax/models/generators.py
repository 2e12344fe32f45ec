"""One call for every generator of motion: the GAN, the GAN as its authors built it, the flow.

Which one it is follows from the type of its parameters, which is known when a function is traced.
"""

from functools import partial

import jax

from facejax.models import flow, motion, motion_reference
from facejax.models.charts import Motion

Params = motion.Params | motion_reference.Params | flow.Params
KINDS = {"gan": motion.Params, "reference": motion_reference.Params, "flow": flow.Params}


@partial(jax.jit, static_argnames="steps")
def sample(params: Params, key: jax.Array, start, end, pose: jax.Array, *, steps: int = flow.STEPS) -> Motion:
    """Draw a motion between two labels that starts at a pose (D,). `steps` of integration are the flow's alone."""
    if isinstance(params, flow.Params):
        return flow.sample(params, key, start, end, pose, steps=steps)
    return _module(params).sample(params, key, start, end, pose)


def kind(params: Params) -> str:
    """ "gan", "reference" or "flow"."""
    return next(name for name, of in KINDS.items() if isinstance(params, of))


def heeds_pose(params: Params) -> bool:
    """Whether the motion depends on the pose that it starts from. The authors' does not."""
    return not isinstance(params, motion_reference.Params)


def _module(params: Params):
    return motion if isinstance(params, motion.Params) else motion_reference
