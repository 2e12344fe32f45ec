"""Labelled grids of pictures, and captions below the frames of a video."""

import os
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw, ImageFont

from facejax.io import atomic


def contact_sheet(
    rows: Iterable[Iterable[ArrayLike]],
    row_labels: Sequence[str] | None = None,
    column_labels: Sequence[str] | None = None,
    *,
    gap: int = 4,
) -> np.ndarray:
    """Arrange pictures in a labelled grid, (height, width, 3) uint8.

    Args:
      rows: rows of pictures, each (h, w, 3) uint8, all of one size; a row may be short.
      row_labels, column_labels: texts, as many as rows and columns.
      gap: pixels between pictures.

    Raises:
      ValueError: no picture, a picture of another size, or a wrong number of labels.
    """
    rows = [list(row) for row in rows]
    columns = max((len(row) for row in rows), default=0)
    if not columns:
        raise ValueError("a contact sheet needs at least one picture")
    shape = next(np.shape(row[0]) for row in rows if row)
    row_labels, column_labels = ([_printable(t) for t in x or ()] for x in (row_labels, column_labels))
    for name, labels, count in (("row", row_labels, len(rows)), ("column", column_labels, columns)):
        if labels and len(labels) != count:
            raise ValueError(f"expected {count} {name} labels, got {len(labels)}")
    height, width = shape[:2]
    size = max(11, min(height, width) // 14)
    font = _load_font(size)
    row_boxes = [font.getbbox(text) for text in row_labels]
    left = int(max((box[2] for box in row_boxes), default=-8)) + 12 if row_labels else gap
    line = int(sum(font.getmetrics()) * 1.5)
    top = line if column_labels else gap
    sheet = Image.new("RGB", (left + columns * (width + gap), top + len(rows) * (height + gap)), "white")
    pen = ImageDraw.Draw(sheet)
    for j, text in enumerate(column_labels):
        place = (left + j * (width + gap) + width / 2, top / 2)
        pen.text(place, text, "#222222", _font(text, size, width), "mm")
    for i, row in enumerate(rows):
        y = top + i * (height + gap)
        if row_labels:
            pen.text((left - 6, y + height / 2), row_labels[i], "#222222", font, "rm")
        for j, picture in enumerate(row):
            if np.shape(picture) != shape:
                raise ValueError(f"picture [{i}][{j}] must be {shape} as the first, got {np.shape(picture)}")
            sheet.paste(Image.fromarray(np.asarray(picture, np.uint8)), (left + j * (width + gap), y))
    return np.asarray(sheet)


def save(path: str | os.PathLike[str], pixels: ArrayLike) -> None:
    """Write a picture (height, width, 3) uint8 as PNG, atomically."""
    with atomic.replace_file(path) as temporary:
        Image.fromarray(np.asarray(pixels, np.uint8)).save(temporary)


def caption(pictures: ArrayLike, captions: Sequence[tuple[int, str]]) -> np.ndarray:
    """Add a strip with the current caption below each frame.

    Args:
      pictures: (T, H, W, 3) uint8.
      captions: ((first frame, text), ...) by rising frame; each is shown until the next.

    Returns:
      (T, H + strip, W, 3) uint8, of even height.
    """
    pictures = np.asarray(pictures)
    count, height, width = pictures.shape[:3]
    strip = max(16, height // 12) // 2 * 2 + height % 2
    result = np.full((count, height + strip, width, 3), 255, np.uint8)
    result[:, :height] = pictures
    bounds = [start for start, _ in captions] + [count]
    for (start, text), stop in zip(captions, bounds[1:], strict=True):
        text = _printable(text)
        font = _font(text, strip * 6 // 10, 0.94 * width)
        band = Image.new("RGB", (width, strip), "white")
        ImageDraw.Draw(band).text((width / 2, strip / 2), text, "#20242a", font, "mm")
        result[start:stop, height:] = np.asarray(band)
    return result


def _load_font(size: float) -> ImageFont.FreeTypeFont:
    font = ImageFont.load_default(size=size)
    assert isinstance(font, ImageFont.FreeTypeFont)  # wherever Pillow is built with FreeType, as its wheels are
    return font


def _font(text: str, size: int, width: float) -> ImageFont.FreeTypeFont:
    """Return Pillow's built-in font at the given size, or smaller if the text is wider than `width`."""
    while (font := _load_font(size)).getlength(text) > width and size > 6:
        size -= 1
    return font


def _printable(text: str) -> str:
    """Replace the arrow, which Pillow's built-in font does not have."""
    return text.replace("→", "to")
