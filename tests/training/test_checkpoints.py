"""Checkpoints give back exactly what was saved, keep the newest, and refuse another model's state."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from facejax.training.checkpoints import CheckpointError, Checkpoints


class State(NamedTuple):
    params: dict
    opt_state: optax.OptState
    key: jax.Array
    extra: tuple


def state(seed: int = 0) -> State:
    params = {"w": jax.random.normal(jax.random.key(seed), (3, 4)), "b": [jnp.float32(seed)]}
    return State(params, optax.adam(1e-3).init(params), jax.random.key(seed), ())


def plain(tree):
    return jax.tree.map(lambda a: jax.random.key_data(a) if jnp.issubdtype(a.dtype, jax.dtypes.prng_key) else a, tree)


def test_round_trip_keeps_tree_values_and_keys(tmp_path):
    with Checkpoints(tmp_path) as checkpoints:
        assert checkpoints.latest() is None
        checkpoints.save(3, state(1))
        checkpoints.wait()
        got = checkpoints.restore(state(0))
    assert jax.tree.structure(got) == jax.tree.structure(state())
    jax.tree.map(np.testing.assert_array_equal, plain(got), plain(state(1)))


def test_the_newest_are_kept_and_a_reopened_folder_knows_them(tmp_path):
    with Checkpoints(tmp_path, keep=2) as checkpoints:
        for step in (1, 5, 10, 20):
            checkpoints.save(step, state(step))
        checkpoints.save(20, state(99))
    with Checkpoints(tmp_path, keep=2) as checkpoints:
        assert checkpoints.steps() == [10, 20] and checkpoints.latest() == 20
        assert checkpoints.restore(state(), step=10).params["b"][0] == 10
        assert checkpoints.restore(state()).params["b"][0] == 20


def test_saving_copies_before_the_buffers_are_overwritten(tmp_path):
    overwrite = jax.jit(lambda x: x * 0, donate_argnums=0)
    big = {"w": jnp.arange(2_000_000.0)}
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(0, big)
        overwrite(big["w"]).block_until_ready()
        checkpoints.wait()
        got = checkpoints.restore({"w": jax.ShapeDtypeStruct((2_000_000,), jnp.float32)})
    np.testing.assert_array_equal(got["w"], np.arange(2_000_000.0, dtype=np.float32))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda s: s._replace(params={"w": jnp.zeros((3, 5)), "b": s.params["b"]}),
            r"params/w should be float32\[3, 5\]",
        ),
        (
            lambda s: s._replace(params=s.params | {"w": jnp.zeros((3, 4), jnp.bfloat16)}),
            r"should be bfloat16\[3, 4\]",
        ),
        (lambda s: s._replace(extra=(jnp.zeros(1),)), "extra/0 is missing"),
        (lambda s: s._replace(opt_state=()), "opt_state/0/count is unexpected"),
    ],
)
def test_another_models_state_is_refused(tmp_path, change, message):
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(4, state())
        checkpoints.wait()
        with pytest.raises(CheckpointError, match=f"4 was written by another model: .*{message}"):
            checkpoints.restore(change(state()))


def test_missing_and_damaged_checkpoints_are_named(tmp_path):
    only = {"w": jnp.ones(3)}  # one leaf: the reader abandons its other reads when the first one fails
    with Checkpoints(tmp_path) as checkpoints:
        with pytest.raises(CheckpointError, match=r"no checkpoint of step None; it has \[\]"):
            checkpoints.restore(only)
        checkpoints.save(4, only)
        checkpoints.wait()
        with pytest.raises(CheckpointError, match=r"no checkpoint of step 7; it has \[4\]"):
            checkpoints.restore(only, step=7)
        for file in (tmp_path / "4" / "default").rglob("d/*"):
            file.write_bytes(b"")
        with pytest.raises(CheckpointError, match=r"4 is damaged .* delete it to resume from an older one"):
            checkpoints.restore(only)


def test_a_half_written_checkpoint_is_swept_away(tmp_path):
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, state(1))
    (tmp_path / "2.orbax-checkpoint-tmp").mkdir()
    (tmp_path / "2.orbax-checkpoint-tmp" / "default").mkdir()
    with Checkpoints(tmp_path) as checkpoints:
        assert checkpoints.steps() == [1]
        checkpoints.save(2, state(2))
    assert sorted(p.name for p in tmp_path.iterdir() if p.is_dir()) == ["1", "2"]
