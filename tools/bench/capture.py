"""Capture at speed: writers and readers side by side, sixteen devices at full rate, a long session.

Run: python -m tools.bench.capture [writers] [array] [memory] [--seconds 60] [--takes 30]

Without names all three run. `writers` compares on one tmpfs, in turns, medians of ratios: see
`tools.bench.bench_mcap`. `array` records simulated devices in real time (75 Hz, 256 x 256 px).
`memory` records takes of 150 frames, one after the other, and reports resident memory. Ratios are
of one run; absolute rates are those of the machine and of what else it does.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from capture.frame_header import ImageLayout
from tools.bench.capture_array import record_array, session_memory

_PARTS = ("writers", "array", "memory")


def main() -> None:
    """Run the parts that are asked for, each in a process of its own, so that memory is its own."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", metavar="part", help=", ".join(_PARTS))
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--takes", type=int, default=30)
    parser.add_argument("--devices", type=int, default=16)
    parser.add_argument("--side", type=int, default=256, help="px, of the frames of array, memory")
    parser.add_argument("--folder", type=Path, default=Path("/dev/shm"))
    arguments = parser.parse_args()
    unknown = [part for part in arguments.parts if part not in _PARTS]
    if unknown:
        parser.error(f"no part {unknown[0]!r}; there are {', '.join(_PARTS)}")
    parts = arguments.parts or list(_PARTS)
    if len(parts) > 1:
        options = sys.argv[1:]
        rest = [option for option in options if option not in _PARTS]
        for part in parts:
            subprocess.run([sys.executable, "-m", "tools.bench.capture", part, *rest], check=True)
        return
    layout = ImageLayout(arguments.side, arguments.side, 1, "uint8")
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        place = Path(folder)
        if parts == ["writers"]:
            # Its opponent is a package of the tests: the other parts run with numpy alone.
            from tools.bench.bench_mcap import bench_lines

            lines = bench_lines(place)
        elif parts == ["array"]:
            lines = record_array(arguments.devices, layout, arguments.seconds, place).lines()
        else:
            lines = memory_lines(arguments.devices, layout, arguments.takes, place)
    print("\n".join(lines), flush=True)


def memory_lines(devices: int, layout: ImageLayout, takes: int, place: Path) -> list[str]:
    """Resident memory at the start, middle and end of a session."""
    resident = session_memory(devices, layout, takes, place)
    return [
        f"resident memory over {takes} takes of {devices} devices: start {resident[0]:.0f} MB, "
        f"middle {resident[takes // 2]:.0f} MB, end {resident[-1]:.0f} MB"
    ]


if __name__ == "__main__":
    main()
