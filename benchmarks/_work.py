"""Training steps as functions to time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax

from facejax import training


def scanned(step: training.Step, count: int) -> training.Step:
    """So many steps on one batch in one call, as the training loop has them."""

    def several(state, batch, constants):
        return jax.lax.scan(lambda state, _: step(state, batch, constants), state, length=count)

    return several


def onward(step: training.Step, state: training.TrainState, batch: Any, constants: Any) -> Callable[[], Any]:
    """A function that goes one call on with every call, and returns the metrics."""
    advance = jax.jit(step, donate_argnums=0)
    state = jax.tree.map(jax.numpy.copy, state)  # what is donated is the copy

    def go() -> dict[str, jax.Array]:
        nonlocal state
        state, metrics = advance(state, batch, constants)
        return metrics

    return go
