"""S2D-Dec in PyTorch from the same weights, in three implementations: peers of `benchmarks.decoder`.

* `rows`: as in published code: upsample every sample (B, V, C) by its three corners, gather whole spirals
  (B, V, S * C), multiply.
* `sparse`: batch axis inside, as in facejax, upsampled by a sparse product.
* `sums`: facejax's algorithm: multiply first, then one weighted sum of gathered rows by `embedding_bag`. No published
  code does so; it separates the effect of the algorithm from that of the library.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import torch
import torch.nn.functional as F

from benchmarks._torch import device, tensor
from facejax.mesh.hierarchy import Hierarchy
from facejax.models.decoders import s2d_dec

WAYS = ("rows", "sparse", "sums")
Tensors = Any


class Peer:
    """Weights, tables and optimiser. Displacements are not standardised: the parameters' scale is one."""

    def __init__(self, params: s2d_dec.S2DDec, hierarchy: Hierarchy, *, rate: float, weight_decay: float):
        self.weights = jax.tree.map(tensor, params.weights)
        self.trained = jax.tree.leaves(self.weights)
        for weight in self.trained:
            weight.requires_grad_()
        self.optimiser = torch.optim.AdamW(self.trained, lr=rate, weight_decay=weight_decay, fused=True)
        levels = list(range(len(hierarchy.corners)))[::-1]
        self.coarse = hierarchy.sizes[-1]
        self.spirals = [tensor(hierarchy.spirals[level]) for level in levels + [0]]
        self.lifts = [(tensor(hierarchy.corners[i]), tensor(hierarchy.weights[i])) for i in levels]
        self.sparse_lifts = [_sparse(hierarchy, i) for i in levels]
        self.bags = [_bag(stencil) for stencil in (*hierarchy.climbs[::-1], hierarchy.surface)]

    def forward(self, way: str) -> Callable[[Tensors], Tensors]:
        """Return a function from landmarks (B, L, 3) to vertices (B, N, 3)."""
        return {"rows": self._rows, "sparse": self._sparse, "sums": self._sums}[way]

    def inference(self, forward: Callable, marks: Tensors) -> Callable[[], Tensors]:
        def call() -> Tensors:
            with torch.no_grad():
                return forward(marks)

        return call

    def slopes(self, forward: Callable, marks: Tensors, target: Tensors) -> Callable[[], list[Tensors]]:
        """Return a function that computes the gradient of the mean absolute error."""
        return lambda: list(torch.autograd.grad((forward(marks) - target).abs().mean(), self.trained))

    def step(self, forward: Callable, marks: Tensors, target: Tensors, weights: Tensors) -> Callable[[], Tensors]:
        """Return a training step on `losses.s2d`, reduced as in the paper; it returns the loss before the step."""

        def call() -> Tensors:
            self.optimiser.zero_grad()
            off = forward(marks) - target
            distance = off.abs().sum(-1)
            loss = (distance.mean(-1) + 0.1 * (weights * distance).mean(-1)).mean()
            loss.backward()
            self.optimiser.step()
            return loss.detach()

        return call

    def _dense(self, marks: Tensors) -> Tensors:
        dense = self.weights["dense"]
        return torch.addmm(dense["bias"], marks.flatten(1), dense["kernel"]).view(len(marks), self.coarse, -1)

    def _rows(self, marks: Tensors) -> Tensors:
        x = self._dense(marks)
        *climbs, last = self.weights["convs"]
        for conv, (corners, weights), spirals in zip(climbs, self.lifts, self.spirals, strict=False):
            x = (x[:, corners] * weights[:, :, None]).sum(2)
            x = F.elu(_rows_conv(x, spirals, conv))
        return _rows_conv(x, self.spirals[-1], last)

    def _sparse(self, marks: Tensors) -> Tensors:
        x = self._dense(marks).transpose(0, 1)
        *climbs, last = self.weights["convs"]
        for conv, lift, spirals in zip(climbs, self.sparse_lifts, self.spirals, strict=False):
            x = torch.mm(lift, x.flatten(1)).view(lift.shape[0], len(marks), -1)
            x = F.elu(_inside_conv(x, spirals, conv))
        return _inside_conv(x, self.spirals[-1], last).transpose(0, 1)

    def _sums(self, marks: Tensors) -> Tensors:
        x = self._dense(marks).transpose(0, 1)
        *climbs, last = zip(self.weights["convs"], self.bags, strict=True)
        for conv, bag in climbs:
            x = F.elu(_bag_conv(x, bag, conv))
        return _bag_conv(x, last[1], last[0]).transpose(0, 1)


def _rows_conv(x: Tensors, spirals: Tensors, conv: dict[str, Tensors]) -> Tensors:
    x = F.pad(x, (0, 0, 0, 1))  # the dummy vertex
    kernel = conv["kernel"]
    gathered = x.index_select(1, spirals.flatten()).view(len(x), len(spirals), -1)
    return F.linear(gathered, kernel.flatten(0, 1).T, conv["bias"])


def _inside_conv(x: Tensors, spirals: Tensors, conv: dict[str, Tensors]) -> Tensors:
    x = F.pad(x, (0, 0, 0, 0, 0, 1))
    kernel, (count, length), batch = conv["kernel"], spirals.shape, x.shape[1]
    gathered = x.index_select(0, spirals.flatten()).view(count, length, batch, -1).transpose(1, 2)
    return torch.addmm(conv["bias"], gathered.reshape(count * batch, -1), kernel.flatten(0, 1)).view(count, batch, -1)


def _bag_conv(x: Tensors, bag: tuple[Tensors, Tensors], conv: dict[str, Tensors]) -> Tensors:
    kernel, (count, batch, channels), (index, weight) = conv["kernel"], x.shape, bag
    products = torch.matmul(x.reshape(count * batch, channels), kernel).view(len(kernel) * count, -1)
    summed = F.embedding_bag(index, products, per_sample_weights=weight, mode="sum")
    return summed.view(len(index), batch, -1) + conv["bias"]


def _bag(stencil) -> tuple[Tensors, Tensors]:
    """Return the indices into the products (S * M, .) of each vertex, and their weights: (V, S * K)."""
    positions, _, vertices = stencil.source.shape
    index = stencil.source + stencil.back.shape[2] * np.arange(positions)[:, None, None]
    # On a GPU embedding_bag needs contiguous bags.
    return tuple(tensor(np.ascontiguousarray(x.reshape(-1, vertices).T)) for x in (index, stencil.weight))


def _sparse(hierarchy: Hierarchy, level: int) -> Tensors:
    """Return the upsampling from level + 1 as a sparse matrix."""
    corners, weights = hierarchy.corners[level], hierarchy.weights[level]
    starts = torch.arange(0, corners.size + 1, corners.shape[1])
    size = (len(corners), hierarchy.sizes[level + 1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns that sparse CSR tensors are in beta
        matrix = torch.sparse_csr_tensor(starts, tensor(corners).cpu().flatten(), tensor(weights).cpu().flatten(), size)
    return matrix.to(device())
