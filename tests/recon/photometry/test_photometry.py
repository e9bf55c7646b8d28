"""The photometric model and its file: inverse, round trip, refusals."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from capture.errors import InputError, LikenessError, ShapeError
from recon.photometry.model import (
    DevicePhotometry,
    PhotometricModel,
    read_photometry,
    write_photometry,
)

ONE = DevicePhotometry(
    name="cam00", width=64, height=48, range_dn=255, black_dn=3.5, gain=1.2, gain_sigma=0.001,
    centre_px=np.array([30.0, 25.0]), coefficients=np.array([-0.2, -0.05, 0.01]),
    covariance=1e-6 * np.eye(3), residual=0.004, samples=321,
    coverage=np.arange(48).reshape(6, 8),
)  # fmt: skip
TWO = dataclasses.replace(ONE, name="cam01", range_dn=65535, gain=1 / 1.2, gain_sigma=float("nan"))
MODEL = PhotometricModel((ONE, TWO))


def test_two_devices_agree_on_the_light_after_correction() -> None:
    light = np.linspace(0.1, 0.6, 48 * 64).reshape(48, 64)
    x, y = np.meshgrid(np.arange(64), np.arange(48))
    pixels = np.stack([x, y], axis=-1).reshape(-1, 2).astype(float)
    for device, kind in ((ONE, np.uint8), (TWO, np.uint16)):
        fall = device.falloff(pixels).reshape(48, 64)
        shown = device.black_dn + device.range_dn * device.gain * fall * light
        image = np.round(shown).astype(kind)
        found = MODEL.corrected(device.name, image)
        assert found.dtype == np.float32
        assert np.abs(found - light).max() < 1.2 / device.range_dn
        colour = device.corrected(np.repeat(image[:, :, None], 3, axis=2))
        np.testing.assert_array_equal(colour[:, :, 1], found)


def test_the_falloff_is_one_at_its_centre_and_counts_half_diagonals() -> None:
    assert ONE.falloff(ONE.centre_px[None])[0] == 1.0
    edge = ONE.centre_px + [0.5 * np.hypot(64, 48), 0.0]
    assert ONE.falloff(edge[None])[0] == pytest.approx(1 - 0.2 - 0.05 + 0.01)
    assert ONE.falloff_sigma(edge[None])[0] == pytest.approx(1e-3 * np.sqrt(3) / 0.76)


def test_images_of_another_kind_are_refused() -> None:
    with pytest.raises(ShapeError, match=r"cam00: expected an image of 64 x 48 px, found shape"):
        ONE.corrected(np.zeros((48, 63), np.uint8))
    with pytest.raises(ShapeError, match="cam00: the calibration is of uint8 images, found uint16"):
        ONE.corrected(np.zeros((48, 64), np.uint16))


def test_the_file_reads_back_and_repeats_its_bytes(tmp_path: Path) -> None:
    path = tmp_path / "photometric.json"
    write_photometry(path, MODEL, {"warnings": []})
    again = read_photometry(path)
    assert again.names == ("cam00", "cam01")
    for one, other in zip(MODEL, again, strict=True):
        for field in dataclasses.fields(one):
            np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))
    first = path.read_bytes()
    write_photometry(path, again, {"warnings": []})
    assert path.read_bytes() == first


def document() -> dict[str, Any]:
    device = {
        "name": "cam00", "width": 64, "height": 48, "range_dn": 255, "black_dn": 0.0, "gain": 1.0,
        "gain_sigma": None, "centre_px": [31.5, 23.5], "coefficients": [-0.2, 0.0, 0.0],
        "covariance": np.eye(3).tolist(), "residual": 0.0, "samples": 5, "coverage": [[1, 2]],
    }  # fmt: skip
    return {"format": 1, "model": "", "devices": [device]}


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("gain", 0.0, "gain must be above 0, found 0.0"),
        ("gain", "1", "gain must be a finite number, found '1'"),
        ("coefficients", [-1.5, 0, 0], "V must stay above 0 in the whole image"),
        ("coefficients", [-0.1, 0], "coefficients"),
        ("range_dn", 1023, "range_dn must be 255 or 65535, found 1023"),
        ("black_dn", 255, r"black_dn must lie in 0..255, found 255.0"),
        ("name", "../cam", "name must be letters"),
        ("coverage", [[1], [1, 2]], "coverage must"),
        ("coverage", [[-1]], "coverage must hold counts"),
        ("width", True, "width must be a whole number"),
    ],
)
def test_values_that_do_not_fit_are_named(
    tmp_path: Path, key: str, value: object, words: str
) -> None:
    path = tmp_path / "photometric.json"
    told = document()
    told["devices"][0][key] = value
    path.write_text(json.dumps(told), encoding="utf-8")
    with pytest.raises(InputError, match=words) as caught:
        read_photometry(path)
    assert str(path) in str(caught.value)


def test_keys_and_files_that_do_not_fit_are_named(tmp_path: Path) -> None:
    path = tmp_path / "photometric.json"
    with pytest.raises(InputError, match="`likeness photometric` writes one"):
        read_photometry(path)
    told = document()
    told["devices"][0]["gian"] = told["devices"][0].pop("gain")
    path.write_text(json.dumps(told), encoding="utf-8")
    with pytest.raises(InputError, match=r"missing key 'gain'(.|\n)*did you mean 'gain'"):
        read_photometry(path)
    path.write_text(json.dumps(document() | {"format": 2}), encoding="utf-8")
    with pytest.raises(InputError, match="format must be 1, found 2"):
        read_photometry(path)
    double = document()
    double["devices"] *= 2
    path.write_text(json.dumps(double), encoding="utf-8")
    with pytest.raises(InputError, match="found twice: cam00"):
        read_photometry(path)


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=8,
)


@settings(max_examples=80, deadline=None)
@given(key=st.sampled_from(sorted(document()["devices"][0])), value=JSON)
def test_whatever_stands_in_the_file_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, key: str, value: object
) -> None:
    path = tmp_path_factory.getbasetemp() / "any.json"
    told = document()
    told["devices"][0][key] = value
    path.write_text(json.dumps(told), encoding="utf-8")
    words = ""
    try:
        read_photometry(path)
    except LikenessError as error:
        words = str(error)
    assert not words or str(path) in words
