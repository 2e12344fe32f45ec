"""Pickles: arrays and names come back, from any protocol and both Pythons; all else is refused before it runs."""

import collections
import fractions
import pathlib
import pickle
import subprocess

import numpy as np
import pytest

from facejax.io import safe_pickle

DATA = {
    "faces": np.arange(6, dtype=np.int32).reshape(2, 3),
    "weights": np.linspace(0, 1, 6).reshape(2, 3),
    "fortran": np.asfortranarray(np.eye(3, dtype=np.float32)),
    "one": np.float64(0.25),
    "names": ["a", "b"],
    "order": collections.OrderedDict(a=1),
    "bytes": b"\x00\xff",
    5: {"deep": (1, 2.5, None, True)},
}


@pytest.mark.parametrize("protocol", range(6))
def test_what_is_data_comes_back(tmp_path, protocol):
    if protocol == 5:  # out of band or not, arrays are built by a function that is not let through: NumPy's own
        contiguous = {name: value for name, value in DATA.items() if not isinstance(value, np.ndarray)}
    path = tmp_path / "data.pkl"
    path.write_bytes(pickle.dumps(DATA if protocol < 5 else contiguous, protocol=protocol))
    found = safe_pickle.read(path)
    assert set(found) == set(DATA if protocol < 5 else contiguous)
    for name, value in found.items():
        np.testing.assert_array_equal(value, DATA[name])
        assert type(value) is type(DATA[name])


def test_python_2s_strings_are_latin1(tmp_path):
    path = tmp_path / "data.pkl"
    # {'caf\xe9': array([1., 2.])} as Python 2.7 with NumPy 1 wrote it.
    path.write_bytes(
        b"(dp0\nS'caf\\xe9'\np1\ncnumpy.core.multiarray\n_reconstruct\np2\n(cnumpy\nndarray\np3\n(I0\ntp4\nS'b'\np5\n"
        b"tp6\nRp7\n(I1\n(I2\ntp8\ncnumpy\ndtype\np9\n(S'f8'\np10\nI0\nI1\ntp11\nRp12\n(I3\nS'<'\np13\nNNNI-1\nI-1\n"
        b"I0\ntp14\nbI00\nS'\\x00\\x00\\x00\\x00\\x00\\x00\\xf0?\\x00\\x00\\x00\\x00\\x00\\x00\\x00@'\np15\ntp16\nbs."
    )
    found = safe_pickle.read(path)
    assert list(found) == ["café"]
    np.testing.assert_array_equal(found["café"], [1.0, 2.0])


class Runs:
    """What a hostile pickle is: a call."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize(
    ("thing", "name"),
    [
        (lambda p: Runs(subprocess.call, ["touch", str(p)]), "(subprocess|commands).call"),
        (lambda p: Runs(eval, f"open({str(p)!r}, 'w')"), "(builtins|__builtin__).eval"),
        (lambda p: Runs(open, str(p), "w"), "_?io.open"),
        (lambda p: Runs(getattr, p, "touch"), "(builtins|__builtin__).getattr"),
        (lambda p: pathlib.PurePosixPath("a"), "pathlib.*PurePosixPath"),
        (lambda p: fractions.Fraction(1, 2), "fractions.Fraction"),
        (lambda p: np.random.default_rng(0), "numpy.random"),
    ],
)
@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_what_is_no_data_is_refused_before_it_runs(tmp_path, thing, name, protocol):
    path, mark = tmp_path / "data.pkl", tmp_path / "ran"
    path.write_bytes(pickle.dumps({"a": thing(mark)}, protocol=protocol))
    with pytest.raises(safe_pickle.PickleError, match=rf"data.pkl: contains {name}.*, which is not allowed"):
        safe_pickle.read(path)
    assert not mark.exists()


def test_arrays_that_claim_more_than_they_hold(tmp_path):
    path = tmp_path / "data.pkl"
    whole = pickle.dumps(np.arange(3.0), protocol=2)
    # The empty array that all begin as, made large.
    path.write_bytes(whole.replace(b"K\x00\x85", b"J\xff\xff\xff\x7f\x85", 1))
    with pytest.raises(safe_pickle.PickleError, match="begins an array with"):
        safe_pickle.read(path)
    path.write_bytes(whole.replace(b"K\x03\x85", b"J\xff\xff\xff\x7f\x85", 1))
    with pytest.raises(safe_pickle.PickleError, match="damaged: "):
        safe_pickle.read(path)


def test_damaged_files_are_named(tmp_path):
    path = tmp_path / "data.pkl"
    whole = pickle.dumps({"a": np.arange(5)}, protocol=2)
    for content in (b"", b"no pickle", whole[:-5], whole[:30], b"\x80\x02P1\n."):
        path.write_bytes(content)
        with pytest.raises(safe_pickle.PickleError, match=r"data.pkl: "):
            safe_pickle.read(path)
    with pytest.raises(safe_pickle.PickleError, match=r"none.pkl: cannot be read"):
        safe_pickle.read(tmp_path / "none.pkl")
