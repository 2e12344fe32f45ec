"""Landmark schemes: the numbers that are documented, mirror symmetry, and agreement where two schemes meet."""

import numpy as np
import pytest

from facejax.landmarks import schemes

COUNTS = (51, 66, 68, 83)


def test_documented_numbers_of_ibug():
    points = schemes.by_count(68).points
    # 300-W, from 1 on: 9 chin, 31 nose tip, 34 below it, 37 and 46 outer corners of the eyes, 49 and 55 of the mouth.
    assert [points[i - 1] for i in (9, 31, 34)] == ["chin", "nose tip", "nose base"]
    assert [points[i - 1] for i in (37, 40, 43, 46)] == [
        "right eye outer corner",
        "right eye inner corner",
        "left eye inner corner",
        "left eye outer corner",
    ]
    assert [points[i - 1] for i in (49, 52, 55, 58)] == [
        "right lip corner",
        "upper lip",
        "left lip corner",
        "lower lip",
    ]


def test_documented_numbers_of_bu_3dfe():
    points = schemes.by_count(83).points
    # Deep-MVLM's notes, 1-based; their "left" is the picture's.
    assert points[0] == "right eye inner corner" and points[4] == "right eye outer corner"
    assert all(points[i].startswith("right eye upper") for i in (1, 2, 3))
    assert all(points[i].startswith("right eye lower") for i in (5, 6, 7))
    assert points[8] == "left eye inner corner" and points[12] == "left eye outer corner"
    assert points[39] == "right nose wing" and points[44] == "left nose wing"
    assert [points[i - 1] for i in (49, 52, 55, 58, 76)] == [
        "right lip corner",
        "upper lip",
        "left lip corner",
        "lower lip",
        "chin",
    ]


@pytest.mark.parametrize(
    ("count", "sizes"), [(68, (17, 10, 9, 12, 20)), (51, (0, 10, 9, 12, 20)), (83, (15, 20, 12, 16, 20))]
)
def test_groups_part_the_points(count, sizes):
    scheme = schemes.by_count(count)
    assert tuple(scheme.groups) == schemes.GROUPS
    assert tuple(len(index) for index in scheme.groups.values()) == sizes
    np.testing.assert_array_equal(np.sort(np.concatenate(list(scheme.groups.values()))), np.arange(count))
    assert len(set(scheme.points)) == len(scheme.points) == count


@pytest.mark.parametrize("count", COUNTS)
def test_mirroring_twice_changes_nothing_and_swaps_the_sides(count):
    scheme = schemes.by_count(count)
    np.testing.assert_array_equal(scheme.mirror[scheme.mirror], np.arange(count))
    for point, i in zip(scheme.points, scheme.mirror, strict=True):
        sides = (point.split()[0], scheme.points[i].split()[0])
        assert sides in (("left", "right"), ("right", "left")) or point == scheme.points[i]


@pytest.mark.parametrize("source", COUNTS)
@pytest.mark.parametrize("target", COUNTS)
def test_what_two_schemes_share(source, target):
    a, b = schemes.common(source, target)
    first, second = schemes.by_count(source), schemes.by_count(target)
    assert [first.points[i] for i in a] == [second.points[i] for i in b]
    wanted = {frozenset([51, 68]): 51, frozenset([68, 83]): 47, frozenset([51, 83]): 46}
    wanted |= {frozenset([51, 66]): 49, frozenset([66, 83]): 45}
    assert len(a) == wanted.get(frozenset([source, target]), min(source, target))
    # The same pairs the other way round, and the mirror image of a pair is a pair.
    pairs = set(zip(a.tolist(), b.tolist(), strict=True))
    assert {(j, i) for i, j in pairs} == set(zip(*(x.tolist() for x in schemes.common(target, source)), strict=True))
    assert {(int(first.mirror[i]), int(second.mirror[j])) for i, j in pairs} == pairs


def test_51_is_68_without_the_jaw():
    a, b = schemes.common(68, 51)
    np.testing.assert_array_equal(a, np.arange(17, 68))
    np.testing.assert_array_equal(b, np.arange(51))


def test_66_is_68_without_the_corners_of_the_inner_lip():
    a, b = schemes.common(68, 66)
    assert set(range(68)) - set(a.tolist()) == {60, 64}
    np.testing.assert_array_equal(b, np.arange(66))


@pytest.mark.parametrize("count", COUNTS)
def test_names_hold_on_a_face(count, template):
    """Sides, order and height of every group of the MakeHuman head, in the points each scheme shares with 68."""
    here, there = schemes.common(68, count)
    scheme = schemes.by_count(count)
    points = np.full((count, 3), np.nan)
    points[there] = template.vertices[template.landmarks[here]]
    by_name = {scheme.points[i]: points[i] for i in there}
    for point, (x, _, _) in by_name.items():
        if (side := point.split()[0]) in ("left", "right"):
            assert (x > 0) == (side == "left"), f"{point} is on the other side"
    for side in ("left", "right"):
        brow = [abs(by_name[f"{side} brow {i}"][0]) for i in range(1, 6)]
        assert brow == sorted(brow)
        assert abs(by_name[f"{side} eye inner corner"][0]) < abs(by_name[f"{side} eye outer corner"][0])
        for place in ("inner", "outer"):
            assert by_name[f"{side} eye upper {place}"][1] > by_name[f"{side} eye lower {place}"][1]
        assert abs(by_name[f"{side} nose nostril"][0]) < abs(by_name[f"{side} nose wing"][0])
    height = [np.nanmean(points[scheme.groups[group], 1]) for group in ("brows", "eyes", "nose", "lips")]
    assert height == sorted(height, reverse=True)
    # A face is nearly its own mirror image, under the scheme's own table.
    flipped = points[scheme.mirror] * [-1, 1, 1]
    assert np.linalg.norm((flipped - points)[there], axis=1).max() < 3.0


def test_closed_lines_run_round_in_both_schemes():
    """Neighbours in the order of 83 are neighbours on the face: eyes, brows, lips are rings, nose and contour arcs."""
    layout = np.array([_place(point) for point in schemes.by_count(83).points])
    for low, high in ((0, 8), (8, 16), (16, 26), (26, 36), (48, 60), (60, 68)):
        ring = layout[low:high]
        step = np.linalg.norm(np.roll(ring, -1, axis=0) - ring, axis=1)
        assert step.max() < 0.75 * np.ptp(ring[:, 0]), "a ring jumps across itself"
    for low, high in ((36, 48), (68, 83)):
        assert (np.diff(layout[low:high, 0]) >= -0.1).mean() > 0.8, "an arc goes back"


def _place(point: str) -> tuple[float, float]:
    """A drawing: where a point of 83 lies on a face of the width 2, from its name alone."""
    words = point.split()
    side = {"left": 1.0, "right": -1.0}.get(words[0], 0.0)
    if "contour" in words:
        return side * np.sin(0.2 * int(words[-1])), -np.cos(0.2 * int(words[-1]))
    if "chin" in words:
        return 0.0, -1.0
    if "brow" in words:
        return side * (0.1 + 0.12 * int(words[-1])), 0.6 - 0.1 * ("lower" in words)
    if "eye" in words:
        x = {"corner": 0.2 if "inner" in words else 0.6, "inner": 0.3, "middle": 0.4, "outer": 0.5}[words[-1]]
        return side * x, 0.3 + 0.1 * ("upper" in words) - 0.1 * ("lower" in words)
    if "nose" in words:
        x, y = {"1": (0.1, 0.3), "2": (0.12, 0.1), "3": (0.2, -0.1), "wing": (0.25, -0.2)}.get(
            words[-1], (0.15 if "rim" in words else 0.05, -0.25)
        )
        return side * x, y
    x = {"corner": 0.4, "2": 0.28, "1": 0.14}.get(words[-1], 0.2 if words[0] in ("left", "right") else 0.0)
    reach = (0.5 if "inner" in words else 1.0) * (0.2 - 0.3 * x)
    return side * x, -0.6 + reach * (("upper" in words) - ("lower" in words))


def test_unknown_counts_name_the_known():
    with pytest.raises(ValueError, match=r"unsupported number of landmarks: 49 \(supported: 51, 66, 68, 83\)"):
        schemes.by_count(49)
    with pytest.raises(ValueError, match="unsupported number of landmarks: 0 "):
        schemes.common(68, 0)


def test_tables_are_nobodys_to_change():
    with pytest.raises(ValueError, match="read-only"):
        schemes.by_count(68).mirror[0] = 3


@pytest.mark.parametrize("count", COUNTS)
def test_what_stays_put_lies_on_both_sides_of_the_upper_face(count):
    scheme = schemes.by_count(count)
    names = [scheme.points[i] for i in scheme.stable]
    assert len(names) >= 6 and not any("lip" in name or "brow" in name or name == "chin" for name in names)
    assert {schemes.mirror_name(name) for name in names} == set(names)
