"""The table and the page of a stability result: what they say, and what becomes of hostile names."""

from __future__ import annotations

from dataclasses import replace

import pytest

from reports import write_report
from reports.stability_chart import error_map
from reports.stability_page import write_stability_page
from reports.stability_reasons import reason
from reports.stability_table import tables
from reports.stability_text import stability_text
from tests.reports.synthetic_run import complete_run
from tests.reports.test_page import EVIL, Reader
from vtfs.stability.record import RungResult, StabilityResult, Verdict, write_result

NOTHING = Verdict()


def wrong(n: int, of: int = 1000) -> Verdict:
    return Verdict(n, 0, n, 0, n / of)


def rung(ladder: str, label: str, **verdicts: Verdict) -> RungResult:
    return RungResult(ladder, f"Title of {ladder}", "built-in", "shadow", label, 1000, 600, 400, verdicts)


def a_result(*rungs: RungResult) -> StabilityResult:
    return StabilityResult({"name": "built-in"}, 0, "a cpu", {"vtfs": "0.1"}, len(rungs), 3.0, rungs)


RESULT = a_result(
    rung("nested", "1", z_pass=NOTHING, z_fail=NOTHING, ptsv=NOTHING, other=NOTHING),
    rung("nested", "2", z_pass=wrong(4), z_fail=NOTHING, ptsv=NOTHING, other=NOTHING),
    rung("nested", "3", z_pass=NOTHING, z_fail=NOTHING, ptsv=NOTHING, other=NOTHING),
    rung("nested", "4", z_pass=wrong(70), z_fail=NOTHING, ptsv=NOTHING, other=NOTHING),
    rung("nested", "5", z_pass=wrong(50), z_fail=NOTHING, ptsv=NOTHING, other=Verdict(refused="too large")),
    replace(rung("far", "1", z_pass=NOTHING, z_fail=NOTHING, ptsv=NOTHING, other=NOTHING), shadowed=0, lit=1000),
    rung("aim", "1", z_pass=NOTHING, z_fail=wrong(9), ptsv=wrong(9), other=NOTHING),
)


def test_each_cell_names_where_it_is_wrong_and_how_badly():
    (table,) = tables(RESULT)
    assert [column.name for column in table.ladders] == ["nested", "aim"]
    assert [(column.name, column.only_lit) for column in table.quiet] == [("far", ("1",))]
    rows = {row.methods: row for row in table.rows}
    assert set(rows) == {("z_pass",), ("z_fail", "ptsv"), ("other",)}  # those with the same cells as one
    nested, aim = rows[("z_pass",)].cells
    assert (nested.state, nested.where, nested.worst, nested.worst_share) == ("fails", "at 2, from 4", "4", 0.07)
    assert aim.state == "holds" and rows[("z_pass",)].state == "fails"
    assert rows[("z_fail", "ptsv")].cells[1].state == "few"
    assert rows[("other",)].cells[0].text == "refused at 5"
    assert [row.methods[0] for row in table.rows] == ["other", "z_fail", "z_pass"]  # the most fragile last


def test_reasons_are_given_where_known_and_only_for_what_was_measured():
    (table,) = tables(RESULT)
    rows = {row.methods[0]: row for row in table.rows}
    assert "No reason is known" in rows["z_pass"].why
    assert "rounding of a vertex" in rows["z_fail"].why
    assert reason("shadow", "z_fail, 8 bits wrapping", "nested") == "256 volumes count as none."
    (alone,) = tables(a_result(rung("nested", "1", z_pass=NOTHING)))
    assert alone.rows[0].why == "Right on every rung." and not alone.ladders


def test_the_text_has_every_method_and_every_failure():
    text = stability_text(replace(RESULT, planned=9))
    assert "z_fail; ptsv" in text and "nested at 2, from 4 (7.0\u00a0% at 4)" in text and "7 of 9 rungs" in text


def test_the_chart_has_a_dot_where_a_method_first_fails():
    figure = error_map(RESULT, "shadow", "built-in")
    assert figure is not None
    heat, dots = figure.data
    assert len(heat.z) == 4 and len(heat.z[0]) == 7  # type: ignore[attr-defined]
    assert set(zip(dots.x, dots.y, strict=True)) == {(1, "z_pass"), (6, "z_fail"), (6, "ptsv")}  # type: ignore[attr-defined]
    assert error_map(RESULT, "light", "built-in") is None


def test_the_page_says_it_in_words(tmp_path):
    write_result(tmp_path, replace(RESULT, planned=9))
    page = write_stability_page(tmp_path).read_text(encoding="utf-8")
    text = Reader(page).text
    assert "at 2, from 4" in text and "7.0 % at 4" in text and "holds" in text
    assert "This run was not finished: 7 of 9 rungs" in text
    assert "On title of far at 1 every sample is lit" in text
    assert "http://" not in page.split("<script>")[0] and "src=" not in page.split("<script>")[0]


def test_hostile_names_stay_text(tmp_path):
    write_result(tmp_path, a_result(replace(rung("nested", EVIL), verdicts={EVIL: wrong(90)}, title=EVIL, source=EVIL)))
    page = write_stability_page(tmp_path).read_text(encoding="utf-8")
    assert "<script>alert(1)" not in page and "<img src=x" not in page and Reader(page).text.count("{{ 7 * 7 }}") >= 2


@pytest.mark.parametrize("with_result", [True, False])
def test_the_report_of_a_run_takes_in_what_lies_in_its_folder(tmp_path, with_result):
    folder = complete_run().write(tmp_path)
    if with_result:
        write_result(folder, RESULT)
    reader = Reader(write_report(folder).read_text(encoding="utf-8"))
    assert ("at 2, from 4" in reader.text) == with_result
    assert any(a.get("id") == "stability" for tag, a in reader.elements if tag == "section") == with_result
