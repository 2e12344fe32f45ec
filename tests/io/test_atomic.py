"""Files and folders appear whole or not at all."""

import pytest

from facejax.io import atomic, errors


def test_replacing_leaves_nothing_behind(tmp_path):
    target = tmp_path / "a" / "file.txt"
    with pytest.raises(RuntimeError), atomic.replace_file(target) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert list(target.parent.iterdir()) == []
    with atomic.replace_file(target) as temporary:
        temporary.write_text("whole")
    assert target.read_text() == "whole" and len(list(target.parent.iterdir())) == 1


def test_replacing_folder_replaces_or_vanishes(tmp_path):
    target = tmp_path / "folder"
    with pytest.raises(RuntimeError), atomic.replace_folder(target) as temporary:
        (temporary / "x").write_text("half")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []
    for text in ("first", "second"):
        with atomic.replace_folder(target) as temporary:
            (temporary / "x").write_text(text)
        assert (target / "x").read_text() == text


def test_what_is_said_of_a_file_is_one_short_printable_line():
    said = str(errors.FileError("/a b.ply: names\n\x1b[31mred\u202e\tand " + 9_000_000 * "x" + ": leave it out"))
    assert said.startswith("/a b.ply: names [31mred and xxx") and said.endswith("xxx: leave it out")
    assert said.isprintable() and len(said) <= errors.MAX_MESSAGE_CHARS + 5
    assert errors.one_line(ValueError("ä short one")) == "ä short one"
