"""A small dataset in memory, for fast training: deformed spheres of 162 vertices."""

import numpy as np
import trimesh

from facejax.data import dataset
from facejax.mesh import deformation_transfer


def make_ball_dataset():
    """Return a dataset of six subjects with four expressions of 9 frames each, and five landmarks.

    Subjects 0, 2, 4 and 5 are in the training split, 3 in validation, 1 in test. Expressions are bumps transferred
    between the spheres; far from the landmarks they also contain a term quadratic in the intensity, which no linear map
    can represent.
    """
    rng = np.random.default_rng(0)
    ball = trimesh.creation.icosphere(subdivisions=2)
    vertices, faces = 50.0 * np.asarray(ball.vertices), np.asarray(ball.faces, np.int32)
    splits, labels, frames = ("train", "test", "train", "validation", "train", "train"), ("a", "b", "c", "d"), 9
    marks = np.array([0, 20, 61, 99, 140], np.int32)

    def bump(centre, width):
        return np.exp(-np.sum((vertices - vertices[centre]) ** 2, axis=1) / (2 * width**2))

    # Each expression combines bumps around landmarks with one at the vertex farthest from all of them.
    bumps = np.stack([bump(mark, 20.0)[:, None] * rng.normal(size=3) for mark in marks])
    mixed = np.einsum("em,mnx->enx", rng.normal(size=(len(labels), len(marks))), 3 * bumps)
    far = np.argmax(np.linalg.norm(vertices[:, None] - vertices[marks], axis=-1).min(axis=1))
    curved = bump(far, 22.0)[:, None] * 16 * rng.normal(size=(len(labels), 1, 3))
    neutral, moved, sequences, start = [], [], [], 0
    strength = np.sin(np.linspace(0, np.pi, frames))[:, None, None]
    for subject in range(len(splits)):
        stretch = np.eye(3) + 0.15 * rng.normal(size=(3, 3))
        neutral.append(vertices @ stretch.T + 3 * bump(int(rng.integers(162)), 30.0)[:, None] * rng.normal(size=3))
        carrier = deformation_transfer.DeformationTransfer(
            vertices, neutral[-1], faces, deformation_transfer.anchor_weights(np.full(len(vertices), 2.0))
        )
        for label, first, second in zip(labels, mixed, curved, strict=True):
            own = rng.uniform(0.5, 1.5) * strength
            moved.append(neutral[-1] + carrier(own * first + own**2 * second))
            sequences.append(dataset.Sequence(subject, label, start, frames, 0, 4, 5, 8, 1.0))
            start += frames
    neutral, moved = np.asarray(neutral, np.float32), np.concatenate(moved).astype(np.float32)
    drawn = np.sort(rng.permutation(start)[: 2 * start // 3])
    index = {"spec": {"name": "balls"}, "labels": labels, "subjects": [{"split": split} for split in splits]}
    return dataset.Dataset(None, index, tuple(sequences), faces, neutral, moved[:, marks], moved[drawn], drawn, marks)
