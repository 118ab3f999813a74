"""What programs read: one JSON document a sequence on standard output, or nothing at all."""

import json

import pytest

from toolkit.cli import main

QUICK = ("--max-frames", "6", "--workers", "1", "--figures", "none")
COMPARE = ("compare", "drive", "--estimators", "dead-reckoning", *QUICK)


@pytest.mark.usefixtures("audited_once", "unrendered")
def test_compare_prints_its_document_or_nothing(tmp_path, capsys) -> None:
    assert main([*COMPARE, "--json", "--out", str(tmp_path / "run")]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert json.loads(line) == json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert main([*COMPARE, "--quiet", "--out", str(tmp_path / "run")]) == 0
    assert capsys.readouterr().out == ""


def test_json_and_quiet_exclude_each_other(capsys) -> None:
    for command in (COMPARE, ("evaluate", "a", "b"), ("verify", "ekf"), ("reproduce", "x.zip")):
        with pytest.raises(SystemExit) as left:
            main([*command, "--json", "--quiet"])
        assert left.value.code == 2
        assert "not allowed with" in capsys.readouterr().err
