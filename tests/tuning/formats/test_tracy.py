"""Tracy's exports: summaries, single zones, zones of the GPU."""

import pytest

from tests.tuning.formats.tables import written
from tuning.formats.registry import recognised
from tuning.formats.tracy import read_tracy
from vtfs.input_error import InputError

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
