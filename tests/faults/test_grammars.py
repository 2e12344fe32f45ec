"""Files that are well formed, and mean nothing: headers that go together and tables that do not, by hypothesis.

Random changes of bytes seldom get past the first check of a format; these do.
"""

import json
import pickle
import tempfile
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tests.faults import fuzz
from tests.faults._record import FILES, outcome

EXAMPLES = FILES // 10 or 40
KNOWN = fuzz.readers()
WHOLE = st.sampled_from([0, 1, 2, 3, 5, -1, 255, 2**31 - 1, 2**31, 2**32, 2**63, 10**30]) | st.integers(-10, 10)
REAL = st.floats(width=32) | st.sampled_from([1e308, -1e-308, 1e39]) | st.integers(-99, 99)
WORDS = st.sampled_from(["vertex", "face", "edge", "x", "y", "z", "vertex_indices", "vertex_index", "red", "s", "n"])
TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"}
TYPES |= {"double": "f8", "float32": "f4", "int32": "i4", "uint8": "u1"}
NAMES = st.sampled_from(list(TYPES))
SCALARS = st.none() | st.booleans() | WHOLE | REAL | st.text(max_size=6) | st.sampled_from(["../x", "neutral", "/etc"])
TREES = st.recursive(
    SCALARS, lambda t: st.lists(t, max_size=4) | st.dictionaries(st.text(max_size=6), t, max_size=3), max_leaves=8
)


@st.composite
def ply(draw):
    form = draw(st.sampled_from(["ascii", "binary_little_endian", "binary_big_endian"]))
    order = ">" if "big" in form else "<"
    head, body = [f"ply\nformat {form} 1.0"], b""
    # Now and then as it should be, so that what comes after is reached too.
    for element in draw(st.lists(WORDS, max_size=3)) if draw(st.integers(0, 4)) == 0 else ("vertex", "face"):
        usual, rows = draw(st.integers(0, 4)) > 0, draw(st.integers(0, 4))
        head.append(f"element {element} {rows if usual or draw(st.booleans()) else draw(WHOLE)}")
        plain = draw(st.lists(st.tuples(WORDS, NAMES), max_size=2))
        listed = [] if usual else [(*pair, draw(WORDS)) for pair in draw(st.lists(st.tuples(NAMES, NAMES), max_size=2))]
        if usual and element == "vertex":
            plain = [(axis, draw(NAMES)) for axis in "xyz"] + plain
        elif usual and element == "face":
            listed = [("uchar", draw(NAMES), "vertex_indices")]
        head += [f"property {kind} {word}" for word, kind in plain]
        head += [f"property list {count} {kind} {word}" for count, kind, word in listed]
        for _ in range(rows):
            row = [(draw(REAL), TYPES[kind]) for _, kind in plain]
            for count, kind, _ in listed:
                size = draw(st.integers(3, 4) if usual else st.integers(0, 5))
                corner = st.integers(0, 3) if usual else st.integers(-2, 6)
                row += [(size, TYPES[count])] + [(draw(corner), TYPES[kind]) for _ in range(size)]
            if form == "ascii":
                body += " ".join(str(value) for value, _ in row).encode() + b"\n"
            else:
                with np.errstate(all="ignore"):
                    body += b"".join(np.float64(value).astype(order + kind).tobytes() for value, kind in row)
    cut = draw(st.integers(0, 200)) if draw(st.integers(0, 4)) == 0 else None
    return "\n".join([*head, "end_header\n"]).encode() + body[:cut]


def lines(*forms, most=30):
    """Text whose lines are words and numbers, in forms such as "v # # #"."""
    number = (WHOLE | REAL).map(str)

    def line(form):
        first, *others = form.split("#")
        return st.tuples(*(number for _ in others)).map(
            lambda found: first + "".join(a + b for a, b in zip(found, others, strict=True))
        )

    return st.lists(st.one_of(*map(line, forms)), max_size=most).map(lambda found: "\n".join(found).encode())


@st.composite
def changed(draw, whole: bytes):
    """JSON of which a part is exchanged for another, or left out."""
    tree = json.loads(whole)
    for _ in range(draw(st.integers(1, 2))):
        at, key = tree, None
        while isinstance(at, dict | list) and at:
            inside, key = at, draw(st.sampled_from(list(at) if isinstance(at, dict) else range(len(at))))
            at = at[key]
            if draw(st.booleans()):
                break
        if key is None or draw(st.integers(0, 5)) == 0:
            inside.pop(key) if key is not None else None
        else:
            inside[key] = draw(TREES)
    return json.dumps(tree).encode()


def of(dtype, shape, **elements):
    return arrays.arrays(dtype, shape, **({"elements": st.integers(**elements)} if elements else {}))


USUAL = {
    "vertices": st.sampled_from([(5, 3), (2, 5, 3)]).flatmap(
        lambda shape: of(np.float32, shape, min_value=-9, max_value=9)
    ),
    "faces": of(np.int32, (3, 3), min_value=0, max_value=4),
    "fps": st.just(np.float64(30)),
    "landmarks": of(np.float32, (2, 2, 3), min_value=-9, max_value=9),
    "lmk_face_idx": of(np.int64, 2, min_value=0, max_value=2),
    "lmk_b_coords": st.just(np.full((2, 3), 1 / 3)),
}
ANY = arrays.arrays(
    arrays.scalar_dtypes() | arrays.array_dtypes() | arrays.unicode_string_dtypes(max_len=3),
    arrays.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4),
)


@st.composite
def zipped(draw, *names: str):
    """An NPZ as it should be, but for up to two arrays of any shape and dtype, and one that may be missing."""
    found = {name: draw(USUAL[name]) for name in names}
    for name in draw(st.sets(st.sampled_from(names), max_size=2)):
        found[name] = draw(of(np.float32, st.tuples(st.integers(0, 6), st.just(3))) | ANY)
    if draw(st.integers(0, 4)) == 0:
        del found[draw(st.sampled_from(names))]
    return fuzz.npz(**found)


@st.composite
def tensors(draw):
    """A safetensors file whose header says something else of the numbers that follow it."""
    whole = KNOWN["safetensors"]().files[0]
    end = 8 + int.from_bytes(whole[:8], "little")
    text = draw(st.just(whole[8:end]) | changed(whole[8:end]))
    return len(text).to_bytes(8, "little") + text + draw(st.just(whole[end:]) | st.binary(max_size=60))


@st.composite
def embedding(draw):
    """What FLAME's landmarks are kept as."""
    count = draw(st.integers(0, 3))
    found = {"lmk_face_idx": draw(arrays.arrays(np.int64, count, elements=st.integers(0, 2)))}
    weights = arrays.arrays(np.float32, (count, 3), elements=st.sampled_from([0, 1, 0.5, np.nan, -1]))
    found["lmk_b_coords"] = draw(weights | st.just(np.full((count, 3), 1 / 3)))
    if draw(st.booleans()):
        found[draw(st.sampled_from([*found, "x"]))] = draw(PICKLED)
    return pickle.dumps(found, draw(st.integers(0, 5)))


@st.composite
def recording(draw):
    """The header of Live Link Face, over times and numbers."""
    head = KNOWN["livelink"]().files[0].split(b"\n")[0]
    rows = [head] if draw(st.integers(0, 4)) else []
    for frame in range(draw(st.integers(0, 4))):
        time = draw(st.just(f"13:02:01:{frame:02d}.000") | st.from_regex(r"[0-9:.]{1,12}", fullmatch=True))
        value = draw(REAL | WHOLE | st.sampled_from(["", "x", "nan"]))
        values = [
            str(value) if draw(st.integers(0, 20)) == 0 else "0.5"
            for _ in range(draw(st.just(61) | st.integers(59, 62)))
        ]
        rows.append(",".join([time, draw(st.just("61") | WHOLE.map(str)), *values]).encode())
    return b"\n".join(rows)


PICKLED = st.recursive(
    SCALARS | st.binary(max_size=4) | arrays.arrays(arrays.scalar_dtypes(), arrays.array_shapes(max_side=3)),
    lambda t: st.lists(t, max_size=3) | st.tuples(t, t) | st.dictionaries(st.text(max_size=3) | WHOLE, t, max_size=3),
    max_leaves=6,
)
CONTENTS = {
    "ply": ply(),
    "obj": lines("v # # #", "v # # # #", "f # # #", "f #/# #//# #/#/#", "f # # # #", "vn # # #", "vt # #", "g a", "o"),
    "npz": zipped("vertices", "faces"),
    "animation": zipped("vertices", "faces", "fps", "landmarks"),
    "landmarks_npz": zipped("lmk_face_idx", "lmk_b_coords"),
    "landmarks_json": st.one_of(*(changed(whole) for whole in KNOWN["landmarks_json"]().files)),
    "landmarks_text": lines("# # #", "#"),
    "landmarks_pp": lines('<point x="#" y="#" z="#" active="#" name="#"/>').map(
        lambda text: b"<PickedPoints>\n" + text + b"\n</PickedPoints>"
    ),
    "landmarks_pkl": embedding(),
    "pickle": st.tuples(PICKLED, st.integers(0, 5)).map(lambda given: pickle.dumps(*given)),
    "bnd": lines("# # # #", "# # #", most=90),
    "csv": lines("subject,recording,label", "A,#,smile", "A,#", "B,one,#,#", "# c"),
    "livelink": recording(),
    "safetensors": tensors(),
    "store": st.one_of(*(changed(whole) for whole in KNOWN["store"]().files)),
    "corpus": st.one_of(*(changed(whole) for whole in KNOWN["corpus"]().files)),
}  # fmt: skip


@pytest.mark.parametrize("name", CONTENTS)
def test_well_formed_nonsense_is_refused_or_taken(name):
    reader = KNOWN[name]()
    taken, refused = 0, 0

    @settings(
        max_examples=EXAMPLES, deadline=None, database=None, derandomize=True,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )  # fmt: skip
    @given(CONTENTS[name])
    def read(content):
        nonlocal taken, refused
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("error")
            path = Path(folder) / f"file{reader.suffix}"
            path.write_bytes(content)
            try:
                reader.read(path)
                taken += 1
            except reader.errors as error:
                assert "\n" not in str(error) and folder in str(error)
                refused += 1
            assert [p.name for p in Path(folder).rglob("*")] == [path.name]

    read()
    assert taken + refused >= EXAMPLES // 2  # it may find that there are no more
    outcome("well-formed nonsense", name, taken + refused, "", refused=refused, read=taken)
