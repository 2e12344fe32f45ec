"""OT23's classifier of transitions (4.3): which pair of labels does a motion show?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from sklearn.ensemble import RandomForestClassifier

from experiments import _motion_eval
from facejax.data import motions, transitions


def forest(
    config: _motion_eval.People, names: Sequence[_motion_eval.Names], trees: int = 300
) -> RandomForestClassifier:
    """OT23's classifier: 30 x 3 L displacements from neutral, unitless, of training people's transitions -> which pair.

    Its training set is the one of OT23: halves, and transitions selected by prototypes.
    """
    data = _motion_eval.data_of(config)
    pairs = [(data.labels.index(a), data.labels.index(b)) for a, b in names]
    train, which = labelled(transitions.transitions(data, "train"), pairs)
    found = RandomForestClassifier(trees, random_state=config.seed, n_jobs=-1)
    return found.fit(train.curves.reshape(len(which), -1), which)


def labelled(found: motions.Motions, pairs: Sequence[_motion_eval.Pair]) -> tuple[motions.Motions, np.ndarray]:
    """The motions of the given pairs, and which pair each is."""
    number = {pair: i for i, pair in enumerate(pairs)}
    which = np.array([number.get(pair, -1) for pair in zip(found.start.tolist(), found.end.tolist(), strict=True)])
    return found.take(which >= 0), which[which >= 0]


def recognised(classifier: RandomForestClassifier, curves: Sequence[np.ndarray], scale: float) -> list[float]:
    """The share of each pair's curves (in mm) that are named rightly."""
    shares = []
    for i, found in enumerate(curves):
        shares.append(float(np.mean(classifier.predict(found.reshape(len(found), -1) / scale) == i)))
    return shares
