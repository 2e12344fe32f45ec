"""The layouts of the gated datasets, written byte by byte from MakeHuman faces; nothing is shared with a loader."""

import io
import pickle
import struct

import numpy as np

CURVE = (0.0, 0.03, 0.4, 0.8, 1.0, 0.97, 0.5, 0.02, 0.0)  # how far an expression has gone, frame by frame


def face(tiny_store, subject):
    """A person at rest (N, 3) float64, mm."""
    return np.asarray(tiny_store.neutral[subject], np.float64)


def motion(tiny_store, subject, expression, curve=CURVE):
    """Meshes (T, N, 3) float64, mm: a smooth bump of its own for every expression."""
    rest = face(tiny_store, subject)
    rng = np.random.default_rng(expression)
    centre = rest[tiny_store.landmark_index[30 + expression]]
    bump = np.exp(-np.sum((rest - centre) ** 2, axis=1) / 900)[:, None] * rng.normal(size=3) * 6
    return rest + np.asarray(curve)[:, None, None] * bump


def ply(vertices, faces, *, form="binary_little_endian", kind="float", extra=False):
    """A PLY file's bytes. `extra`: normals and colours stand between, as exporters write them."""
    code = {"float": "f", "double": "d"}[kind]
    more = ["property float nx", "property uchar red"] if extra else []
    head = ["ply", f"format {form} 1.0", "comment made for a test", f"element vertex {len(vertices)}"]
    head += [f"property {kind} {axis}" for axis in "xyz"] + more
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    out = io.BytesIO()
    out.write(("\n".join(head) + "\n").encode())
    if form == "ascii":
        for x, y, z in vertices:
            out.write(f"{x:.9g} {y:.9g} {z:.9g}{' 0 128' if extra else ''}\n".encode())
        for a, b, c in faces:
            out.write(f"3 {a} {b} {c}\n".encode())
        return out.getvalue()
    order = "<" if "little" in form else ">"
    for row in vertices:
        out.write(struct.pack(f"{order}3{code}", *row) + (struct.pack(f"{order}fB", 0.0, 128) if extra else b""))
    for row in faces:
        out.write(struct.pack(f"{order}B3i", 3, *row))
    return out.getvalue()


def coma(root, data, *, unit=0.001):
    """Two people, three expressions; metres, single precision."""
    for subject in range(2):
        for e, name in enumerate(("bareteeth", "cheeks_in", "mouth_up")):
            folder = root / f"FaceTalk_17072{subject}_00137_TA" / name
            folder.mkdir(parents=True)
            for t, mesh in enumerate(motion(data, subject, e)):
                content = ply(mesh * unit, data.faces, form=("binary_little_endian", "ascii")[t % 2])
                (folder / f"{name}.{t + 1:06d}.ply").write_bytes(content)


def d3dfacs(root, data):
    """Two people, three recordings of two combinations of action units; frames from 7 on, unpadded."""
    for subject in range(2):
        for e, name in enumerate(("1+2", "12+25", "12+25_02")):
            folder = root / f"subject{subject}" / name
            folder.mkdir(parents=True)
            for t, mesh in enumerate(motion(data, subject, e)):
                content = ply(mesh / 1000, data.faces, form="binary_big_endian", extra=True)
                (folder / f"{name}_{t + 7}.ply").write_bytes(content)


def florence4d(root, data):
    """Two people, two expressions of 60 frames; double precision."""
    up = np.linspace(0, 1, 31)
    curve = np.concatenate([up, up[-2:0:-1]])
    for subject in range(2):
        for e, name in enumerate(("Smile", "Frown")):
            folder = root / f"id{subject}" / name
            folder.mkdir(parents=True)
            for t, mesh in enumerate(motion(data, subject, e, curve)):
                content = ply(mesh / 1000, data.faces, kind="double")
                (folder / f"{name}_{t}.ply").write_bytes(content)


def vocaset(root, data):
    """Two people, two sentences, their rows out of order."""
    root.mkdir()
    takes = [(s, e) for s in range(2) for e in range(2)]
    moved = np.concatenate([motion(data, s, e) for s, e in takes]) / 1000
    order = np.random.default_rng(0).permutation(len(moved))
    np.save(root / "data_verts.npy", moved[order].astype(np.float32))
    row = np.argsort(order)
    frames = len(CURVE)
    index = {f"FaceTalk_{s}_TA": {} for s in range(2)}
    for k, (s, e) in enumerate(takes):
        rows = {t: int(row[k * frames + t]) for t in range(frames)}
        index[f"FaceTalk_{s}_TA"][f"sentence{e + 1:02d}"] = rows
    (root / "subj_seq_to_idx.pkl").write_bytes(pickle.dumps(index, protocol=2))
    still = {f"FaceTalk_{s}_TA": face(data, s) / 1000 for s in range(2)}
    (root / "templates.pkl").write_bytes(pickle.dumps(still, protocol=2))
    (root.parent / "template.ply").write_bytes(ply(face(data, 0) / 1000, data.faces))


def bu3dfe(root, data):
    """Three people, of whom one has no neutral mesh; two emotions in four strengths, mm."""
    for subject, name in enumerate(("F0001", "F0002", "M0001")):
        folder = root / name
        folder.mkdir(parents=True)
        if name != "F0002":
            (folder / f"{name}_NE00WH_F3D.ply").write_bytes(ply(face(data, subject), data.faces))
        for e, code in enumerate(("AN", "DI")):
            for level, mesh in enumerate(motion(data, subject, e, (0.25, 0.5, 0.75, 1.0)), 1):
                (folder / f"{name}_{code}{level:02d}WH_F3D.ply").write_bytes(ply(mesh, data.faces))


def bu4dfe(root, data):
    """Two people, two emotions: 83 vertices of the meshes stand in for the landmarks; a blank row at the end."""
    marks = np.arange(83) * 39
    for subject, name in enumerate(("F001", "M001")):
        for e, emotion in enumerate(("Angry", "Happy")):
            folder = root / name / emotion
            folder.mkdir(parents=True)
            for t, mesh in enumerate(motion(data, subject, e)[:, marks] + 0):
                # Bumps of one landmark's size hardly reach these vertices: move them all a little.
                mesh = mesh + 3 * CURVE[t]
                rows = [f"{v} {x:.6f} {y:.6f} {z:.6f}" for v, (x, y, z) in zip(marks * 7, mesh, strict=True)]
                (folder / f"{t:03d}.bnd").write_text("\n".join(rows) + "\n" + "\n" * (t % 2))
    return marks
