"""A virtual machine with the kernel's vivid driver, that runs a command on the host's files.

The guest reads the host's whole file system over 9p beneath a tmpfs: it runs the host's Python and
this repository, and what it writes is gone when it ends, but for the folder it shares.
"""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BUILT = ROOT / "build" / "v4l2"

# Four webcams of the single-planar interface, and one of the other kind, which is refused.
VIVID_OPTIONS = (
    "n_devs=5 node_types=0x1,0x1,0x1,0x1,0x1 num_inputs=1,1,1,1,1 "
    "input_types=0,0,0,0,0 multiplanar=1,1,1,1,2"
)


@dataclass(frozen=True)
class GuestRun:
    """How a command ended in the guest.

    Attributes:
        status: its exit status; None when it did not end in time.
        console: what the guest printed.
        booted_s: from the kernel's start to the command.
        ended_s: to the command's end.
    """

    status: int | None
    console: str
    booted_s: float
    ended_s: float


def why_not() -> str:
    """Why no guest can be started; empty when one can."""
    reason = BUILT / "unavailable"
    if reason.exists():
        return reason.read_text(encoding="utf-8").strip()
    if not (BUILT / "guest.cpio.gz").exists() or shutil.which("qemu-system-x86_64") is None:
        return "no guest is set up; run tools/setup_v4l2.sh, or make test-v4l2"
    return ""


def run_in_guest(command: str, share: Path, timeout_s: float) -> GuestRun:
    """Boot the guest, run a shell command in the repository, and switch it off.

    Args:
        command: what `sh` runs, in the repository's folder.
        share: a folder of the host that the guest may write to, there /share.
        timeout_s: after which the machine is killed.
    """
    share.mkdir(parents=True, exist_ok=True)
    (share / "vivid.options").write_text(VIVID_OPTIONS + "\n", encoding="utf-8")
    lines = ("export HOME=/tmp TMPDIR=/tmp PYTHONDONTWRITEBYTECODE=1", f"cd '{ROOT}'", command)
    (share / "run.sh").write_text("\n".join(lines) + "\n", encoding="utf-8")
    console = share / "console.txt"
    # numpy wants the instructions of a Nehalem at least; KVM is not asked for, since it is seldom
    # there inside another virtual machine. The guest's time is counted in instructions and jumps
    # while it idles: a busy host makes the run longer, and no frame late.
    # Guards against Meltdown throw the emulator's page tables away at every call of the kernel.
    arguments = [
        "qemu-system-x86_64", "-accel", "tcg,thread=single", "-icount", "shift=2,sleep=off",
        "-rtc", "clock=vm", "-cpu", "Nehalem", "-smp", "1", "-m", "1024",
        "-nodefaults", "-display", "none", "-serial", "stdio", "-no-reboot",
        "-kernel", str(BUILT / "vmlinuz"), "-initrd", str(BUILT / "guest.cpio.gz"),
        "-append", "console=ttyS0 panic=-1 quiet mitigations=off nopti nowatchdog audit=0",
        "-virtfs",
        "local,path=/,security_model=none,mount_tag=host,readonly=on,multidevs=remap",
        "-virtfs", f"local,path={share},security_model=none,mount_tag=share",
    ]  # fmt: skip
    with console.open("wb") as out:
        try:
            subprocess.run(
                arguments, stdin=subprocess.DEVNULL, stdout=out, stderr=out,
                timeout=timeout_s, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            out.write(f"\nthe guest did not end in {timeout_s:.0f} s\n".encode())
    status = _number(share / "status")
    return GuestRun(
        None if status is None else int(status),
        console.read_text(encoding="utf-8", errors="replace"),
        _number(share / "booted_s") or 0.0,
        _number(share / "ended_s") or 0.0,
    )


def _number(path: Path) -> float | None:
    try:
        return float(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
