# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import json
import operator

import pytest

from benchmarks import report

NUMBERS = [(number, 2) for number in range(5)]


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_in_the_order_of_the_cases_on_any_number_of_jobs(tmp_path, jobs, monkeypatch):
    for name in report._ONE_THREAD:
        monkeypatch.setenv(name, "1")
    assert report.each(operator.pow, NUMBERS, jobs=jobs, table=tmp_path / "powers.json") == [0, 1, 4, 9, 16]


def test_what_was_done_before_an_interruption_is_kept_until_the_table_is_there(tmp_path):
    table = tmp_path / "quotients.json"
    with pytest.raises(ZeroDivisionError):
        report.each(operator.truediv, [(4, 2), (1, 0)], jobs=1, table=table)
    kept = report.results_of(table)
    assert [json.loads(line) for line in kept.read_text().splitlines()] == [[["4", "2"], 2.0]]
    report.save(table, report.Table("Quotients", "", {}))
    assert not kept.exists()


def test_a_page_says_which_table_was_made_where(tmp_path, monkeypatch):
    paths = [tmp_path / f"{name}.json" for name in ("one", "other")]
    for path in paths:
        monkeypatch.setattr(report, "machine", lambda path=path: f"machine {path.stem}")
        report.save(path, report.Table(path.stem.title(), "", {}))
    assert "Here: machine one (One); machine other (Other)." in report.page("head", paths)
    assert "Here: machine one.\n" in report.page("head", paths[:1])
