"""Named arrays of an exported function: shapes with symbolic sizes, and the function that takes them."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import export

Arrays = dict[str, Any]
_DIMENSION = re.compile(r"(?:(\d{1,9})\*)?([a-z]{1,40})(?: \+ (\d{1,9}))?")


class Dimension(NamedTuple):
    """A size that is chosen when the function is called: `factor` times a symbol plus `offset`."""

    symbol: str
    factor: int = 1
    offset: int = 0

    def __str__(self) -> str:
        product = self.symbol if self.factor == 1 else f"{self.factor}*{self.symbol}"
        return f"{product} + {self.offset}" if self.offset else product

    @classmethod
    def parse(cls, text: str) -> Dimension:
        """Return the dimension of a text such as "batch", "30*transitions" or "transitions + 1".

        Raises:
          ValueError: another text.
        """
        if not (found := _DIMENSION.fullmatch(text)):
            raise ValueError(f"expected a dimension such as batch or 30*transitions + 1, got {text[:40]!r}")
        factor, symbol, offset = found.groups()
        return cls(symbol, int(factor or 1), int(offset or 0))


class Spec(NamedTuple):
    """Shape and dtype of an array; sizes are numbers or `Dimension`s."""

    shape: tuple[int | Dimension, ...]
    dtype: str = "float32"


@dataclasses.dataclass(frozen=True)
class Function:
    """A pure function `call(params, *inputs)` that returns a tuple of arrays."""

    name: str
    call: Callable[..., tuple[jax.Array, ...]]
    params: Arrays  # arrays by name
    inputs: dict[str, Spec]
    outputs: tuple[str, ...]
    constraints: tuple[str, ...] = ()  # on symbolic dimensions, such as "frames >= 2"

    @property
    def symbols(self) -> tuple[str, ...]:
        """The symbolic dimensions of the inputs, in order."""
        sizes = [size for spec in self.inputs.values() for size in spec.shape if isinstance(size, Dimension)]
        return tuple(dict.fromkeys(size.symbol for size in sizes))

    def arguments(self, sizes: Mapping[str, int] | None = None) -> list[jax.ShapeDtypeStruct]:
        """Return shape and dtype of every input: with given sizes of all symbols, or symbolic ones of `jax.export`."""
        if sizes is None:
            scope = export.SymbolicScope(self.constraints)
            shapes = [
                export.symbolic_shape(",".join(map(str, spec.shape)), scope=scope) for spec in self.inputs.values()
            ]
        else:
            shapes = [
                tuple(n if isinstance(n, int) else n.factor * sizes[n.symbol] + n.offset for n in spec.shape)
                for spec in self.inputs.values()
            ]
        return [
            jax.ShapeDtypeStruct(shape, np.dtype(spec.dtype))
            for shape, spec in zip(shapes, self.inputs.values(), strict=True)
        ]

    def outputs_spec(self, sizes: Mapping[str, int] | None = None) -> dict[str, jax.ShapeDtypeStruct]:
        """Return shape and dtype of every output by name; `sizes` as in `arguments`."""
        found = jax.eval_shape(self.call, self.params, *self.arguments(sizes))
        return dict(zip(self.outputs, found, strict=True))
