"""The page of `make bench`: what it compares, what it marks, and that it goes on where it was."""

import importlib.util
import sys
from pathlib import Path

import pytest

_PATH = Path(__file__).parents[1] / "benchmarks" / "page.py"
_SCRIPT = """
import csv, os, sys
from pathlib import Path
out = Path(sys.argv[sys.argv.index("--out") + 1])
out.mkdir(parents=True, exist_ok=True)
with Path("ran").open("a") as file:
    file.write("x")
if os.environ.get("FAIL"):
    sys.exit(3)
fast = float(os.environ["FAST"])
with (out / "fake.csv").open("w") as file:
    rows = [("what", "size", "s", "speed"), ("walk", "0.50", 2 / fast, 1000 * fast), ("rest", "1", "", 5)]
    csv.writer(file).writerows(rows)
(out / "fake.png").write_bytes(b"picture")
"""


def loaded(monkeypatch):
    spec = importlib.util.spec_from_file_location("bench_page", _PATH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "bench_page", module)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def page(monkeypatch, tmp_path):
    module = loaded(monkeypatch)
    (tmp_path / "fake.py").write_text(_SCRIPT)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(module, "_HERE", tmp_path)
    section = module.Section("Fakes", "fake", ("what", "size"), {"s": "s", "speed": "steps/s"})
    monkeypatch.setattr(module, "SECTIONS", (section,))
    monkeypatch.setattr(module, "_jitter", lambda: 0.01)
    return module


def written(page, monkeypatch, commit, fast):
    monkeypatch.setenv("FAST", str(fast))
    monkeypatch.setattr(page, "commit_of", lambda _: commit)
    page.main(Path("bench"))
    return Path("bench", commit, "bench.md").read_text()


def test_every_figure_stands_beside_its_ratio_to_the_last_page_and_above_one_is_better(page, monkeypatch):
    first = written(page, monkeypatch, "aaaa", 1)
    assert "There is no page to compare with." in first
    assert "| walk, 0.5 | 2 s | – | 1,000 steps/s | – |" in first
    assert "| rest, 1 | – | – | 5 steps/s | – |" in first
    second = written(page, monkeypatch, "bbbb", 4)
    assert "Ratios are to aaaa; above 1 is better." in second
    assert "| walk, 0.5 | 0.5 s | 4.00 | 4,000 steps/s | 4.00 |" in second
    assert "| rest, 1 | – | – | 5 steps/s | 1.00 |" in second
    assert "![Fakes](fake/fake.png)" in second


def test_what_is_measured_is_not_measured_again_for_the_same_commit(page, monkeypatch):
    first = written(page, monkeypatch, "aaaa", 1)
    assert written(page, monkeypatch, "aaaa", 7) == first
    assert Path("ran").read_text() == "x"


@pytest.mark.parametrize("commit", ["none", "aaaa-dirty"])
def test_what_no_commit_names_is_measured_again(page, monkeypatch, commit):
    written(page, monkeypatch, commit, 1)
    assert "| walk, 0.5 | 1 s |" in written(page, monkeypatch, commit, 2)


def test_a_benchmark_that_fails_is_named_and_runs_again_the_next_time(page, monkeypatch):
    monkeypatch.setenv("FAIL", "1")
    assert "It failed; see what it printed." in written(page, monkeypatch, "aaaa", 1)
    monkeypatch.delenv("FAIL")
    assert "| walk, 0.5 | 2 s |" in written(page, monkeypatch, "aaaa", 1)


def test_a_section_that_does_not_exist_is_refused_with_the_names_of_those_that_do(page):
    with pytest.raises(SystemExit, match="no such section: fkae; there are fake"):
        page.main(Path("bench"), ("fkae",))


def test_every_section_is_a_script_with_the_options_and_columns_that_it_is_asked_for(monkeypatch):
    for section in loaded(monkeypatch).SECTIONS:
        source = (_PATH.parent / f"{section.script}.py").read_text()
        for option in (*section.arguments, *section.quick, "--out"):
            if option.startswith("--"):
                assert f"{option[2:].replace('-', '_')}: " in source, (section.script, option)
        for column in (*section.keys, *section.figures):
            assert column in source, (section.script, column)
