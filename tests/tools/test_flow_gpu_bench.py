"""The flow bench measures what it says, on a small pair."""

import json

import pytest

from capture.errors import WorkError
from tools.bench.bench_flow_gpu import main
from track.gpu_flow import GpuFlow


def test_the_bench_prints_times_the_device_and_the_difference(
    capsys: pytest.CaptureFixture[str],
) -> None:
    try:
        name = GpuFlow().device_name
    except WorkError as error:
        pytest.skip(f"no compute shaders here: {error}")
    main(["--size", "192", "--rounds", "1"])
    line = json.loads(capsys.readouterr().out)
    assert line["device"] == name
    assert line["size"] == 192
    for way in (line["cpu"], line["gpu"]):
        parts = way["warp_ms"] + way["search_ms"] + way["refine_ms"]
        assert way["whole_ms"] == pytest.approx(parts, abs=0.05)
    assert line["cpu_over_gpu"] == pytest.approx(
        line["cpu"]["whole_ms"] / line["gpu"]["whole_ms"], rel=0.02
    )
    assert line["difference"]["samples"] > 1000
    assert line["difference"]["matched_by_one_alone"] <= 0.001 * line["difference"]["samples"]
    assert line["difference"]["within_1e-3_px"] >= 0.999
