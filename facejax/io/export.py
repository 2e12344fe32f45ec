"""Export of animations and still faces; the suffix of the path selects the format."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image

from facejax.io import atomic, glb_writer, meshes
from facejax.viz import html_viewer, render, scene, video

CONTACT_SHEET_FRAMES = 8


def save(
    path: str | os.PathLike[str],
    vertices: ArrayLike,
    faces: ArrayLike,
    *,
    fps: float = 30.0,
    captions: scene.Captions = (),
    title: str | None = None,
    landmarks: ArrayLike | None = None,
    extras: Sequence[scene.PartLike] = (),
    colours: ArrayLike | None = None,
    size: tuple[int, int] = (320, 400),
    camera: render.Camera | None = None,
) -> None:
    """Save an animation or a still face, atomically, in the format of the path's suffix.

    `.glb` animated glTF; `.html` self-contained viewer; `.webp`, `.gif`, `.mp4` video; `.png` image, or a contact
    sheet of eight frames of an animation; `.npz` arrays; `.ply`, `.obj` one mesh; a folder, or a path that ends in
    "/", one PLY per frame. Options that a format does not support are ignored.

    Args:
      path: output file or folder.
      vertices: (T, N, 3) or (N, 3) mm.
      faces: (F, 3).
      fps: frames per second.
      captions: ((first frame, text), ...); each is shown until the next.
      title: heading of the viewer and name in glTF; by default the stem of the path.
      landmarks: (T, L, 3) positions or (L,) vertex indices; drawn in images, optional in the viewer.
      extras: further parts, see `scene.Part`.
      colours: (N, 3) sRGB in [0, 1]; in images also (T, N, 3).
      size: (width, height) of images.
      camera: of images, see `render.fit_camera`.

    Raises:
      ValueError: the suffix is unknown, arrays have wrong shapes, or the format holds one mesh and there are several.
    """
    name, path = os.fspath(path), Path(path)
    shot = scene.make(vertices, faces, fps=fps, captions=captions, landmarks=landmarks, extras=extras)
    title = path.stem if title is None else title
    suffix = path.suffix.lower()
    if name.endswith(("/", os.sep)) or path.is_dir():
        meshes.write_sequence(path, shot.vertices, shot.faces)
    elif suffix == ".glb":
        glb_writer.write(path, *shot[:2], fps=fps, captions=captions, extras=extras, name=title)
    elif suffix == ".html":
        html_viewer.write(
            path, *shot[:2], fps=fps, captions=captions, title=title,
            landmarks=shot.landmarks, extras=extras, colours=colours,
        )  # fmt: skip
    elif suffix in video.FORMATS or suffix == ".png":
        if suffix != ".png":
            video.check(path)
        view = render.fit_camera(shot.vertices, size=size) if camera is None else camera
        if suffix == ".png":
            _write_picture(path, shot, colours, size, view)
        else:
            pictures = _pictures(shot, colours, size, view)
            video.write(path, render.caption(pictures, shot.captions) if shot.captions else pictures, fps=fps)
    elif suffix == ".npz":
        _write_arrays(path, shot)
    elif suffix in (".ply", ".obj"):
        if len(shot.vertices) > 1:
            raise ValueError(
                f"{path}: {suffix} holds one mesh, got {len(shot.vertices)} frames; use a folder: end the path in '/'"
            )
        meshes.write(path, shot.vertices[0], shot.faces)
    else:
        known = ".glb .html .webp .gif .mp4 .png .npz .ply .obj, or a folder ending in '/'"
        raise ValueError(f"{path}: unknown format {suffix!r}; expected {known}")


def _pictures(shot: scene.Scene, colours: ArrayLike | None, size: tuple[int, int], camera: render.Camera) -> np.ndarray:
    return render.frames(
        *shot[:2], landmarks=shot.landmarks, extras=shot.extras, colours=colours, size=size, camera=camera
    )


def _write_picture(
    path: Path, shot: scene.Scene, colours: ArrayLike | None, size: tuple[int, int], camera: render.Camera
) -> None:
    count = len(shot.vertices)
    chosen = np.unique(np.linspace(0, count - 1, CONTACT_SHEET_FRAMES).round().astype(int))
    if colours is not None and np.ndim(colours) == 3:
        colours = np.asarray(colours)[chosen]
    extras = [
        part._replace(vertices=part.vertices[chosen]) if part.vertices.ndim == 3 else part for part in shot.extras
    ]
    marks = None if shot.landmarks is None else shot.landmarks[chosen]
    still = shot._replace(vertices=shot.vertices[chosen], landmarks=marks, extras=extras)
    pictures = _pictures(still, colours, size, camera)
    if count > 1:
        labels = [_label(t, shot.captions) for t in chosen]
        picture = render.contact_sheet([pictures], column_labels=labels)
    else:
        picture = pictures[0]
    with atomic.replace_file(path) as temporary:
        Image.fromarray(picture).save(temporary)


def _label(frame: int, captions: scene.Captions) -> str:
    """Return the frame's number, from 1, and its caption."""
    return ": ".join([str(frame + 1)] + [text for start, text in captions if start <= frame][-1:])


def _write_arrays(path: Path, shot: scene.Scene) -> None:
    if len(shot.vertices) == 1:
        meshes.write(path, shot.vertices[0], shot.faces)
        return
    faces, fps = shot.faces.astype(np.int32), np.float64(shot.fps)
    with atomic.replace_file(path) as temporary:
        if shot.landmarks is None:
            np.savez(temporary, vertices=shot.vertices, faces=faces, fps=fps)
        else:
            np.savez(temporary, vertices=shot.vertices, faces=faces, fps=fps, landmarks=shot.landmarks)
