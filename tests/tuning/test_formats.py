"""Nothing is lost between a table and a file, and what a file says wrong is refused in one line."""

import gzip
import json
import math
import re

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.tuning.measurements import a_measurement
from tuning.formats import bounded_text
from tuning.formats.csv_table import CsvLayout, read_csv, read_features, read_layout, unit_of, write_csv
from tuning.formats.extra_p import read_extra_p, write_extra_p
from tuning.formats.grouping import rows_where, without
from tuning.formats.kernel_tuner import read_kernel_tuner, write_kernel_tuner
from tuning.formats.measurements import read_measurements
from tuning.formats.presentmon import read_presentmon
from tuning.formats.registry import read_table, recognised
from tuning.formats.t4 import read_t4, write_t4
from tuning.formats.tracy import read_tracy
from tuning.measurement import Measurement
from tuning.record import append_measurement
from tuning.timing_table import TimingTable
from vtfs.input_error import InputError

# Every character that a text file can hold; a carriage return, quotes and separators among them.
texts = st.text(st.characters(blacklist_categories=("Cs",), blacklist_characters="\0"), max_size=6)
names = st.text(st.characters(blacklist_categories=("Cs", "Cc", "Zs", "Zl", "Zp")), min_size=1, max_size=6).filter(
    lambda name: name not in ("time_ms", "compile_ms", "time", "times", "compile_time", "device", "kernel")
)
numbers = st.floats(allow_nan=False, allow_infinity=False)
times = st.floats(0, 1e300)  # their sum is finite


@st.composite
def tables(draw, blanks=True, compiled=True) -> TimingTable:
    """Whose rows differ, as those of a table that was read do; each column has at least one number."""
    n_rows = draw(st.integers(1, 4))
    own = draw(st.lists(names, unique=True, max_size=4))
    n_columns = draw(st.integers(0, len(own)))
    # One column of whole numbers tells the rows apart.
    columns = {"row": np.arange(n_rows) * 1.0}
    for name in own[:n_columns]:
        columns[name] = np.array(draw(st.lists(numbers, min_size=n_rows, max_size=n_rows)))
        if blanks and n_rows > 1 and draw(st.booleans()):
            columns[name][draw(st.integers(1, n_rows - 1))] = math.nan
    labels = {name: tuple(draw(st.lists(texts, min_size=n_rows, max_size=n_rows))) for name in own[n_columns:]}
    repeats = draw(st.lists(st.lists(times, min_size=1, max_size=3).map(tuple), min_size=n_rows, max_size=n_rows))
    compile_ms = None
    if compiled and draw(st.booleans()):
        compile_ms = tuple(draw(st.lists(st.floats(0.1, 1e6), min_size=n_rows, max_size=n_rows)))
    return TimingTable(columns, labels, tuple(repeats), compile_ms)


def are_the_same(read: TimingTable, table: TimingTable) -> None:
    assert read.repeats_ms == table.repeats_ms
    assert read.labels == table.labels
    assert read.compile_ms == table.compile_ms
    assert read.columns.keys() == table.columns.keys()
    for name, column in table.columns.items():
        np.testing.assert_array_equal(read.columns[name], column)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("formats")


RETURNS = TimingTable({"row": np.array([0.0])}, {"scene": ("a\rb",)}, ((1.0,),))


@settings(max_examples=60, deadline=None)
@given(table=tables())
@example(table=RETURNS)
def test_csv_loses_nothing(folder, table):
    path = folder / "table.csv"
    write_csv(path, table)
    # Texts that look like numbers are numbers, unless the layout says otherwise.
    are_the_same(read_csv(path, CsvLayout(labels=tuple(table.labels))), table)


@settings(max_examples=60, deadline=None)
@given(table=tables())
def test_t4_loses_nothing(folder, table):
    write_t4(folder / "table.json", table)
    are_the_same(read_t4(folder / "table.json"), table)
    assert recognised(folder / "table.json") == "t4"


COMMAS = TimingTable({}, {"a": ("x,y", "x"), "b": ("z", "y,z")}, ((1.0,), (2.0,)))


@settings(max_examples=60, deadline=None)
@given(table=tables(), device=texts)
@example(table=COMMAS, device="a GPU")
def test_a_kernel_tuner_cache_loses_nothing(folder, table, device):
    labels = table.labels | {"device": (device,) * len(table)}
    table = TimingTable(table.columns, labels, table.repeats_ms, table.compile_ms)
    write_kernel_tuner(folder / "cache.json", table)
    are_the_same(read_kernel_tuner(folder / "cache.json"), table)
    assert recognised(folder / "cache.json") == "kernel_tuner"


@settings(max_examples=60, deadline=None)
@given(table=tables(blanks=False, compiled=False))
def test_extra_p_loses_nothing(folder, table):
    write_extra_p(folder / "table.jsonl", table)
    are_the_same(read_extra_p(folder / "table.jsonl"), table)
    assert recognised(folder / "table.jsonl") == "extra_p"


def written(folder, content: str | bytes, name: str = "given.csv"):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def test_rows_that_agree_in_all_but_the_time_are_repeats(folder):
    path = written(folder, "tile_px,quality,time_ms\n8,low,3\n16,low,2\n8,low,3.5\n16,high,2.5\n8,low,\n")
    table = read_csv(path)
    assert table.repeats_ms == ((3.0, 3.5), (2.0,), (2.5,)) and table.n_untimed == 1
    assert table.columns["tile_px"].tolist() == [8, 16, 16] and table.labels == {"quality": ("low", "low", "high")}


def test_columns_left_out_make_repeats_of_rows(folder):
    path = written(folder, "tile_px,frame,time_ms\n8,0,3\n16,0,2\n8,1,4\n")
    expected = ((3.0, 4.0), (2.0,))
    assert read_csv(path, CsvLayout(ignore=("frame",))).repeats_ms == expected
    assert without(read_csv(path), ["frame"]).repeats_ms == expected


@pytest.mark.parametrize(
    ("header", "layout", "factor"),
    [
        ("time_us", CsvLayout(), 1e-3),
        ("gpu_ns", CsvLayout(), 1e-6),
        ("Frame Time (s)", CsvLayout(), 1e3),
        ("ms", CsvLayout(), 1.0),
        ("milliseconds", CsvLayout(), 1.0),
        ("time", CsvLayout(unit="us"), 1e-3),
        ("shade", CsvLayout(time="shade"), 1.0),
        ("shade_us", CsvLayout(), 1e-3),
        ("shade_us", CsvLayout(time="shade_us"), 1e-3),
        ("shade_us", CsvLayout(time="shade_us", unit="ns"), 1e-6),
        ("T", CsvLayout(time="T", unit="s", rename={"lights": "n"}), 1e3),
        ("T_us", CsvLayout(time="time_x", rename={"T_us": "time_x"}), 1.0),
        ("T_us", CsvLayout(time="T_us", rename={"T_us": "time_x"}), 1e-3),
    ],
)
def test_the_time_and_its_unit_are_found(folder, header, layout, factor):
    table = read_csv(written(folder, f"lights,{header}\n10,8\n20,16\n"), layout)
    assert list(table.columns) == [layout.rename.get("lights", "lights")]
    assert table.median_ms.tolist() == pytest.approx([8 * factor, 16 * factor], rel=1e-15)  # one rounding


@pytest.mark.parametrize("name", ["lights", "samples", "items", "columns", "alarms", "focus", "bonus"])
def test_an_ending_that_is_part_of_a_word_is_no_unit(name):
    assert unit_of(name) is None


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_separators_line_ends_and_marks_of_spreadsheets(folder, separator, end):
    rows = ["tile_px,time_ms", "8,3.5", "", "16,2.5"]
    text = "\ufeff" + end.join(row.replace(",", separator) for row in rows)
    assert read_csv(written(folder, text)).median_ms.tolist() == [3.5, 2.5]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", ("is empty",)),
        ("  \n\n", ("is empty",)),
        ("tile_px,time_ms\n", ("no rows",)),
        ("tile_px,lights\n8,3\n", ("time_ms", "--time", "tile_px, lights")),
        ("time_us,time_ns\n8,3\n", ("--time",)),
        ("lights,time_ms\n8,3\n9,x\n", ("line 3", "`time_ms`", "'x'")),
        ("lights,time_ms\n8,nan\n", ("line 2", "`time_ms`", "nan", "finite")),
        ("lights,time_ms\n8,-1\n", ("line 2", "`time_ms`", "-1", "negative")),
        ("lights,time_ms\n8,inf\n", ("`time_ms`", "inf")),
        ("lights,time_ms\n8,\n9,\n", ("no row has a time",)),
        ("lights,time_ms\n8,3\nmany,3\n9,4\n", ("line 3", "`lights`", "'many'", "not a number")),
        ("lights;time_ms\n8;3\n9;4,5\n10;4\n", ("line 3", "4,5")),
        ("lights,time_ms\n8,3\n9,4\nnan,4\n", ("line 4", "`lights`", "nan")),
        ("lights,lights,time_ms\n8,8,3\n", ("`lights`", "two columns")),
        (",lights,time_ms\n0,8,3\n", ("column 1", "no name")),
        ("lights,time_ms\n8,3,4\n", ("line 2", "3 cells", "2")),
        ("lights,time_ms\n8\n", ("line 2", "1 cells", "2")),
        ('lights,time_ms\n"8,3\n', ("line 2", "quotes")),
        ("lights,time_ms\n8,3\xff\n".encode("latin-1"), ("not UTF-8", "0xff")),
        ("lights,time_ms\n8,3\n".encode("utf-16"), ("UTF-16", "UTF-8")),
        (b"lights,time_ms\n8,3\0\n", ("NUL",)),
        (b"PK\x03\x04lights", ("zip archive",)),
        (b"\x1f\x8bnothing", ("gzip",)),
        (gzip.compress(b"lights,time_ms\n8,3\n")[:-9], ("gzip",)),
        ("lights,time_ms\n8," + "9" * 200_000 + "\n", ("field larger",)),
    ],
)
def test_a_bad_csv_is_refused(folder, content, words):
    path = written(folder, content)
    with pytest.raises(InputError) as refused:
        read_csv(path)
    message = str(refused.value)
    assert str(path) in message and "\n" not in message and len(message) < 400, message
    for word in words:
        assert word in message, message


def test_a_missing_file_and_a_folder_are_refused(folder):
    for path in (folder / "absent.csv", folder):
        with pytest.raises(InputError, match="cannot be read"):
            read_csv(path)


def test_nothing_is_unpacked_past_the_limit(folder, monkeypatch):
    monkeypatch.setattr(bounded_text, "LARGEST_BYTES", 2**20)
    bomb = written(folder, gzip.compress(b"0" * 2**26), "bomb.json.gz")
    assert bomb.stat().st_size < 2**18
    asked = []

    def counted(self, size=-1):
        asked.append(size)
        return original(self, size)

    original = gzip.GzipFile.read
    monkeypatch.setattr(gzip.GzipFile, "read", counted)
    with pytest.raises(InputError, match="more than 1 MiB"):
        read_kernel_tuner(bomb)
    assert asked == [2**20 + 1]
    plain = written(folder, b"0" * (2**20 + 1), "large.csv")
    with pytest.raises(InputError, match="more than 1 MiB"):
        read_csv(plain)


def test_a_layout_says_what_columns_are(folder):
    layout = read_layout(
        written(
            folder,
            'time = "gpu"\nunit = "us"\nignore = ["note"]\nlabels = ["build"]\n[rename]\nTileSize = "tile_px"\n',
            "map.toml",
        )
    )
    path = written(folder, "TileSize,build,note,gpu\n8,12,a,3000\n16,13,b,2000\n")
    table = read_csv(path, layout)
    assert table.columns["tile_px"].tolist() == [8, 16] and table.labels == {"build": ("12", "13")}
    assert table.median_ms.tolist() == [3, 2]
    assert CsvLayout(unit="ns").over(layout).unit == "ns" and CsvLayout(ignore=("x",)).over(layout).ignore == (
        "note",
        "x",
    )
    # Another time has another unit.
    assert CsvLayout(time="cpu_ms").over(layout).unit is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time = 3", ("`time` = 3", "a text")),
        ('unit = "hours"', ("hours", "ns, us, ms, s")),
        ('ignore = "a"', ("`ignore`", "a list")),
        ('labels = ["a", 3]', ("`labels`",)),
        ("[rename]\na = 3", ("`rename`",)),
        ("features = []", ("`features`", "unknown")),
        ("time = ", ("not TOML",)),
    ],
)
def test_a_bad_layout_is_refused(folder, text, words):
    with pytest.raises(InputError) as refused:
        read_layout(written(folder, text, "map.toml"))
    for word in words:
        assert word in str(refused.value)


@pytest.mark.parametrize(
    ("layout", "words"),
    [
        (CsvLayout(time="absent"), ("`absent`", "lights, tile, ms")),
        (CsvLayout(ignore=("absent",)), ("`absent`",)),
        (CsvLayout(labels=("absent",)), ("`absent`",)),
        (CsvLayout(rename={"absent": "x"}), ("`absent`",)),
        (CsvLayout(rename={"tile": "lights"}), ("two columns",)),
    ],
)
def test_a_layout_that_does_not_fit_the_file_is_refused(folder, layout, words):
    path = written(folder, "lights,tile,ms\n1,2,3\n")
    with pytest.raises(InputError) as refused:
        read_csv(path, layout)
    for word in words:
        assert word in str(refused.value)


def test_features_are_read_row_by_row_without_a_time(folder):
    path = written(folder, "lights,scene\n3,a\n1,b\n3,a\n,\n")
    features = read_features(path, CsvLayout(time="ms", ignore=("note",), rename={"T": "tile"}))
    np.testing.assert_array_equal(features.columns["lights"], [3, 1, 3, math.nan])
    assert features.labels == {"scene": ("a", "b", "a", "")} and len(features) == 4
    with_times = written(folder, "lights,time_ms\n3,oops\n")
    assert list(read_features(with_times).columns) == ["lights"]


def test_rows_are_chosen_by_a_value(folder):
    table = read_csv(written(folder, "lights,scene,ms\n3,a,1\n4,b,2\n3,b,5\n"))
    assert rows_where(table, "scene", "b").median_ms.tolist() == [2, 5]
    assert rows_where(table, "lights", "3.0").median_ms.tolist() == [1, 5]
    for name, value, word in (("scene", "c", "a, b"), ("lights", "many", "numbers"), ("x", "1", "lights, scene")):
        with pytest.raises(InputError, match=word):
            rows_where(table, name, value)


V1 = (
    "Application,ProcessID,SwapChainAddress,Runtime,SyncInterval,PresentFlags,Dropped,TimeInSeconds,msInPresentAPI,"
    "msBetweenPresents,AllowsTearing,PresentMode,msUntilRenderComplete,msUntilDisplayed,msBetweenDisplayChange,"
    "msUntilRenderStart,msGPUActive,msGPUVideoActive\n"
    "game.exe,10,0x1,DXGI,0,0,0,0.10,0.1,16.6,1,Hardware: Independent Flip,8,20,16.7,1,7.5,0\n"
    "game.exe,10,0x1,DXGI,0,0,1,0.12,0.1,16.8,1,Hardware: Independent Flip,8,20,16.7,1,7.7,0\n"
    "dwm.exe,11,0x2,DXGI,0,0,0,0.12,0.1,8.3,1,Composed: Flip,8,20,16.7,1,0.5,0\n"
)
V2 = (
    "Application,ProcessID,SwapChainAddress,PresentRuntime,SyncInterval,PresentFlags,AllowsTearing,PresentMode,"
    "FrameType,CPUStartTime,FrameTime,CPUBusy,CPUWait,GPULatency,GPUTime,GPUBusy,GPUWait,DisplayLatency,DisplayedTime,"
    "ClickToPhotonLatency\n"
    "game.exe,10,0x1,DXGI,0,0,1,Hardware: Independent Flip,Application,0.1,16.6,3,13,1,8,7.5,0.5,20,16.7,NA\n"
    "game.exe,10,0x1,DXGI,0,0,1,Hardware: Independent Flip,Intel XeSS-FG,0.1,8.3,3,13,1,8,7.5,0.5,20,16.7,NA\n"
    "game.exe,10,0x1,DXGI,0,0,1,Hardware: Independent Flip,Application,0.2,16.8,3,13,1,NA,NA,NA,NA,NA,NA\n"
)
V2_4 = (
    "Application,ProcessID,SwapChainAddress,PresentRuntime,SyncInterval,PresentFlags,AllowsTearing,PresentMode,"
    "TimeInSeconds,MsBetweenSimulationStart,MsBetweenPresents,MsBetweenDisplayChange,MsInPresentAPI,MsGPUTime\n"
    "game.exe,10,0x1,DXGI,0,0,1,Hardware: Independent Flip,1.0,NA,16.5,16.7,0.1,8.5\n"
)


def test_presentmon_of_every_version(folder):
    v1 = read_presentmon(written(folder, V1))
    assert v1.repeats_ms == ((16.6, 16.8), (8.3,)) and v1.labels["application"] == ("game.exe", "dwm.exe")
    assert read_presentmon(written(folder, V1), "msGPUActive").repeats_ms == ((7.5, 7.7), (0.5,))
    v2 = read_presentmon(written(folder, V2))
    assert v2.repeats_ms == ((16.6, 16.8),)  # generated frames are not the application's
    gpu = read_presentmon(written(folder, V2), "GPUTime")
    assert gpu.repeats_ms == ((8.0,),) and gpu.n_untimed == 1
    assert read_presentmon(written(folder, V2_4)).repeats_ms == ((16.5,),)
    assert read_presentmon(written(folder, V2_4), "GPUTime").repeats_ms == ((8.5,),)
    for text in (V1, V2, V2_4):
        assert recognised(written(folder, text)) == "presentmon"


def test_a_bad_presentmon_file_is_refused(folder):
    with pytest.raises(InputError, match="`Shade`"):
        read_presentmon(written(folder, V1), "Shade")
    with pytest.raises(InputError, match="no frame has a time in `ClickToPhotonLatency`"):
        read_presentmon(written(folder, V2), "ClickToPhotonLatency")
    with pytest.raises(InputError, match=r"line 2: `msBetweenPresents` = -16.6"):
        read_presentmon(written(folder, V1.replace(",16.6,", ",-16.6,")))
    with pytest.raises(InputError, match="MsBetweenPresents, FrameTime"):
        read_presentmon(written(folder, "Application,SwapChainAddress\na,b\n"))


SUMMARY = (
    "name,src_file,src_line,total_ns,total_perc,counts,mean_ns,min_ns,max_ns,std_ns\n"
    "Cull,cull.cpp,12,3000000,1.5,2,1500000,1000000,2000000,707106.7\n"
)
UNWRAPPED = (
    "name,src_file,src_line,ns_since_start,exec_time_ns,thread,value\n"
    "Cull,cull.cpp,12,100,1000000,1,\nShade,shade.cpp,7,200,4000000,1,level 3\nCull,cull.cpp,12,300,2000000,1,\n"
    "vram,,,300,,,17\n"
)
GPU = "name,src_file,Time from start of program,GPU execution time\nShade,shade.cpp,10,4000000\n"


def test_tracy_exports(folder):
    assert read_tracy(written(folder, SUMMARY)).repeats_ms == ((1.5,),)
    zones = read_tracy(written(folder, UNWRAPPED))
    assert zones.repeats_ms == ((1.0, 2.0), (4.0,)) and zones.labels["stage"] == ("Cull", "Shade")
    assert zones.labels["source"] == ("cull.cpp:12", "shade.cpp:7")
    gpu = read_tracy(written(folder, GPU))
    assert gpu.repeats_ms == ((4.0,),) and gpu.labels["source"] == ("shade.cpp",)
    for text in (SUMMARY, UNWRAPPED, GPU):
        assert recognised(written(folder, text)) == "tracy"
    with pytest.raises(InputError, match="tracy-csvexport"):
        read_tracy(written(folder, "MessageName,total_ns\nhello,3\n"))


CACHE = {
    "device_name": "A GPU", "kernel_name": "shade", "problem_size": [64, 64], "tune_params_keys": ["tile", "layout"],
    "tune_params": {"tile": [8, 16], "layout": ["soa"]}, "objective": "time",
    "cache": {
        "8,soa": {"tile": 8, "layout": "soa", "time": 2.0, "times": [1.5, 2.5], "compile_time": 900.0, "GFLOP/s": 7.0},
        "16,soa": {"tile": 16, "layout": "soa", "time": "RuntimeFailedConfig", "compile_time": 1.0},
        "32,soa": {"tile": 32, "layout": "soa", "time": 3.0, "compile_time": 800.0},
    },
}  # fmt: skip


def test_a_kernel_tuner_cache_holds_parameters_repeats_and_failures(folder):
    table = read_kernel_tuner(written(folder, json.dumps(CACHE), "cache.json"))
    assert table.columns["tile"].tolist() == [8, 32] and list(table.columns) == ["tile"]
    assert table.labels == {"layout": ("soa", "soa"), "device": ("A GPU",) * 2, "kernel": ("shade",) * 2}
    assert table.repeats_ms == ((1.5, 2.5), (3.0,)) and table.compile_ms == (900.0, 800.0) and table.n_untimed == 1
    # Kernel Tuner appends to an open cache, and closes it when it is done; hubs keep them packed.
    still_open = json.dumps(CACHE)[:-2] + ","
    packed = written(folder, gzip.compress(still_open.encode()), "open.json.gz")
    are_the_same(read_table(packed, CsvLayout()), table)


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("tune_params_keys",), None, ("tune_params_keys",)),
        (("cache",), [], ("`cache`",)),
        (("cache", "8,soa"), 3, ("8,soa", "no object")),
        (("cache", "8,soa", "tile"), "wide", ("`tile`", "numbers", "'wide'")),
        (("cache", "8,soa", "tile"), [8], ("`tile`", "not a number")),
        (("cache", "8,soa", "times"), [1.0, -1.0], ("8,soa", "`time` = -1", "negative")),
        (("cache", "8,soa", "times"), [math.nan], ("8,soa", "nan")),
        (("cache", "8,soa", "times"), [], ("8,soa", "`times`")),
        (("cache", "32,soa", "time"), None, ("32,soa", "`time`", "None")),
        (("cache",), {}, ("no configuration",)),
    ],
)
def test_a_bad_kernel_tuner_cache_is_refused(folder, path, value, words):
    content = json.loads(json.dumps(CACHE))
    at = content
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = value
    with pytest.raises(InputError) as refused:
        read_kernel_tuner(written(folder, json.dumps(content), "cache.json"))
    for word in words:
        assert word in str(refused.value), refused.value


def test_a_missing_parameter_of_a_cache_is_named(folder):
    content = json.loads(json.dumps(CACHE))
    del content["cache"]["8,soa"]["tile"]
    with pytest.raises(InputError, match=r"8,soa.*`tile` is missing"):
        read_kernel_tuner(written(folder, json.dumps(content), "cache.json"))


@pytest.mark.parametrize("reader", [read_kernel_tuner, read_t4, read_extra_p])
@pytest.mark.parametrize(
    ("content", "words"),
    [
        ('{"cache": {"8": {"time"', ("cut off",)),
        ('{"a": 1} x', ("not JSON",)),
        ("[1]", ("object",)),
        ('{"a": ' + "9" * 5000 + "}", ("digits",)),
        ("[" * 100_000, ("nested",)),
        ("", ("empty",)),
    ],
)
def test_damaged_json_is_refused(folder, reader, content, words):
    with pytest.raises(InputError) as refused:
        reader(written(folder, content, "damaged.json"))
    for word in words:
        assert word in str(refused.value), refused.value


T4 = {
    "schema_version": "1.0.0", "metadata": {"timeunit": "milliseconds"},
    "results": [
        {"configuration": {"tile": 8}, "times": {"compilation": 900.0, "runtimes": [1.5, 2.5]},
         "invalidity": "correct", "correctness": 1, "measurements": [], "objectives": ["time"]},
        {"configuration": {"tile": 16}, "times": {}, "invalidity": "runtime", "correctness": 0},
        {"configuration": {"tile": 32}, "times": {"compilation_time": 800.0, "runtimes": []}, "invalidity": "correct",
         "correctness": 1, "measurements": [{"name": "energy", "value": 5, "unit": "J"},
                                            {"name": "kernel", "value": 3000, "unit": "us"}],
         "objectives": ["kernel"]},
    ],
}  # fmt: skip


def test_t4_results_of_others(folder):
    table = read_t4(written(folder, json.dumps(T4), "t4.json"))
    assert table.columns["tile"].tolist() == [8, 32] and table.n_untimed == 1
    assert table.repeats_ms == ((1.5, 2.5), (3.0,)) and table.compile_ms == (900.0, 800.0)
    seconds = {**T4, "metadata": {"timeunit": "seconds"}}
    assert read_t4(written(folder, json.dumps(seconds), "t4.json")).repeats_ms[0] == (1500.0, 2500.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"results": None}, ("`results`",)),
        ({"results": []}, ("no correct result",)),
        ({"results": [3]}, ("results[0]", "configuration")),
        ({"results": [{**T4["results"][0], "times": {"runtimes": [-1]}}]}, ("results[0]", "times.runtimes", "-1")),
        ({"results": [{**T4["results"][0], "times": {}}]}, ("results[0]", "neither")),
        ({"metadata": {"timeunit": "fortnights"}}, ("timeunit", "fortnights")),
        ({"schema_version": "2.0.0"}, ("schema_version", "2.0.0")),
    ],
)
def test_a_bad_t4_file_is_refused(folder, change, words):
    with pytest.raises(InputError) as refused:
        read_t4(written(folder, json.dumps({**T4, **change}), "t4.json"))
    for word in words:
        assert word in str(refused.value), refused.value


def test_t4_is_written_as_its_schema_wants_it(folder):
    """Required fields and types of the results schema 1.0.0; Kernel Tuner's name of the compile time."""
    table = TimingTable({"tile": np.array([8.0])}, {"technique": ("forward",)}, ((1.0, 3.0),), (250.0,))
    write_t4(folder / "t4.json", table)
    content = json.loads((folder / "t4.json").read_text())
    result = content["results"][0]
    assert content["schema_version"] == "1.0.0" and content["metadata"] == {"timeunit": "milliseconds"}
    assert result["configuration"] == {"tile": 8, "technique": "forward"}
    assert result["times"]["compilation"] == 250.0 and result["times"]["runtimes"] == [1.0, 3.0]
    assert result["invalidity"] == "correct" and result["correctness"] == 1
    assert result["measurements"] == [{"name": "time", "value": 2.0, "unit": "ms"}] and result["objectives"] == ["time"]


T4_RESULT = {"configuration": dict, "times": dict, "invalidity": str, "correctness": (int, float)}
"""What the results schema requires of a result, and of what type; the rest is optional there."""


@pytest.mark.parametrize("compile_ms", [None, (250.0, 1e3, 0.0)])
def test_all_that_t4s_schema_requires_is_there_in_its_types(folder, compile_ms):
    """By hand, after results-schema.json of github.com/odgaard/TuningSchema: no validator is among the dependencies."""
    repeats = ((1.0, 3.0), (0.5,), (1e-6, 2e9, 4.0))
    columns = {"tile": np.array([8.0, 0.5, 1e12]), "batch": np.array([1.0, math.nan, 3.0])}
    write_t4(folder / "t4.json", TimingTable(columns, {"technique": ("a", "b", "c")}, repeats, compile_ms))
    text = (folder / "t4.json").read_text()
    content = json.loads(text, parse_constant=pytest.fail)  # NaN and Infinity are no JSON
    assert re.fullmatch(r"[0-9]+\.[0-9]+\.[0-9]+", content["schema_version"])
    assert len(content["results"]) == len(repeats)
    for result in content["results"]:
        assert all(isinstance(result[name], kind) for name, kind in T4_RESULT.items())
        times = result["times"]
        assert {"compilation", "runtimes", "framework", "search_algorithm", "validation"} <= times.keys()
        assert all(isinstance(value, list if name == "runtimes" else (int, float)) for name, value in times.items())
        assert all(isinstance(ms, (int, float)) for ms in times["runtimes"])
        assert isinstance(result["objectives"], list)
        for one in result["measurements"]:
            assert isinstance(one["name"], str) and isinstance(one["value"], (int, float))
            assert isinstance(one["unit"], str)


def test_extra_p_lines_of_others(folder):
    text = (
        '{"params": {"p": 4}, "value": 1.5, "callpath": "main->solve", "metric": "time_us"}\n'
        '{"params": {"p": 4}, "value": [2.5, 3.5], "callpath": "main->solve", "metric": "time_us"}\n\n'
        '{"params": {"p": 8}, "value": 9, "callpath": "main->solve", "metric": "visits"}\n'
    )
    path = written(folder, text, "lines.jsonl")
    table = read_extra_p(path, "time_us")
    assert table.repeats_ms == (pytest.approx((0.0015, 0.0025, 0.0035)),) and table.columns["p"].tolist() == [4]
    assert table.labels == {"callpath": ("main->solve",)}
    with pytest.raises(InputError, match="time_us, visits"):
        read_extra_p(path)
    with pytest.raises(InputError, match="no metric `energy`"):
        read_extra_p(path, "energy")
    assert read_extra_p(written(folder, '{"params": {"p": 4}, "value": 2}', "l.jsonl"), unit="s").repeats_ms == (
        (2e3,),
    )


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('{"value": 3}', ("line 2", "`params`")),
        ('{"params": {"p": 3}}', ("line 2", "`value`")),
        ('{"params": {"p": 3}, "value": []}', ("line 2", "`value`")),
        ('{"params": {"p": 3}, "value": -3}', ("line 2", "negative")),
        ('{"params": {"p": 3}, "value": true}', ("line 2", "not a time")),
        ('{"params": {"p": "four"}, "value": 3}', ("`p`", "numbers")),
        ('{"params": {"p": 3}, "val', ("line 2", "cut off")),
    ],
)
def test_a_bad_extra_p_line_is_refused(folder, line, words):
    with pytest.raises(InputError) as refused:
        read_extra_p(written(folder, '{"params": {"p": 3}, "value": 3}\n' + line, "lines.jsonl"))
    for word in words:
        assert word in str(refused.value), refused.value


def test_extra_p_needs_every_number(folder):
    table = TimingTable({"tile": np.array([8.0, math.nan])}, {}, ((1.0,), (2.0,)))
    with pytest.raises(InputError, match="`tile` is empty"):
        write_extra_p(folder / "t.jsonl", table)


@pytest.mark.parametrize(("write", "name"), [(write_csv, "time_ms"), (write_kernel_tuner, "times")])
def test_a_column_with_the_name_of_a_field_is_not_overwritten(folder, write, name):
    with pytest.raises(InputError, match=f"`{name}`"):
        write(folder / "t", TimingTable({name: np.array([8.0])}, {}, ((1.0,),)))


def test_our_own_record_is_a_row_for_each_stage_and_frame(folder):
    path = folder / "measurements.jsonl"
    timed = Measurement(
        "tiled_deferred", {"tile_px": 16, "gbuffer": "float32"}, "scene", (3, 7), 0, "timed", 1.5,
        {"frame": ((5.0, 6.0), (4.0,)), "assign": ((1.0,),)}, ({"samples": 10}, {"samples": 20}), 0.0, 0.0,
        "CPU", {}, 0.1,
    )  # fmt: skip
    failed = Measurement("forward", {}, "scene", (3,), 0, "timeout", 1.0, {}, (), None, None, "CPU", {}, 0.1)
    append_measurement(path, timed)
    append_measurement(path, failed)
    assert recognised(path) == "measurements"
    table = read_measurements(path)
    assert table.repeats_ms == ((5.0, 6.0), (4.0,), (1.0,)) and table.n_untimed == 1
    assert table.labels["stage"] == ("frame", "frame", "assign") and table.labels["gbuffer"] == ("float32",) * 3
    assert table.columns["frame"].tolist() == [3, 7, 3] and table.columns["samples"].tolist() == [10, 20, 10]
    assert table.columns["tile_px"].tolist() == [16, 16, 16] and table.compile_ms == (1500.0,) * 3


def test_levels_that_a_tree_of_our_own_record_does_not_have_took_no_tests(folder):
    path = folder / "levels.jsonl"
    for technique, counts in (("ptsv", {"tests_0": 5, "tests_1": 7}), ("ptsv", {"tests_0": 6}), ("forward", {"n": 1})):
        append_measurement(path, a_measurement(technique, counts=(counts,), stages_ms={"frame": ((1.0,),)}))
    columns = read_measurements(path).columns
    assert columns["tests_1"].tolist()[:2] == [7, 0] and columns["tests_0"].tolist()[:2] == [5, 6]
    assert np.isnan(columns["tests_1"][2]) and np.isnan(columns["n"][:2]).all()  # another technique's


def test_an_unknown_format_is_refused(folder):
    with pytest.raises(InputError, match="--format xlsx"):
        read_table(written(folder, "a,ms\n1,2\n"), CsvLayout(), "xlsx")
    with pytest.raises(InputError, match="no format known"):
        recognised(written(folder, '{"hello": 1}'))


@settings(max_examples=200, deadline=None)
@given(
    content=st.one_of(
        st.binary(max_size=60), texts.map(str.encode), st.text("\"',;\n\r{}[]:1a.-", max_size=40).map(str.encode)
    )
)
def test_any_bytes_are_read_or_refused(folder, content):
    path = written(folder, content)
    for reader in (read_csv, read_presentmon, read_tracy, read_kernel_tuner, read_t4, read_extra_p):
        try:
            table = reader(path)
        except InputError as error:
            assert "\n" not in str(error)
        else:
            assert len(table) > 0
