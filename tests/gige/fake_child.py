"""One fake camera of Aravis, run as a child in a network namespace of its own.

Orders come by line on standard input, each answered by a line: ``loss 0.01`` sets the share of
packets that are lost at the sender, ``rate 1000`` how often software triggers are looked at.
"""

from __future__ import annotations

import sys

import gi

gi.require_version("Aravis", "0.8")
from gi.repository import Aravis  # noqa: E402


def main() -> None:
    interface, serial = sys.argv[1:3]
    fake = Aravis.GvFakeCamera.new(interface, serial)
    print("running" if fake.is_running() else "not running", flush=True)
    for line in sys.stdin:
        order, value = line.split()
        if order == "loss":
            fake.set_property("gvsp-lost-ratio", float(value))
        elif order == "rate":
            fake.get_fake_camera().set_trigger_frequency(float(value))
        print("done", flush=True)


if __name__ == "__main__":
    main()
