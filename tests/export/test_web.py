"""The page that generates motions: its JavaScript against Python, in Node and in Chromium."""

import functools
import http.server
import importlib.util
import math
import os
import shutil
import threading
from importlib import resources
from pathlib import Path

import jax
import numpy as np
import pytest

from facejax.export import manifest, onnx, web
from facejax.inference import composition, pipeline
from tests import tiny_models

NEEDED = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in onnx.PACKAGES), reason="jax2onnx, onnx or onnxruntime"
)
RUNTIME = os.environ.get("ONNXRUNTIME_WEB")  # dist of the npm package


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@pytest.fixture
def serve():
    """Serve a folder; gives the address."""
    servers = []

    def start(folder):
        Quiet.extensions_map[".mjs"] = "text/javascript"
        handler = functools.partial(Quiet, directory=str(folder))
        server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        servers.append(server)
        return f"http://127.0.0.1:{server.server_port}/"

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


@pytest.fixture(scope="module")
def runtime(tmp_path_factory):
    """A folder with empty files in place of ONNX Runtime."""
    folder = tmp_path_factory.mktemp("runtime")
    for name in web.RUNTIME_FILES:
        (folder / name).write_text("")
    return folder


@pytest.fixture(scope="module")
def faces():
    rest = np.asarray(tiny_models.make().face.vertices)
    return {"one": rest, "two": (rest * [1.1, 1.0, 0.9]).astype(np.float32)}


@pytest.fixture(scope="module")
def site(runtime, faces, tmp_path_factory):
    """A folder of the page, without ONNX Runtime, and the files that the export names."""
    out = tmp_path_factory.mktemp("site") / "web"
    return out, web.export(tiny_models.make(), out, faces=faces, runtime=runtime)


def xoshiro(seed, count):
    """The numbers of motion.js, written anew."""
    mask, state = 2**32 - 1, []
    for _ in range(4):
        seed = (seed + 0x9E3779B9) & mask
        z = ((seed ^ seed >> 16) * 0x85EBCA6B) & mask
        z = ((z ^ z >> 13) * 0xC2B2AE35) & mask
        state.append(z ^ z >> 16)
    turn = lambda x, k: ((x << k) | (x >> (32 - k))) & mask  # noqa: E731
    for _ in range(count):
        yield (turn((state[1] * 5) & mask, 7) * 9) & mask
        shifted = (state[1] << 9) & mask
        state[2] ^= state[0]
        state[3] ^= state[1]
        state[1] ^= state[2]
        state[0] ^= state[3]
        state[2] ^= shifted
        state[3] = turn(state[3], 11)


def test_timeline_random_numbers_and_rigid_motions_of_the_page(node):
    cases = [([30], 30), ([2, 2], 30), ([30, 12, 2, 45], 30), ([4, 9, 5], 6), ([7, 3], 2)]
    jobs = [{"frames": frames, "drawn": drawn} for frames, drawn in cases]
    file = str(resources.files("facejax.viz").joinpath("web", "motion.js"))
    source = np.random.default_rng(0).normal(size=(9, 3)) * [30, 5, 20]
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])
    points = {"source": source.ravel().tolist(), "target": (source @ turn.T + [1, 2, 3]).ravel().tolist()}
    found = node("motion.cjs", {"file": file, "seed": 7, "timelines": jobs, **points})
    np.testing.assert_allclose(found["rigid"]["rotation"], turn, atol=1e-6)
    np.testing.assert_allclose(found["rigid"]["to"], turn @ found["rigid"]["from"] + [1, 2, 3], atol=1e-6)
    for (frames, drawn), values in zip(cases, found["timelines"], strict=True):
        expected = composition.timeline(frames, drawn=drawn)
        np.testing.assert_allclose(np.reshape(values, expected.shape), expected, atol=1e-6)
    whole = list(xoshiro(7, 10))
    assert found["whole"] == whole[:5]
    assert found["choice"] == whole[0] / 2**32
    radius, angle = math.sqrt(-2 * math.log((whole[1] + 1) / 2**32)), 2 * math.pi * whole[2] / 2**32
    np.testing.assert_allclose(found["blur"][:2], [radius * math.cos(angle), radius * math.sin(angle)], rtol=1e-6)
    values = np.concatenate([found["blur"], found["transitions"]])
    assert values.size == 30_000
    moments = [np.mean(values**k) for k in (1, 2, 3, 4)]
    np.testing.assert_allclose(moments, [0, 1, 0, 3], atol=0.1)
    assert abs(np.corrcoef(values[:-1], values[1:])[0, 1]) < 0.03


def test_16_bits_keep_linear_maps_to_a_65000th_of_a_row():
    rng = np.random.default_rng(0)
    arrays = {"neutral": rng.normal(size=(5, 3)), "map_0": rng.normal(size=(4, 7)) * [[1], [1e-3], [50], [0]]}
    data, rows = web.pack(arrays)
    first, second = rows
    np.testing.assert_array_equal(
        np.frombuffer(data, "<f4", 15, first["offset"]).reshape(5, 3), np.float32(arrays["neutral"])
    )
    whole = np.frombuffer(data, "<i2", 28, second["offset"]).reshape(4, 7)
    found = whole * np.frombuffer(data, "<f4", 4, second["scales"])[:, None]
    largest = np.abs(arrays["map_0"]).max(axis=1, keepdims=True)
    assert np.all(np.abs(found - arrays["map_0"]) <= largest / 65_000)


@NEEDED
def test_an_export_is_whole_and_asks_no_other_server(site):
    out, files = site
    assert files[0] == out / "index.html"
    assert {*web.PAGE, "model.json", "manifest.json", "motion.onnx", "decoder.onnx", "face0.bin"} < {
        path.name for path in files
    }
    manifest.check_folder(out)  # may be replaced
    text = "".join((out / name).read_text() for name in web.PAGE)
    assert "http:" not in text and "https:" not in text and "eval(" not in text.replace("wasm-unsafe-eval", "")
    policy = (out / "index.html").read_text()
    assert "default-src 'none'" in policy and "unsafe-inline" not in policy and "'unsafe-eval'" not in policy


@NEEDED
def test_errors_leave_nothing_behind(tmp_path, runtime):
    models, out = tiny_models.make(), tmp_path / "web"
    shutil.copytree(runtime, tmp_path / "runtime")
    (tmp_path / "runtime" / web.RUNTIME_FILES[-1]).unlink()
    with pytest.raises(web.RuntimeMissing, match=r"simd-threaded\.wasm of onnxruntime-web"):
        web.export(models, out, runtime=tmp_path / "runtime")
    with pytest.raises(ValueError, match="expected one or more"):
        web.export(models, out, faces={})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["runtime"]


def test_a_missing_npm_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(web.shutil, "which", lambda name: None)
    with pytest.raises(web.RuntimeMissing, match="npm is not installed") as caught:
        web.add_runtime(tmp_path)
    assert "\n" not in str(caught.value)


@NEEDED
@pytest.mark.browser
def test_chromium_generates_the_vertices_of_jax(browser, serve, site, faces, tmp_path):
    if RUNTIME is None or not Path(RUNTIME).is_dir():
        pytest.skip("ONNXRUNTIME_WEB names no folder of onnxruntime-web")
    models, (out, _) = tiny_models.make(), site
    web.add_runtime(out / "onnxruntime", RUNTIME)
    motions, expected = [], []
    for face, labels, frames, intensity in ((0, [0, 1, 0], [4, 9], 1.0), (1, [2, 0], [11], 1.5)):
        noise = pipeline.sample_noise(models, jax.random.key(face), np.array(labels))
        values = {name: np.ravel(value).tolist() for name, value in noise._asdict().items()}
        values["choice"] = values["choice"][0]
        motions.append({"labels": labels, "frames": frames, "noise": values, "face": face, "intensity": intensity})
        prepared = pipeline.prepare(models, list(faces.values())[face])
        moved = pipeline.motion_from_noise(
            models, noise, np.array(labels), prepared, frames=frames, intensity=intensity
        )
        expected.append(pipeline.vertices(models, prepared, moved))
    drawn = len(models.motion.chart.p) + 1
    job = {"url": serve(out), "folder": str(tmp_path), "motions": motions, "frames": 3 * (drawn - 1) + 1}
    found = browser("generate.cjs", job)
    assert (found["failure"], found["errors"]) == ("", [])
    assert all(url.startswith(job["url"]) for url in found["requests"] if not url.startswith("data:"))
    for file, vertices in zip(found["found"], expected, strict=True):
        values = np.fromfile(file, np.float32).reshape(vertices.shape)
        np.testing.assert_allclose(values, vertices, atol=1e-2)
    assert found["sequence"] == 4 and found["paused"] == "Play"
