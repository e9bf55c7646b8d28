"""The page of a photometric calibration: falloff maps, gains, residuals, what to worry about."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from capture.arrays import Floats
from recon.photometry.model import DevicePhotometry, PhotometricModel
from recon.photometry.words import GAIN_OFF, WEAK_SIGMA, cell_middles, gain_ratios
from tools.report.charts import Labels, Series, bar_chart, colour_scale, line_chart
from tools.report.page import Section, Verdict, facts, figure, gallery, table, write_page
from tools.report.picture import jpeg_tag, sequential, stops
from tools.report.svg import PALETTE, drawing, element, escape

_MAP_PX = 150
_GOOD_RESIDUAL, _FAIR_RESIDUAL = 0.01, 0.02


def write_photometric_page(model: PhotometricModel, report: Mapping[str, Any], out: Path) -> Path:
    """Write the page of a photometric calibration.

    Args:
        model: the devices.
        report: what stands under "report" in photometric.json.
        out: the file.
    """
    sections = [_light(model, report), _falloff(model), _numbers(model, report)]
    count = "1 device" if len(model) == 1 else f"{len(model)} devices"
    lead = f'<p class="lead">{escape(count)}, {escape(_sources(report))}</p>'
    write_page("Photometric calibration", lead, sections, Path(out))
    return Path(out)


def photometric_verdicts(model: PhotometricModel, report: Mapping[str, Any]) -> tuple[Verdict, ...]:
    """On the scatter of the readings, and every warning of the calibration."""
    worst = max(model, key=lambda device: device.residual)
    words = f"readings scatter by up to {100 * worst.residual:.2g} % ({worst.name})"
    out = [Verdict(level=_level(worst.residual), subject="Light:", words=words)]
    warnings = report.get("warnings")
    if isinstance(warnings, list):
        out += [Verdict(level="warn", subject="Light:", words=str(line)) for line in warnings]
    return tuple(out)


def _light(model: PhotometricModel, report: Mapping[str, Any]) -> Section:
    names = list(model.names)
    parts = []
    if report.get("gains_known"):
        gains = [device.gain for device in model]
        off = np.abs(gain_ratios(model) - 1.0) > GAIN_OFF
        levels = ["warn" if bad else "good" for bad in off.tolist()]
        chart = bar_chart(
            names, gains, Labels(title="gain by device", x="gain over the array's mean"),
            levels=levels, limit=(1.0, "mean"),
        )  # fmt: skip
        parts.append(figure(chart, "What each device makes of the same light at its centre."))
    else:
        parts.append(
            "<p>Gains are not known: a flat field tells them only when all devices look at one "
            "light (<code>--same-light</code>), a board take always.</p>"
        )
    values = [100 * device.residual for device in model]
    chart = bar_chart(
        names, values, Labels(title="residual by device", x="scatter of the readings, %"),
        levels=[_level(device.residual) for device in model],
    )  # fmt: skip
    parts.append(figure(chart, "Gloss, flicker and an uneven field show here."))
    return Section(
        anchor="light", title="Gain and scatter", body="".join(parts),
        verdicts=photometric_verdicts(model, report),
    )  # fmt: skip


def _falloff(model: PhotometricModel) -> Section:
    maps = [_map_of(device) for device in model]
    low = min(float(values.min()) for values in maps)
    low = min(low, 0.99)
    pictures = [
        figure(
            jpeg_tag(
                (255 * sequential(values, low, 1.0)).astype(np.uint8),
                f"falloff of {device.name}",
            ),
            f"{device.name}, corners {values.min():.2f}",
        )
        for device, values in zip(model, maps, strict=True)
    ]
    scale = colour_scale(stops("sequential"), low, 1.0, "V, share of the light")
    radii = np.linspace(0.0, 1.0, 41)
    lines = [
        Series(name=device.name, x=radii.tolist(), y=_along(device, radii).tolist())
        for device in model
    ]
    labels = Labels(title="falloff by radius", x="distance from the centre, half diagonals", y="V")
    body = (
        gallery(pictures, "small")
        + scale
        + figure(line_chart(lines, labels), "The light a lens passes, from its centre outwards.")
        + "<h3>Where light was read in each image</h3>"
        + gallery([_coverage(device) for device in model], "small")
    )
    return Section(anchor="falloff", title="Falloff", body=body)


def _numbers(model: PhotometricModel, report: Mapping[str, Any]) -> Section:
    told = {str(entry["name"]): entry for entry in report.get("devices", [])}
    head = (
        "device", "black", "gain", "gain sigma, %", "centre x, px", "centre y, px", "a1", "a2",
        "a3", "V in the worst corner", "its sigma, %", "scatter, %", "readings", "dropped, %",
        "ink over white",
    )  # fmt: skip
    rows = []
    for device in model:
        corners = _corners(device)
        entry = told.get(device.name, {})
        rows.append([
            device.name, device.black_dn, device.gain, 100 * device.gain_sigma,
            *device.centre_px.tolist(), *device.coefficients.tolist(),
            float(device.falloff(corners).min()),
            100 * float(device.falloff_sigma(corners).max()),
            100 * device.residual, device.samples, 100 * float(entry.get("dropped") or 0.0),
            "" if entry.get("ink_ratio") is None else float(entry["ink_ratio"]),
        ])  # fmt: skip
    plain = {
        key.replace("_", " "): value
        for key, value in report.items()
        if isinstance(value, str | int | float | bool)
    }
    return Section(anchor="numbers", title="Numbers", body=facts(plain) + table(head, rows))


def _coverage(device: DevicePhotometry) -> str:
    """Readings in each cell; amber where there is none and the falloff is badly known."""
    rows, columns = device.coverage.shape
    middles = cell_middles(device.width, device.height, (rows, columns))
    weak = (device.falloff_sigma(middles) > WEAK_SIGMA).reshape(rows, columns)
    top = max(float(np.percentile(device.coverage, 90)), 1.0)
    step = 110.0 / columns
    cells = []
    for row in range(rows):
        for column in range(columns):
            count = int(device.coverage[row, column])
            fill = PALETTE[0] if count else ("#e69f00" if weak[row, column] else "#e8ebee")
            shade = min(1.0, 0.25 + 0.75 * count / top) if count else None
            cells.append(
                element(
                    "rect", x=step * column, y=step * row, width=step - 0.6, height=step - 0.6,
                    fill=fill, fill_opacity=shade,
                )
            )  # fmt: skip
    chart = drawing(110.0, step * rows, "".join(cells), f"coverage of {device.name}")
    return figure(chart, f"{device.name}, {device.samples} readings")


def _map_of(device: DevicePhotometry) -> Floats:
    """V (H, W) on a small grid that reaches the corners of the image."""
    shrink = _MAP_PX / max(device.width, device.height)
    wide, high = (max(2, round(size * shrink)) for size in (device.width, device.height))
    x = np.linspace(0.0, device.width - 1.0, wide)
    y = np.linspace(0.0, device.height - 1.0, high)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return device.falloff(grid).reshape(high, wide)


def _along(device: DevicePhotometry, radii: Floats) -> Floats:
    unit = 0.5 * float(np.hypot(device.width, device.height))
    away = np.column_stack([radii * unit, np.zeros(len(radii))])
    return device.falloff(device.centre_px + away)


def _corners(device: DevicePhotometry) -> Floats:
    right, low = device.width - 1.0, device.height - 1.0
    return np.array([[0.0, 0.0], [right, 0.0], [0.0, low], [right, low]])


def _sources(report: Mapping[str, Any]) -> str:
    words = {"board_take": "the white of board take", "flat": "flat field", "dark": "dark take"}
    named = report.get("sources")
    if not isinstance(named, Mapping):
        return "sources not told"
    return ", ".join(f"{words[key]} {named[key]}" for key in words if named.get(key))


def _level(residual: float) -> str:
    if residual <= _GOOD_RESIDUAL:
        return "good"
    return "warn" if residual <= _FAIR_RESIDUAL else "bad"
