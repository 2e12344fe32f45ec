"""Random forest that classifies transitions by their pair of labels (OT23, section 4.3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from sklearn.ensemble import RandomForestClassifier

from experiments import _motion_eval
from facejax.data import motions, transitions


def train_forest(
    config: _motion_eval.DataOptions, names: Sequence[_motion_eval.NamePair], trees: int = 300
) -> RandomForestClassifier:
    """Train the classifier of OT23 on the training subjects' motions; it predicts the index of the pair in `names`.

    Inputs are T x 3 L unitless displacements from neutral. As in OT23, the training set consists of motions from and to
    neutral and of peak-to-peak transitions selected by prototypes.
    """
    data = _motion_eval.load_dataset(config)
    pairs = [(data.labels.index(a), data.labels.index(b)) for a, b in names]
    train, which = select_pairs(transitions.transitions(data, "train"), pairs)
    found = RandomForestClassifier(trees, random_state=config.seed, n_jobs=-1)
    return found.fit(train.curves.reshape(len(which), -1), which)


def select_pairs(found: motions.Motions, pairs: Sequence[_motion_eval.LabelPair]) -> tuple[motions.Motions, np.ndarray]:
    """Return the motions that belong to one of the pairs, and the index (K,) of each motion's pair."""
    number = {pair: i for i, pair in enumerate(pairs)}
    which = np.array([number.get(pair, -1) for pair in zip(found.start.tolist(), found.end.tolist(), strict=True)])
    return found.take(which >= 0), which[which >= 0]


def accuracy_per_pair(classifier: RandomForestClassifier, curves: Sequence[np.ndarray], scale: float) -> list[float]:
    """Return the share of each pair's curves (K, T, L, 3) in mm that are classified correctly."""
    shares = []
    for i, found in enumerate(curves):
        shares.append(float(np.mean(classifier.predict(found.reshape(len(found), -1) / scale) == i)))
    return shares
