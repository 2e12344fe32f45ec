"""Spirals as sparse maps: the vertices that each spiral position reads, and the transposed tables.

A spiral convolution on an upsampled signal is, per spiral position s, a sparse V x M matrix: row v holds
the barycentric weights of the coarse vertices under the s-th vertex of v's spiral. Its product with dense
rows is a sum of K gathers. The gradient needs the transpose, which would be a scatter. XLA's scatter on a
CPU takes ten times longer per row than its gather, so a second table lists for every coarse vertex the rows that
read it: as many slots as 90 % of the vertices need, and a short remainder that is scattered.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float32, Int32, Integer, Real

if TYPE_CHECKING:
    from facejax.geometry.sphere import AnyArray


class Stencil(NamedTuple):
    """S sparse maps from M to V vertices. Unused slots have index 0 and weight 0.

    The map: out[v] = sum_k weight[s, k, v] x[source[s, k, v]].

    Transposed: out[m] = sum_j back_weight[s, j, m] g[back[s, j, m]], and rest_weight[s, r] g[rest_from[s,
    r]] for every r with rest_to[s, r] = m.
    """

    source: Int32[AnyArray, "S K V"]  # below M
    weight: Float32[AnyArray, "S K V"]
    back: Int32[AnyArray, "S J M"]  # below V
    back_weight: Float32[AnyArray, "S J M"]
    rest_from: Int32[AnyArray, "S R"]  # below V
    rest_to: Int32[AnyArray, "S R"]  # below M
    rest_weight: Float32[AnyArray, "S R"]


def build(
    spirals: Integer[np.ndarray, "V S"],
    corners: Integer[np.ndarray, "W K"],
    weights: Real[np.ndarray, "W K"],
    coarse: int,
) -> Stencil:
    """Return the maps of spirals (V, S) on a signal of W vertices, upsampled from `coarse` ones.

    Corners and weights (W, K) are the upsampling. Usually V = W: the spirals of all vertices. W marks the dummy vertex,
    which reads zero.
    """
    length = spirals.shape[1]
    real = spirals < len(corners)  # corners has all vertices, spirals may be those of a subset
    spirals = np.where(real, spirals, 0)
    source = np.transpose(corners[spirals], (1, 2, 0))
    weight = np.transpose(weights[spirals] * real[..., None], (1, 2, 0)).astype(np.float32)
    source = np.where(weight > 0, source, 0).astype(np.int32)

    position, _, reader = np.nonzero(weight)
    target, value = source[weight > 0], weight[weight > 0]
    # Entries of one (position, target) are adjacent, each with its index in that list.
    bucket = position * coarse + target
    order = np.argsort(bucket, kind="stable")
    bucket, reader, value = bucket[order], reader[order], value[order]
    sizes = np.bincount(bucket, minlength=length * coarse)
    place = np.arange(len(bucket)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    position, target = np.divmod(bucket, coarse)

    slots = max(1, int(np.quantile(sizes, 0.9)))
    back = np.zeros((length, slots, coarse), np.int32)
    back_weight = np.zeros((length, slots, coarse), np.float32)
    fits = place < slots
    back[position[fits], place[fits], target[fits]] = reader[fits]
    back_weight[position[fits], place[fits], target[fits]] = value[fits]

    left = ~fits
    position, target, reader, value = position[left], target[left], reader[left], value[left]
    sizes = np.bincount(position, minlength=length)
    place = np.arange(len(position)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    rest_from, rest_to = np.zeros((2, length, sizes.max()), np.int32)
    rest_weight = np.zeros((length, sizes.max()), np.float32)
    rest_from[position, place], rest_to[position, place], rest_weight[position, place] = reader, target, value
    return Stencil(source, weight, back, back_weight, rest_from, rest_to, rest_weight)


def flat(spirals: Integer[np.ndarray, "V S"]) -> Stencil:
    """Return the maps of spirals (V, S) on a signal of the same V vertices, without upsampling."""
    own = np.arange(len(spirals))[:, None]
    return build(spirals, own, np.ones_like(own, np.float32), len(spirals))


def without_transpose(stencil: Stencil) -> Stencil:
    """Return a stencil without the tables of the transpose, half of its memory: for inference, not for gradients."""
    back, weight = (table[:, :0] for table in (stencil.back, stencil.back_weight))
    rest = (table[:, :0] for table in (stencil.rest_from, stencil.rest_to, stencil.rest_weight))
    return Stencil(stencil.source, stencil.weight, back, weight, *rest)
