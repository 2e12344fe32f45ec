"""Training steps of the GAN and the flow in eager PyTorch: peers of `benchmarks.motion`.

Same weights, tangent PCA, data, losses, optimisers with their schedules, and moving averages, on whole batches.
`check` runs both sides on the same random draws first; a timed step draws for itself, as facejax does. Values that a
critic step needs three times are computed once, and gradients are taken with respect to the trained weights only.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch
import torch.nn.functional as F

from benchmarks._torch import tensor
from facejax.models.motion import flow_matching, tangent_pca
from facejax.training import loop
from facejax.training.recipes.fit_motion import FlowPlan, GanPlan

Tensors = Any


class Peer:
    """Common parts of both trainings: data and tangent PCA as tensors, optimisers, moving average."""

    def __init__(self, state: loop.TrainState, held: Any, plan: GanPlan | FlowPlan):
        (values, conditions), chart = held
        self.data = [tensor(array) for array in (values, *conditions)]
        self.chart, self.plan, self.done = jax.tree.map(tensor, chart), plan, 0
        self.average, self.weights = jax.tree.map(tensor, state.extra), jax.tree.map(tensor, state.params)
        for weight in jax.tree.leaves(self.weights):
            weight.requires_grad_()

    def held(self) -> list[torch.Tensor]:
        """Return all tensors that persist from step to step; gradients do not."""
        moments = [moment for adam in self.adams for state in adam.state.values() for moment in state.values()]
        return [*self.data, *jax.tree.leaves((tuple(self.chart), self.average, self.weights)), *moments]

    def expected(self, start, end, pose):
        """Return `tangent_pca.conditional_mean` of a batch."""
        mean = F.pad(self.chart.mean[start, end], (tangent_pca.SCALARS, 0))
        return mean + torch.bmm(pose[:, None], self.chart.gain[start])[:, 0]

    def follow(self, trained: Tensors) -> None:
        with torch.no_grad():
            torch._foreach_lerp_(jax.tree.leaves(self.average), jax.tree.leaves(trained), 1 - self.plan.decay)
        self.done += 1


class Gan(Peer):
    """Training of `facejax.training.recipes.fit_motion.fit_gan`, without its optional terms."""

    def __init__(self, state: loop.TrainState, held: Any, plan: GanPlan):
        super().__init__(state, held, plan)
        self.generator, self.critic = self.weights
        self.adams = [torch.optim.Adam(jax.tree.leaves(side), betas=(0.5, 0.9), fused=True) for side in self.weights]

    def draws(self, state: loop.TrainState, size: int) -> list[jax.Array]:
        """Return the random draws of facejax's step."""
        count, width = self.plan.critic_steps, len(self.generator["skip"])
        noise, chord, play = jax.random.split(jax.random.fold_in(state.key, state.step), 3)
        chords = [jax.random.uniform(key, (size // count,)) for key in jax.random.split(chord, count)]
        return [_normals(noise, size, width), jnp.stack(chords), _normals(play, size // count, width)]

    def step(self, rows, draws=None) -> dict[str, torch.Tensor]:
        """Run one step, four of the critic and one of the generator; return the same metrics as facejax."""
        plan, width, each = self.plan, len(self.generator["skip"]), len(rows) // self.plan.critic_steps
        if draws is None:
            draws = torch.randn(len(rows), width), torch.rand(plan.critic_steps, each), torch.randn(each, width)
        noise, chords, play = draws
        values, *condition = [array[rows] for array in self.data]
        with torch.no_grad():
            fakes = self._generate(noise, *condition, self.expected(*condition))
        found = []
        rounds = zip(chords, *(array.split(each) for array in (values, fakes, *condition)), strict=True)
        for i, (chord, real, fake, *here) in enumerate(rounds):
            expected, known = self.expected(*here), self._known(*here)
            distance = self._score(real, known, expected).mean() - self._score(fake, known, expected).mean()
            between = torch.lerp(fake, real, 1 - chord[:, None]).requires_grad_()
            (slope,) = torch.autograd.grad(self._score(between, known, expected).sum(), between, create_graph=True)
            penalty = (torch.linalg.vector_norm(slope, dim=1) - 1).square().mean()
            rate = self._rate(self.done * plan.critic_steps + i, plan.critic_steps)
            _descend(self.adams[1], plan.penalty * penalty - distance, rate)
            found.append(torch.stack([distance, penalty]).detach())
        # `here` and the others are of the last batch, which the generator uses.
        fake = self._generate(play, *here, expected)
        loss = -self._score(fake, self._known(*here), expected).mean()
        _descend(self.adams[0], loss, self._rate(self.done, 1))
        self.follow(self.generator)
        distance, penalty = torch.stack(found).mean(0)
        return {"wasserstein": distance, "slope": penalty, "adversarial": loss.detach()}

    def _rate(self, done: int, count: int) -> float:
        return self.plan.rate * (0.95 * _cosine(done, self.plan.steps * count) + 0.05)

    def _generate(self, noise, start, end, pose, expected):
        weights = self.generator
        hidden = torch.cat([noise, *_conditions(weights, start, end, pose)], 1)
        deviation = noise @ weights["skip"] + _linear(weights["head"], _stack(weights, hidden, F.silu))
        unit = F.pad(self.chart.scale[start, end], (tangent_pca.SCALARS, 0), value=1.0)
        return expected + unit * deviation

    def _known(self, start, end, pose):
        """Return the critic's condition of a batch, and the factor of its coordinates."""
        factor = self.chart.scale[start, end].square().mean(1, keepdim=True).rsqrt()
        return torch.cat(_conditions(self.critic, start, end, pose), 1), factor

    def _score(self, values, known, expected):
        told, factor = known
        scalars, offset = (values - expected).tensor_split([tangent_pca.SCALARS], 1)
        hidden = torch.cat([scalars, offset * factor, told], 1)
        activation = partial(F.leaky_relu, negative_slope=0.2)
        return _linear(self.critic["head"], _stack(self.critic, hidden, activation))[:, 0]


class Flow(Peer):
    """Training of `facejax.training.recipes.fit_motion.fit_flow`; states are (B, R + 1), without the axes of size 1."""

    def __init__(self, state: loop.TrainState, held: Any, plan: FlowPlan):
        super().__init__(state, held, plan)
        weights = jax.tree.leaves(self.weights)
        self.adams = [torch.optim.AdamW(weights, weight_decay=plan.weight_decay, fused=True)]

    def draws(self, state: loop.TrainState, size: int) -> list[jax.Array]:
        """Return the random draws of facejax's step."""
        source, time = jax.random.split(jax.random.fold_in(state.key, state.step))
        return [_normals(source, size, self.data[0].shape[1]), jax.random.uniform(time, (size,))]

    def step(self, rows, draws=None) -> dict[str, torch.Tensor]:
        """Run one step; return the same metrics as facejax."""
        if draws is None:
            draws = torch.randn(len(rows), self.data[0].shape[1]), torch.rand(len(rows))
        noise, time = draws
        time = time[:, None]
        values, start, end, pose = [array[rows] for array in self.data]
        with torch.no_grad():
            scale = self.chart.scale[start, end]
            expected = self.expected(start, end, pose)
            source = expected + F.pad(scale, (tangent_pca.SCALARS, 0), value=1.0) * noise
            y0, y1, centre = (self._wrap(x) for x in (source, values, expected))
            rate = (values - source)[:, : tangent_pca.SCALARS]
            way = _log(y0, y1)
            y, s = _exp(y0, time * way), source[:, : tangent_pca.SCALARS] + time * rate
            wanted = _transport(y0, y, way)
            scale /= math.sqrt(len(self.chart.p))
            unit = torch.cat([scale.square().mean(1, keepdim=True).sqrt(), scale], 1)
            size = unit.pow(2 - 2 * self.plan.whitening).mean(1, keepdim=True).sqrt()
        found, found_rate = self._velocity(y, s, time, _conditions(self.weights, start, end, pose), centre, unit)
        off = (found - wanted) / (size * unit.pow(self.plan.whitening))
        loss = torch.cat([off, found_rate - rate], 1).square().mean()
        _descend(self.adams[0], loss, self.plan.rate * _cosine(self.done, self.plan.steps))
        self.follow(self.weights)
        return {"loss": loss.detach()}

    def _wrap(self, values):
        tangent = values[:, tangent_pca.SCALARS :] / math.sqrt(len(self.chart.p))
        pole = torch.zeros(len(values), 1 + tangent.shape[1])
        pole[:, 0] = 1
        return _exp(pole, F.pad(tangent, (1, 0)))

    def _velocity(self, y, s, time, told, centre, unit):
        weights = self.weights
        angle = math.pi * time * torch.arange(flow_matching.FREQUENCIES)
        context = torch.cat([angle.cos(), angle.sin(), *told], 1)
        hidden = torch.cat([torch.tanh((y - centre) / unit / 4) * 4, y * math.sqrt(unit.shape[1]), s, context], 1)
        hidden = F.silu(_linear(weights["stem"], hidden))
        for block, gate in zip(weights["blocks"], weights["gates"], strict=True):
            change = F.silu(_linear(block, hidden)) * (1 + _linear(gate, context))
            hidden = hidden + change / len(weights["blocks"])
        out, rate = _linear(weights["head"], hidden).tensor_split([unit.shape[1]], 1)
        out = unit * out
        return out - _inner(y, out) * y, rate


def check(peer: Peer, advance: Callable, start: loop.TrainState, rows: np.ndarray, held: Any) -> None:
    """Assert that three steps of the peer give the same metrics, weights and moving averages as facejax."""
    state = jax.tree.map(jnp.copy, start)  # the copy is donated
    for step in range(3):
        draws = map(tensor, peer.draws(state, len(rows)))
        state, expected = advance(state, rows, held)
        found = peer.step(tensor(rows), draws)
        assert found.keys() == expected.keys(), (sorted(found), sorted(expected))
        for name, value in expected.items():
            # The weights of the first step are equal. Later they differ by rounding in Adam: means of scores of order
            # 1 may cancel, and those of the third step differed by up to 0.0012 on four datasets.
            apart = 3e-3 if step else 1e-5
            np.testing.assert_allclose(found[name].item(), value, rtol=1e-3, atol=apart, err_msg=name)
    # Adam's first steps have the same size for any gradient: where it is rounding error, the sides differ.
    for ways in ((state.params, start.params, peer.weights), (state.extra, start.extra, peer.average)):
        ours, before, theirs = map(_flat, ways)
        apart, gone = np.linalg.norm(theirs - ours), np.linalg.norm(ours - before)
        assert apart < 0.02 * gone, f"the weights moved by {gone:.3g} and differ by {apart:.3g}"


def _normals(key: jax.Array, count: int, width: int) -> jax.Array:
    return jax.vmap(lambda key: jax.random.normal(key, (width,)))(jax.random.split(key, count))


def _flat(tree: Any) -> np.ndarray:
    return np.concatenate([tensor(leaf).cpu().numpy().ravel() for leaf in jax.tree.leaves(tree)])


def _cosine(done: int, steps: int) -> float:
    return 0.5 * (1 + math.cos(math.pi * min(done, steps) / steps))


def _descend(optimiser: torch.optim.Optimizer, loss: torch.Tensor, rate: float) -> None:
    (group,) = optimiser.param_groups
    for weight, slope in zip(group["params"], torch.autograd.grad(loss, group["params"]), strict=True):
        weight.grad = slope
    group["lr"] = rate
    optimiser.step()
    optimiser.zero_grad()


def _conditions(weights: Tensors, start, end, pose) -> list[torch.Tensor]:
    return [weights["labels"][0, start], weights["labels"][1, end], pose]


def _linear(layer: Tensors, x: torch.Tensor) -> torch.Tensor:
    return torch.addmm(layer["bias"], x, layer["kernel"])


def _stack(weights: Tensors, x: torch.Tensor, activation: Callable) -> torch.Tensor:
    x = activation(_linear(weights["stem"], x))
    for block in weights["blocks"]:
        x = x + activation(_linear(block, x)) / len(weights["blocks"])
    return x


def _inner(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return (a * b).sum(-1, keepdim=True)


def _exp(p: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    angle = _inner(v, v).sqrt()
    return angle.cos() * p + torch.sinc(angle / math.pi) * v


def _log(p: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    cosine = _inner(p, q)
    u = q - cosine * p
    sine = _inner(u, u).sqrt()
    return torch.atan2(sine, cosine) / sine * u


def _transport(p: torch.Tensor, q: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    middle = p + q
    return v - 2 * _inner(middle, v) / _inner(middle, middle) * middle
