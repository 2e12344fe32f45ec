"""Training steps as functions to time, and counts of their operations."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax

from facejax.training import loop


def scanned(step: loop.Step, count: int) -> loop.Step:
    """Return a step that runs `count` steps on one batch by a scan, as the training loop does."""

    def several(state, batch, constants):
        return jax.lax.scan(lambda state, _: step(state, batch, constants), state, length=count)

    return several


def onward(step: loop.Step, state: loop.TrainState, batch: Any, constants: Any) -> Callable[[], Any]:
    """Return a function that advances the training state by one call of the step and returns the metrics."""
    advance = jax.jit(step, donate_argnums=0)
    state = jax.tree.map(jax.numpy.copy, state)  # the copy is donated

    def go() -> dict[str, jax.Array]:
        nonlocal state
        state, metrics = advance(state, batch, constants)
        return metrics

    return go


def products(function: Callable, *args: Any) -> float:
    """Return the billions of multiplications and additions of the matrix products in a function's jaxpr."""
    return 2e-9 * _multiplications(jax.make_jaxpr(function)(*args).jaxpr)


def _multiplications(jaxpr: Any) -> int:
    """Count the multiplications in a jaxpr; the body of a scan counts once per iteration."""
    total = 0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (left, _), _ = equation.params["dimension_numbers"]
            summed = [equation.invars[0].aval.shape[axis] for axis in left]
            total += math.prod(equation.outvars[0].aval.shape) * math.prod(summed)
        inner = sum(map(_multiplications, _within(equation.params)))
        total += inner * equation.params.get("length", 1) if equation.primitive.name == "scan" else inner
    return total


def _within(params: dict[str, Any]) -> list[Any]:
    """Return the jaxprs among an equation's parameters."""

    def is_program(leaf: Any) -> bool:
        return hasattr(leaf, "eqns") or hasattr(leaf, "jaxpr")

    leaves = jax.tree.leaves(list(params.values()), is_leaf=is_program)
    return [getattr(leaf, "jaxpr", leaf) for leaf in leaves if is_program(leaf)]
