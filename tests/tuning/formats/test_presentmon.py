"""PresentMon's CSVs, of every version."""

import pytest

from tests.tuning.formats.tables import written
from tuning.formats.presentmon import read_presentmon
from tuning.formats.registry import recognised
from vtfs.input_error import InputError

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
