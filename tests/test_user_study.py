"""The user study: what the page holds and hides, what its script does, and what the table makes of answers."""

import base64
import html.parser
import io
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from experiments import _run, _study, user_study
from facejax.cli import runtime
from facejax.data.synthetic import makehuman
from facejax.inference import pipeline
from facejax.models import bundle

ROOT = Path(__file__).parents[1]
TINY = {"composed": 2, "peaks": 2, "real": 1, "frames": 4, "width": 48}
RELEASED = ROOT / "facejax" / "assets" / bundle.RELEASED


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A page with items of every kind; its folder and what `run` answers."""
    out = tmp_path_factory.mktemp("study")
    return out, user_study.run(user_study.Config(out=out, predecessor=RELEASED, **TINY))


def study_of(out):
    text = (out / "page.html").read_text("utf-8")
    return json.loads(re.search(r'id="study">([^<]*)</script>', text)[1])


def test_items_are_listed_and_hidden(made):
    out, found = made
    items, study = json.loads((out / "items.json").read_text()), study_of(out)
    assert found["items"] == {"composed": 2, "peak": 2, "predecessor": 2, "real": 1}
    assert found["version"] == study["version"] == items["version"]
    names = [item["id"] for item in study["items"]]
    assert names == sorted(items["items"]) and all(re.fullmatch("[0-9a-f]{12}", name) for name in names)
    for item in study["items"]:
        assert set(item) == {"id", "labels", "milliseconds", "film"}
        assert item["labels"] == items["items"][item["id"]]["labels"]
    kinds = {}
    for item in items["items"].values():
        kinds.setdefault(item["kind"], set()).add((item["subject"], *item["labels"]))
    assert kinds["peak"] == kinds["predecessor"] and kinds["real"] < kinds["peak"] and len(kinds["peak"]) == 2
    assert all(len(chain) == 5 and chain[1] == "neutral" for chain in kinds["composed"])
    assert sorted(chain[-1] == "neutral" for chain in kinds["composed"]) == [False, True]
    assert {"command", "commit", "machine", "seed"} <= set(items["made"])
    assert set(items["weights"]) == {"ours", "predecessor"}


def test_films_have_the_promised_length(made):
    study = study_of(made[0])
    for item in (*study["items"], *study["examples"].values()):
        picture = Image.open(io.BytesIO(base64.b64decode(item["film"])))
        total = 0
        for frame in range(picture.n_frames):
            picture.seek(frame)
            picture.load()
            total += picture.info["duration"]
        assert picture.format == "WEBP" and picture.n_frames > 3 and picture.width == TINY["width"]
        assert total == pytest.approx(item["milliseconds"], abs=2)


class Links(html.parser.HTMLParser):
    """Whatever a page asks for, and whether its elements are closed in order."""

    EMPTY = ("meta", "link", "img", "input")

    def __init__(self):
        super().__init__()
        self.found, self.open = [], []

    def handle_starttag(self, tag, attrs):
        self.found += [value for name, value in attrs if name in ("src", "href", "srcset", "action", "data")]
        self.open += [] if tag in self.EMPTY else [tag]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_asks_for_nothing_and_says_nothing(made):
    text = (made[0] / "page.html").read_text("utf-8")
    links = Links()
    links.feed(text)
    assert links.open == [] and links.found == ["data:,"]
    assert "default-src 'none'" in text
    words = re.sub(r'"film": "[^"]*"', "", text)
    assert len(words) < 40_000 and not re.search(r"https?://|//\w|@import|fetch|XMLHttp|eval", words)
    assert not re.search(r"composed|peak|predecessor|generat|model|ours|GAN|\bS1\d\d\b|kind", words)
    assert "real" not in json.dumps([item["labels"] for item in study_of(made[0])["items"]])


def test_the_failed_example_is_a_broken_mesh():
    config, models = user_study.Config(**TINY), pipeline.load()
    item = user_study.Item("example", user_study.EXAMPLE, user_study.EXAMPLE_FACE, 6)
    failed, sound = user_study._failed(config, models, item), user_study._generated(config, models, item)
    assert failed.vertices.shape == sound.vertices.shape and np.isfinite(failed.vertices).all()
    face = np.asarray(models.face.mask)
    moved = [np.linalg.norm(np.diff(m.vertices[:, face], axis=0), axis=-1).mean() for m in (failed, sound)]
    assert moved[0] > 1.5 and moved[0] > 3 * moved[1]


def test_without_a_predecessor_the_output_says_so(tmp_path, capsys, monkeypatch):
    shape = makehuman.template()
    still = user_study.Motion(shape.vertices[None], shape.vertices[None, shape.landmarks], (0,))
    for name in ("_moved", "_performed", "_failed"):
        monkeypatch.setattr(user_study, name, lambda *_: still)
    monkeypatch.setattr(user_study, "EXAMPLE", ("neutral", "high_smile"))
    found = user_study.run(user_study.Config(out=tmp_path, composed=0, peaks=1, real=0, frames=2, width=16))
    assert found["items"] == {"peak": 1}
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 2 and said[0].startswith("no --predecessor: the page has no neutral → peak animations")


def test_the_plan_is_drawn_by_seed_and_never_repeats():
    models = {"ours": pipeline.load()}
    items = user_study.plan(user_study.Config(), models)
    assert items == user_study.plan(user_study.Config(), models)
    assert items != user_study.plan(user_study.Config(seed=1), models)
    kinds = [item.kind for item in items]
    assert [kinds.count(kind) for kind in ("composed", "peak", "predecessor", "real")] == [14, 14, 0, 4]
    shown = [item.labels for item in items if item.kind != "real"]
    assert len(set(shown)) == len(shown) == 28
    assert all(a != b for labels in shown for a, b in zip(labels, labels[1:], strict=False))
    assert {item.subject for item in items} <= set(user_study.FACES)


NONE = {"composed": 0, "peaks": 0, "real": 0}


@pytest.mark.parametrize(
    "wrong", [{"peaks": 19}, {"peaks": -1}, {"real": 15}, {"composed": -1}, {"composed": 613}, NONE]
)
def test_more_than_there_is_gets_refused(wrong):
    with pytest.raises(ValueError, match=r"expected .*(peaks|0 to 612|at least one).* got"):
        user_study.plan(user_study.Config(**wrong), {"ours": pipeline.load()})


def test_a_page_that_was_answered_is_not_replaced(tmp_path):
    write(tmp_path / "scores", p=answers(P, (6, 8, 4, 10)))
    with pytest.raises(ValueError, match=r"scores holds answers to an earlier page: name another --out"):
        user_study.run(user_study.Config(out=tmp_path))
    with pytest.raises(ValueError, match="width: expected 16 pixels or more, got 0"):
        user_study.run(user_study.Config(out=tmp_path, width=0))
    assert [path.name for path in tmp_path.iterdir()] == ["scores"]


# Answers.

VERSION, P, Q = "0123456789ab", "aaaaaaaaaaaa", "bbbbbbbbbbbb"
ITEMS = {
    "00000000000a": {"kind": "composed", "labels": ["neutral", "fear", "anger", "neutral"], "subject": "S101"},
    "00000000000b": {"kind": "peak", "labels": ["neutral", "fear"], "subject": "S102"},
    "00000000000c": {"kind": "predecessor", "labels": ["neutral", "fear"], "subject": "S102"},
    "00000000000d": {"kind": "real", "labels": ["neutral", "fear"], "subject": "S102"},
}
STUDY = {"version": VERSION, "items": ITEMS, "weights": {}, "made": {"dataset": {"level": 3}}}


def answers(participant, nat, lab=(5, 5, 5, 5)):
    """A file as the page writes it: a line for each of `ITEMS`, below the header."""
    lines = [",".join(_study.HEADER)]
    for i, (name, item) in enumerate(ITEMS.items()):
        labels = ">".join(item["labels"])
        lines.append(f"{participant},7,{VERSION},{i + 1},{name},{labels},{nat[i]},{lab[i]},12.5")
    return lines


def write(folder, **files):
    folder.mkdir(exist_ok=True)
    for name, lines in files.items():
        (folder / f"{name}.csv").write_text("\n".join(lines) + "\n")
    return folder


def test_the_table_against_a_hand_computed_one(tmp_path):
    (tmp_path / "items.json").write_text(json.dumps(STUDY))
    folder = write(tmp_path / "scores", p=answers(P, (6, 8, 4, 10)), q=answers(Q, (8, 6, 6, 9)))
    config = user_study.Config(out=tmp_path, scores=(str(folder),))
    user_study.run(config)
    found = json.loads((tmp_path / "metrics.json").read_text())
    assert (found["participants"], found["ratings"], found["version"]) == (2, 8, VERSION)
    groups, t = found["groups"], 12.706204736  # Student's t, one degree of freedom
    assert list(groups) == ["ours", "composed", "peak", "predecessor", "real"]
    assert [row["ratings"] for row in groups.values()] == [4, 2, 2, 2, 2]
    assert groups["ours"]["nat"] == {"mean": 7.0, "std": pytest.approx((4 / 3) ** 0.5), "interval": [7.0, 7.0]}
    assert groups["peak"]["nat"]["std"] == pytest.approx(2**0.5)
    assert groups["peak"]["nat"]["interval"] == pytest.approx([7 - t, 7 + t])
    assert groups["real"]["nat"]["mean"] == 9.5
    assert groups["real"]["lab"] == {"mean": 5.0, "std": 0.0, "interval": [5.0, 5.0]}
    assert found["gain"]["nat"] == {"mean": 2.0, "interval": pytest.approx([2 - 2 * t, 2 + 2 * t])}
    assert {"command", "seed", "dataset"} <= set(found["made"]) and found["page"] == STUDY["made"]
    table = (tmp_path / "table.md").read_text()
    assert table.startswith("Participants: 2, ratings: 8.\n")
    cells = ("generated, all of ours", "7.00 ± 1.15 (7.00 to 7.00)", "5.00 ± 0.00 (5.00 to 5.00)", "4", "7.22 / 7.05")
    assert f"| {' | '.join(cells)} |" in table
    assert "| neutral → peak, predecessor | 5.00 ± 1.41 (-7.71 to 17.71) |" in table and "| 2 | 5.82 / – |" in table
    assert "OT23, 23 participants" in table and "less predecessor" in table and P not in table


def test_one_participant_has_no_interval(tmp_path):
    found = _study.summary(_study.read_scores([write(tmp_path / "s", p=answers(P, (6, 8, 4, 10)))], STUDY))
    assert found["groups"]["peak"]["nat"] == {"mean": 8.0, "std": None, "interval": None}
    assert "| neutral → peak, ours | 8.00 | 5.00 | 1 | 7.39 / – |" in _study.table(found)
    # A page without one of the kinds: no row for it, and none for what it belongs to.
    kept = [_study.Answer(P, "peak", 8, 5)]
    assert list(_study.summary(kept)["groups"]) == ["peak"]


def edited(line, old, new):
    def change(lines):
        assert old in lines[line - 1]
        return [*lines[: line - 1], lines[line - 1].replace(old, new, 1), *lines[line:]]

    return change


WRONG = {
    "header": (edited(1, "nat,lab", "lab,nat"), r"line 1, header: expected 'participant,.*', got '.*lab,nat,"),
    "semicolons": (lambda lines: [x.replace(",", ";") for x in lines], r"line 1, header: .* got 'participant;seed"),
    "no header": (lambda lines: [], r"line 1, header: expected .*, got ''"),
    "fields": (edited(3, ",12.5", ""), r"line 3, row: expected 9 fields, got 8"),
    "participant": (edited(2, P, "Ann"), r"line 2, participant: expected 12 hexadecimal digits, got 'Ann'"),
    "seed": (edited(2, ",7,", ",-7,"), r"line 2, seed: expected a whole number, 0 to 4294967295, got '-7'"),
    "version": (edited(4, VERSION, "ba9876543210"), rf"line 4, version: expected '{VERSION}', .*, got 'ba9876543210'"),
    "order": (edited(5, ",4,0", ",5,0"), r"line 5, order: expected a whole number, 1 to 4, got '5'"),
    "item": (edited(3, "00000000000b", "00000000000e"), r"line 3, item: expected a name in items.json, got '0+e'"),
    "labels": (edited(3, ">fear", ">anger"), r"line 3, labels: expected 'neutral>fear', got 'neutral>anger'"),
    "nat": (edited(2, ",6,5,", ",11,5,"), r"line 2, nat: expected a whole number, 0 to 10, got '11'"),
    "half": (edited(2, ",6,5,", ",6.5,5,"), r"line 2, nat: expected a whole number, 0 to 10, got '6.5'"),
    "lab": (edited(2, ",6,5,", ",6,,"), r"line 2, lab: expected a whole number, 0 to 10, got ''"),
    "seconds": (edited(2, "12.5", "nan"), r"line 2, seconds: expected a number, 0 or more, got 'nan'"),
    "twice": (lambda lines: [*lines, lines[1]], r"line 6, item: expected one answer, got '0+a' again, after .*line 2"),
    "missing": (lambda lines: lines[:-1], r"line 4, item: expected 4 answers of each participant, got 3"),
    "nothing": (lambda lines: lines[:1], r"line 1, item: expected 4 answers of each participant, got 0"),
    "quotes": (lambda lines: [*lines[:2], '"a"b'], r"expected comma-separated UTF-8 text, got something else"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_malformed_file_is_refused_by_file_line_and_field(tmp_path, name):
    change, message = WRONG[name]
    folder = write(tmp_path / "scores", p=change(answers(P, (6, 8, 4, 10))))
    with pytest.raises(ValueError, match=message) as caught:
        _study.read_scores([folder], STUDY)
    assert str(caught.value).startswith(str(folder / "p.csv")) and "\n" not in str(caught.value)


def test_the_same_file_twice_is_refused(tmp_path):
    folder = write(tmp_path / "scores", p=answers(P, (6, 8, 4, 10)), p_copy=answers(P, (6, 8, 4, 10)))
    with pytest.raises(ValueError, match=r"p_copy.csv, line 2, item: expected one answer, got .*p.csv, line 2"):
        _study.read_scores([folder], STUDY)
    (folder / "p_copy.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match=r"p_copy.csv: expected comma-separated UTF-8 text"):
        _study.read_scores([folder], STUDY)


def test_a_byte_order_mark_is_forgiven(tmp_path):
    folder = write(tmp_path / "scores", p=answers(P, (6, 8, 4, 10)))
    (folder / "p.csv").write_text((folder / "p.csv").read_text(), "utf-8-sig")
    assert len(_study.read_scores([folder / "p.csv"], STUDY)) == 4


def test_without_scores_or_items_no_table_is_made(tmp_path):
    config = user_study.Config(out=tmp_path, scores=(str(write(tmp_path / "scores")),))
    for text in (None, "{", "[]", '{"version": "a", "items": {"b": {"kind": "real"}}}'):
        if text is not None:
            (tmp_path / "items.json").write_text(text)
        with pytest.raises(ValueError, match=r"items.json cannot be read .* written with the page"):
            user_study.run(config)
    (tmp_path / "items.json").write_text(json.dumps(STUDY))
    with pytest.raises(ValueError, match="--scores: expected files of participants, found none"):
        user_study.run(config)
    assert not (tmp_path / "table.md").exists()


def test_the_command_refuses_in_one_line(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(runtime, "configure", lambda: None)
    (tmp_path / "items.json").write_text(json.dumps(STUDY))
    folder = write(tmp_path / "scores", p=answers(P, (6, 8, 4, 10)), q=answers(Q, (6, 8, 4, 12)))
    files = [str(folder / f"{name}.csv") for name in "pq"]
    monkeypatch.setattr(sys, "argv", ["user_study", "--out", str(tmp_path), "--scores", *files])
    with pytest.raises(SystemExit) as left:
        _run.main("user_study", user_study.Config, user_study.run)
    said = capsys.readouterr().err.splitlines()
    assert left.value.code == 2 and len(said) == 1
    assert said[0].endswith("q.csv, line 5, nat: expected a whole number, 0 to 10, got '12'")


# The page's script.


def node(*arguments):
    if shutil.which("node") is None:
        pytest.skip("Node is not installed")
    done = subprocess.run(["node", *arguments], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


def script(out, name):
    return re.search(rf'<script id="{name}">(.*?)</script>', (out / "page.html").read_text("utf-8"), re.DOTALL)[1]


def test_the_scripts_parse(made, tmp_path):
    for name in ("logic", "page"):
        (tmp_path / f"{name}.js").write_text(script(made[0], name), "utf-8")
        node("--check", str(tmp_path / f"{name}.js"))


DRIVER = """
const study = JSON.parse(require("fs").readFileSync(process.argv[2], "utf-8"));
const state = logic.fresh(study, [4000000000, 17, 4294967295]), ids = study.items.map(item => item.id);
const order = logic.shuffled(ids, state.seed), texts = [];
const keeps = state => logic.restored(study, JSON.stringify(state)) !== null;
order.forEach((id, i) => {
  const answer = state.answers[id] = {nat: null, lab: 0, seconds: 1.25, seen: false};
  texts.push([logic.missing(answer)]);
  answer.seen = true;
  texts[i].push(logic.missing(answer));
  answer.nat = i % 11;
  texts[i].push(logic.missing(answer));
});
const last = state.answers[order.at(-1)];
console.log(JSON.stringify({
  order, ids, texts, csv: logic.csv(study, state), restored: logic.restored(study, JSON.stringify(state)), state,
  orders: [state.seed, 1, 2, 3].map(seed => logic.shuffled(ids, seed)),
  kept: [
    keeps({...state, at: ids.length}), keeps({...state, at: ids.length + 1}), keeps({...state, version: "other"}),
    keeps({...state, participant: "x"}), keeps({...state, seed: -1}), keeps({...state, answers: null}),
    keeps({...state, at: ids.length, answers: {...state.answers, [order.at(-1)]: {...last, seen: false}}}),
    keeps({...state, answers: {...state.answers, [order[0]]: {...last, nat: 11}}}),
    keeps({...state, answers: {...state.answers, other: last}}), keeps(null),
  ],
}));
"""


def test_the_logic_shuffles_keeps_and_writes_what_is_read(made, tmp_path):
    out, _ = made
    (tmp_path / "drive.js").write_text(script(out, "logic") + DRIVER, "utf-8")
    (tmp_path / "study.json").write_text(json.dumps(study_of(out)))
    found = json.loads(node(str(tmp_path / "drive.js"), str(tmp_path / "study.json")))
    assert sorted(found["order"]) == found["ids"] and found["orders"][0] == found["order"]
    assert len({tuple(order) for order in found["orders"]}) > 1
    watch, score = "Please watch the animation to its end.", "Please give both scores."
    assert found["texts"] == [[watch, score, ""]] * len(found["ids"])
    assert found["restored"] == found["state"] and found["kept"] == [True] + [False] * 9
    (tmp_path / "scores.csv").write_text(found["csv"])
    read = _study.read_scores([tmp_path / "scores.csv"], _study.read_items(out / "items.json"))
    assert [answer.nat for answer in read] == list(range(len(found["ids"]))) and {a.lab for a in read} == {0}
    assert {answer.participant for answer in read} == {"00000011ffff"}
    rows = [line.split(",") for line in found["csv"].splitlines()[1:]]
    assert [row[4] for row in rows] == found["order"] and {row[1] for row in rows} == {"4000000000"}


BROWSE = """
const {chromium} = require("playwright-core");
const [path, folder, program] = process.argv.slice(1);
(async () => {
  const browser = await chromium.launch({executablePath: program, args: ["--no-sandbox"]});
  const context = await browser.newContext(), found = {errors: [], requests: [], gates: []};
  const open = async () => {
    const tab = await context.newPage();
    tab.on("console", message => found.errors.push(message.text()));
    tab.on("pageerror", error => found.errors.push(error.message));
    tab.on("request", request => /^(file|data|blob):/.test(request.url()) || found.requests.push(request.url()));
    await tab.goto("file://" + path);
    return tab;
  };
  const ready = (tab, id) => tab.waitForFunction(id => !document.getElementById(id).disabled, id);
  let tab = await open();
  found.gates.push(await tab.isDisabled("#begin"));
  await ready(tab, "begin");
  await tab.click("#begin");
  const count = await tab.evaluate(() => order.length);
  for (let i = 0; i < count; i++) {
    await tab.check(`#nat input[value="${i}"]`, {force: true});
    found.gates.push(await tab.isDisabled("#next"));
    await tab.check('#lab input[value="10"]', {force: true});
    await ready(tab, "next");
    if (i === 1) {
      await tab.click("#back");
      found.back = await tab.isChecked('#nat input[value="0"]');
      await tab.click("#next");
      await tab.close();
      tab = await open();
      found.resumed = await tab.textContent("#place");
    }
    await tab.click("#next");
  }
  const [file] = await Promise.all([tab.waitForEvent("download"), tab.click("#download")]);
  await file.saveAs(folder + "/scores.csv");
  console.log(JSON.stringify(found));
  await browser.close();
})();
"""


@pytest.mark.browser
def test_the_page_in_chromium(made, tmp_path):
    programs = [path for path in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if path]
    package = ["node", "-e", "require.resolve('playwright-core')"]
    if not programs or not shutil.which("node") or subprocess.run(package, cwd=ROOT, capture_output=True).returncode:
        pytest.skip("Chromium, Node or npm's playwright-core is not installed")
    out, _ = made
    found = json.loads(node("-e", BROWSE, str(out / "page.html"), str(tmp_path), programs[0]))
    assert found["errors"] == [] and found["requests"] == []
    assert all(found["gates"]) and found["back"] and found["resumed"] == "Animation 2 of 7"
    read = _study.read_scores([tmp_path / "scores.csv"], _study.read_items(out / "items.json"))
    assert [answer.nat for answer in read] == list(range(7)) and {answer.lab for answer in read} == {10}
