"""The page in a real browser: Chromium, headless."""

import re

import pytest

from reports import write_report
from tests.reports.chromium import Chromium, find_chromium
from tests.reports.synthetic_run import complete_run, run_inside_the_noise, run_of_one, run_without_times

pytestmark = pytest.mark.browser

CHARTS = ["speed-against-error", "stage-times", "predicted-against-measured", "time-along-parameters"]


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    program = find_chromium()
    assert program, "no chromium on the PATH: install it, or leave out `-m browser`"
    with Chromium(program, tmp_path_factory.mktemp("chromium") / "profile") as browser:
        yield browser


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    return write_report(complete_run().write(tmp_path_factory.mktemp("run")))


def column(browser, label):
    """The texts of a column of the table of measurements, as they stand."""
    return browser.evaluate(
        "(() => { const t = document.getElementById('measurement-table');"
        f" const i = [...t.tHead.rows[0].cells].findIndex(c => c.textContent.trim() === '{label}');"
        " return [...t.tBodies[0].rows].map(r => r.cells[i].textContent.trim()); })()"
    )


def header(browser, label):
    """A selector for the button of a column."""
    i = browser.evaluate(
        f"[...document.querySelectorAll('#measurement-table th')].findIndex(c => c.textContent.trim() === '{label}')"
    )
    return f"#measurement-table th:nth-child({i + 1}) button"


def as_number(text):
    return float(text.replace(",", ""))


@pytest.mark.parametrize(
    "make", [complete_run, run_inside_the_noise, run_of_one, run_without_times], ids=lambda make: make.__name__
)
def test_it_opens_without_complaints_and_without_the_network(browser, tmp_path, make):
    browser.open(write_report(make().write(tmp_path)))
    assert browser.complaints() == []
    asked = [event["request"]["url"] for event in browser.seen("Network.requestWillBeSent")]
    assert [url for url in asked if not url.startswith("data:")] == [(tmp_path / "report.html").as_uri()]


@pytest.mark.parametrize("chart", CHARTS)
def test_a_chart_is_drawn(browser, page, chart):
    browser.open(page)
    width, height = browser.evaluate(
        f"(() => {{ const r = document.querySelector('#{chart} .main-svg').getBoundingClientRect();"
        " return [r.width, r.height]; })()"
    )
    assert width > 500
    assert height > 200
    assert browser.evaluate(f"document.querySelectorAll('#{chart} .trace').length") >= 3
    marks = f"document.querySelectorAll('#{chart} .point path, #{chart} path.point, #{chart} .bars path').length"
    assert browser.evaluate(marks) > 3


@pytest.mark.parametrize("width_px", [1366, 1920, 800])
def test_nothing_sticks_out_of_the_window(browser, page, width_px):
    browser.open(page, width_px=width_px)
    assert browser.evaluate("document.documentElement.scrollWidth <= document.documentElement.clientWidth")
    assert browser.evaluate(
        "[...document.querySelectorAll('.js-plotly-plot')].every(c => c.querySelector('.main-svg')"
        ".getBoundingClientRect().right <= c.parentElement.getBoundingClientRect().right + 1)"
    )


def test_the_answer_is_on_the_first_screen(browser, page):
    browser.open(page, width_px=1366, height_px=768)
    assert browser.evaluate("document.querySelector('.facts').getBoundingClientRect().bottom") < 768


def test_a_click_sorts_by_numbers_and_another_one_the_other_way(browser, page):
    browser.open(page)
    times = column(browser, "slowest frame, ms")
    timed = sorted((text for text in times if text != "–"), key=as_number)
    assert times != [*timed, "–", "–"]
    button = header(browser, "slowest frame, ms")
    browser.click(button)
    assert column(browser, "slowest frame, ms") == [*timed, "–", "–"]
    assert browser.evaluate("document.querySelectorAll('#measurement-table [aria-sort]').length") == 1
    assert browser.evaluate(f"document.querySelector('{button}').parentElement.ariaSort") == "ascending"
    browser.click(button)
    # Failures last, this way too.
    assert [as_number(text) for text in column(browser, "slowest frame, ms")[:-2]] == [
        as_number(text) for text in timed[::-1]
    ]
    assert column(browser, "slowest frame, ms")[-2:] == ["–", "–"]
    assert browser.evaluate(f"document.querySelector('{button}').parentElement.ariaSort") == "descending"
    assert browser.complaints() == []


def test_the_keyboard_sorts_too(browser, page):
    browser.open(page)
    browser.evaluate(f"document.querySelector('{header(browser, 'technique')}').focus()")
    browser.press("Enter")
    techniques = column(browser, "technique")
    assert techniques == sorted(techniques)
    browser.press("Enter")
    assert column(browser, "technique") == techniques[::-1] == sorted(techniques, reverse=True)


def test_the_filter_shows_rows_with_every_word_and_print_shows_all(browser, page):
    browser.open(page)
    shown = "[...document.querySelectorAll('#measurement-table tbody tr')].filter(r => r.offsetHeight > 0).length"
    browser.click("#filter")
    browser.type_text("BVH memory")
    assert browser.evaluate(shown) == 1
    assert browser.evaluate("document.querySelector('output').textContent") == "1 of 24"
    browser.call("Emulation.setEmulatedMedia", {"media": "print"})
    try:
        assert browser.evaluate(shown) == 24
    finally:
        browser.call("Emulation.setEmulatedMedia", {"media": ""})
    assert browser.evaluate(shown) == 1


def test_a_picture_is_enlarged_and_closed(browser, page):
    browser.open(page)
    is_open = "document.getElementById('enlarged').open"
    browser.click("button.enlarge")
    assert browser.evaluate(is_open)
    assert browser.evaluate("document.querySelector('#enlarged img').naturalWidth") == 320
    browser.press("Escape")
    assert not browser.evaluate(is_open)


def test_it_prints(browser, page):
    browser.open(page)
    browser.click(header(browser, "slowest frame, ms"))
    printed = browser.pdf()
    assert printed.startswith(b"%PDF-")
    # Skia writes its page objects as plain text.
    assert 5 <= len(re.findall(rb"/Type\s*/Page\b", printed)) <= 12
    assert len(printed) > 50_000
    # Afterwards the charts fill the window again.
    filled = browser.evaluate(
        "new Promise(resolve => setTimeout(resolve, 300)).then(() => document.querySelector('#stage-times .main-svg')"
        ".getBoundingClientRect().width / document.getElementById('stages').clientWidth)"
    )
    assert filled == pytest.approx(1, abs=0.01)
    assert browser.complaints() == []


def test_charts_and_tables_fit_on_paper(browser, page):
    """In the width of an upright A4 page less its margins, with the styles for print."""
    browser.open(page, width_px=688)
    browser.call("Emulation.setEmulatedMedia", {"media": "print"})
    try:
        browser.evaluate("dispatchEvent(new Event('beforeprint'))")
        too_wide = (
            "[...document.querySelectorAll('.main-svg, section:not(#measurements) table, .pictures, .facts')]"
            ".filter(e => e.getBoundingClientRect().right > 689).map(e => e.className.baseVal ?? e.className)"
        )
        assert browser.evaluate(too_wide) == []
    finally:
        browser.call("Emulation.setEmulatedMedia", {"media": ""})
