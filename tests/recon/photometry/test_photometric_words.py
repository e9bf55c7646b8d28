"""What the photometric calibration tells an operator."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from capture.frame_header import FrameHeader, ImageLayout
from capture.ledger import all_present, write_ledger
from capture.manifest import TakeManifest
from capture.take import Take
from capture.take_writer import TakeWriter
from recon.photometry.flat_samples import sample_flats
from recon.photometry.model import DevicePhotometry, PhotometricModel
from recon.photometry.words import (
    Evidence,
    coverage_refusals,
    gain_ratios,
    photometric_warnings,
)

GOOD = DevicePhotometry(
    name="cam00", width=800, height=600, range_dn=255, black_dn=4.0, gain=1.0, gain_sigma=0.001,
    centre_px=np.array([399.5, 299.5]), coefficients=np.array([-0.2, 0.0, 0.0]),
    covariance=1e-8 * np.eye(3), residual=0.004, samples=500, coverage=np.full((6, 8), 10),
)  # fmt: skip
QUIET = {
    "readings": 500, "dropped": 0.02, "clipped": 0.0, "ink_ratio": 0.06, "exposure_slope": np.nan,
    "darkest": 5.0 / 255,
}  # fmt: skip


def told(second: DevicePhotometry, **evidence: float) -> list[str]:
    """Warnings of an array of good devices whose second one is another."""
    model = PhotometricModel(
        tuple(
            dataclasses.replace(second if index == 1 else GOOD, name=f"cam{index:02d}")
            for index in range(4)
        )
    )
    columns = {
        key: np.array([evidence.get(key, quiet) if k == 1 else quiet for k in range(4)])
        for key, quiet in QUIET.items()
    }
    return photometric_warnings(model, Evidence(**columns))


def changed(**values: object) -> DevicePhotometry:
    return dataclasses.replace(GOOD, **values)  # type: ignore[arg-type]


def test_a_good_array_is_not_warned_of() -> None:
    assert told(GOOD) == []


def weak_corner() -> DevicePhotometry:
    coverage = np.full((6, 8), 10)
    coverage[:2, :2] = 0
    return changed(covariance=np.diag([0.0, 0.0, 1e-3]), coverage=coverage)


@pytest.mark.parametrize(
    ("device", "evidence", "words"),
    [
        (changed(gain=0.82), {}, "passes 18 % less light than the others: check its aperture ring"),
        (changed(gain=2.5), {}, "passes 2.5 times the light of the others"),
        (changed(coefficients=np.array([-0.5, 0, 0])), {},
         "loses 24 % of the light at the image's edge, the others 9.8 %"),
        (changed(coefficients=np.array([0.05, 0, 0])), {}, "images brighten by 3.7 % away from"),
        (weak_corner(), {}, "no light was seen in the upper left, where the falloff is known to"),
        (changed(residual=0.031), {}, "readings scatter by 3.1 %: a glossy board"),
        (GOOD, {"dropped": 0.3}, "30 % of its readings did not fit"),
        (GOOD, {"clipped": 0.5}, "50 % of the white is clipped"),
        (GOOD, {"ink_ratio": 0.3}, "black ink reads 30 % of white"),
        (GOOD, {"exposure_slope": 0.45}, "grows with the power 0.45 of the exposure time"),
        (GOOD, {"darkest": 1.0 / 255}, "black level of 4 is above values it shows, down to 1;"),
    ],
)  # fmt: skip
def test_each_fault_is_told_of_its_device(
    device: DevicePhotometry, evidence: dict[str, float], words: str
) -> None:
    lines = told(device, **evidence)
    assert len(lines) == 1
    assert words in lines[0]
    assert lines[0].startswith("cam01")


def test_a_falloff_that_is_not_told_is_refused_with_its_place() -> None:
    blind = changed(covariance=np.diag([0.0, 0.0, 0.2]), coverage=weak_corner().coverage)
    (line,) = coverage_refusals(PhotometricModel((blind,)))
    assert "cam00: its falloff is not told by 500 readings" in line
    assert "in the upper left)" in line
    assert coverage_refusals(PhotometricModel((GOOD,))) == []


def test_unknown_gains_are_not_compared() -> None:
    off = changed(name="cam01", gain=2.0, gain_sigma=float("nan"))
    assert gain_ratios(PhotometricModel((GOOD, off))).tolist() == [1.0, 1.0]


def bracketed(folder: Path, power: float) -> Take:
    """A flat field at three exposure times, by a device of that gamma."""
    layout = ImageLayout(200, 200, 1, "uint16")
    with TakeWriter(folder, {"cam00": layout}) as writer:
        for frame, exposure in enumerate((1000.0, 2000.0, 4000.0)):
            level = 65535.0 * (exposure / 5000.0) ** power
            image = np.full((200, 200), round(level), np.uint16)
            header = FrameHeader(frame, frame_id=frame, exposure_us=exposure)
            writer.write("cam00", header, image)
        writer.finish(
            lambda devices: TakeManifest(
                name="flat", kind="capture", devices=devices, frame_count=3
            )
        )
    write_ledger(folder / "ledger.csv", all_present(["cam00"], 3))
    return Take.open(folder)


@pytest.mark.parametrize("power", [1.0, 0.45])
def test_exposure_tells_linear_values_from_gamma(tmp_path: Path, power: float) -> None:
    take = bracketed(tmp_path / "flat", power)
    found = sample_flats(take, ("cam00",), black=np.zeros(1))
    assert found.exposure_slope[0] == pytest.approx(power, abs=0.002)
