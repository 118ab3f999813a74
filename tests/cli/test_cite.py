"""``vislam cite`` prints BibTeX for what an estimator's or a format's own module says it rests on."""

import re
from pathlib import Path

from toolkit.cli import main
from toolkit.datasets import formats
from toolkit.registry import discover
from toolkit.report.citations import bibtex, citations, references

MINE = '''"""A filter of somebody's own, in one file."""

CITES = ("li2013high", """@misc{mine2026,
  author = {Somebody},
  title = {A {Filter}}
}""")


def build(setup):
    raise NotImplementedError
'''


def test_every_estimator_and_every_format_of_recorded_data_says_what_to_cite():
    # What these hold was published by nobody, or is the user's own.
    own = {"vislam-recording", "own-tables", "bags", "course-npy"}
    names = {*discover(), *formats()} - own
    assert not [name for name in names if not any(citations([name]).values())]


def test_every_reference_is_used_and_whole():
    used = {key for entries in citations([]).values() for key in entries}
    assert used == references().keys()
    for key, text in references().items():
        assert text.count("{") == text.count("}"), key
        assert re.search(r"^  title = ", text, re.MULTILINE), key


def test_an_entry_stands_once_and_may_be_that_of_a_file_of_ones_own(tmp_path):
    path = tmp_path / "my_filter.py"
    path.write_text(MINE)
    text = bibtex(citations(["msckf", str(path), "msckf-fej"]))
    assert "% my-filter\n@misc{mine2026" in text
    assert text.count("mourikis2007msckf") == 1
    assert "% msckf, msckf-fej\n@inproceedings{mourikis2007msckf" in text
    assert "% the toolkit\n@software{vislam_toolkit" in text


def test_a_run_directory_stands_for_what_it_compared(tmp_path):
    documents = Path(__file__).parents[1] / "report" / "documents"
    (tmp_path / "manifest.json").write_text((documents / "manifest.json").read_text())
    assert list(citations([str(tmp_path)]))[:2] == ["dead-reckoning", "ekf"]


def test_a_reference_that_there_is_not_is_reported_in_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text('CITES = ("li2013hihg",)')
    assert main(["cite", "mine.py"]) == 5
    printed = capsys.readouterr().err
    assert "did you mean li2013high?" in printed
    assert printed.count("\n") == 1
