"""Training steps as functions to time."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax

from facejax.training import loop


def scanned(step: loop.Step, count: int) -> loop.Step:
    """So many steps on one batch in one call, as the training loop has them."""

    def several(state, batch, constants):
        return jax.lax.scan(lambda state, _: step(state, batch, constants), state, length=count)

    return several


def onward(step: loop.Step, state: loop.TrainState, batch: Any, constants: Any) -> Callable[[], Any]:
    """A function that goes one call on with every call, and returns the metrics."""
    advance = jax.jit(step, donate_argnums=0)
    state = jax.tree.map(jax.numpy.copy, state)  # what is donated is the copy

    def go() -> dict[str, jax.Array]:
        nonlocal state
        state, metrics = advance(state, batch, constants)
        return metrics

    return go


def products(function: Callable, *args: Any) -> float:
    """Billions of multiplications and additions in a function's matrix products, as JAX writes the function down."""
    return 2e-9 * _multiplications(jax.make_jaxpr(function)(*args).jaxpr)


def _multiplications(jaxpr: Any) -> int:
    """Of one program; a scan's body as often as it runs."""
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
    """The programs among an equation's parameters."""

    def is_program(leaf: Any) -> bool:
        return hasattr(leaf, "eqns") or hasattr(leaf, "jaxpr")

    leaves = jax.tree.leaves(list(params.values()), is_leaf=is_program)
    return [getattr(leaf, "jaxpr", leaf) for leaf in leaves if is_program(leaf)]
