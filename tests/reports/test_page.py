import json
import re
import subprocess
import sys
from html.parser import HTMLParser

import pytest

import reports
from reports import write_report
from tests.reports.synthetic_run import complete_run, run_inside_the_noise, run_of_one, run_without_times
from vtfs.input_error import InputError

EVIL = "</script><script>alert(1)</script><img src=x onerror=alert(2)> {{ 7 * 7 }}"


class Reader(HTMLParser):
    """The elements of a page with their attributes, and the text outside scripts and styles."""

    def __init__(self, page):
        super().__init__()
        self.elements = []
        self.texts = []
        self._inside = ""
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        self._inside = tag

    def handle_data(self, data):
        if self._inside not in ("script", "style"):
            self.texts.append(data)

    def handle_endtag(self, tag):
        self._inside = ""

    @property
    def text(self):
        return " ".join(" ".join(self.texts).replace("\u00a0", " ").split())


def page_of(files, folder):
    return write_report(files.write(folder)).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    return page_of(complete_run(), tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def reader(page):
    return Reader(page)


def test_it_is_written_beside_what_it_was_made_from(tmp_path):
    folder = complete_run().write(tmp_path)
    before = sorted(path.name for path in folder.iterdir())
    assert write_report(folder) == folder / "report.html"
    assert sorted(path.name for path in folder.iterdir()) == sorted([*before, "report.html"])


def test_the_recommendation_is_one_sentence_with_gain_interval_and_claim(reader):
    assert re.search(
        r"Use volume_tiled_bvh with depth_slices = 32 and branching = 16 : [\d.]+ ms "
        r"\(95 % interval [\d.]+ to [\d.]+ ms\) a frame, [\d.]+× \([\d.]+ to [\d.]+\) as fast as its own defaults and "
        r"[\d.]+× \([\d.]+ to [\d.]+\) as fast as the fastest default, that of tiled_deferred, "
        r"for this JAX implementation on this device; nothing is rasterised: frame times start at view samples\.",
        reader.text,
    )


def test_every_part_is_there(reader):
    ids = {attributes.get("id") for _, attributes in reader.elements}
    assert {"answer", "pictures", "speed", "stages", "model", "counts", "measurements", "provenance"} <= ids
    assert {"speed-against-error", "stage-times", "predicted-against-measured", "time-along-parameters"} <= ids
    assert "list-lengths" in ids
    for said in (
        "stages need not add up to it",
        "908,412,000",
        "1.87 ns",
        "dropped at a cap of 64",
        "77,000",
        "light_cluster_pairs 5.8 %",
        "cpu: AMD EPYC 9654 (2 cores)",
        "vtfs tune --lights 1000 --size 1280x720 --seed 0",
        "jaxlib 0.10.2",
        "predicted gain 1.2 % is inside the noise (3.4 %)",
        "only its default: counts say 908,412,000 lighting computations, 24 times the least",
        "needs <more> than 64 levels & stopped",
    ):
        assert said in reader.text


def test_one_light_is_one_and_sentences_stand_apart(tmp_path):
    files = complete_run()
    files.result.update({"kind": "shadows", "max_error": 0.01})
    files.result["scene"] |= {"lights": 1, "shadow_lights": 1}
    text = Reader(page_of(files, tmp_path)).text
    assert ", 1 light, 1 of them with shadows" in text and ", 1 lights" not in text
    assert "are another job. Only images with an error up to" in text


def test_nothing_is_asked_of_the_network(page, reader):
    addresses = [
        value for _, attributes in reader.elements for name, value in attributes.items() if name in ("src", "href")
    ]
    assert len(addresses) > 10
    assert all(re.match(r"data:|#", address) for address in addresses)
    style = re.search(r"<style>(.*?)</style>", page, re.S)
    assert style
    assert not re.search(r"@import|url\(", style[1])
    policy = next(a["content"] for _, a in reader.elements if a.get("http-equiv") == "Content-Security-Policy")
    assert "default-src 'none'" in policy
    assert '"displaylogo": false' in page
    assert '"showSendToCloud": false' in page


def test_plotly_is_there_once_and_does_not_end_its_script(page, reader):
    assert page.count("plotly.js v") == 1
    assert page.count("</script>") == sum(tag == "script" for tag, _ in reader.elements)


def test_every_picture_and_chart_is_described(reader):
    pictures = [a for tag, a in reader.elements if tag == "img" and "src" in a]
    assert len(pictures) == 6
    assert all(a["alt"] for a in pictures)
    assert sum(a.get("role") == "img" and len(a.get("aria-label", "")) > 20 for _, a in reader.elements) == 6


def test_what_files_say_cannot_break_out(tmp_path):
    files = complete_run()
    files.result["scene"]["name"] = files.result["command"] = files.result["device"] = EVIL
    files.result["pictures"][0]["caption"] = EVIL
    files.result["versions"][EVIL] = EVIL
    files.result["stop_reason"] = EVIL
    for key in ("stages", "counts"):
        files.result[key][EVIL] = files.result[key]["tiled_deferred"]
    for made in files.result["predictions"]:
        made["technique"] = made["technique"].replace("tiled_deferred", EVIL)
    for line in files.measurements:
        line["technique"] = line["technique"].replace("tiled_deferred", EVIL)
        line["message"] = EVIL
        line["params"] |= {EVIL: EVIL} if line["technique"] == EVIL else {}
    page = page_of(files, tmp_path)
    reader = Reader(page)
    assert "alert(1)</script>" not in page
    assert "<img src=x" not in page
    assert not any("onerror" in attributes for _, attributes in reader.elements)
    assert "{{ 7 * 7 }}" in reader.text


def test_a_gain_inside_the_noise_is_said(tmp_path):
    text = Reader(page_of(run_inside_the_noise(), tmp_path)).text
    assert re.search(r"Keep the default: volume_tiled_bvh at its defaults takes [\d.]+ ms", text)
    assert "is not faster for certain: 1.02× (0.98 to 1.06) as fast as its defaults" in text
    assert "inside the noise" in text


def test_a_loss_is_not_called_noise(tmp_path):
    files = run_inside_the_noise()
    files.result["fastest_default"] |= {"technique": "forward", "params": {}}
    files.result["gain"] |= {"over_fastest_default": 0.88, "over_fastest_default_interval": [0.73, 0.95]}
    text = Reader(page_of(files, tmp_path)).text
    assert "1.02× (0.98 to 1.06) as fast as its own defaults, inside the noise," in text
    assert "0.88× (0.73 to 0.95) as fast as the fastest default, that of forward, which is slower," in text


def test_a_single_measurement_is_a_report(tmp_path):
    text = Reader(page_of(run_of_one(), tmp_path)).text
    assert "Keep the default: volume_tiled_bvh" in text
    assert "nothing that was measured is faster" in text


def test_a_run_in_which_everything_failed_is_a_report(tmp_path):
    text = Reader(page_of(run_without_times(), tmp_path)).text
    assert "No recommendation: none of the 24 measured configurations gave a time (24 out of memory)." in text
    assert "No cost model was fitted" in text


def test_a_result_with_nothing_in_it_is_a_report(tmp_path):
    files = run_without_times()
    files.result.clear()
    files.result["schema"] = 1
    files.measurements.clear()
    assert "No recommendation: nothing was measured." in Reader(page_of(files, tmp_path)).text


def test_an_allowed_error_and_an_image_that_differs_are_said(tmp_path):
    files = complete_run()
    files.result["max_error"] = 1e-3
    files.result["best"]["error"] = 2.4e-4
    text = Reader(page_of(files, tmp_path)).text
    assert "a frame at an image error of 2.4e-4" in text
    assert "Only images with an error up to 1.0e-3 were allowed to win." in text


def test_a_damaged_run_leaves_the_old_report_alone(tmp_path):
    folder = complete_run().write(tmp_path)
    (folder / "report.html").write_text("the old one")
    (folder / "pictures" / "frame.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    with pytest.raises(InputError, match=r"frame\.png"):
        write_report(folder)
    assert (folder / "report.html").read_text() == "the old one"


def test_naming_the_package_loads_nothing_and_reporting_needs_no_jax(tmp_path):
    folder = complete_run().write(tmp_path)
    program = (
        "import json, sys, reports\n"
        "early = [name for name in ('plotly', 'jinja2', 'jax') if name in sys.modules]\n"
        f"reports.write_report({str(folder)!r})\n"
        "print(json.dumps([early, 'plotly' in sys.modules, 'jax' in sys.modules]))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == [[], True, False]


def test_public_names_are_there_and_no_others():
    assert all(callable(getattr(reports, name)) for name in reports.__all__)
    with pytest.raises(AttributeError, match="no `other`"):
        _ = reports.other


def test_what_the_models_answer_is_said_and_only_where_there_are_models(tmp_path):
    text = Reader(page_of(complete_run(), tmp_path / "models")).text
    assert "What the models answer Predicted best: volume_tiled_bvh: tile_px 16 <of> 24" in text
    files = complete_run()
    del files.result["answer_lines"]
    assert "What the models answer" not in Reader(page_of(files, tmp_path / "none")).text
