"""An expression network in eager PyTorch: the peer of `benchmarks.lstm`.

torch.compile 2.13 does not compile `nn.LSTM` (a graph break leaves it eager, and only the loss would be compiled), and
with its experimental `allow_rnn` the compiled program fails.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from benchmarks._torch import device, tensor
from facejax.models import lstm

RATE = 1e-3  # learning rate of Adam
Tensors = Any


class Peer:
    """The same network, loss and optimiser, from the same weights; a batch is (x, target, mask), time first.

    `nn.LSTM` has two biases and adds them. The second stays zero: training both would double the bias's learning rate.
    """

    def __init__(self, weights: lstm.Weights):
        rows, dense = weights["layers"], weights["dense"]
        size, hidden = dense["kernel"].shape[1], dense["kernel"].shape[0]
        self.lstm = torch.nn.LSTM(size, hidden, len(rows)).to(device())
        self.dense = torch.nn.Linear(hidden, size).to(device())
        places = [getattr(self.lstm, name) for i in range(len(rows)) for name in _names(i)]
        places += [self.dense.weight, self.dense.bias]
        values = [row[name] for row in rows for name in ("input", "hidden", "bias")] + [dense["kernel"], dense["bias"]]
        with torch.no_grad():
            for place, value in zip(places, values, strict=True):
                place.copy_(tensor(np.asarray(value).T))  # same order of gates: i, f, g, o
            for i in range(len(rows)):
                getattr(self.lstm, f"bias_hh_l{i}").zero_().requires_grad_(False)
        self.trained = places
        self.optimiser = torch.optim.Adam(places, lr=RATE, fused=True)

    def forward(self, batch: Tensors) -> Callable[[], Tensors]:
        def call() -> Tensors:
            with torch.no_grad():
                return self.dense(self.lstm(batch[0])[0])

        return call

    def gradient(self, batch: Tensors) -> Callable[[], Tensors]:
        return lambda: torch.autograd.grad(self._loss(batch), self.trained)

    def step(self, batch: Tensors) -> Callable[[], Tensors]:
        """Return a training step; it returns the loss before the step."""

        def call() -> Tensors:
            self.optimiser.zero_grad()
            loss = self._loss(batch)
            loss.backward()
            self.optimiser.step()
            return loss.detach()

        return call

    def _loss(self, batch: Tensors) -> Tensors:
        x, target, mask = batch
        error = torch.square(self.dense(self.lstm(x)[0]) - target).mean(-1)
        return (error * mask).sum() / mask.sum()


def as_weights(found: Tensors) -> lstm.Weights:
    """Return tensors in the order of `trained` as a pytree like facejax's weights."""
    *rows, kernel, bias = [array.cpu().numpy().T for array in found]
    layers = [dict(zip(("input", "hidden", "bias"), rows[i : i + 3], strict=True)) for i in range(0, len(rows), 3)]
    return {"layers": layers, "dense": {"kernel": kernel, "bias": bias}}


def _names(layer: int) -> tuple[str, str, str]:
    return f"weight_ih_l{layer}", f"weight_hh_l{layer}", f"bias_ih_l{layer}"
