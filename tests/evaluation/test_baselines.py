"""Every way from landmarks to a mesh fits a tiny dataset and moves a new face, as the model that it stands for does."""

import numpy as np
import pytest

from facejax.data.mesh_subset import of_split
from facejax.evaluation import baselines
from facejax.mesh import hierarchy
from facejax.models.decoders import dictionary, gpmm, linear, s2d_dec
from facejax.training.recipes import fit_gpmm, fit_linear, fit_neural3dmm, fit_residual, fit_s2d_dec

FRAMES = 3


@pytest.fixture(scope="module", autouse=True)
def quick():
    """Few candidates for what is chosen, and few atoms."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit_linear, "ALPHAS", (1e-6, 1e-2))
        patch.setattr(fit_linear, "FOLDS", 2)
        patch.setattr(fit_gpmm, "SMOOTHNESS_GRID", (0.0, 0.1))
        patch.setattr(fit_gpmm, "NOISE_GRID", (1e-4, 1e-2))
        patch.setattr(dictionary, "ATOMS", 12)
        yield


@pytest.fixture(scope="module")
def options(template):
    return baselines.Options(
        decoder=fit_s2d_dec.S2DDecPlan(steps=1, batch=2),
        residual=fit_residual.ResidualPlan(steps=1, batch=2),
        neural3dmm=fit_neural3dmm.Neural3DMMPlan(steps=1, batch=2),
        components=8,
        hierarchy=hierarchy.build(template.vertices, template.faces, lengths=3),
    )


@pytest.fixture(scope="module")
def train(tiny_store):
    return of_split(tiny_store, "train")


@pytest.fixture(scope="module")
def new(tiny_store):
    """A face that was not seen, and some of its landmarks and vertices."""
    neutral, marks, vertices = of_split(tiny_store, "test").person(5)
    return neutral, marks[:FRAMES], vertices[:FRAMES]


@pytest.fixture(scope="module")
def fitted(train, options, tmp_path_factory):
    """Parameters by name, fitted once each."""
    folder, found = tmp_path_factory.mktemp("methods"), {}

    def fit(name):
        if name not in found:
            more = {"base": fit("gpmm")} if name == "s2d_residual" else {}
            found[name] = baselines.METHODS[name].fit(train, folder / name, options._replace(**more))
        return found[name]

    return fit


def moved(fitted, name, new):
    neutral, marks, _ = new
    return np.asarray(baselines.METHODS[name].apply(fitted(name), marks, neutral))


@pytest.mark.parametrize("name", baselines.METHODS)
def test_every_method_fits_and_moves_a_new_face(fitted, name, new):
    method, (neutral, marks, _) = baselines.METHODS[name], new
    some = np.concatenate([marks[:-1], 0 * marks[:1]])
    found = np.asarray(method.apply(fitted(name), some, neutral))
    assert found.shape == (FRAMES, *neutral.shape) and np.isfinite(found).all()
    # Frames are each for itself, and tell of their landmarks: but for `still`, one without motion differs.
    turned = np.asarray(method.apply(fitted(name), some[::-1], neutral))
    np.testing.assert_allclose(turned[::-1], found, atol=1e-2)
    assert (np.abs(found[0] - found[-1]).max() > 1e-2) == (name != "still")


def test_still_is_the_neutral_face(fitted, new):
    np.testing.assert_array_equal(moved(fitted, "still", new), np.stack([new[0]] * FRAMES))


@pytest.mark.parametrize("name", ["ridge", "pca38", "pca220"])
def test_linear_methods_are_linear_maps_with_the_alpha_that_is_chosen(fitted, train, new, name):
    model, fixed = {
        "ridge": (linear.ridge, {}),
        "pca38": (linear.pca, {"components": 38}),
        "pca220": (linear.pca, {"components": 220}),
    }[name]
    params, alpha = fit_linear.fit_linear(model, train, **fixed)
    assert fitted(name).alpha == alpha
    np.testing.assert_allclose(moved(fitted, name, new), new[0] + linear.apply(params, new[1]), atol=1e-3)


def test_others_are_their_models(fitted, options, new):
    neutral, marks, _ = new
    params = dict(zip(("s2d", "gpmm", "dl3dmm"), map(fitted, ("s2d", "gpmm", "dl3dmm")), strict=True))
    expected = {
        "s2d": s2d_dec.apply(params["s2d"][0], options.hierarchy, marks),
        "gpmm": linear.apply(gpmm.linear_map(params["gpmm"].params, neutral), marks),
        "dl3dmm": linear.apply(params["dl3dmm"].params, marks),
    }
    for name, displacements in expected.items():
        np.testing.assert_allclose(moved(fitted, name, new), neutral + displacements, atol=1e-3)
    assert params["dl3dmm"].params.factors[0].shape[1] == dictionary.ATOMS


def test_radial_functions_meet_the_landmarks(fitted, new, tiny_store):
    neutral, marks, _ = new
    at = tiny_store.landmark_index
    np.testing.assert_allclose(moved(fitted, "rbf", new)[:, at], neutral[at] + marks, atol=2e-2)


def test_the_residual_decoder_starts_from_the_base_that_it_is_given(fitted):
    assert fitted("s2d_residual").base is fitted("gpmm").params
    assert baselines.METHODS["gpmm"].fit(None, None, baselines.Options(base=fitted("gpmm"))) is fitted("gpmm")


def test_the_linear_ones_are_better_than_none_on_a_new_face(fitted, new):
    neutral, _, vertices = new
    still = np.linalg.norm(vertices, axis=-1).mean()
    for name in ("ridge", "pca38", "pca220", "gpmm", "dl3dmm", "rbf"):
        assert np.linalg.norm(moved(fitted, name, new) - neutral - vertices, axis=-1).mean() < 0.7 * still, name


def test_components_of_whole_meshes_are_those_of_faces_and_motion_together(ball_store, tmp_path):
    train = of_split(ball_store, "train", size=20)
    method = baselines.METHODS["pca220_mean"]
    fitted = method.fit(train, tmp_path, baselines.Options())
    _, moved = train.read(np.arange(train.count))
    whole = (moved + ball_store.neutral[train.owner]).astype(np.float64).reshape(train.count, -1)
    _, singular, right = np.linalg.svd(whole - whole.mean(axis=0), full_matrices=False)
    kept = singular**2 > 1e-12 * singular[0] ** 2
    components, variance = right[kept][:220], singular[kept][:220] ** 2 / train.count
    neutral, marks, _ = of_split(ball_store, "test").person(1)
    y = components.reshape(len(components), -1, 3)[:, ball_store.landmark_index].reshape(len(components), -1)
    # Components move a face from where it is: without landmarks' motion, nowhere.
    codes = np.linalg.solve(y @ y.T + fitted.alpha * np.diag(1 / variance), y @ marks.reshape(len(marks), -1).T)
    expected = neutral + (codes.T @ components).reshape(len(marks), -1, 3)
    np.testing.assert_allclose(method.apply(fitted, marks, neutral), expected, atol=5e-2)
    np.testing.assert_allclose(method.apply(fitted, 0 * marks, neutral)[0], neutral, atol=1e-4)


@pytest.mark.parametrize("by", ["subjects", "labels"])
def test_what_will_be_new_is_said_to_every_choice(train, tmp_path, monkeypatch, by):
    monkeypatch.setattr(fit_linear, "fit_linear", lambda model, train, *, by, **fixed: (by, fixed))
    monkeypatch.setattr(fit_gpmm, "fit", lambda train, *, by, components: (by, components))
    monkeypatch.setattr(fit_residual, "fit", lambda *args, by, base, **more: (by, base))
    options = baselines.Options(by=by, seed=3, components=7, hierarchy="given")
    asked = {
        name: baselines.METHODS[name].fit(train, tmp_path, options)
        for name in ("ridge", "pca38", "pca220", "pca220_mean", "dl3dmm", "gpmm", "s2d_residual")
    }
    assert {found[0] for found in asked.values()} == {by}
    assert asked["pca38"][1] == {"components": 38} and asked["pca220"][1] == {"components": 220}
    assert asked["dl3dmm"][1]["seed"] == 3 and asked["gpmm"][1] == 7
    assert asked["s2d_residual"][1] == asked["gpmm"]


def test_the_hierarchy_is_of_the_training_peoples_mean_face_unless_given(ball_store, tmp_path, monkeypatch):
    built = []
    monkeypatch.setattr(hierarchy, "build", lambda vertices, faces: built.append((vertices, faces)) or "hierarchy")
    monkeypatch.setattr(fit_neural3dmm, "fit", lambda train, hierarchy, folder, **options: hierarchy)
    train = of_split(ball_store, "train")
    assert baselines.METHODS["neural3dmm"].fit(train, tmp_path, baselines.Options()) == "hierarchy"
    np.testing.assert_allclose(built[0][0], ball_store.neutral[ball_store.subjects("train")].mean(axis=0), atol=1e-4)
    assert baselines.METHODS["neural3dmm"].fit(train, tmp_path, baselines.Options(hierarchy="mine")) == "mine"
    assert len(built) == 1
