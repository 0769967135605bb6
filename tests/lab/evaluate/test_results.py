"""The command on many sets and rows, and the files and the page that it leaves."""

import json
import re

import pytest
from generated_sets import make_set

from edgevpr.cli.main import main

pytestmark = [pytest.mark.process, pytest.mark.slow]

NASTY = "<script>alert(1)</script><img src=http://example.test/x.png>"
PLAN = f"""
sets:
  meadow: {{folder: meadow}}
  "{NASTY}": {{folder: meadow, camera: nadir}}
rows:
  cohog: {{technique: cohog, parameters: {{w1: 208}}}}
  "hog|{NASTY}": {{technique: hog, parameters: {{w1: 64}}, form: 1bit}}
"""


def run(*argv):
    return main(["eval", *map(str, argv)])


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    """A folder with the results of two sets by two rows."""
    folder = tmp_path_factory.mktemp("results")
    make_set(folder / "meadow")
    (folder / "plan.yaml").write_text(PLAN)
    assert run("--sets", folder / "plan.yaml", "--out", folder / "out", "--workers", "1") == 0
    return folder / "out"


def test_every_result_says_who_made_it(out):
    content = json.loads((out / "results.json").read_text())
    assert len(content["results"]) == 4
    for each in content["results"]:
        made = each["made"]
        assert made["machine"]["cpu"] == content["machine"]["cpu"]
        assert made["versions"]["numpy"]
        assert made["versions"]["edgevpr"] == content["versions"]["edgevpr"]
        assert re.fullmatch(r"\d{4}-\d\d-\d\d", made["date"])
        assert each["queries"] == 5
        assert each["recall_at_k"][0] == each["recall_at_1"]
        assert each["recall_at_k"] == sorted(each["recall_at_k"])
        assert each["pcu"] > 0


def test_the_page_shows_curves_costs_and_matches(out):
    page = (out / "index.html").read_text()
    assert page.count('<div class="match wrong">') >= 4
    scores = re.findall(r'<div class="match wrong"><p>.*?score ([\d.e-]+)', page.split("<details")[1])
    assert list(map(float, scores)) == sorted(map(float, scores), reverse=True)
    first = re.search(r'<div class="match wrong">.*?</div></div>', page)[0]
    assert re.findall(r'src="data:image/jpeg;base64,[^"]+"><figcaption>(\w+): ', first) == ["query", "found", "right"]
    assert "<script" not in page


def test_what_could_not_be_measured_is_said_everywhere(tmp_path, capsys):
    broken = make_set(tmp_path / "broken")
    (broken / "ref" / "r1.png").write_bytes(b"")
    flags = ["--techniques", "hog", "--param", "hog.w1=64", "--workers", "1"]
    assert run("--data", broken, "--out", tmp_path / "out", *flags) == 1
    assert "broken, hog" in capsys.readouterr().err
    assert json.loads((tmp_path / "out" / "results.json").read_text())["failed"][0]["set"] == "broken"
    assert "r1.png" in (tmp_path / "out" / "index.html").read_text()


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["--data", "SET", "SET"], "--out"),
        (["--sets", "plan.yaml"], "--out"),
        (["--data", "SET", "--workers", "2"], "--out"),
        (["--out", "out"], "--data"),
        (["--sets", "plan.yaml", "--data", "SET", "--out", "out"], "--rate-hz"),
        (["--sets", "gone.yaml", "--out", "out"], "gone.yaml"),
        (["--data", "gone", "--out", "out"], "gone"),
        (["--data", "SET", "--out", "out", "--techniques", "cohogg"], "cohogg"),
        (["--data", "SET", "--out", "out", "--salience"], "--salience"),
    ],
)
def test_a_wrong_request_gets_one_sentence(out, tmp_path, monkeypatch, capsys, argv, said):
    monkeypatch.chdir(tmp_path)
    meadow = str(out.parent / "meadow")
    assert run(*[meadow if each == "SET" else each for each in argv]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert "Traceback" not in err
